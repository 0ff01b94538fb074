"""Range requests for an object at a URL: obstore for buckets, urllib3 for http and https.

Both have one verb, `get`, and raise errors of traffic.py, which repeats and counts requests. A bucket can be listed.
"""

from __future__ import annotations

import ipaddress
import os
import re
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any
from urllib.parse import urljoin, urlsplit

from flowrec.core import SessionError, UsageError
from flowrec.store.traffic import HiddenError, MissingError, RefusedError, TransientError

CONNECTIONS = 32  # requests at a time
_REDIRECTS = 3  # followed for one request
_PIECE_BYTES = 1 << 16
_ENDPOINTS = ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT", "AZURE_STORAGE_ENDPOINT", "GOOGLE_BASE_URL")
_CONTENT_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+)")
_OK, _PARTIAL, _NO_RANGE, NOT_OFFERED = 200, 206, 416, 501  # statuses of HTTP
_LATER = (408, 425, 429)  # a time limit, too early, too many requests
_NOT_INSTALLED = "{}: reading from a URL needs a package; pip install 'flowrec[remote]'"
_WHOLE_ONLY = "can not be read in ranges, the server sends whole files only; copy it to this machine"
_PACKED = "can not be read: the server compresses ranges ({}), which was not asked for; switch that off for .mcap"
_NO_RANGE_TOLD = "can not be read: the server answers 206 without a range"


@dataclass(frozen=True, slots=True)
class Answer:
    """The bytes of a range, and of which object."""

    data: bytes
    first: int  # offset of the first byte
    size: int  # of the whole object in bytes
    version: str  # the server's word for this content, its ETag or the time of its last change; '' where it has none

    @property
    def end(self) -> int:
        """Offset after the last byte."""
        return self.first + len(self.data)


class OtherRangeError(TransientError):
    """The server has sent another range than was asked for; `size` of the object is 0 where it is not known."""

    def __init__(self, text: str, size: int = 0) -> None:
        super().__init__(text)
        self.size = size


class ObjectRequests(ABC):
    """Requests for one object, from several threads at a time."""

    def get(self, first: int | None, length: int, timeout_s: float) -> Answer:
        """The bytes from `first` on, or the last ones where it is None; fewer where the object has no more.

        Raises
        ------
        TransientError, RefusedError : it failed, in a few words.
        """
        end_s = time.monotonic() + timeout_s
        try:
            return self._get(first, length, end_s)
        except OtherRangeError as error:  # a server that takes "the last bytes" for something else
            if first is not None:
                raise
            return self._get(max(0, error.size - length), length, end_s)

    @abstractmethod
    def _get(self, first: int | None, length: int, end_s: float) -> Answer:
        """Bytes as of `get`; OtherRangeError, with the size of the object, where the last ones are not to be had so."""


def requests_for(url: str, timeout_s: float) -> ObjectRequests:
    """The requests for the object at a URL.

    Raises UsageError: the packages of the extra `remote` are not installed, or the URL names a bucket or host alone;
    SessionError: the URL can not name an object.
    """
    if not url.partition("://")[2].partition("/")[2]:
        raise UsageError(f"{url}: names no object; name a session in it, as in {url.rstrip('/')}/run.mcap")
    try:
        return _Http(url) if url.startswith("http") else _Bucket(url, timeout_s)
    except ImportError as error:
        raise UsageError(_NOT_INSTALLED.format(url)) from error


@dataclass(frozen=True, slots=True)
class ListedObject:
    """An object of a bucket."""

    name: str  # after the folder that was listed
    size: int  # in bytes
    version: str  # as of an `Answer`


def listing(url: str, begin: str, timeout_s: float) -> list[ListedObject]:
    """The objects of a folder in a bucket, without folders in it, in order of name.

    `begin`: only those whose names begin so; few are asked for, however many are in the folder.

    Raises
    ------
    TransientError, RefusedError : it failed, in a few words.
    """
    try:
        bucket = _Bucket(url, timeout_s)
    except ImportError as error:
        raise UsageError(_NOT_INSTALLED.format(url)) from error
    return sorted(bucket.objects(begin), key=lambda each: each.name)


