"""The status behind a lock: subscribers write, requests read."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

from prometheus_client import CollectorRegistry, Gauge, generate_latest

from schemas.base import Message
from schemas.fences import Fences
from schemas.operation import CommandAnswer
from schemas.world import GraphRequest
from services.status.commands import CommandDesk
from services.status.config import Config
from services.status.core import StatusCore
from services.status.geojson import FeatureCollectionOut, fences_geojson
from services.status.picture import render_png
from services.status.report import StatusReport

_T = TypeVar("_T")
_FRESH_NS = 100_000_000
"""So long a status serves all who ask for one."""


class SharedStatus:
    """A `StatusCore` behind a lock. now_ns: the local monotonic clock.

    desk: the way to the mission. configuration: the whole program's, to be read; set by whoever runs the service.
    """

    def __init__(self, config: Config, robot: str, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.config = config
        self.desk = CommandDesk(config.command_timeout_s, now_ns)
        self.configuration: dict[str, Any] = {"status": config.model_dump(mode="json")}
        self._core = StatusCore(config, robot)
        self._lock = threading.Lock()
        self._now_ns = now_ns
        self._made: tuple[int, StatusReport | None] = (0, None)

    def observe(self, topic_name: str, message: Message) -> None:
        """Take in one message, from any thread."""
        with self._lock:
            self._core.observe(topic_name, message, self._now_ns())
        if isinstance(message, CommandAnswer):
            self.desk.answered(message)

    def read(self, work: Callable[[StatusCore, int], _T]) -> _T:
        """What `work(core, now_ns)` gives, with the core locked meanwhile: take out what is needed and be quick."""
        with self._lock:
            return work(self._core, self._now_ns())

    def fences(self) -> FeatureCollectionOut:
        """The fences that hold, as GeoJSON."""
        held = self.read(lambda core, now_ns: core.latest("mission/fences", Fences))
        return fences_geojson(held.version if held else 0, held.fences if held else [])

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
        """See `StatusCore.status`. Made anew at most ten times a second, however many ask."""
        with self._lock:
            now_ns = self._now_ns()
            made_ns, report = self._made
            if report is None or not 0 < now_ns - made_ns < _FRESH_NS:
                report = self._core.status(now_ns)
                self._made = now_ns, report
            return report

    def not_ready(self) -> list[str]:
        """See `StatusCore.not_ready`."""
        with self._lock:
            return self._core.not_ready(self._now_ns())

    def picture_png(self) -> bytes:
        """The map as PNG; drawn outside the lock."""
        with self._lock:
            picture = self._core.picture()
        return render_png(picture, self.config.map_size_px)

    def metrics(self) -> bytes:
        """Prometheus text: the numbers of the mission, and of every service its rate, step time and errors."""
        with self._lock:
            numbers, report = self._core.numbers(self._now_ns()), self._core.status(self._now_ns())
            link = self._core.link()
        registry = CollectorRegistry()
        for name, value in numbers.items():
            Gauge(f"plgrim_{name}", name.replace("_", " "), registry=registry).set(value)
        if report.mission is not None:
            phase = Gauge("plgrim_mission_phase", "1 for the phase that is", ["phase"], registry=registry)
            phase.labels(report.mission.phase).set(1.0)
        for field in ("rate_hz", "step_p50_ms", "step_p99_ms", "memory_mb", "errors"):
            gauge = Gauge(f"plgrim_stage_{field}", f"{field} of a service", ["service"], registry=registry)
            for stage in report.stages:
                gauge.labels(stage.service).set(getattr(stage, field))
        dropped = Gauge("plgrim_dropped", "refused messages", ["service", "reason"], registry=registry)
        for stage in report.stages:
            for reason, count in stage.dropped.items():
                dropped.labels(stage.service, reason).set(count)
        if link is not None:
            used = Gauge("plgrim_link_kb_per_s", "use of the link", ["way", "topic"], registry=registry)
            for way, rates in (("down", link.down_kb_per_s), ("up", link.up_kb_per_s)):
                for topic, rate in rates.items():
                    used.labels(way, topic).set(rate)
        return generate_latest(registry)
