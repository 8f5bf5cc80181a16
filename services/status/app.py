"""The status over HTTP: a thin adapter of `StatusCore`. Its pages and answers need nothing from elsewhere."""

from __future__ import annotations

import math
import socket
import threading
import time
from typing import Literal

import uvicorn
from fastapi import Depends, FastAPI, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel

from services.status.api_mission import mission_routes
from services.status.api_views import NO_STORE, view_routes
from services.status.board import Board
from services.status.live import Painter
from services.status.live_socket import add_live
from services.status.once import Once
from services.status.page import add_page
from services.status.problems import FiniteJSONResponse, install
from services.status.report import Readiness
from services.status.security import check_binding, require_viewer, require_viewer_socket, secure
from services.status.shared import SharedStatus

__all__ = ["PortTakenError", "SharedStatus", "StatusServer", "create_app"]

_SLOW_S = 0.5
_DESCRIPTION = """What the robot does and why, and how to steer it.

Lengths are in metres, angles in radians, times in seconds of mission time, places in the frame `map` unless a field
says otherwise. Every error is a problem (RFC 9457, `application/problem+json`) that names the field and the mend.
"""
_TAGS = [
    {"name": "health", "description": "For supervisors and load balancers."},
    {"name": "status", "description": "How it is."},
    {
        "name": "mission",
        "description": "The mission, and the commands to it. These need the token of an operator.",
    },
    {"name": "planners", "description": "What they think."},
    {"name": "map", "description": "What is known of the world."},
    {"name": "events", "description": "What happened, and why."},
    {"name": "access", "description": "Tokens."},
]


class LiveStatus:
    """Draws the shared status onto a board for the live page. What changes slowly at most every `_SLOW_S`."""

    def __init__(self, shared: SharedStatus) -> None:
        self._shared = shared
        self._painter = Painter()
        self._told_s = -math.inf
        self.tick()  # its kernel is compiled before anybody looks
        self._told_s = -math.inf

    @property
    def board(self) -> Board:
        """What browsers are sent."""
        return self._painter.board

    def tick(self) -> None:
        """Draw what has changed."""
        now_s, since = time.monotonic(), self._painter.pastes
        due = now_s - self._told_s >= _SLOW_S
        self._told_s = now_s if due else self._told_s
        self._painter.paint(self._shared.read(lambda core, now_ns: core.view(now_ns, since, due)))


def create_app(shared: SharedStatus) -> FastAPI:
    """The HTTP application over a shared status. Raises SecurityError."""
    app = FastAPI(
        title="PLGRIM",
        version="1",
        description=_DESCRIPTION,
        openapi_tags=_TAGS,
        docs_url=None,  # FastAPI's own pages load their scripts from a CDN: see page.py
        redoc_url=None,
        default_response_class=FiniteJSONResponse,
    )
    secure(app, shared.config)
    install(app)
    _health_routes(app, shared)
    once = Once()
    app.include_router(view_routes(shared, once))
    app.include_router(mission_routes(shared))
    viewer = [Depends(require_viewer)]

    @app.get(
        "/map.png",
        tags=["map"],
        response_class=Response,
        responses={200: {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}},
        dependencies=viewer,
    )
    async def map_png() -> Response:
        """The map as far as it is known, with the driven path, the plan and the target."""
        picture = await once.get("map.png", shared.picture_png)
        return Response(picture, media_type="image/png", headers=NO_STORE)

    @app.get("/metrics", response_class=Response, include_in_schema=False, dependencies=viewer)
    async def metrics() -> Response:
        """For Prometheus."""
        return Response(await once.get("metrics", shared.metrics), media_type=CONTENT_TYPE_LATEST)

    add_live(app, LiveStatus(shared), [Depends(require_viewer_socket)])
    add_page(app)
    return app


class Alive(BaseModel):
    """This process answers."""

    status: Literal["ok"] = "ok"


def _health_routes(app: FastAPI, shared: SharedStatus) -> None:
    @app.get("/healthz", tags=["health"])
    def healthz() -> Alive:
        """This process answers. It says nothing about the robot: see /readyz."""
        return Alive()

    @app.get(
        "/readyz",
        tags=["health"],
        responses={503: {"model": Readiness, "description": "Not ready, and why."}},
    )
    def readyz(response: Response) -> Readiness:
        """200 when every expected service and topic is there, 503 with the reasons otherwise."""
        reasons = shared.not_ready()
        response.status_code = 503 if reasons else 200
        return Readiness(ready=not reasons, reasons=reasons)


class PortTakenError(RuntimeError):
    """The address of the status service cannot be used."""


class StatusServer:
    """Serves the application from a thread of its own."""

    def __init__(self, shared: SharedStatus) -> None:
        """Binds the address at once: raises `PortTakenError` or `SecurityError` with what to change."""
        self.shared = shared
        check_binding(shared.config)
        self._socket = _bind(shared.config.host, shared.config.port)
        self.port: int = self._socket.getsockname()[1]
        settings = uvicorn.Config(
            create_app(shared),
            log_level="warning",
            ws="websockets-sansio",
            ws_per_message_deflate=False,
            ws_max_size=4096,
            lifespan="off",
            server_header=False,
            limit_concurrency=shared.config.max_connections,
            ssl_certfile=shared.config.tls_certificate_file or None,
            ssl_keyfile=shared.config.tls_key_file or None,
        )
        self._server = uvicorn.Server(settings)
        self._thread = threading.Thread(target=self._serve, name="status-http", daemon=True)

    def _serve(self) -> None:
        self._server.run(sockets=[self._socket])

    def start(self) -> None:
        """Begin to answer."""
        self._thread.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """End the server and free the port."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        self._socket.close()


def _bind(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
        listening.listen(128)
    except OSError as error:
        listening.close()
        text = f"status cannot listen on {host}:{port}: {error.strerror}; choose another `status.port`"
        raise PortTakenError(text) from error
    return listening