class _Bucket(ObjectRequests):
    """An object or folder of s3, gs or az; credentials and endpoint come from the environment."""

    def __init__(self, url: str, timeout_s: float) -> None:
        from obstore.exceptions import BaseError
        from obstore.store import from_url

        scheme, _, rest = url.partition("://")
        bucket, _, self._key = rest.partition("/")
        limit = timedelta(seconds=timeout_s)
        self._takes_suffix = scheme != "az"
        try:
            self._store = from_url(
                f"{scheme}://{bucket}",
                client_options={
                    "timeout": limit,
                    "connect_timeout": min(limit, timedelta(seconds=5)),
                    # Plain http is for an endpoint that somebody has named so.
                    "allow_http": any(os.environ.get(key, "").startswith("http:") for key in _ENDPOINTS),
                },
                retry_config={"max_retries": 0, "retry_timeout": limit},
            )
        except (BaseError, ValueError) as error:
            if "account must be specified" in str(error).lower():
                raise SessionError(
                    f"{url}: the environment names no account; set AZURE_STORAGE_ACCOUNT_NAME"
                ) from error
            raise SessionError(f"{url}: is no URL of a bucket ({in_a_line(error)})") from error

    def _get(self, first: int | None, length: int, end_s: float) -> Answer:
        import obstore

        wanted: Any = {"suffix": length} if first is None else (first, first + length)
        try:
            with _bucket_errors():
                if first is None and not self._takes_suffix:
                    raise OtherRangeError("")
                found = obstore.get(self._store, self._key, options={"range": wanted})
                meta, (begin, end) = found.meta, found.range
                data = bytes(found.bytes())
        except _NoRangeError:
            return Answer(b"", 0, 0, "")
        except OtherRangeError as error:
            if first is None:
                with _bucket_errors():
                    error.size = obstore.head(self._store, self._key)["size"]
            raise
        if len(data) != end - begin:
            raise _too_few(len(data), end - begin, found.attributes.get("Content-Encoding", ""))
        return Answer(data, begin, meta["size"], _version(meta))

    def objects(self, begin: str) -> Iterator[ListedObject]:
        """As of `listing`, in any order."""
        import obstore

        folder = f"{self._key}/" if self._key else ""
        with _bucket_errors():
            if not begin:
                for meta in obstore.list_with_delimiter(self._store, self._key or None)["objects"]:
                    yield ListedObject(meta["path"].removeprefix(folder), meta["size"], _version(meta))
                return
            # Keys come in their order, so those that begin alike come together.
            for some in obstore.list(self._store, self._key or None, offset=folder + begin, chunk_size=1000):
                for meta in some:
                    name = meta["path"].removeprefix(folder)
                    if not name.startswith(begin):
                        return
                    if "/" not in name:
                        yield ListedObject(name, meta["size"], _version(meta))


class _NoRangeError(RefusedError):
    """The object has no bytes, of which no range can be had."""


@contextmanager
def _bucket_errors() -> Iterator[None]:
    """Turn the errors of obstore into ours."""
    from obstore import exceptions

    try:
        yield
    except (exceptions.NotFoundError, FileNotFoundError) as error:
        raise of_status(404) from error
    except (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError, PermissionError) as error:
        raise of_status(403) from error
    except (exceptions.BaseError, OSError, ValueError) as error:
        text = in_a_line(error)
        if "416" in text and "ange" in text:
            raise _NoRangeError("has no bytes (416)") from error
        if "UnexpectedRange" in text:
            raise OtherRangeError("the server sends other bytes than those that are asked for") from error
        if "NotPartial" in text or "NoContentRange" in text:
            raise RefusedError(_WHOLE_ONLY if "NotPartial" in text else _NO_RANGE_TOLD) from error
        if "169.254.169.254" in text or "redential" in text:
            raise RefusedError(
                "can not be asked for: there are no credentials in the environment (AWS_ACCESS_KEY_ID, ...)"
            ) from error
        status = re.search(r"\b(?:status|Status|code)\D{0,20}([45]\d\d)\b", text)
        raise of_status(int(status[1])) if status else TransientError(reason(text)) from error


def of_status(status: int) -> Exception:
    """The error of an answer that is none."""
    if status in (401, 403):
        return RefusedError(f"refuses access ({status}); check the credentials in the environment", HiddenError)
    if status in (404, 410):
        return RefusedError("is not there (404); check the name", MissingError)
    if status == NOT_OFFERED:
        return RefusedError(f"the server does not offer what is asked of it ({status})")
    if status >= 500 or status in _LATER:
        return TransientError(f"the server answers {status}")
    return RefusedError(f"can not be read: the server answers {status}")


def _version(meta: Mapping[str, Any]) -> str:
    return meta.get("e_tag") or str(meta.get("last_modified") or "")


