"""The pages' files, served from the package: nothing is built, nothing comes from elsewhere."""

from __future__ import annotations

from pathlib import Path

from fastapi import FastAPI, Response
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles

STATIC = Path(__file__).parent / "static"
PAGES = {"/": "index.html", "/docs": "docs.html"}
"""By path: the live page, and the interface to read and to try (Swagger UI over /openapi.json)."""
_HEADERS = {
    "Cache-Control": "no-cache",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
}


class _Files(StaticFiles):
    """Static files that a browser asks again about each time: after an update no old script stays."""

    def file_response(self, *args: object, **kwargs: object) -> Response:
        """As the base class, with no-cache: an unchanged file is answered with 304."""
        response = super().file_response(*args, **kwargs)  # type: ignore[arg-type]
        response.headers["Cache-Control"] = "no-cache"
        return response


def add_page(app: FastAPI) -> None:
    """Serve the pages and their files under `/static`."""
    app.mount("/static", _Files(directory=STATIC), name="static")
    for path, name in PAGES.items():
        _add(app, path, STATIC / name)


def _add(app: FastAPI, path: str, file: Path) -> None:
    @app.get(path, include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(file, media_type="text/html", headers=_HEADERS)
