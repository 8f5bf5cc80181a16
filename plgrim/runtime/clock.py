"""The live mission clock: the one place where the runtime reads the machine's clock."""

from __future__ import annotations

import time
from dataclasses import dataclass

from plgrim.config import ClockConfig
from schemas.contract import SECOND_NS, Stamp


@dataclass(frozen=True, slots=True)
class MissionClock:
    """Mission time from the machine's clock: `(reading - origin_ns) * speed`.

    CLOCK_MONOTONIC is system wide on Linux, so that all processes of a host share it, and no step of the wall clock
    moves it. Ages of messages are differences of this clock: stale limits are in mission time.
    """

    speed: float = 1.0
    origin_ns: int = 0
    realtime: bool = False

    @classmethod
    def of(cls, config: ClockConfig) -> MissionClock:
        """The clock of a configuration."""
        return cls(config.speed, config.origin_ns, config.source == "realtime")

    def now_ns(self) -> Stamp:
        """Mission clock, ns; 0 before the origin."""
        reading = time.time_ns() if self.realtime else time.monotonic_ns()
        return max(0, int((reading - self.origin_ns) * self.speed))

    def wall_seconds(self, mission_ns: int) -> float:
        """Wall seconds that a span of mission time takes."""
        return mission_ns / self.speed / SECOND_NS
