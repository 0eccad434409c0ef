"""The page that people see, the API's page, and `/`, which is both theirs and OGC's."""

from functools import cache
from pathlib import Path

from fastapi import APIRouter, Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, Response

from service.api import docs_page
from service.api.routes import ogc
from service.problems import KINDS, Problem

router = APIRouter(include_in_schema=False)
FOLDER = Path(__file__).parents[2] / "page"
"""Where the build puts it."""
_NO_PAGE = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>lvba</title></head><body><main>
<h1>lvba</h1><p>The service runs. Its page was not built into this installation; the API is there:
<a href="/docs">documentation</a>.</p></main></body></html>"""


@router.get("/")
def root(request: Request) -> Response:
    """The page for people, the landing page for programs."""
    return index() if _prefers_html(request.headers.get("accept", "")) else ogc.landing(request)


def _prefers_html(accept: str) -> bool:
    """Whether HTML is asked for, and not less than JSON."""
    weights: dict[str, float] = {}
    for part in accept.split(","):
        kind, *parameters = (word.strip() for word in part.split(";"))
        weight = next((word[2:] for word in parameters if word.startswith("q=")), "1")
        try:
            weights[kind] = float(weight)
        except ValueError:
            weights[kind] = 0.0
    return weights.get("text/html", 0.0) > weights.get("application/json", 0.0)


def index() -> Response:
    """The page itself."""
    index = FOLDER / "index.html"
    if not index.is_file():
        return HTMLResponse(_NO_PAGE)
    return FileResponse(index, headers={"Cache-Control": "no-cache"}, media_type="text/html")


@router.get("/app")
@router.get("/app/{path:path}")
def app(path: str = "") -> Response:
    """A file of the page; the page itself for its own addresses."""
    try:
        file = (FOLDER / path).resolve()
        exists = path != "" and file.is_relative_to(FOLDER) and file.is_file()
    except OSError:  # no file has a name as long as that
        raise Problem("not-found", "there is no such file") from None
    if exists:
        lasting = path.startswith("assets/")  # their names change with their contents
        cached = "public, max-age=31536000, immutable" if lasting else "no-cache"
        return FileResponse(file, headers={"Cache-Control": cached})
    if "." in path.rsplit("/", 1)[-1]:
        raise Problem("not-found", "there is no such file")
    return index()


@router.get("/docs")
def docs(request: Request) -> HTMLResponse:
    """The API."""
    return HTMLResponse(_docs(request))


def _docs(request: Request) -> str:
    return _page(request.app)


@cache
def _page(app: object) -> str:
    return docs_page.page(app.openapi())  # type: ignore[attr-defined]


@router.get("/docs.css")
def style() -> Response:
    """Of the API's page."""
    return Response(docs_page.STYLE, media_type="text/css")


@router.get("/problems/{code}")
def problem(code: str) -> PlainTextResponse:
    """What a problem's type means."""
    if code not in KINDS:
        raise Problem("not-found", "there is no such problem")
    status, title, hint = KINDS[code]
    return PlainTextResponse(f"{code} ({status}): {title}. What helps: {hint}.\n")
