"""Sessions at URLs as sources of bytes, with few requests, many at a time; and the objects of folders in buckets.

Opening asks for the last 512 KiB, which hold the index of most sessions and a copy of their head (lookup.py);
files without copies are asked for the first 256 KiB, too. Both, and the rest of a longer index, are remembered for a
while, because a session is opened several times in a row. What `prefetch` announces is fetched at once, a bounded
number of bytes ahead; ranges near each other are one request. Each answer must be of the object that was
opened. Nothing lists the files of an http server.
"""

from __future__ import annotations

import fnmatch
import glob
import threading
import time
import weakref
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from flowrec.core import Closing, SessionError
from flowrec.store.object_requests import CONNECTIONS, Answer, ListedObject, ObjectRequests, listing, requests_for
from flowrec.store.session_path import UrlPath
from flowrec.store.traffic import TRAFFIC, MissingError, ask_repeatedly, timeout_s

_END_BYTES, _HEAD_BYTES = 512 << 10, 256 << 10
_AHEAD_BYTES = 64 << 20
_GAP_BYTES, _JOINED_BYTES = 64 << 10, 16 << 20
_BLOCK_BYTES = 4 << 20  # that are asked for at a time where one read begins at the end of the one before
_NEAR_BYTES = 1 << 20  # a read that ends so near before the known end is extended up to that
_REMEMBERED, _REMEMBERED_S = 64, 60.0  # openings, and for how long they hold
_TOGETHER = 8  # objects that are opened at a time


@dataclass(frozen=True, slots=True)
class _Opened:
    """An object as it was when it was opened."""

    requests: ObjectRequests
    tail: Answer
    until_s: float
    head: Answer | None = None

    @property
    def known(self) -> tuple[Answer, ...]:
        """The bytes that need not be asked for."""
        return (self.tail,) if self.head is None else (self.tail, self.head)


@dataclass(slots=True)
class _Ahead:
    """A range that was asked for ahead; `waits` announced ranges of it have not been read."""

    first: int
    end: int
    waits: int
    answer: Future[Answer]


_remembered: OrderedDict[str, _Opened] = OrderedDict()
_remembering = threading.Lock()


class RemoteFile(Closing):
    """An object at a URL, whose bytes are read as those of a LocalFile.

    Attributes
    ----------
    version : the server's word for its content.
    is_far : as of a LocalFile.

    Raises
    ------
    SessionError : the server does not answer, in one line; MissingError: it is not there, or access is refused.
    UsageError : the extra `remote` is not installed, or the time limit is no number.
    """

    is_far = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self._url = str(path)
        self._threads = ThreadPoolExecutor(CONNECTIONS, "remote-file")
        self._closer = weakref.finalize(self, self._threads.shutdown, wait=False, cancel_futures=True)
        self._ahead: list[_Ahead] = []
        self._block: Answer | None = None  # of a reader that goes through the file
        self._last_end = 1 << 63  # nothing was read
        self._lock = threading.Lock()
        try:
            self._object = self._open()
        except BaseException:
            self.close()
            raise
        self.size, self.version = self._object.tail.size, self._object.tail.version

    def read(self, offset: int, length: int) -> bytes:
        """As of a LocalFile."""
        if not self._closer.alive:
            raise SessionError(f"{self.path}: has been closed; open the session again")
        end = min(offset + length, self.size)
        if end <= offset:
            return b""
        opened = self._object
        answer = next((each for each in opened.known if _holds(each, offset, end)), None)
        if answer is not None:
            pass
        elif (ahead := self._take_ahead(offset, end)) is not None:
            answer = ahead.result()
        elif end > opened.tail.first - _NEAR_BYTES and opened.tail.first - offset <= _JOINED_BYTES:
            answer = self._longer_tail(opened, offset)
        elif end <= _HEAD_BYTES and opened.head is None:
            answer = self._range(0, min(_HEAD_BYTES, opened.tail.first))
            self._remember(opened, replace(opened, head=answer))
        else:
            answer = self._fetch_unannounced(offset, end)
        return answer.data[offset - answer.first : end - answer.first]

    def prefetch(self, ranges: Iterable[tuple[int, int]], gap_bytes: int | None = None) -> None:
        """Ask for ranges (offset, length) that will be read soon; those with no larger gap between are one request."""
        gap = _GAP_BYTES if gap_bytes is None else gap_bytes
        with self._lock:
            known: list[Answer | _Ahead] = [*self._object.known, *self._ahead]
            room = _AHEAD_BYTES - sum(each.end - each.first for each in self._ahead)
            joined: list[list[int]] = []
            for offset, length in sorted(ranges):
                end = min(offset + length, self.size)
                if length > _JOINED_BYTES or any(_holds(each, offset, end) for each in known):
                    continue
                last_one = joined[-1] if joined else None
                if last_one and offset - last_one[1] <= gap and end - last_one[0] <= _JOINED_BYTES:
                    last_one[1], last_one[2] = max(last_one[1], end), last_one[2] + 1
                else:
                    joined.append([offset, end, 1])
            for first, end, waits in joined:
                room -= end - first
                while room < 0 and self._ahead and self._ahead[0].answer.done():  # abandoned by who announced it
                    oldest = self._ahead.pop(0)
                    room += oldest.end - oldest.first
                if room < 0 or not self._closer.alive:
                    break  # it is read when its turn comes
                self._ahead.append(_Ahead(first, end, waits, self._threads.submit(self._range, first, end - first)))

    def close(self) -> None:
        """Release it; garbage collection releases it, too."""
        self._closer()

    def _take_ahead(self, offset: int, end: int) -> Future[Answer] | None:
        """The range ahead that has these bytes; it is forgotten with the last one that was announced."""
        with self._lock:
            for each in self._ahead:
                if _holds(each, offset, end):
                    each.waits -= 1
                    if not each.waits:
                        self._ahead.remove(each)
                    return each.answer
        return None

    def _fetch_unannounced(self, offset: int, end: int) -> Answer:
        """A range that holds these bytes; who reads on from where the last one ended gets more at a time."""
        with self._lock:
            block, last_end = self._block, self._last_end
            self._last_end = end
        if block is not None and _holds(block, offset, end):
            return block
        if not 0 <= offset - last_end <= _GAP_BYTES:
            return self._range(offset, end - offset)
        block = self._range(offset, min(max(end - offset, _BLOCK_BYTES), self.size - offset))
        with self._lock:
            self._block = block
        return block

    def _longer_tail(self, opened: _Opened, offset: int) -> Answer:
        """The end of the object from an offset on, remembered: a long index, and what stands before it."""
        first = max(0, offset - _GAP_BYTES)
        more = self._range(first, opened.tail.first - first)
        longer = replace(opened.tail, data=more.data + opened.tail.data, first=first)
        self._remember(opened, replace(opened, tail=longer))
        return longer

    def _remember(self, before: _Opened, opened: _Opened) -> None:
        self._object = opened
        with _remembering:
            if _remembered.get(self._url) is before:
                _remembered[self._url] = opened

    def _open(self) -> _Opened:
        with _remembering:
            known = _remembered.get(self._url)
        if known is not None and time.monotonic() < known.until_s:
            return known
        asked = requests_for(self._url, timeout_s())
        opened = _Opened(asked, self._answer(asked, None, _END_BYTES), time.monotonic() + _REMEMBERED_S)
        with _remembering:
            _remembered[self._url] = opened
            _remembered.move_to_end(self._url)
            while len(_remembered) > _REMEMBERED:
                _remembered.popitem(last=False)
        return opened

    def _range(self, first: int, length: int) -> Answer:
        answer, before = self._answer(self._object.requests, first, length), self._object.tail
        if (answer.version, answer.size) != (before.version, before.size):  # it is of another object
            forget(self.path)
            raise SessionError(f"{self.path}: was replaced while it was read; open it again")
        if (answer.first, len(answer.data)) != (first, length):
            raise SessionError(f"{self.path}: the server sent other bytes than those that were asked for")
        return answer

    def _answer(self, asked: ObjectRequests, first: int | None, length: int) -> Answer:
        answer = ask_repeatedly(
            self.path, lambda limit_s: asked.get(first, length, limit_s), lambda: self._closer.alive
        )
        TRAFFIC.add(nbytes=len(answer.data))
        return answer


