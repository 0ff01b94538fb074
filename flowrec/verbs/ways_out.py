"""The ways in which a run ends, each tried with a field on: how long the coils take to go to zero."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from flowrec.core import FlowrecError, RigError, SessionError, say
from flowrec.run import RemoteControl
from flowrec.store import GrowingRun

if TYPE_CHECKING:
    from flowrec.stages import ResolvedConfig
    from flowrec.verbs.protocol_day import Day

_BEGIN_S = 180.0  # until a run makes a field: the first one of an installation compiles
_LONG_S = 60.0  # of a run that does not end by itself
_SHORT_S = 5.0  # of one that does
_MARGIN_S = 0.5  # of the instrument, and of a busy computer
_ORDERLY_S = 2.0  # a run that is ended has its file complete by then, and its coils are off
_POLL_S = 0.1


class Way(NamedTuple):
    """A way out."""

    name: str  # as in the key of an answer
    text: str  # for people
    # does it, to the recorder of a session; the coils have to go to zero from then on
    leave: Callable[[Day, subprocess.Popen[bytes], Path], object]
    limit_s: Callable[[ResolvedConfig], float]  # time that it may take


def _by_operator(_day: Day, _process: subprocess.Popen[bytes], session: Path) -> None:
    refused = RemoteControl(session).obey({"command": "zero", "text": ""})
    if refused:
        raise RigError(f"{session}: {refused}")


WAYS = (
    Way("end", "end of the run", lambda _day, process, _session: process.wait(), lambda _config: _MARGIN_S),
    Way(
        "ctrl_c",
        "Ctrl-C",
        lambda _day, process, _session: process.send_signal(signal.SIGINT),
        lambda _config: _ORDERLY_S,
    ),
    Way("operator", "zero by the operator", _by_operator, lambda _config: _MARGIN_S),
    Way(
        "kill",
        "kill -9",
        lambda _day, process, _session: process.kill(),
        lambda config: config.lab.guardian_s + _MARGIN_S,
    ),
    Way(
        "camera",
        "camera unplugged",
        lambda day, _process, _session: day.hand.pull_cable(pulled=True),
        lambda config: config.lab.camera_timeout_s + _MARGIN_S,
    ),
)


def zero_on_ways(day: Day) -> tuple[float, float, str]:
    """The longest time of all ways in % of what it may take, 100, and all of them as text.

    Raises FlowrecError: the time of a way is not known: nobody has read it, or its run made no field.
    """
    shares, told = [], []
    for way in WAYS:
        limit_s, given = way.limit_s(day.config), day.hand.number(f"zero_{way.name}_s")
        took_s = _time_of(day, way, limit_s) if given is None else given
        shares.append(took_s / limit_s)
        told.append(f"{way.text} {took_s:.2f} s of {limit_s:.2g}")
    return 100.0 * max(shares), 100.0, ", ".join(told)


def _time_of(day: Day, way: Way, limit_s: float) -> float:
    """Record until there is a field, leave, and see when the coils are off."""
    if not day.hand.sees_zero:
        raise RigError(f"nobody looks at an ammeter; measure each way, then --answer zero_{way.name}_s=SECONDS")
    session = day.new_path(f"zero_{way.name}")
    lasts_s = _SHORT_S if way.name == "end" else _LONG_S
    process = day.start(session, "mission.phases=survey", "recording.admission_s=0", f"duration_s={lasts_s}")
    try:
        _wait_for_field(session, process)
        way.leave(day, process, session)
        took_s = day.hand.zero_after_s(way.text, time.monotonic_ns(), 4.0 * limit_s)
    finally:
        if way.name == "camera":
            day.hand.pull_cable(pulled=False)
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate()
    say(f"  {way.text}: the coils were off after {took_s:.2f} s")
    return took_s


def _wait_for_field(session: Path, process: subprocess.Popen[bytes]) -> None:
    end_s = time.monotonic() + _BEGIN_S
    while process.poll() is None and time.monotonic() < end_s:
        try:
            for tick in GrowingRun(session).ticks():
                if tick.currents is not None and tick.currents.amplitude_mt > 0.0:
                    return
        except (SessionError, FileNotFoundError):  # its file is not there yet
            time.sleep(_POLL_S)
    raise FlowrecError(f"{session}: the run made no field in which the coils could stay on")
