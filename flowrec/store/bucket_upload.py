"""Files to a bucket of S3: in parts, a few at a time, resumed from what the bucket has, never over other content.

No state is kept on this machine: an upload that was interrupted stays in the bucket with its parts, and is found by the
name of its object. Each part is sent with its MD5, which the server compares. obstore, which reads and lists buckets,
can neither continue an upload nor write in parts only where no object is, so this is done with botocore.
"""

from __future__ import annotations

import base64
import hashlib
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from flowrec.core import Closing, SessionError, UsageError
from flowrec.store.object_requests import NOT_OFFERED, in_a_line, of_status, reason
from flowrec.store.session_path import UrlPath
from flowrec.store.traffic import MissingError, RefusedError, TransientError, ask_repeatedly, timeout_s

_PART_BYTES = 16 << 20
_MOST_PARTS = 10_000  # of an upload
_TOGETHER = 4  # parts that are sent at a time, and held in memory
_SLOWEST_BYTES_S = 250e3  # a part may take the time limit and what it takes at this rate
_CANDIDATES = 8  # interrupted uploads of the name that are looked at
# Where botocore may take credentials from: nothing that lies in a file of this user.
_PROVIDERS = ("env", "assume-role-with-web-identity", "container-role", "iam-role")
_AGAIN = ("BadDigest", "RequestTimeout", "SlowDown", "Throttling", "OperationAborted", "ConditionalRequestConflict")
_LOOKS = ("head_object", "list_multipart_uploads", "list_parts")  # who may write may not always look


class StoreError(SessionError):
    """The bucket does not take what is sent; for any other session it would be the same."""


@dataclass(frozen=True, slots=True)
class Content:
    """Size and hashes of a file."""

    size: int  # in bytes
    sha256: str  # of all bytes
    etag: str  # that S3 gives to an object that was sent in parts of our size


@dataclass(frozen=True, slots=True)
class Sent:
    """A file that has become an object."""

    content: Content  # of the file
    sent_bytes: int  # what was sent now; less than the size where an upload was resumed
    etag: str  # that the store gave to the object


