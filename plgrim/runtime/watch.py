"""Watches the pulses of services from a thread of its own and flags those that live but make no steps."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from plgrim.logs import get_logger
from plgrim.runtime.pulse import Reading, read_pulse

FLAG_PERIODS = 2.5
"""Periods without the end of a step after which a service is flagged: less than three after it went astray, as that may
be up to one period after its last step."""
_SHORTEST_S, _LONGEST_S = 0.005, 0.05
_LOGGED_S = 1.0
"""A busy machine makes a service of 20 Hz late now and then: only what lasts is worth a line."""


@dataclass(slots=True)
class Watched:
    """One service as it was seen. late_s, silent_s: watched time since the last step and heartbeat (s).

    Watched time grows by no more than four times `_LONGEST_S` a look, so that a supervisor that was itself stopped, or
    starved, blames nobody for it. flagged_s: monotonic seconds since when it is flagged.
    """

    reading: Reading
    late_s: float = 0.0
    silent_s: float = 0.0
    flagged_s: float | None = None
    told: bool = False

    def look(self, reading: Reading, passed_s: float, now: float) -> None:
        """Take in one more reading."""
        if reading.pid != self.reading.pid:
            self.late_s = self.silent_s = 0.0
        self.late_s = 0.0 if reading.steps != self.reading.steps else self.late_s + passed_s
        self.silent_s = 0.0 if reading.beats != self.reading.beats else self.silent_s + passed_s
        self.reading = reading
        if not self.expected:
            self.late_s = self.silent_s = 0.0
        limit_s = FLAG_PERIODS * reading.period_ns / 1e9
        if not self.late_s or self.late_s < limit_s:
            self.flagged_s, self.told = None, False
        elif self.flagged_s is None:
            self.flagged_s = now

    @property
    def expected(self) -> bool:
        """Whether steps can be expected: the first one may have to load or compile what it needs."""
        r = self.reading
        return bool(r.pid and r.period_ns and r.steps and not r.compiling)


class Watch:
    """Looks at `<folder>/<service>` several times a period. A context manager; ask `flagged` and `silent_s`.

    flags: how often each service was flagged.
    """

    def __init__(
        self, folder: Path, services: tuple[str, ...], stopwatch: Callable[[], float] = time.monotonic
    ) -> None:
        self._folder = folder
        self._stopwatch = stopwatch
        self._watched = {name: Watched(Reading()) for name in services}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._looked_s = stopwatch()
        self.flags: Counter[str] = Counter()

    def start(self) -> None:
        """Begin to watch."""
        self._thread.start()

    def stop(self) -> None:
        """End it; harmless when it was never started."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(2.0)

    def _run(self) -> None:
        while not self._stop.wait(self._pause_s()):
            self.look()

    def _pause_s(self) -> float:
        periods = [w.reading.period_ns / 1e9 for w in self._watched.values() if w.reading.period_ns]
        return min(_LONGEST_S, max(_SHORTEST_S, min(periods, default=1.0) / 5))

    def look(self) -> None:
        """One look at all of them."""
        now = self._stopwatch()
        passed_s, self._looked_s = min(now - self._looked_s, 4 * _LONGEST_S), now
        for name, watched in self._watched.items():
            reading = read_pulse(self._folder / name)
            with self._lock:
                before = watched.flagged_s
                watched.look(reading, passed_s, now)
                self._tell(name, watched, before, now)

    def _tell(self, name: str, watched: Watched, before: float | None, now: float) -> None:
        if watched.flagged_s is not None and before is None:
            self.flags[name] += 1
        if watched.flagged_s is not None and not watched.told and now - watched.flagged_s > _LOGGED_S:
            watched.told = True
            get_logger().warning("makes no steps", child=name, for_s=round(watched.late_s, 2))

    def flagged(self) -> dict[str, float]:
        """The services that live but have made no step for 2.5 of their periods; monotonic seconds since when."""
        with self._lock:
            return {n: w.flagged_s for n, w in self._watched.items() if w.flagged_s is not None}

    def late_s(self, service: str, pid: int) -> float:
        """Watched seconds since the process last ended a step, when steps can be expected of it; else 0."""
        with self._lock:
            watched = self._watched[service]
            return watched.late_s if watched.reading.pid == pid else 0.0

    def silent_s(self, service: str, pid: int) -> float:
        """Watched seconds since the last heartbeat of this very process, when it has begun to step; else 0."""
        with self._lock:
            watched = self._watched[service]
            return watched.silent_s if watched.expected and watched.reading.pid == pid else 0.0
