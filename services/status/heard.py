"""What was heard, of whom, and how fresh it is: the newest message of each topic with its age and rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from schemas.base import Message
from schemas.contract import SECOND_NS
from schemas.operation import StageHealth
from schemas.topics import health_topic, topic_named
from services.status.config import Config
from services.status.report import StageReport, TopicReport

_RATE_SMOOTHING = 0.2
_FROM_THE_ROBOT = ("sim/odometry", "mission/state", "reconciler/plan", "riskmap/risk_map")
"""Told by the robot's own processes wherever the planners run: all of them stale, and nothing is known of it."""
_M = TypeVar("_M", bound=Message)


@dataclass(slots=True)
class _Seen:
    """One topic as received. received_ns: local clock; interval_s: mean time between messages."""

    message: Message
    received_ns: int
    count: int = 1
    interval_s: float = 0.0


class Heard:
    """The newest message of each topic. Times are of one clock, ns: the one that every call is given."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._seen: dict[str, _Seen] = {}

    def note(self, topic_name: str, message: Message, now_ns: int) -> None:
        """Take in one message."""
        seen = self._seen.get(topic_name)
        if seen is None:
            self._seen[topic_name] = _Seen(message, now_ns)
            return
        interval_s = (now_ns - seen.received_ns) / SECOND_NS
        smooth = _RATE_SMOOTHING if seen.interval_s > 0 else 1.0
        seen.interval_s += smooth * (interval_s - seen.interval_s)
        seen.message, seen.received_ns, seen.count = message, now_ns, seen.count + 1

    def latest(self, topic_name: str, kind: type[_M]) -> _M | None:
        """The newest message of a topic, or None when none has come."""
        seen = self._seen.get(topic_name)
        return seen.message if seen is not None and isinstance(seen.message, kind) else None

    def age_s(self, topic_name: str, now_ns: int) -> float | None:
        """Since the newest message of a topic; None: none has come."""
        seen = self._seen.get(topic_name)
        return None if seen is None else (now_ns - seen.received_ns) / SECOND_NS

    def _is_stale(self, topic_name: str, now_ns: int) -> bool:
        """By the table of topics; one that has not come is not stale, but missing."""
        seen, limit_ns = self._seen.get(topic_name), topic_named(topic_name).stale_after_ns
        return seen is not None and 0 < limit_ns < now_ns - seen.received_ns

    def silent_s(self, now_ns: int) -> float | None:
        """How long nothing has come from a robot that was heard before; None: it is heard, or never was."""
        known = [name for name in _FROM_THE_ROBOT if name in self._seen]
        if not known or not all(self._is_stale(name, now_ns) for name in known):
            return None
        return min((now_ns - self._seen[name].received_ns) / SECOND_NS for name in known)

    def not_ready(self, now_ns: int) -> list[str]:
        """Why the robot is not ready, in plain words; empty when it is."""
        reasons = [reason for stage in self.stages(now_ns) if (reason := _why_not(stage))]
        for name in self._config.expected_topics:
            age_s = self.age_s(name, now_ns)
            if age_s is None:
                reasons.append(f"{name}: nothing received yet")
            elif self._is_stale(name, now_ns):
                reasons.append(f"{name}: nothing for {age_s:.1f} s")
        return reasons

    def stages(self, now_ns: int) -> list[StageReport]:
        """Every service that is expected, and what else was heard."""
        heard = {name.split("/")[0] for name in self._seen if name.endswith("/health")}
        extra = sorted(heard - set(self._config.expected_services))
        return [self._stage(name, now_ns) for name in (*self._config.expected_services, *extra)]

    def _stage(self, service: str, now_ns: int) -> StageReport:
        topic = health_topic(service)
        health, age_s = self.latest(topic.name, StageHealth), self.age_s(topic.name, now_ns)
        if health is None or age_s is None:
            return StageReport(service=service, state="missing")
        late = age_s * SECOND_NS > topic.stale_after_ns
        state = "silent" if late else "ok" if health.ready else "not_ready"
        return StageReport(state=state, age_s=age_s, **health.model_dump(exclude={"stamp_ns", "ready"}))

    def topics(self, now_ns: int) -> list[TopicReport]:
        """Every topic that was heard."""
        return [self._topic(name, seen, now_ns) for name, seen in sorted(self._seen.items())]

    def _topic(self, name: str, seen: _Seen, now_ns: int) -> TopicReport:
        age_s = (now_ns - seen.received_ns) / SECOND_NS
        return TopicReport(
            name=name,
            messages=seen.count,
            age_s=age_s,
            rate_hz=1.0 / max(seen.interval_s, age_s) if seen.interval_s > 0 else 0.0,
            stale=self._is_stale(name, now_ns),
        )


def _why_not(stage: StageReport) -> str:
    """Why a service is not ready; empty when it is."""
    if stage.state == "missing":
        return f"{stage.service}: not heard of yet"
    if stage.state == "silent":
        return f"{stage.service}: silent for {stage.age_s:.1f} s"
    if stage.state == "not_ready":
        waiting = f", waiting for {', '.join(stage.waiting_for)}" if stage.waiting_for else ""
        return f"{stage.service}: not ready{waiting}"
    return ""
