"""A server from elsewhere: uploads that go on where they were cut, jobs, results."""

import base64
import hashlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import httpx

from lvba.errors import InputError, LvbaError
from lvba.progress import Progress, silent

PIECE = 16 << 20
"""Bytes of one request."""
_TRIES = 6
_WAIT_S = 0.5
"""Before the second try; then twice as long each time."""
_POLL_S = 1.0
_TIMEOUT = httpx.Timeout(60.0, connect=10.0)
_PASSING = (423, 429, 502, 503, 504)
"""Answers that may be others a moment later."""
_ASKED_WRONGLY = (400, 401, 403, 404, 413, 415, 422)
"""Answers to what the user should ask in another way: bad input, wherever it is found."""


class ServerError(LvbaError):
    """The server cannot do what was asked now, or cannot be reached."""


class Client:
    """One server, asked with one key.

    check: called while waiting; what it raises goes through
    """

    def __init__(
        self, url: str, key: str = "", check: Callable[[], None] = lambda: None, *, transport: Any = None
    ) -> None:
        if not url.startswith(("http://", "https://")) or not _host(url):
            raise InputError(f"--server {url}", "is no URL", "give one such as http://host:8080")
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._http = httpx.Client(base_url=url, headers=headers, timeout=_TIMEOUT, transport=transport)
        self._url, self._check = url, check
        self._met = False
        """Whether it has answered before: then it is worth waiting for."""

    def close(self) -> None:
        """Give back the connections."""
        self._http.close()

    def get(self, path: str, **query: Any) -> Any:
        """What a path answers."""
        return self._ask("GET", path, params=query).json()

    def post(self, path: str, body: Any = None, key: str | None = None) -> Any:
        """What a path answers to a body; with an idempotency key it is tried again when the answer is lost."""
        headers = {"Idempotency-Key": key} if key else {}
        tries = _TRIES if key else 1
        return self._ask("POST", path, tries, json=body, headers=headers).json()

    def every(self, path: str, **query: Any) -> Iterator[dict[str, Any]]:
        """All items of a list, page by page."""
        cursor: str | None = None
        while True:
            page = self.get(path, **query, **({"cursor": cursor} if cursor else {}))
            yield from page["items"]
            cursor = page.get("next")
            if cursor is None:
                return

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
        answer = self._http.head(place)
        if answer.status_code == 404:
            return 0, None
        if answer.status_code in _PASSING:
            raise _Again(f"answered {answer.status_code}")
        _raise_for(answer, self._url)
        if answer.headers["Upload-Length"] != str(length):
            return 0, None
        if answer.headers["Upload-Complete"] == "?1":
            return length, answer.headers.get("Upload-Digest")
        return int(answer.headers["Upload-Offset"]), None

    def _send(
        self, place: str, file: Path, offset: int, length: int, digest: str, progress: Progress
    ) -> None:
        with file.open("rb") as stream:
            stream.seek(offset)
            while True:
                self._check()
                piece = stream.read(min(PIECE, length - offset))
                headers = {"Upload-Offset": str(offset), "Upload-Length": str(length), "Repr-Digest": digest}
                answer = self._http.put(place, content=piece, headers=headers)
                if answer.status_code in (409, *_PASSING) and answer.headers.get("Upload-Offset") != "0":
                    raise _Again(f"answered {answer.status_code}")
                _raise_for(answer, self._url)
                offset += len(piece)
                progress(file.name, offset, length)
                if offset >= length:
                    return

    def download(self, path: str, file: Path, size: int, tag: str) -> None:
        """Get a file, going on where it was cut. It has its name only when it is whole."""
        partial = file.with_name(f".{file.name}.partial")
        file.parent.mkdir(parents=True, exist_ok=True)
        for attempt in range(_TRIES):
            try:
                self._receive(path, partial, tag)
                break
            except httpx.TransportError as error:
                if attempt == _TRIES - 1:
                    raise ServerError(f"{self._url}: {file.name} could not be fetched ({error})") from None
                self._wait(attempt)
        if partial.stat().st_size != size:
            partial.unlink()
            raise ServerError(f"{self._url}: {file.name} has not the size that was announced")
        partial.replace(file)

    def _receive(self, path: str, partial: Path, tag: str) -> None:
        there = partial.stat().st_size if partial.exists() else 0
        headers = {"Range": f"bytes={there}-", "If-Range": tag} if there else {}
        with self._http.stream("GET", path, headers=headers) as answer:
            if answer.status_code == 416:
                partial.unlink()
                raise httpx.ReadError("begins anew")
            if answer.is_error:
                answer.read()
            _raise_for(answer, self._url)
            with partial.open("ab" if answer.status_code == 206 else "wb") as stream:
                for data in answer.iter_bytes():
                    self._check()
                    stream.write(data)

    def wait_while(self, path: str, states: tuple[str, ...]) -> dict[str, Any]:
        """What a path answers, once its state is none of these."""
        while True:
            found: dict[str, Any] = self.get(path)
            if found["state"] not in states:
                return found
            self.pause()

    def pause(self) -> None:
        """Until it makes sense to ask again."""
        self._pause(_POLL_S)

    def _ask(self, method: str, path: str, tries: int = _TRIES, **more: Any) -> httpx.Response:
        for attempt in range(tries):
            try:
                answer = self._http.request(method, path, **more)
            except httpx.TransportError as error:
                if attempt == tries - 1 or (attempt and not self._met):
                    raise ServerError(
                        f"{self._url}: cannot be reached ({_why(error)}); check --server"
                    ) from None
            else:
                self._met = True
                if answer.status_code not in _PASSING or attempt == tries - 1:
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
    """Not now: ask what has arrived, and go on."""


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


def _raise_for(answer: httpx.Response, url: str) -> httpx.Response:
    """The answer, if it is none of an error.

    Raises InputError: another request would have been answered; ServerError: the same one might be at another time.
    """
    if not answer.is_error:
        return answer
    try:
        problem = answer.json()
        detail, hint = str(problem["detail"]), str(problem["hint"])
    except (ValueError, KeyError, TypeError):
        raise ServerError(f"{url}: answered {answer.status_code}") from None
    if answer.status_code in _ASKED_WRONGLY:
        raise InputError(url, detail, hint)
    raise ServerError(f"{url}: {detail}; {hint}")


def _host(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


def _why(error: Exception) -> str:
    return str(error) or type(error).__name__


def _sha256(file: Path) -> bytes:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").digest()