def _holds(known: Answer | _Ahead, offset: int, end: int) -> bool:
    return known.first <= offset and end <= known.end


def forget(path: Path) -> None:
    """Ask again what an object holds when it is opened next."""
    with _remembering:
        _remembered.pop(str(path), None)


def are_there(paths: Sequence[Path]) -> list[bool]:
    """True for each object that can be opened, asked for together; those are opened again without a request.

    Raises SessionError: a server does not say.
    """
    threads = ThreadPoolExecutor(_TOGETHER)
    try:
        return list(threads.map(_is_there, paths))
    finally:
        threads.shutdown(wait=False, cancel_futures=True)  # one that is interrupted waits for no server


def _is_there(path: Path) -> bool:
    try:
        RemoteFile(path).close()
    except MissingError:
        return False
    return True


def is_listed(url: Path) -> bool:
    """True if the folders of this server can be listed."""
    return not str(url).startswith(("http://", "https://"))


def objects_in(folder: UrlPath, begin: str = "") -> list[tuple[UrlPath, ListedObject]]:
    """The objects of a folder in a bucket, in order of name, and what the listing says of each.

    `begin`: only those whose names begin so. Raises SessionError: the folder can not be listed; MissingError if there
    is no such bucket, or access is refused.
    """
    if not is_listed(folder):
        raise SessionError(f"{folder}: a server of http does not list its files; name the sessions one by one")
    found = ask_repeatedly(folder, lambda limit_s: listing(str(folder), begin, limit_s))
    return [(folder / each.name, each) for each in found]


def files_at(place: UrlPath, suffixes: Sequence[str]) -> list[Path]:
    """The files that a URL names: of a folder, or of a pattern such as `s3://lab/runs/*.mcap`; else itself.

    `suffixes`: of the files that are wanted; a URL that ends so is no folder. Raises SessionError: the folder can not
    be listed, holds nothing, or a pattern is not in the last part of the URL.
    """
    if glob.has_magic(str(place.parent)):
        raise SessionError(f"{place}: a pattern at a URL stands after its last slash, as in s3://lab/runs/*.mcap")
    pattern = place.name if glob.has_magic(place.name) else ""
    if not pattern and place.name.endswith(tuple(suffixes)):
        return [place]
    folder = place.parent if pattern else place
    assert isinstance(folder, UrlPath)
    found = [path for path, _ in objects_in(folder, pattern.partition("*")[0] if "[" not in pattern else "")]
    if not found:
        raise MissingError(f"{place}: no file is there; check the name, or name a folder in it")
    return [
        path
        for path in found
        if path.name.endswith(tuple(suffixes)) and (not pattern or fnmatch.fnmatchcase(path.name, pattern))
    ]
