"""A server from elsewhere: uploads that continue where they were cut, jobs, results."""

import base64
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote, urlsplit

import httpx

from lvba.errors import InputError, LvbaError
from lvba.progress import Progress, silent
from service.cli import server_responses
from service.cli.download_folder import OutFile, OutFolder
from service.cli.server_responses import Result
from service.system.printable import printable

PIECE = 16 << 20
"""Bytes of one request."""
_TRIES = 6
_WAIT_S = 0.5
"""Before the second try; then twice as long each time."""
_POLL_S = 1.0
_TIMEOUT = httpx.Timeout(60.0, connect=10.0)
_PASSING = (408, 423, 429, 502, 503, 504)
"""Answers that may be others a moment later."""
_ASKED_WRONGLY = (400, 401, 403, 404, 413, 415, 422)
"""Answers to what the user should ask in another way: bad input, wherever it is found."""
_LONGEST = 64 << 20
"""Bytes of an answer that is no file."""
_SAID = 500
"""Letters of what a server says of an error."""
Query = Mapping[str, Any] | None
Value = TypeVar("Value")
Waited = TypeVar("Waited", server_responses.Dataset, server_responses.Job)


class ServerError(LvbaError):
    """The server cannot do what was asked now, or cannot be reached."""


@dataclass(frozen=True)
class Answer:
    """An answer with all of its body."""

    status: int
    headers: Mapping[str, str]
    content: bytes


def _as_it_is(value: Any) -> Any:
    return value


