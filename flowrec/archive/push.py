"""`flowrec push`: sessions to a bucket of S3, as they are, with all parts of a run and the notes beside it.

An object that is there is never replaced by other content. Only the notes, to which lines are added, are written anew
where the bucket has the beginning of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from flowrec.core import SessionError, UsageError, progress, say
from flowrec.store import (
    SESSION_SUFFIX,
    TRAFFIC,
    Bucket,
    Content,
    HiddenError,
    MissingError,
    Run,
    StoreError,
    UrlPath,
    content_of_file,
    forget,
    notes_content,
    notes_file,
    on_this_machine,
    open_bytes,
    session_path,
    session_sha256,
    signature_file,
)

_RANGE_BYTES = 64 << 10  # that is read back at a time
_RANGE_EVERY_BYTES = 256 << 20  # of an object, one range more is read back
_BY_ALL = "by reading all of it"


@dataclass(frozen=True, slots=True)
class PushedFile:
    """An object that holds a file, compared with it."""

    file: Path
    url: UrlPath
    size_bytes: int
    sent_bytes: int  # what was sent by this call; 0 if it was there already, less than `size_bytes` if it was resumed
    sha256: str  # of the file
    # how, in words: by reading back what was sent, all of it or, where the ETag of the store is that of the content,
    # some ranges; '' where these credentials may not read it
    compared: str

    def __str__(self) -> str:
        if not self.sent_bytes and self.size_bytes:
            return f"{self.url}: is there already, the same"
        resumed = f", {self.sent_bytes / 1e6:.1f} MB of them now" if self.sent_bytes < self.size_bytes else ""
        how = f"compared {self.compared}" if self.compared else "not compared: these credentials may not read it"
        return f"{self.url}: {self.size_bytes / 1e6:.1f} MB sent{resumed}, {how}"


@dataclass(slots=True)
class Pushed:
    """Sessions that were pushed, and the errors of those that were not.

    `failed`: errors, by session.
    """

    target: str
    files: list[PushedFile] = field(default_factory=list)
    failed: dict[Path, str] = field(default_factory=dict)

    @property
    def exit_status(self) -> int:
        """0 all is there, 1 a session is not, 3 all was sent, and what could not be read back may not be there."""
        return 1 if self.failed else 0 if all(each.compared for each in self.files) else 3

    def as_json(self) -> dict[str, Any]:
        objects = [asdict(each) | {"file": str(each.file), "url": str(each.url)} for each in self.files]
        failed = [{"session": str(path), "error": text} for path, text in self.failed.items()]
        return {"target": self.target, "objects": objects, "failed": failed, "repeated_requests": TRAFFIC.repeated}


def push(sessions: Sequence[Path], target: str) -> Pushed:
    """Copy sessions into a folder of a bucket, each under its name; what is there already is passed over.

    Parameters
    ----------
    sessions : files, or runs X.mcap with all their parts.
    target : the folder, as in s3://lab/runs.

    Raises
    ------
    UsageError : the target is no folder of S3, or two sessions have one name.
    StoreError : the bucket can not be written. A session that is damaged or unfinished, or whose name has another
        content there, is named in the result, and the others are pushed.
    """
    bucket, pushed = Bucket(_folder(target)), Pushed(target)
    files: dict[Path, list[Path]] = {}
    for session in sessions:
        path = on_this_machine(session, "nothing is pushed from")
        try:
            files[path] = _files(path)
        except SessionError as error:
            pushed.failed[path] = str(error)
    known: dict[str, Path] = {}
    total = 0
    for file in (file for some in files.values() for file in some):
        if (other := known.setdefault(file.name, file)) is not file:
            raise UsageError(f"{file}: has the name of {other}; push them to two folders")
        total += file.stat().st_size
    before = 0
    with progress("pushing", max(total, 1), "bytes") as bar:

        def advance(nbytes: int) -> None:
            bar(before + nbytes)

        for path, some in files.items():
            try:
                for file in some:
                    bar.stage(file.name)
                    done = _push_one(bucket, path, file, advance)
                    say(str(done))
                    pushed.files.append(done)
                    before += done.size_bytes
            except StoreError:
                raise  # the bucket can not be written: all others would fail likewise
            except SessionError as error:
                pushed.failed[path] = str(error)
    return pushed


def _folder(target: str) -> UrlPath:
    folder = session_path(target)
    if not isinstance(folder, UrlPath) or not str(folder).startswith("s3://"):
        raise UsageError(
            f"{target}: is no folder of S3, as in s3://lab/runs (AWS_ENDPOINT_URL names any store with its interface); "
            "other stores have programs of their own to copy files"
        )
    if folder.suffix == ".mcap":
        raise UsageError(f"{target}: name a folder, as in s3://lab/runs; a session keeps its name")
    return folder


def _files(session: Path) -> list[Path]:
    """The files of a session, and its notes; SessionError where it is no whole session."""
    files, notes = [file.path for file in Run.at(session).files], notes_file(session)
    return [*files, *(beside for beside in (notes, *map(signature_file, files)) if beside.is_file())]


def _push_one(bucket: Bucket, session: Path, file: Path, done: Callable[[int], None]) -> PushedFile:
    if file == notes_file(session):
        return _pushed_notes(bucket, file)
    stored = bucket.stat(file.name)
    if stored is None and file.suffix != SESSION_SUFFIX:  # a signature
        sent = bucket.upload(file, done)
    elif stored is None:
        from flowrec.verbs import check  # late: it takes a second

        verdict = check(file)
        if verdict.exit_status == 1:
            worst = next(each.text for each in verdict.findings if each.level == "bad")
            raise SessionError(f"{file}: is not pushed, {worst}")
        sent = bucket.upload(file, done)
        if sent is not None:
            content, url = sent.content, bucket.url(file.name)
            compared = _read_back(url, file, content, sent.etag)
            return PushedFile(file, url, content.size, sent.sent_bytes, content.sha256, compared)
        stored = bucket.stat(file.name)  # it has come meanwhile
    return _same(bucket.url(file.name), file, stored, done)


def _same(url: UrlPath, file: Path, stored: tuple[int, str] | None, done: Callable[[int], None]) -> PushedFile:
    """The file and the object of its name, if they hold the same; SessionError if not."""
    size_bytes, etag = stored or (0, "")
    if size_bytes == file.stat().st_size:
        content = content_of_file(file, done)
        if etag == content.etag:
            return PushedFile(file, url, content.size, 0, content.sha256, "by its ETag")
        forget(url)
        if session_sha256([url]) == content.sha256:
            return PushedFile(file, url, content.size, 0, content.sha256, _BY_ALL)
    raise SessionError(f"{url}: is there with another content than {file}, and stays; push to another folder")


def _read_back(url: UrlPath, file: Path, content: Content, etag: str) -> str:
    """Compare an object with the file that was sent to it; returns how, '' where these credentials may not read.

    The answer to what was sent is no evidence, a store may keep nothing. An ETag that is the MD5 of the content says
    that all of it has arrived; then ranges of what is stored are read, its beginning and end among them. Raises
    SessionError: it does not hold what was sent.
    """
    wrong = SessionError(f"{url}: does not hold what was sent; delete it, and push again")
    forget(url)
    try:
        with open_bytes(url) as stored, open_bytes(file) as sent:
            if stored.size != content.size:
                raise wrong
            if etag != content.etag:
                if session_sha256([url]) != content.sha256:
                    raise wrong
                return _BY_ALL
            ranges = _ranges(content.size)
            if any(stored.read(*each) != sent.read(*each) for each in ranges):
                raise wrong
    except HiddenError:
        return ""
    except MissingError as error:
        raise SessionError(f"{url}: is not there, although the store has taken it; is this a store of S3?") from error
    return f"by its ETag and {len(ranges)} of its ranges"


def _ranges(size: int) -> list[tuple[int, int]]:
    """Ranges (offset, length) that are read back: begin, middle, end, and others so that 256 MB lie between two."""
    length, steps = min(_RANGE_BYTES, size), 2 + size // _RANGE_EVERY_BYTES
    return [(offset, length) for offset in sorted({number * (size - length) // steps for number in range(steps + 1)})]


def _pushed_notes(bucket: Bucket, file: Path) -> PushedFile:
    """Notes are small, and lines are only ever added to them: what is there may be the beginning, or have more."""
    here, url, stored = content_of_file(file), bucket.url(file.name), bucket.stat(file.name)
    data = notes_content(file)
    forget(url)
    there = b"" if stored is None else notes_content(url)
    if stored is not None and there.startswith(data):
        return PushedFile(file, url, here.size, 0, here.sha256, _BY_ALL)
    if not data.startswith(there) or bucket.put(file.name, data, "" if stored is None else stored[1]) is None:
        raise SessionError(f"{url}: has other notes than {file}, and stays; put them together by hand")
    return PushedFile(file, url, here.size, len(data), here.sha256, _read_back(url, file, here, ""))
