"""One result of the command line, shown in a browser: the page and the files of the result, read only, on loopback."""

import asyncio
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from starlette.responses import FileResponse, Response

from lvba.errors import InputError
from service.api import file_responses, problem_responses
from service.api.middleware import Guard
from service.api.routes import page
from service.api.web_server import WebServer, listening
from service.datasets import file_names
from service.db import keys
from service.jobs import results as result_files
from service.problems import Problem
from service.settings import Settings
from service.system import descriptors
from service.system.descriptors import DescriptorLimits

_BASE = "/v1/result/results/"


@dataclass(frozen=True)
class ViewedResult:
    """A result folder, and where what a viewer needs lies: in it, or made for this occasion beside it."""

    result: Path
    viewer: Path

    def paths(self) -> dict[str, Path]:
        """The folder of each file, by name; of the octree and its pictures those of `viewer` alone."""
        folders = {
            name: self.result for name in result_files.result_names(self.result) if not _is_viewers(name)
        }
        return folders | {
            name: self.viewer for name in result_files.result_names(self.viewer) if _is_viewers(name)
        }


def _is_viewers(name: str) -> bool:
    return name.startswith(("cloud/", "frames/"))


def create(viewed: ViewedResult, settings: Settings) -> FastAPI:
    """The ASGI application: the page asks it as it asks the service, about one result instead of a job."""
    app = FastAPI(title="lvba view", openapi_url=None, docs_url=None, redoc_url=None, redirect_slashes=False)
    problem_responses.install(app)
    name = viewed.result.name

    @app.get("/")
    def root() -> Response:
        return page.index()

    @app.get("/app/{path:path}")
    def file_of_page(path: str) -> Response:
        return page.app(path)

    @app.get("/v1/me")
    def me() -> dict[str, Any]:
        return {"owner": keys.LOCAL.owner, "scopes": [keys.READ], "auth": False, "result": {"name": name}}

    @app.get("/v1/result")
    def result() -> dict[str, Any]:
        return {"name": name}

    @app.get("/v1/result/results")
    def results() -> dict[str, Any]:
        paths = sorted(viewed.paths().items())
        return {
            "items": [file_responses.result_shown(_BASE, folder, name) for name, folder in paths],
            "next": None,
        }

    @app.head("/v1/result/results/{name:path}")
    @app.get("/v1/result/results/{name:path}")
    def one(name: str, download: bool = False) -> FileResponse:
        folder = viewed.viewer if _is_viewers(name) else viewed.result
        if not result_files.is_result(name):
            raise Problem("not-found", "there is no such file in the result")
        try:
            return file_responses.FileOf(file_names.opened(folder, name), name, download=download)
        except InputError:
            raise Problem("not-found", "there is no such file in the result") from None

    @app.get("/v1/result/frames")
    def frames() -> dict[str, Any]:
        return {"items": frames_of(viewed)}

    app.add_middleware(Guard, settings=settings)
    return app


def frames_of(viewed: ViewedResult) -> list[dict[str, Any]]:
    """The images as the page asks for them; none where nothing for a viewer tells of images."""
    try:
        with file_names.opened(viewed.viewer, "cloud/cloud.json") as file:
            images = json.load(file)["images"]
            there = viewed.paths()
            return [
                {
                    "index": i,
                    "time": time,
                    "name": name,
                    "raw": None,
                    **file_responses.pictures(_BASE, there, i),
                }
                for i, (time, name) in enumerate(zip(images["times"], images["names"], strict=True))
            ]
    except (InputError, ValueError, KeyError, TypeError):
        return []


class _Viewer(WebServer):
    """Says where it listens."""

    def __init__(
        self, viewed: ViewedResult, settings: Settings, limits: DescriptorLimits, ready: Callable[[str], None]
    ) -> None:
        super().__init__(create(viewed, settings), settings, limits)
        self._ready = ready

    async def startup(self, sockets: list[Any] | None = None) -> None:
        await super().startup(sockets)
        for socket in sockets or []:
            await asyncio.to_thread(self._ready, f"http://127.0.0.1:{socket.getsockname()[1]}/")


def view(viewed: ViewedResult, port: int, ready: Callable[[str], None]) -> None:
    """Serve until a signal comes.

    port: 0: any that is free; ready: called with the address once it answers
    Raises InputError: the port cannot be listened on.
    """
    settings = Settings(port=port)
    limits = descriptors.raise_limits(settings.limits.connections)
    web = _Viewer(viewed, settings, limits, ready)
    with listening(web, settings) as sockets:
        web.run(sockets=sockets)
    sys.stderr.flush()
