"""How a service is: measured by its driver, published as StageHealth, answered to health checks.

Liveness (the token) says that a process is connected; health says that it makes progress.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

import psutil

from plgrim.runtime.pulse import Pulse
from plgrim.runtime.watch import FLAG_PERIODS
from plgrim.runtime.zenoh_session import Link
from schemas.codec import decode
from schemas.contract import Stamp, root_of
from schemas.operation import StageHealth
from schemas.topics import health_topic

_WINDOW = 512
_SHORTEST_STUCK_S = 1.0
"""The supervisor flags what is late by its pulse; in health, heard twice a second, only more than this counts."""
_MIB = 1024 * 1024


def token_key(robot: str, service: str, instance: str) -> str:
    """Key of a service's liveliness token; `*` as instance matches all of them."""
    return f"{root_of(robot)}/{service}/alive/{instance}"


def query_key(robot: str, service: str) -> str:
    """Key on which a service answers queries with its health."""
    return f"{root_of(robot)}/{service}/health_now"


def quantile(values: list[float], share: float) -> float:
    """The value at a share (0..1) of the sorted values, nearest rank; 0 when there are none."""
    if not values:
        return 0.0
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


@dataclass(slots=True)
class HealthMonitor:
    """Counts what the driver reports. Safe to read from another thread.

    stuck_after_s: a step that has run so long (wall) makes the service not ready; `expect` sets it. degraded: what the
    service goes on without.
    """

    service: str
    stuck_after_s: float = 10.0
    degraded: str = ""
    pulse: Pulse = field(default_factory=lambda: Pulse(None))
    ready: bool = False
    errors: int = 0
    last_error: str = ""
    steps: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    _seconds: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    _ended: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    _began: float | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _process: psutil.Process = field(default_factory=psutil.Process)

    def expect(self, period_s: float) -> None:
        """From now on a step ends at least once in `period_s` wall seconds; the first may take what it needs."""
        self.stuck_after_s = max(_SHORTEST_STUCK_S, FLAG_PERIODS * period_s)
        self.pulse.expect(period_s)

    def step_began(self) -> None:
        """A step starts now."""
        self._began = time.monotonic()

    def step_ended(self) -> None:
        """The step that began last has ended, well or not."""
        ended = time.monotonic()
        with self._lock:
            self.steps += 1
            self._seconds.append(ended - (self._began or ended))
            self._ended.append(ended)
            self._began = None
        self.pulse.stepped()

    def failed(self, error: BaseException) -> None:
        """Count an error of the stage."""
        self.errors += 1
        self.last_error = f"{type(error).__name__}: {error}"[:500]

    def report(self, now: Stamp, dropped: dict[str, int], waiting_for: list[str]) -> StageHealth:
        """The message. dropped, waiting_for: what the mailbox knows."""
        with self._lock:
            seconds, ended, began = list(self._seconds), list(self._ended), self._began
        stuck = bool(began and self.steps and time.monotonic() - began > self.stuck_after_s)
        return StageHealth(
            stamp_ns=now,
            service=self.service,
            ready=self.ready and not stuck,
            steps=self.steps,
            step_p50_ms=1e3 * quantile(seconds, 0.5),
            step_p99_ms=1e3 * quantile(seconds, 0.99),
            rate_hz=_rate(ended),
            memory_mb=self._process.memory_info().rss / _MIB,
            pid=os.getpid(),
            errors=self.errors,
            last_error="a step does not end" if stuck else self.last_error,
            dropped={**dropped, **self.dropped},
            waiting_for=waiting_for,
            degraded=self.degraded[:500],
        )


def _rate(ended: list[float], span_s: float = 5.0) -> float:
    now = time.monotonic()
    recent = [t for t in ended if now - t <= span_s]
    return len(recent) / max(0.5, now - recent[0]) if recent else 0.0


class Heartbeat:
    """Calls `beat` at once and then every `period_s` wall seconds, from a thread of its own, until stopped."""

    def __init__(self, period_s: float, beat: Callable[[], None]) -> None:
        self._period_s = period_s
        self._beat = beat
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        self._beat()
        while not self._stop.wait(self._period_s):
            self._beat()

    def stop(self) -> None:
        """End it and wait for the last beat."""
        self._stop.set()
        self._thread.join(2.0)


def ask_health(link: Link, service: str, timeout_s: float = 1.0, instance: str = "") -> StageHealth | None:
    """The health of a running service, asked end to end; None when it does not answer. Raises MessageError.

    instance: which of two instances of the service is asked (`LinkConfig.instance`).
    """
    payload = link.ask(query_key(link.robot, f"{instance}/{service}".lstrip("/")), timeout_s)
    if not payload:
        return None
    topic = health_topic(service)
    return decode(payload, topic.message, topic.max_bytes)[0]
