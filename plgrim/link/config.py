"""The section `link` of the configuration; the same file on both hosts but for `host`."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from schemas.contract import SECOND_NS
from schemas.topics import MAY_RUN_AT_BASE, TOPICS

MayMove = Literal["irm", "lcp", "gcp", "status"]


class LinkConfig(BaseModel):
    """Robot and base station. Rates are of bytes on the link, in 1000 bytes/s; times are wall time."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    host: Literal["", "robot", "base"] = ""
    """On which of the two hosts this process runs; empty: there is only one."""
    endpoint: str = Field("", pattern=r"^$|^(tcp|tls|quic)/.+")
    """The base's router, as the robot dials it (`tls/base:7447`). Empty: no link."""
    at_base: tuple[MayMove, ...] = ("gcp", "status")
    """Services that run at the base. Of irm, lcp and gcp a standby runs on the robot."""
    commands_kb_per_s: float = Field(60.0, gt=0, le=1e6)
    """At most so much from robot to base on the lane of commands, plans, states and heartbeats."""
    maps_kb_per_s: float = Field(120.0, gt=0, le=1e6)
    """At most so much on the lane of maps. Both together below what the link carries: nothing then queues in it."""
    topic_kb_per_s: dict[str, float] = Field(
        default_factory=lambda: {"sim/odometry": 8.0, "reconciler/plan": 16.0, "riskmap/risk_map": 60.0}
    )
    """At most so much of one topic (`irm/local_irm: 40`); one of which only the newest counts is then sent less often."""
    queue_kb: float = Field(2000.0, gt=0, le=1e6)
    """What a topic of which every message counts may keep waiting; then differences are dropped, and asked for anew."""
    send_buffer_bytes: int = Field(32_768, ge=4096, le=16_000_000)
    """Of the connection for maps: what the kernel holds of them delays everything else on the link."""
    lease_ms: int = Field(2000, ge=200, le=60_000)
    """Silence after which a connection to the base counts as lost, ms."""
    silent_after_s: float = Field(2.0, ge=0.2, le=60)
    """So long without a good word from the base's instance, and the robot's own takes over."""
    hand_back_after_s: float = Field(2.0, ge=0.0, le=600)
    """So long in step without a break, and the base's instance is obeyed again; doubles when it fails soon after."""
    behind_after_s: float = Field(2.5, ge=0.2, le=60)
    """An instance whose newest input is older than that is not in step, and what it makes of it is not passed on."""

    @field_validator("topic_kb_per_s")
    @classmethod
    def _known_topics(cls, value: dict[str, float]) -> dict[str, float]:
        crossing = [topic.name for topic in TOPICS if topic.crosses_link]
        for name, rate in value.items():
            if name not in crossing:
                raise ValueError(
                    f"{name!r} is no topic that crosses the link; there are {', '.join(crossing)}"
                )
            if not 0.0 < rate <= 1e6:
                raise ValueError(f"{name}: {rate:g} kB/s is not within 0 and 1e6; a topic cannot be shut off")
        return value

    def instance(self, service: str) -> str:
        """`base`, `standby`, or empty where a service has one instance only."""
        if not self.host or service not in self.at_base or service not in MAY_RUN_AT_BASE:
            return ""
        return "base" if self.host == "base" else "standby"

    @property
    def leased(self) -> tuple[str, ...]:
        """The stages that run at the base and have a standby."""
        return tuple(name for name in MAY_RUN_AT_BASE if name in self.at_base)

    def ns(self, name: str) -> int:
        """A time of this section in ns."""
        return int(getattr(self, name) * SECOND_NS)
