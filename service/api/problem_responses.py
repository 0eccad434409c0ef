"""Every exception answered as problem JSON."""

import logging

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import DBAPIError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from lvba.errors import InputError
from service.problems import Problem, first_errors, of_input, too_slow

_log = logging.getLogger(__name__)

_BY_STATUS = {400: "invalid", 401: "unauthorized", 403: "forbidden", 404: "not-found"}
_BY_STATUS |= {405: "method-not-allowed", 413: "too-large", 415: "unsupported"}


def install(app: FastAPI) -> None:
    """Have every exception answered as a problem."""

    @app.exception_handler(Problem)
    async def _problem(request: Request, error: Problem) -> JSONResponse:
        return error.response(request.url.path)

    @app.exception_handler(InputError)
    async def _input(request: Request, error: InputError) -> JSONResponse:
        return of_input(error).response(request.url.path)

    @app.exception_handler(RequestValidationError)
    async def _invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        errors = first_errors(error.errors())
        detail = "; ".join(f"{each['where']}: {each['message']}" for each in errors[:3])
        return Problem("invalid", detail, errors=errors).response(request.url.path)

    @app.exception_handler(ClientDisconnect)
    async def _gone(request: Request, error: ClientDisconnect) -> JSONResponse:
        # nobody hears it but a client that was too slow
        return too_slow().response(request.url.path)

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        code = _BY_STATUS.get(error.status_code, "internal" if error.status_code >= 500 else "invalid")
        problem = Problem(code, str(error.detail), headers=error.headers)
        problem.status = error.status_code
        return problem.response(request.url.path)

    @app.exception_handler(DBAPIError)
    async def _database(request: Request, error: DBAPIError) -> JSONResponse:
        _log.warning("the database refused: %s", str(error).splitlines()[0])
        problem = Problem("unavailable", "the database cannot be reached", headers={"Retry-After": "2"})
        return problem.response(request.url.path)

    @app.exception_handler(Exception)
    async def _unexpected(request: Request, error: Exception) -> JSONResponse:
        _log.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return Problem("internal", "an error that is not the request's").response(request.url.path)
