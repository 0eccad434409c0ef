"""Every error of the API as problem JSON (RFC 9457): status, code, cause and hint."""

from collections.abc import Mapping, Sequence
from typing import Any

from starlette.responses import JSONResponse

from lvba.errors import InputError

KINDS: dict[str, tuple[int, str, str]] = {
    "unauthorized": (
        401,
        "A key is needed",
        "send Authorization: Bearer KEY; keys are made by lvba admin key create",
    ),
    "forbidden": (403, "The key may not do this", "use a key with the scope that is named"),
    "not-found": (
        404,
        "There is no such thing",
        "check the path and the id; what belongs to others is not shown",
    ),
    "method-not-allowed": (405, "This path has no such method", "see /docs"),
    "too-slow": (
        408,
        "The request did not come in time",
        "send it again; an upload continues from Upload-Offset",
    ),
    "conflict": (409, "Not in this state", "look at its state first"),
    "offset-mismatch": (409, "The bytes do not begin where the server's end", "continue from Upload-Offset"),
    "not-ready": (409, "There is no result yet", "wait for the state done"),
    "length-required": (411, "The length is needed", "send Content-Length"),
    "too-large": (413, "Too large", "send less, or ask the server's administrator for more"),
    "unsupported": (415, "Not this kind of body", "send JSON, or raw bytes for an upload"),
    "range": (416, "There is no such part", "ask for bytes that the file has"),
    "invalid": (422, "The request does not fit", "mend what is named; see /docs and /v1/options"),
    "digest-mismatch": (422, "The bytes are not those of the digest", "send them again"),
    "locked": (423, "An older request is still at it", "try again after a second"),
    "quota": (429, "Your quota is used up", "wait for jobs to end, or remove what is not needed"),
    "too-many-requests": (429, "Too many requests", "wait as long as Retry-After says"),
    "damaged": (
        500,
        "A result is not what the job made",
        "restart the job: it makes again what is missing or damaged, and keeps the stages that are whole",
    ),
    "internal": (500, "The server failed", "try again; if it stays, tell the server's administrator"),
    "unavailable": (503, "Not now", "try again after a few seconds"),
    "disk-full": (
        507,
        "The disk cannot hold it",
        "remove what is not needed, or ask the server's administrator",
    ),
}
"""Status, title and hint of each code."""
_ERRORS = 20


class Problem(Exception):  # noqa: N818  # the word of RFC 9457
    """What a request is answered with instead."""

    def __init__(
        self,
        code: str,
        detail: str,
        hint: str | None = None,
        headers: Mapping[str, str] | None = None,
        **more: Any,
    ) -> None:
        super().__init__(detail)
        self.status, self.title, usual = KINDS[code]
        self.code, self.detail, self.hint = code, detail, hint or usual
        self.headers, self.more = dict(headers or {}), more

    def body(self, instance: str) -> dict[str, Any]:
        """The JSON object."""
        return {
            "type": f"/problems/{self.code}",
            "title": self.title,
            "status": self.status,
            "code": self.code,
            "detail": self.detail,
            "hint": self.hint,
            "instance": instance,
            **self.more,
        }

    def response(self, instance: str) -> JSONResponse:
        """The answer."""
        return JSONResponse(
            self.body(instance), self.status, self.headers, media_type="application/problem+json"
        )


def of_input(error: InputError) -> Problem:
    """What is wrong with what a user gave."""
    detail = f"{error.where}: {error.problem}"
    return Problem("invalid", detail, error.mend, errors=[{"where": error.where, "message": error.problem}])


def too_slow() -> Problem:
    """What a client hears whose request is not all there when it should be."""
    return Problem("too-slow", "the request stopped before its end", headers={"Connection": "close"})


def ending() -> Problem:
    """What a client hears that comes too late for a service, or whose request takes too long for it."""
    return Problem(
        "unavailable", "the service is ending", headers={"Retry-After": "5", "Connection": "close"}
    )


def first_errors(errors: Sequence[Any]) -> list[dict[str, str]]:
    """What pydantic found, as the API tells it: some of it, where it is much."""
    return [
        {"where": ".".join(str(part) for part in error["loc"]), "message": error["msg"]}
        for error in errors[:_ERRORS]
    ]
