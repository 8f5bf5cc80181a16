"""What happened in a mission, in plain words: from the messages, for results and reports."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from schemas.base import Message
from schemas.contract import SECOND_NS, Stamp
from schemas.operation import JudgeReport, MissionState, StageHealth
from schemas.policy import GlobalPolicy, Plan, SafetyState
from schemas.world import CoverageSummary
from services.status.events import SAFETY_WORDS, GivenUp

_MOST = 2000
_QUIET = frozenset({SafetyState.RUN, SafetyState.DONE, SafetyState.RETURN})


@dataclass(slots=True)
class EventLog:
    """Collects events: {"t_s", "kind", "text"}, oldest first, at most 2000; `dropped` counts those beyond.

    t_s: mission clock, s. kind: mission, target, safety, given up, fault.
    """

    events: list[dict[str, Any]] = field(default_factory=list)
    dropped: int = 0
    _phase: str = ""
    _target: int = -1
    _safety: SafetyState = SafetyState.RUN
    _errors: Counter[str] = field(default_factory=Counter)
    _given_up: GivenUp = field(default_factory=GivenUp)
    _lost: bool = False

    def observe(self, message: Message, now: Stamp) -> None:
        """Take in a message. now: mission clock, ns."""
        match message:
            case MissionState():
                self._mission(message, now)
            case GlobalPolicy():
                self._policy(message, now)
            case Plan():
                self._plan(message, now)
            case CoverageSummary():
                self._coverage(message, now)
            case StageHealth() if message.errors > self._errors[message.service]:
                self._errors[message.service] = message.errors
                self._add(now, "fault", f"{message.service}: {message.last_error}")
            case JudgeReport() if message.lost and not self._lost:
                self._lost = True
                self._add(now, "fault", f"the robot is lost: {message.lost_reason}")

    def since(self, zero_ns: Stamp) -> list[dict[str, Any]]:
        """The events with times since `zero_ns`; what came before it has a negative one."""
        return [{**event, "t_s": round(event["t_s"] - zero_ns / SECOND_NS, 1)} for event in self.events]

    def _add(self, now: Stamp, kind: str, text: str) -> None:
        if len(self.events) >= _MOST:
            self.dropped += 1
            return
        self.events.append({"t_s": round(now / SECOND_NS, 1), "kind": kind, "text": text})

    def _mission(self, m: MissionState, now: Stamp) -> None:
        if m.phase.value != self._phase:
            self._phase = m.phase.value
            finish = f" ({m.finish.value})" if m.finish.value else ""
            self._add(now, "mission", f"{m.phase.value}{finish}" + (f": {m.reason}" if m.reason else ""))

    def _policy(self, m: GlobalPolicy, now: Stamp) -> None:
        if m.target == self._target:
            return
        self._target = m.target
        if m.target < 0:
            self._add(now, "target", f"no target: {m.reason}")
            return
        x, y, _ = m.target_xyz_m
        why = "left the last target for" if m.switched else "chose"
        said = m.reason.removeprefix(f"frontier {m.target}: ")
        self._add(now, "target", f"{why} frontier {m.target} at ({x:.1f}, {y:.1f}): {said}")

    def _plan(self, m: Plan, now: Stamp) -> None:
        if m.safety is self._safety:
            return
        before, self._safety = self._safety, m.safety
        if m.safety not in _QUIET or before not in _QUIET:
            why = f": {m.reason}" if m.reason and m.safety is not SafetyState.RUN else ""
            self._add(now, "safety", SAFETY_WORDS[m.safety.value] + why)

    def _coverage(self, m: CoverageSummary, now: Stamp) -> None:
        for x, y, reason in self._given_up.fresh(m):
            self._add(now, "given up", f"frontier at ({x:.1f}, {y:.1f}) given up: {reason}")
