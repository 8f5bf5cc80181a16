"""The status over HTTP: a thin adapter of `StatusCore`.

The page at `/` and all answers need nothing from elsewhere; only `/docs` loads its script from a CDN.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable

import uvicorn
from fastapi import FastAPI, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Gauge, generate_latest

from schemas.base import Message
from schemas.world import GraphRequest
from services.status.board import Board
from services.status.config import Config
from services.status.core import StatusCore
from services.status.live import Painter
from services.status.live_socket import add_live
from services.status.page import add_page
from services.status.picture import render_png
from services.status.report import Readiness, StatusReport
from services.status.view import View

_REPORT_S = 0.5
_NO_STORE = {"Cache-Control": "no-store"}


class SharedStatus:
    """A `StatusCore` behind a lock: subscribers write, requests read. now_ns: the local monotonic clock."""

    def __init__(self, config: Config, robot: str, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.config = config
        self._core = StatusCore(config, robot)
        self._lock = threading.Lock()
        self._now_ns = now_ns

    def observe(self, topic_name: str, message: Message) -> None:
        """Take in one message, from any thread."""
        with self._lock:
            self._core.observe(topic_name, message, self._now_ns())

    def graph_request(self, stamp_ns: int) -> GraphRequest | None:
        """See `StatusCore.graph_request`."""
        with self._lock:
            return self._core.graph_request(self._now_ns(), stamp_ns)

    def snapshot(self) -> bytes:
        """See `StatusCore.snapshot`."""
        with self._lock:
            return self._core.snapshot()

    def restore(self, snapshot: bytes) -> None:
        """See `StatusCore.restore`."""
        with self._lock:
            self._core.restore(snapshot)

    def status(self) -> StatusReport:
        """See `StatusCore.status`."""
        with self._lock:
            return self._core.status(self._now_ns())

    def not_ready(self) -> list[str]:
        """See `StatusCore.not_ready`."""
        with self._lock:
            return self._core.not_ready(self._now_ns())

    def picture_png(self) -> bytes:
        """The map as PNG; drawn outside the lock."""
        with self._lock:
            picture = self._core.picture()
        return render_png(picture, self.config.map_size_px)

    def view(self, tiles_since: int, with_report: bool) -> View:
        """See `StatusCore.view`."""
        with self._lock:
            return self._core.view(self._now_ns(), tiles_since, with_report)

    def metrics(self) -> bytes:
        """Prometheus text: the numbers of the mission, and of every service its rate, step time and
        errors.
        """
        with self._lock:
            numbers, report = self._core.numbers(self._now_ns()), self._core.status(self._now_ns())
        registry = CollectorRegistry()
        for name, value in numbers.items():
            Gauge(f"plgrim_{name}", name.replace("_", " "), registry=registry).set(value)
        for field in ("rate_hz", "step_p50_ms", "step_p99_ms", "memory_mb", "errors"):
            gauge = Gauge(f"plgrim_stage_{field}", f"{field} of a service", ["service"], registry=registry)
            for stage in report.stages:
                gauge.labels(stage.service).set(getattr(stage, field))
        dropped = Gauge("plgrim_dropped", "refused messages", ["service", "reason"], registry=registry)
        for stage in report.stages:
            for reason, count in stage.dropped.items():
                dropped.labels(stage.service, reason).set(count)
        return generate_latest(registry)


class LiveStatus:
    """Draws the shared status onto a board for the live page. Report and curves at most every `_REPORT_S`."""

    def __init__(self, shared: SharedStatus) -> None:
        self._shared = shared
        self._painter = Painter()
        self._reported_s = -math.inf

    @property
    def board(self) -> Board:
        """What browsers are sent."""
        return self._painter.board

    def tick(self) -> None:
        """Draw what has changed."""
        now_s = time.monotonic()
        due = now_s - self._reported_s >= _REPORT_S
        self._reported_s = now_s if due else self._reported_s
        self._painter.paint(self._shared.view(self._painter.pastes, due))


def create_app(shared: SharedStatus) -> FastAPI:
    """The HTTP application over a shared status."""
    app = FastAPI(title="PLGRIM status", version="1", description="What the robot does, and why.")

    @app.get("/healthz")
    def healthz() -> dict[str, str]:
        """This process answers. It says nothing about the robot: see /readyz."""
        return {"status": "ok"}

    @app.get("/readyz", responses={503: {"model": Readiness}})
    def readyz(response: Response) -> Readiness:
        """200 when every expected service and topic is there, 503 with the reasons otherwise."""
        reasons = shared.not_ready()
        response.status_code = 503 if reasons else 200
        return Readiness(ready=not reasons, reasons=reasons)

    @app.get("/api/v1/status")
    def status() -> StatusReport:
        """Phase, pose, coverage, target and why, plan, and how every service is."""
        return shared.status()

    @app.get("/map.png", response_class=Response, responses={200: {"content": {"image/png": {}}}})
    def map_png() -> Response:
        """The map as far as it is known, with the driven path, the plan and the target."""
        return Response(shared.picture_png(), media_type="image/png", headers=_NO_STORE)

    @app.get("/metrics", response_class=Response, include_in_schema=False)
    def metrics() -> Response:
        """For Prometheus."""
        return Response(shared.metrics(), media_type=CONTENT_TYPE_LATEST)

    add_live(app, LiveStatus(shared))
    add_page(app)
    return app


class PortTakenError(RuntimeError):
    """The address of the status service cannot be used."""


class StatusServer:
    """Serves the application from a thread of its own."""

    def __init__(self, shared: SharedStatus) -> None:
        """Binds the address at once: raises `PortTakenError` with what to change."""
        self.shared = shared
        self._socket = _bind(shared.config.host, shared.config.port)
        self.port: int = self._socket.getsockname()[1]
        settings = uvicorn.Config(create_app(shared), log_level="warning", ws="websockets-sansio", ws_per_message_deflate=False, lifespan="off")
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