class LocalParts(Closing):
    """A file, in the parts in which it is sent.

    `content`: of the file, once `read_all` has come to its end. Raises SessionError: it can not be read, or changes
    while it is read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._read_errors():
            self._file = path.open("rb")
            self._stat = os.fstat(self._file.fileno())
        self.size = self._stat.st_size
        self.part_bytes = max(_PART_BYTES, -(-self.size // _MOST_PARTS))
        self.count = max(1, -(-self.size // self.part_bytes))

    def length(self, number: int) -> int:
        """Bytes of a part, from 1."""
        return min(self.part_bytes, self.size - (number - 1) * self.part_bytes)

    def read(self, number: int) -> bytes:
        """The bytes of a part, from 1."""
        with self._read_errors():
            self._file.seek((number - 1) * self.part_bytes)
            data = self._file.read(self.length(number))
            now = os.fstat(self._file.fileno())
        if len(data) != self.length(number) or (now.st_size, now.st_mtime_ns) != (self.size, self._stat.st_mtime_ns):
            raise SessionError(f"{self.path}: changes while it is sent; push it when it is finished")
        return data

    def read_all(self) -> Iterator[tuple[int, bytes, bytes]]:
        """Number, bytes and MD5 of each part, in order."""
        sha256, md5s = hashlib.sha256(), list[bytes]()
        for number in range(1, self.count + 1):
            data = self.read(number)
            sha256.update(data)
            md5s.append(_md5(data))
            yield number, data, md5s[-1]
        etag = md5s[0].hex() if len(md5s) == 1 else f"{_md5(b''.join(md5s)).hex()}-{len(md5s)}"
        self.content = Content(self.size, sha256.hexdigest(), etag)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @contextmanager
    def _read_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise SessionError(f"{self.path}: can not be read ({error.strerror or error})") from error


def content_of_file(path: Path, progress: Callable[[int], None] = lambda _: None) -> Content:
    """Size and hashes of a file; `progress` takes the bytes that have been read. SessionError if it can not be read."""
    with LocalParts(path) as parts:
        for number, _, _ in parts.read_all():
            progress(min(number * parts.part_bytes, parts.size))
        return parts.content


class Bucket:
    """A folder in a bucket of S3 that files are sent to; credentials and endpoint come from the environment.

    Raises UsageError: the extra `remote` is not installed; StoreError: from any method: the bucket can not be written,
    in one line.
    """

    def __init__(self, folder: UrlPath) -> None:
        self._folder = folder
        self._bucket, _, self._prefix = str(folder).partition("://")[2].partition("/")
        try:
            self._client = _client(folder)
        except ImportError as error:
            raise UsageError(f"{folder}: writing to S3 needs a package; pip install 'flowrec[remote]'") from error

    def url(self, name: str) -> UrlPath:
        """URL of an object in the folder."""
        return self._folder / name

    def stat(self, name: str) -> tuple[int, str] | None:
        """Size in bytes and ETag of an object; None if there is none, or this user may not know."""
        head = self._ask(name, "head_object")
        return None if head is None else (head["ContentLength"], _etag(head))

    def put(self, name: str, data: bytes, replaces: str = "") -> str | None:
        """Write a small object where none is, or only over the one with an ETag; its ETag, None if there is another."""
        condition: dict[str, Any] = {"IfMatch": replaces} if replaces else {"IfNoneMatch": "*"}
        md5 = base64.b64encode(_md5(data)).decode()
        made = self._ask(name, "put_object", len(data), Body=data, ContentMD5=md5, **condition)
        return None if made is None else _etag(made)

    def upload(self, path: Path, progress: Callable[[int], None]) -> Sent | None:
        """Send a file; None if there is an object of its name already.

        `progress`: takes the bytes of the file that the bucket has.
        """
        name = path.name
        with LocalParts(path) as parts:
            if parts.count > 1:
                return _Upload(partial(self._ask, name), self._key(name), parts).run(progress)
            ((_, data, _),) = parts.read_all()
            etag = self.put(name, data)
            progress(parts.size)
            return None if etag is None else Sent(parts.content, parts.size, etag)

    def _key(self, name: str) -> str:
        return f"{self._prefix}/{name}".lstrip("/")

    def _ask(
        self, name: str, verb: str, nbytes: int = 0, wanted: Callable[[], bool] = lambda: True, **words: Any
    ) -> Any:
        """The answer of S3; None where a condition is not met, an upload has ended, or there is nothing to look at."""
        named = {"Prefix" if verb == "list_multipart_uploads" else "Key": self._key(name)}

        def once(_: float) -> Any:
            from botocore import exceptions

            try:
                return getattr(self._client, verb)(Bucket=self._bucket, **named, **words)
            except (exceptions.ClientError, exceptions.BotoCoreError, RecursionError) as error:
                if (ours := _ours(error)) is None:
                    return None
                raise ours from error

        try:
            return ask_repeatedly(self.url(name), once, wanted, timeout_s() + nbytes / _SLOWEST_BYTES_S, "written")
        except SessionError as error:
            if isinstance(error, MissingError) and verb in _LOOKS:
                return None
            raise StoreError(str(error)) from error


class _Upload:
    """The upload of one file in parts: a new one, or what an interrupted one has left."""

    def __init__(self, ask: Callable[..., Any], key: str, parts: LocalParts) -> None:
        self._ask, self._key, self._parts = ask, key, parts
        self._there: dict[int, str] = {}  # ETags by number
        self._sending: set[Future[int]] = set()
        self._stop = threading.Event()
        self._sent_bytes = self._done_bytes = 0

    def run(self, progress: Callable[[int], None]) -> Sent | None:
        """Send what is missing and make the object; None if there is one of that name by now."""
        upload_id: str = self._find_interrupted() or self._ask("create_multipart_upload")["UploadId"]
        threads = ThreadPoolExecutor(_TOGETHER, "upload")
        try:
            for number, data, md5 in self._parts.read_all():
                if self._there.get(number) == md5.hex():
                    self._done_bytes += len(data)
                    progress(self._done_bytes)
                    continue
                self._wait(_TOGETHER - 1, progress)
                self._sending.add(threads.submit(self._send, upload_id, number, data, md5))
            self._wait(0, progress)
        finally:
            self._stop.set()
            threads.shutdown(wait=False, cancel_futures=True)
        listed = [{"PartNumber": number, "ETag": self._there[number]} for number in sorted(self._there)]
        made = self._ask(
            "complete_multipart_upload",
            UploadId=upload_id,
            MultipartUpload={"Parts": listed[: self._parts.count]},
            IfNoneMatch="*",
        )
        if made is None:
            self._ask("abort_multipart_upload", UploadId=upload_id)
            return None
        return Sent(self._parts.content, self._sent_bytes, _etag(made))

    def _find_interrupted(self) -> str | None:
        """An interrupted upload of this file: one of its name, whose first part holds the same."""
        uploads = (self._ask("list_multipart_uploads") or {}).get("Uploads", [])
        named = [each for each in uploads if each["Key"] == self._key]
        newest = sorted(named, key=lambda each: str(each.get("Initiated")), reverse=True)
        for upload in newest[:_CANDIDATES]:
            upload_id: str = upload["UploadId"]
            fits = {
                number: _etag(part)
                for part in self._list_parts(upload_id)
                if (number := part["PartNumber"]) <= self._parts.count and part["Size"] == self._parts.length(number)
            }
            if fits and fits[first := min(fits)] == _md5(self._parts.read(first)).hex():
                self._there = fits
                return upload_id
        return None

    def _list_parts(self, upload_id: str) -> Iterator[Mapping[str, Any]]:
        marker: dict[str, int] = {}
        while True:
            found = self._ask("list_parts", UploadId=upload_id, **marker) or {}  # none where it has ended meanwhile
            yield from found.get("Parts", [])
            if not found.get("IsTruncated"):
                return
            marker = {"PartNumberMarker": found["NextPartNumberMarker"]}

    def _send(self, upload_id: str, number: int, data: bytes, md5: bytes) -> int:
        if self._stop.is_set():
            return 0
        digest = base64.b64encode(md5).decode()
        words = {"UploadId": upload_id, "PartNumber": number, "Body": data, "ContentMD5": digest}
        sent = self._ask("upload_part", len(data), lambda: not self._stop.is_set(), **words)
        if sent is None:
            raise StoreError(f"{self._parts.path}: its upload was ended by somebody else; the same command goes on")
        self._there[number] = _etag(sent)
        return len(data)

    def _wait(self, left: int, progress: Callable[[int], None]) -> None:
        """Until so many parts are left that are being sent; the error of a part is raised here."""
        while len(self._sending) > left:
            sent, self._sending = wait(self._sending, return_when=FIRST_COMPLETED)
            for length in (future.result() for future in sent):
                self._sent_bytes += length
                self._done_bytes += length
                progress(self._done_bytes)


def _ours(error: Exception) -> Exception | None:
    """Our error for one of botocore; None for a condition that is not met, or an upload that has ended."""
    from botocore import exceptions

    if isinstance(error, exceptions.ClientError):
        status = int(error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0))
        code = str(error.response.get("Error", {}).get("Code", ""))
        if status == 412 or code == "NoSuchUpload":
            return None
        if code == "NoSuchBucket":
            return RefusedError("there is no such bucket (404); check its name")
        if status == 301 or code == "AuthorizationHeaderMalformed":
            return RefusedError(f"the bucket is in another region ({status}); set AWS_REGION")
        if code in _AGAIN:
            return TransientError(f"the server answers {code}")
        found = of_status(status)
        if status == NOT_OFFERED:
            return RefusedError(f"can not be written: the store does not offer what push needs ({status} {code[:60]})")
        if isinstance(found, RefusedError) and found.kind is SessionError:
            return RefusedError(f"the server answers {status} {code[:60]}")
        return found
    if isinstance(error, exceptions.NoCredentialsError | exceptions.PartialCredentialsError):
        return RefusedError("can not be written: there are no credentials in the environment (AWS_ACCESS_KEY_ID, ...)")
    if isinstance(error, exceptions.ReadTimeoutError | exceptions.ConnectTimeoutError):
        return TransientError("the server does not answer in time")
    if isinstance(error, exceptions.HTTPClientError | exceptions.ConnectionError):
        return TransientError(reason(in_a_line(error)))
    if isinstance(error, RecursionError):  # botocore follows a bucket to its region, and a server that sends it on
        return RefusedError("is redirected without end; check AWS_ENDPOINT_URL and AWS_REGION")
    return RefusedError(f"can not be asked for ({type(error).__name__}); check the environment")


def _client(folder: UrlPath) -> Any:
    import botocore.session
    from botocore.config import Config
    from botocore.exceptions import BotoCoreError

    environment = os.environ
    named = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")  # that obstore takes, too
    endpoint = next((environment[key] for key in named if environment.get(key)), None)
    virtual = environment.get("AWS_VIRTUAL_HOSTED_STYLE_REQUEST", "").lower() == "true"
    limit_s = timeout_s()
    config = Config(
        connect_timeout=min(5.0, limit_s),
        read_timeout=limit_s,
        retries={"total_max_attempts": 1},  # traffic.py repeats, and counts
        max_pool_connections=_TOGETHER + 1,
        s3={"addressing_style": "path" if endpoint and not virtual else "auto"},
        request_checksum_calculation="when_required",  # the MD5 is known to every store
        response_checksum_validation="when_required",
    )
    region = environment.get("AWS_REGION") or environment.get("AWS_DEFAULT_REGION") or "us-east-1"
    try:
        session = botocore.session.get_session()
        resolver = session.get_component("credential_provider")
        resolver.providers = [each for each in resolver.providers if each.METHOD in _PROVIDERS]
        return session.create_client("s3", region_name=region, endpoint_url=endpoint, config=config)
    except (BotoCoreError, ValueError) as error:
        raise StoreError(f"{folder}: can not be written ({type(error).__name__}); check the environment") from error


def _md5(data: bytes) -> bytes:
    return hashlib.md5(data, usedforsecurity=False).digest()


def _etag(answer: Mapping[str, Any]) -> str:
    return str(answer.get("ETag", "")).strip('"')