class Client:
    """One server, asked with one key.

    check: called while waiting; what it raises goes through
    """

    def __init__(
        self, url: str, key: str = "", check: Callable[[], None] = lambda: None, *, transport: Any = None
    ) -> None:
        if not url.startswith(("http://", "https://")) or not _host(url):
            raise InputError(f"--server {url}", "is no URL", "give one such as http://host:8080")
        if not key.isascii() or not key.isprintable():
            raise InputError("the key", "holds letters that no key has", "give the key as it was shown")
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._http = httpx.Client(base_url=url, headers=headers, timeout=_TIMEOUT, transport=transport)
        self._url, self._check = url, check
        self._met = False
        """Whether it has answered before: then it is worth waiting for."""

    def close(self) -> None:
        """Give back the connections."""
        self._http.close()

    def get(self, path: str, read: Callable[[Any], Value] = _as_it_is, query: Query = None) -> Value:
        """What a path answers.

        read: makes of JSON what is wanted (see `answers`)
        Raises ServerError: the answer is none of an lvba server.
        """
        return self._read(self._ask("GET", path, params=dict(query or {})), read)

    def post(
        self,
        path: str,
        body: Any = None,
        read: Callable[[Any], Value] = _as_it_is,
        *,
        key: str | None = None,
    ) -> Value:
        """What a path answers to a body; with an idempotency key it is tried again when the answer is lost."""
        headers = {"Idempotency-Key": key} if key else {}
        tries = _TRIES if key else 1
        return self._read(self._ask("POST", path, tries, json=body, headers=headers), read)

    def every(
        self, path: str, read: Callable[[Any], Value] = _as_it_is, query: Query = None
    ) -> Iterator[Value]:
        """All items of a list, page by page."""
        cursors: set[str] = set()
        cursor: str | None = None
        while True:
            wanted = {**(query or {}), **({"cursor": cursor} if cursor else {})}
            items, cursor = self.get(path, lambda value: server_responses.page(value, read), wanted)
            yield from items
            if cursor is None:
                return
            if cursor in cursors or not items:
                raise self._wrong("a list has no end")
            cursors.add(cursor)

    def _read(self, answer: "Answer", read: Callable[[Any], Value]) -> Value:
        try:
            return read(json.loads(answer.content))
        except server_responses.WrongAnswerError as error:
            raise self._wrong(str(error)) from None
        except (ValueError, RecursionError):
            raise self._wrong("it is no JSON") from None

    def _wrong(self, what: str) -> "ServerError":
        return ServerError(f"{self._url}: answered what no lvba server would ({what}); check --server")

    def upload(self, dataset_id: str, file: Path, path: str | None, progress: Progress = silent) -> None:
        """Send a file (path: None: the archive), or what is missing of it; checked at the other end.

        Raises LvbaError: it could not be sent, or became another file meanwhile.
        """
        place = f"/v1/datasets/{dataset_id}/" + ("archive" if path is None else f"files/{quote(path)}")
        digest = _sha256(file)
        said = f"sha-256=:{base64.b64encode(digest).decode()}:"
        length = file.stat().st_size
        for attempt in range(_TRIES):
            try:
                offset, complete = self._arrived(place, length)
                if complete == digest.hex():
                    return
                self._send(place, file, 0 if complete else offset, length, said, progress)
                return
            except (httpx.TransportError, _Again) as error:
                if attempt == _TRIES - 1:
                    raise ServerError(f"{self._url}: {file} could not be sent ({error})") from None
                self._wait(attempt)

    def _arrived(self, place: str, length: int) -> tuple[int, str | None]:
        """How much of a file is there; its digest if all is."""
        answer = self._request("HEAD", place)
        if answer.status == 404:
            return 0, None
        if answer.status in _PASSING:
            raise _Again(f"answered {answer.status}")
        _raise_for(answer, self._url)
        if answer.headers.get("Upload-Length") != str(length):
            return 0, None
        if answer.headers.get("Upload-Complete") == "?1":
            return length, answer.headers.get("Upload-Digest")
        offset = answer.headers.get("Upload-Offset", "")
        if not offset.isascii() or not offset.isdigit() or len(offset) > 15 or int(offset) > length:
            raise self._wrong("Upload-Offset is no place in the file")
        return int(offset), None

    def _send(
        self, place: str, file: Path, offset: int, length: int, digest: str, progress: Progress
    ) -> None:
        with file.open("rb") as stream:
            stream.seek(offset)
            while True:
                self._check()
                piece = stream.read(min(PIECE, length - offset))
                headers = {"Upload-Offset": str(offset), "Upload-Length": str(length), "Repr-Digest": digest}
                answer = self._request("PUT", place, content=piece, headers=headers)
                if answer.status in (409, *_PASSING) and answer.headers.get("Upload-Offset") != "0":
                    raise _Again(f"answered {answer.status}")
                _raise_for(answer, self._url)
                offset += len(piece)
                progress(file.name, offset, length)
                if offset >= length:
                    return

    def download(self, path: str, folder: OutFolder, result: Result) -> None:
        """Get a file into a folder, continuing where it was cut. It has its name only when it is whole, and right.

        Raises ServerError: it is not what the server said it would be.
        """
        with folder.file(result.name) as target:
            for attempt in range(_TRIES):
                try:
                    self._receive(path, target, result)
                    break
                except httpx.TransportError as error:
                    if attempt == _TRIES - 1:
                        shown = printable(result.name)
                        raise ServerError(
                            f"{self._url}: {shown} could not be fetched ({_why(error)})"
                        ) from None
                    self._wait(attempt)
            self._check_whole(target, result)
            target.finish()

    def _receive(self, path: str, target: OutFile, result: Result) -> None:
        there = target.arrived()
        if there > result.bytes:
            target.forget()
            there = 0
        headers = {"Range": f"bytes={there}-", "If-Range": result.etag} if there else {}
        with self._stream("GET", path, headers=headers) as answer:
            if answer.status_code == 416:
                target.forget()
                raise httpx.ReadError("begins anew")
            if answer.status_code not in (200, 206):
                _raise_for(self._all_of(answer), self._url)
                raise self._wrong(f"{answer.status_code} for a file")
            goes_on = answer.status_code == 206
            flags = os.O_WRONLY | os.O_CREAT | (os.O_APPEND if goes_on else os.O_TRUNC)
            with os.fdopen(target.opened(flags), "ab" if goes_on else "wb") as stream:
                size = there if goes_on else 0
                for data in answer.iter_bytes():
                    self._check()
                    size += len(data)
                    if size > result.bytes:
                        raise self._wrong(f"{printable(result.name)} is longer than was announced")
                    stream.write(data)

    def _check_whole(self, target: OutFile, result: Result) -> None:
        with os.fdopen(target.opened(os.O_RDONLY), "rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            right = (
                result.sha256 is None or hashlib.file_digest(stream, "sha256").hexdigest() == result.sha256
            )
        if size == result.bytes and right:
            return
        target.forget()
        said = "digest" if size == result.bytes else "size"
        raise ServerError(
            f"{self._url}: {printable(result.name)} does not have the {said} that was announced"
        )

    def wait_while(self, path: str, read: Callable[[Any], Waited], states: tuple[str, ...]) -> Waited:
        """What a path answers, once its state is none of these."""
        while True:
            record = self.get(path, read)
            if record.state not in states:
                return record
            self.pause()

    def pause(self) -> None:
        """Until it makes sense to ask again."""
        self._pause(_POLL_S)

    def _request(self, method: str, path: str, **more: Any) -> "Answer":
        """One request, and its answer as far as an answer may be long."""
        with self._stream(method, path, **more) as answer:
            return self._all_of(answer)

    @contextmanager
    def _stream(self, method: str, path: str, **more: Any) -> Iterator[httpx.Response]:
        """An answer that is coming.

        Raises ServerError: it is no HTTP that can be understood; httpx.TransportError: the connection broke.
        """
        try:
            with self._http.stream(method, path, **more) as answer:
                yield answer
        except httpx.TransportError:
            raise
        except (httpx.HTTPError, httpx.InvalidURL, UnicodeError) as error:
            raise self._wrong(_why(error)) from None

    def _all_of(self, answer: httpx.Response) -> "Answer":
        content = bytearray()
        for piece in answer.iter_bytes():
            self._check()
            content += piece
            if len(content) > _LONGEST:
                raise self._wrong(f"more than {_LONGEST} bytes")
        return Answer(answer.status_code, answer.headers, bytes(content))

    def _ask(self, method: str, path: str, tries: int = _TRIES, **more: Any) -> "Answer":
        for attempt in range(tries):
            try:
                answer = self._request(method, path, **more)
            except httpx.TransportError as error:
                if attempt == tries - 1 or (attempt and not self._met):
                    raise ServerError(
                        f"{self._url}: cannot be reached ({_why(error)}); check --server"
                    ) from None
            else:
                self._met = True
                if answer.status not in _PASSING or attempt == tries - 1:
                    return _raise_for(answer, self._url)
            self._wait(attempt)
        raise AssertionError("not reached")

    def _wait(self, attempt: int) -> None:
        self._pause(_WAIT_S * 2**attempt)

    def _pause(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self._check()
            time.sleep(0.1)


class _Again(Exception):  # noqa: N818
    """Not now: ask what has arrived, and continue."""


@contextmanager
def connected(
    server: str | None,
    key_file: Path | None,
    check: Callable[[], None],
    environment: Mapping[str, str] = os.environ,
) -> Iterator[Client]:
    """The server that a command line names.

    Raises InputError: a key that cannot be read.
    """
    url = server or environment.get("LVBA_SERVER") or "http://127.0.0.1:8080"
    key = environment.get("LVBA_KEY", "")
    if key_file is not None:
        try:
            key = key_file.read_text().strip()
        except OSError as error:
            raise InputError(
                key_file, f"cannot be read ({error.strerror})", "give --key-file a file"
            ) from None
    client = Client(url, key, check)
    try:
        yield client
    finally:
        client.close()


def _raise_for(answer: Answer, url: str) -> Answer:
    """The answer, if it is none of an error.

    Raises InputError: another request would have been answered; ServerError: the same one might be at another time.
    """
    if 200 <= answer.status < 300:
        return answer
    try:
        problem = json.loads(answer.content) if answer.status >= 400 else {}
        detail, hint = (printable(str(problem[name]))[:_SAID] for name in ("detail", "hint"))
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ServerError(f"{url}: answered {answer.status}; check --server") from None
    if answer.status in _ASKED_WRONGLY:
        raise InputError(url, detail, hint)
    raise ServerError(f"{url}: {detail}; {hint}")


def _host(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


def _why(error: Exception) -> str:
    return printable(str(error) or type(error).__name__)[:_SAID]


def _sha256(file: Path) -> bytes:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").digest()
