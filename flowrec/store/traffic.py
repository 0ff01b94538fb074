"""Requests to servers: repeated while a failure may pass, within a time limit, and counted."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from flowrec.core import SessionError, UsageError

TIMEOUT_KEY = "FLOWREC_TIMEOUT_S"  # environment variable; the option --timeout sets it
_TIMEOUT_S = 30.0  # of a request, with all of its tries
_TRIES, _PAUSE_S = 4, 0.2  # of a request; the pause before the second try, doubled each time
_NAMED = 3  # causes of repetitions that are named
_Answered = TypeVar("_Answered")


class TransientError(Exception):
    """A failure that may not come again: no connection, a time limit, a server in trouble, a body that was cut."""


class MissingError(SessionError):
    """No file or object of that name can be read: there is none, or access to the object is refused."""


class HiddenError(MissingError):
    """Access to the object is refused."""


class RefusedError(Exception):
    """A failure that the same request will meet again; `kind` of error is raised for it."""

    def __init__(self, text: str, kind: type[SessionError] = SessionError) -> None:
        super().__init__(text)
        self.kind = kind


@dataclass(slots=True)
class Traffic:
    """Statistics of the requests of this process to servers.

    Attributes
    ----------
    requests, repeated : number of requests, and how many of them repeated a failed one.
    nbytes : bytes of content received.
    reasons : why requests were repeated, and how often.
    """

    requests: int = 0
    repeated: int = 0
    nbytes: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, requests: int = 0, nbytes: int = 0, repeated: str = "") -> None:
        """Count, from any thread; `repeated` says why a request is made again."""
        with self._lock:
            self.requests += requests
            self.nbytes += nbytes
            if repeated:
                self.repeated += 1
                self.reasons[repeated] += 1

    @property
    def line(self) -> str:
        """Number of requests that were repeated, with the reasons; '' where none was."""
        count = self.reasons.total()
        if not count:
            return ""
        many = f"{count} requests were" if count > 1 else "1 request was"
        named = self.reasons.most_common(_NAMED)
        causes = [f"{reason} ({number})" for reason, number in named]
        if (others := count - sum(number for _, number in named)) > 0:
            causes.append(f"other causes ({others})")
        return f"{many} repeated: {', '.join(causes)}"


TRAFFIC = Traffic()


def ask_repeatedly(
    path: Path,
    ask: Callable[[float], _Answered],
    wanted: Callable[[], bool] = lambda: True,
    limit_s: float | None = None,
    done: str = "read",
) -> _Answered:
    """An answer, after several tries and within the time limit.

    Raises SessionError: there is none, in one line; MissingError if that is because of this object.

    Parameters
    ----------
    path : what is asked for, for messages.
    ask : makes the request, which may take a time in s.
    wanted : whether it is still worth a try.
    limit_s : time limit of all tries together in s; None: that of a request.
    done : what could not be done with it, for messages.
    """
    end_s = time.monotonic() + (limit_s or timeout_s())
    reason = ""
    for number in range(_TRIES):
        TRAFFIC.add(requests=1, repeated=reason)
        try:
            return _unless_interrupted(ask, max(0.1, end_s - time.monotonic()))
        except RefusedError as error:
            raise error.kind(f"{path}: {error}") from error
        except TransientError as error:
            pause_s, reason = _PAUSE_S * 2.0**number, str(error)
            if number == _TRIES - 1 or time.monotonic() + pause_s > end_s or not wanted():
                tries = f"{number + 1} tries" if number else "one try"
                raise SessionError(
                    f"{path}: can not be {done} ({error}, {tries}); check address and connection"
                ) from error
            time.sleep(pause_s)
    raise AssertionError("the last try raises or returns")


def _unless_interrupted(ask: Callable[[float], _Answered], limit_s: float) -> _Answered:
    """The answer. Clients of compiled code take no signal while they wait, so the main thread waits beside one."""
    if threading.current_thread() is not threading.main_thread():
        return ask(limit_s)
    answered: Future[_Answered] = Future()

    def work() -> None:
        try:
            answered.set_result(ask(limit_s))
        except BaseException as error:  # noqa: BLE001 - the main thread raises it
            answered.set_exception(error)

    threading.Thread(target=work, name="request", daemon=True).start()
    return answered.result()


def timeout_s() -> float:
    """Time limit of a request in s; UsageError where the environment holds something else."""
    text = os.environ.get(TIMEOUT_KEY, "")
    try:
        limit_s = float(text) if text else _TIMEOUT_S
    except ValueError:
        limit_s = 0.0
    if not 0.0 < limit_s <= 3600.0:
        raise UsageError(f"{TIMEOUT_KEY}={text}: the time limit of a request is a number of seconds up to 3600")
    return limit_s
