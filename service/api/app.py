"""The application: routes, problems and guards around one server."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from importlib import metadata

from fastapi import FastAPI

from service.api import problem_responses
from service.api.context import Server
from service.api.middleware import Guard
from service.api.routes import (
    about,
    batches,
    checks,
    datasets,
    inspections,
    job_files,
    jobs,
    ogc,
    page,
    uploads,
)

_DESCRIPTION = "Refines recordings of LiDAR and cameras. docs/rest.md says how things fit together."


def create(server: Server) -> FastAPI:
    """The ASGI application."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        listening = asyncio.create_task(server.broadcaster.run())
        yield
        server.broadcaster.close()
        listening.cancel()
        with suppress(asyncio.CancelledError):
            await listening

    app = FastAPI(
        title="lvba",
        version=metadata.version("lvba"),
        description=_DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.state.server = server
    problem_responses.install(app)
    for module in (uploads, checks, inspections, datasets, jobs, job_files, batches, about, ogc, page):
        app.include_router(module.router)
    app.add_middleware(Guard, settings=server.settings)
    return app
