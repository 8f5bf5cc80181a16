"""Errors over HTTP as problem+json (RFC 9457): what is wrong, in which field, and the mend."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

MEDIA_TYPE = "application/problem+json"


class FieldError(BaseModel):
    """One field of a request. field: where, as `body.geojson.coordinates[0]`."""

    field: str
    message: str


class Problem(BaseModel):
    """An error (RFC 9457). errors: by field, when it is about the request."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    errors: list[FieldError] = Field(default_factory=list)
    answer: dict[str, Any] | None = Field(
        None, description="The mission's own answer, when it refused a command."
    )


class ProblemError(Exception):
    """Raised by a route to be answered with a problem."""

    def __init__(
        self,
        status: int,
        detail: str,
        errors: Sequence[FieldError] = (),
        answer: dict[str, Any] | None = None,
        headers: dict[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status, self.detail = status, detail
        self.errors, self.answer, self.headers = list(errors), answer, headers


class FiniteJSONResponse(JSONResponse):
    """JSON in which numbers that are not finite are null: no reader chokes on NaN."""

    def render(self, content: Any) -> bytes:
        """The bytes."""
        return json.dumps(
            finite(content), ensure_ascii=False, allow_nan=False, separators=(",", ":")
        ).encode()


def finite(value: Any) -> Any:
    """The value with null for every number that is not finite, at any depth."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite(inner) for inner in value]
    return value


def field_name(location: Sequence[str | int]) -> str:
    """`body.points[3]` from its parts."""
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _content(error: ProblemError) -> dict[str, Any]:
    problem = Problem(
        title=HTTPStatus(error.status).phrase,
        status=error.status,
        detail=error.detail,
        errors=error.errors,
        answer=error.answer,
    )
    return problem.model_dump(mode="json", exclude_none=True)


def problem_json(error: ProblemError) -> bytes:
    """The problem as JSON."""
    return json.dumps(finite(_content(error)), ensure_ascii=False).encode()


def problem_response(error: ProblemError) -> Response:
    """The answer."""
    return FiniteJSONResponse(_content(error), error.status, error.headers, media_type=MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Have every error of an application answered as a problem, and its OpenAPI document say so."""

    @app.exception_handler(ProblemError)
    def _problem(request: Request, error: ProblemError) -> Response:
        return problem_response(error)

    @app.exception_handler(HTTPException)
    def _http(request: Request, error: HTTPException) -> Response:
        headers = dict(error.headers) if error.headers else {}
        if error.status_code == 405:  # Starlette names the methods of one of the routes of this path alone
            headers["Allow"] = ", ".join(_allowed(app, request.url.path)) or headers.get("Allow", "GET")
        return problem_response(ProblemError(error.status_code, str(error.detail), headers=headers))

    @app.exception_handler(RequestValidationError)
    def _invalid(request: Request, error: RequestValidationError) -> Response:
        errors = [FieldError(field=field_name(e["loc"]), message=e["msg"]) for e in error.errors()]
        first = f"{errors[0].field}: {errors[0].message}" if errors else "the request does not fit"
        return problem_response(ProblemError(422, first, errors))

    @app.exception_handler(Exception)
    def _fault(request: Request, error: Exception) -> Response:
        detail = "the status service failed; its log says where"
        return problem_response(ProblemError(500, detail))

    app.openapi = lambda: _document(app)  # type: ignore[method-assign]


def _allowed(app: FastAPI, path: str) -> list[str]:
    """The methods of a path, by the document."""
    found: set[str] = set()
    for template, operations in app.openapi()["paths"].items():
        pattern = "[^/]+".join(re.escape(part) for part in re.split(r"\{[^}]+\}", template))
        if re.fullmatch(pattern, path):
            found |= {method.upper() for method in operations}
    return sorted(found)


_COMMON = {
    "400": "The request cannot be read.",
    "401": "A token is needed.",
    "403": "The token's role does not allow it, or the request comes from a foreign host or page.",
}


def _document(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document, with problems in place of FastAPI's own errors."""
    if app.openapi_schema:
        return app.openapi_schema
    document = get_openapi(
        title=app.title,
        version=app.version,
        description=app.description,
        routes=app.routes,
        tags=app.openapi_tags,
    )
    parts = document.setdefault("components", {}).setdefault("schemas", {})
    for name in ("HTTPValidationError", "ValidationError"):
        parts.pop(name, None)
    schema = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
    parts.update(schema.pop("$defs", {}))
    parts["Problem"] = schema
    for path in document["paths"].values():
        for method, operation in path.items():
            _describe(operation)
            if method == "get" and "security" in operation:
                operation["security"].append({})  # reading needs no token on a loopback address
    app.openapi_schema = document
    return document


def _describe(operation: dict[str, Any]) -> None:
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    responses = operation["responses"]
    common = dict(_COMMON)
    if "422" in responses:
        common["422"] = "A field does not fit; `errors` names it."
    for status, text in common.items():
        responses[status] = {"description": text}
    for status, response in responses.items():
        if int(status) >= 400 and not response.get("content"):
            response["content"] = content