class _Http(ObjectRequests):
    """An object of an http server. Redirects are followed, but never from a public host to a private one."""

    def __init__(self, url: str) -> None:
        import urllib3

        self._url = url
        self._pool = urllib3.PoolManager(maxsize=CONNECTIONS, retries=False)

    def _get(self, first: int | None, length: int, end_s: float) -> Answer:
        import urllib3

        wanted = f"bytes=-{length}" if first is None else f"bytes={first}-{first + length - 1}"
        headers = {"Range": wanted, "Accept-Encoding": "identity"}
        timeout_s = max(0.1, end_s - time.monotonic())
        limits = urllib3.Timeout(connect=min(5.0, timeout_s), read=timeout_s)
        url = self._url
        try:
            for _ in range(_REDIRECTS + 1):
                response = self._pool.request(
                    "GET", url, headers=headers, redirect=False, timeout=limits, preload_content=False
                )
                try:
                    target = response.get_redirect_location()
                    if not target:
                        return _answer(response, first, length, end_s)
                    url = _redirect_target(url, urljoin(url, target))
                finally:
                    response.close()  # gives a connection back that was read to its end, and cuts any other
        except urllib3.exceptions.HTTPError as error:
            raise TransientError(reason(in_a_line(error))) from error
        raise RefusedError(f"is redirected more than {_REDIRECTS} times")


def _answer(response: Any, first: int | None, length: int, end_s: float) -> Answer:
    """The answer in an http response.

    Raises
    ------
    TransientError, RefusedError : it is not what was asked for.
    """
    status = response.status
    if status == _NO_RANGE:
        return Answer(b"", 0, 0, "")
    if status >= 400:
        raise of_status(status)
    if status == _OK:
        raise RefusedError(_WHOLE_ONLY)
    found = _CONTENT_RANGE.fullmatch(response.headers.get("Content-Range", ""))
    if status != _PARTIAL or found is None:
        raise RefusedError(_NO_RANGE_TOLD if status == _PARTIAL else f"can not be read: the server answers {status}")
    begin, last, size = map(int, found.groups())
    expected = last - begin + 1
    asked = max(0, size - length) if first is None else first
    if begin != asked or expected != min(length, size - asked):
        text = f"the server sent the bytes {begin} to {last} where {length} from {asked} were asked for"
        raise OtherRangeError(text, size)
    data = bytearray()
    while piece := response.read1(_PIECE_BYTES, decode_content=False):
        data += piece
        if time.monotonic() > end_s:
            raise TransientError("the server is too slow")
        if len(data) > expected:
            break
    if len(data) != expected:
        raise _too_few(len(data), expected, response.headers.get("Content-Encoding", ""))
    version = response.headers.get("ETag") or response.headers.get("Last-Modified") or ""
    return Answer(bytes(data), begin, size, version)


def _too_few(count: int, expected: int, encoding: str) -> Exception:
    """The error of an answer whose content has another length than its range."""
    if encoding not in ("", "identity"):
        return RefusedError(_PACKED.format(encoding))
    return TransientError(f"the server sent {count} of {expected} bytes")


def _redirect_target(url: str, target: str) -> str:
    """The target of a redirect; RefusedError where it leads from a public host to a private one, or to no http."""
    before, after = urlsplit(url), urlsplit(target)
    if after.scheme not in ("http", "https") or (before.scheme == "https" and after.scheme == "http"):
        raise RefusedError(f"is redirected from {before.scheme} to {after.scheme or 'nothing'}, which is not followed")
    if after.hostname != before.hostname and _is_private(after.hostname) and not _is_private(before.hostname):
        raise RefusedError("is redirected to a private address, which is not followed; name that URL itself")
    return target


def _is_private(host: str | None) -> bool:
    """True if any address of a host is not of the public network."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError:
        return False  # the request says so
    return any(not ipaddress.ip_address(str(address[4][0]).partition("%")[0]).is_global for address in found)


def in_a_line(error: BaseException) -> str:
    """The text of an error of a library."""
    return " ".join(str(error).split())


def reason(text: str) -> str:
    """Error of a library about a failed connection, in a few words that can not hold a credential."""
    lower = text.lower()
    if "timed out" in lower or "kind: timeout" in lower:
        return "the server does not answer in time"
    if "incompleteread" in lower or "body" in lower or "broken" in lower:
        return "the connection was cut"
    if "resolve" in lower or "dns" in lower:
        return "the host is not known"
    if "connect" in lower or "unreachable" in lower:
        return "no connection"
    return "the answer of the server can not be used"
