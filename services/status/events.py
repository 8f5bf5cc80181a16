"""What happened and why, in plain words, out of the messages: each event once, with a number to go on from."""

from __future__ import annotations

import math
import re
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from schemas.base import Message
from schemas.contract import SECOND_NS
from schemas.fences import Fences
from schemas.operation import CommandAnswer, JudgeReport, MissionState, StageHealth
from schemas.policy import GlobalPolicy, Plan
from schemas.world import CoverageSummary

_LOG_2 = math.log(2.0)
_LOW_RISK, _HIGH_RISK = 0.1, 0.3
_SAME_M = 1.0
_TOLD_S = 180
"""A place that was given up counts as told for so long after it was last listed."""
_AT_REST = ("idle", "paused", "stopped", "done")
"""Phases in which the robot stands because it was told to."""
SAFETY_WORDS = {
    "run": "drives on",
    "degraded": "drives on slowly",
    "hold": "stands still",
    "return": "drives home",
    "done": "stands for good",
}
"""What the robot does in each safety state of the plan."""
_SKIPPED_IDS = 1000
"""More than the events between two snapshots: numbers that clients have seen are not given again."""


class Event(BaseModel):
    """One event. id: ascending; go on from it with `Last-Event-ID` or `after`."""

    model_config = ConfigDict(
        frozen=True,
        json_schema_extra={
            "examples": [
                {
                    "id": 17,
                    "mission_time_s": 61.0,
                    "kind": "target",
                    "severity": "info",
                    "text": "chose frontier 41: 38 cells expected, 12 m, low risk; first target",
                    "data": {"frontier": 41, "gain": 26.3, "distance_m": 12.1, "risk": 0.02, "q": 11.5},
                }
            ]
        },
    )

    id: int
    mission_time_s: float = Field(description="Mission clock, s.")
    kind: str = Field(description="target, given_up, mission, command, fences, safety, fault.")
    severity: str = Field(description="info, warning or error.")
    text: str
    data: dict[str, Any] = Field(default_factory=dict)


def _without_numbers(text: str) -> str:
    """A reason whose ages and distances alone have changed is the same one."""
    return re.sub(r"-?\d+(\.\d+)?", "", text)


def risk_in_words(risk: float) -> str:
    """low, medium or high: the probability of failing on the way."""
    return "low risk" if risk < _LOW_RISK else "medium risk" if risk < _HIGH_RISK else "high risk"


def frontier_in_words(frontier: int, gain: float, distance_m: float, risk: float) -> str:
    """As "frontier 41: 38 cells expected, 12 m, low risk"; a cell is a whole patch of the Local IRM."""
    cells = round(gain / _LOG_2)
    return f"frontier {frontier}: {cells} cells expected, {distance_m:.0f} m, {risk_in_words(risk)}"


@dataclass(slots=True)
class GivenUp:
    """Tells which places are given up anew: noise makes frontiers come and go at one place every second or two."""

    _until: list[tuple[float, float, str, int]] = field(default_factory=list)
    """x, y, reason, and the time until which the place counts as told, ns."""

    def fresh(self, coverage: CoverageSummary) -> list[tuple[float, float, str]]:
        """(x, y, reason) of what is listed and was not, for the same reason within `_SAME_M`, in the last minutes."""
        now, until = coverage.stamp_ns, coverage.stamp_ns + _TOLD_S * SECOND_NS
        told = [place for place in self._until if place[3] > now]
        found: list[tuple[float, float, str]] = []
        for (x, y), reason in zip(
            coverage.unreachable_xy_m.tolist(), coverage.unreachable_reason, strict=False
        ):
            near = [
                k
                for k, (a, b, r, _) in enumerate(told)
                if r == reason and math.dist((x, y), (a, b)) < _SAME_M
            ]
            if not near:
                found.append((x, y, reason))
                told.append((x, y, reason, until))
            for k in near:
                told[k] = (*told[k][:3], until)
        self._until = told
        return found

    def state(self) -> list[list[Any]]:
        """For a snapshot."""
        return [list(place) for place in self._until]

    def set_state(self, state: list[list[Any]]) -> None:
        """Go on from `state`; places of an older snapshot, without times, count as new."""
        self._until = [(float(p[0]), float(p[1]), str(p[2]), int(p[3])) for p in state if len(p) == 4]


@dataclass(slots=True)
class EventLog:
    """The newest events. Fed with every message; says something when something changed."""

    most: int = 2000
    last_id: int = 0
    events: deque[Event] = field(default_factory=deque)
    _target: int = -1
    _phase: str = ""
    _safety: tuple[str, str] = ("", "")
    _fences: int = 0
    _given_up: GivenUp = field(default_factory=GivenUp)
    _health: dict[str, tuple[bool, int]] = field(default_factory=dict)
    _lost: bool = False

    def after(self, last_id: int) -> list[Event]:
        """The events later than one, oldest first.

        One that was never given is of another life of the service, whose numbers were lost: then all there are.
        """
        if last_id > self.last_id:
            last_id = 0
        return [event for event in self.events if event.id > last_id]

    def observe(self, message: Message) -> None:
        """Take in one message."""
        match message:
            case GlobalPolicy():
                self._policy(message)
            case MissionState():
                self._mission(message)
            case CoverageSummary():
                self._coverage(message)
            case Plan():
                self._plan(message)
            case StageHealth():
                self._stage(message)
            case Fences():
                self._polygons(message)
            case CommandAnswer():
                self._answer(message)
            case JudgeReport():
                self._judge(message)

    def add(self, stamp_ns: int, kind: str, text: str, severity: str = "info", **data: Any) -> None:
        """Note an event."""
        self.last_id += 1
        event = Event(
            id=self.last_id,
            mission_time_s=stamp_ns / SECOND_NS,
            kind=kind,
            severity=severity,
            text=text,
            data=data,
        )
        self.events.append(event)
        while len(self.events) > self.most:
            self.events.popleft()

    def _policy(self, policy: GlobalPolicy) -> None:
        before, self._target = self._target, policy.target
        if policy.target == before:
            return
        if policy.target < 0:
            self.add(policy.stamp_ns, "target", policy.reason, before=before)
            return
        if policy.reason.startswith("home"):
            text = f"heads {policy.reason}"
        else:
            told = frontier_in_words(
                policy.target, policy.target_gain, policy.target_distance_m, policy.target_risk
            )
            _, _, why = policy.reason.partition("; ")
            text = f"chose {told}" + (f"; {why.replace('Q ', 'value ')}" if why else "")
        self.add(
            policy.stamp_ns,
            "target",
            text,
            frontier=policy.target,
            before=before,
            gain=policy.target_gain,
            distance_m=policy.target_distance_m,
            risk=policy.target_risk,
            q=policy.target_q,
            switched=policy.switched,
        )

    def _mission(self, state: MissionState) -> None:
        before, self._phase = self._phase, state.phase.value
        if state.phase.value == before:
            return
        text = f"mission {state.phase.value}: {state.reason}"
        self.add(state.stamp_ns, "mission", text, before=before, finish=state.finish.value)

    def _coverage(self, coverage: CoverageSummary) -> None:
        """Frontiers that were given up lately."""
        for x, y, reason in self._given_up.fresh(coverage):
            text = f"gave up the frontier at ({x:.1f}, {y:.1f}): {reason}"
            self.add(coverage.stamp_ns, "given_up", text, x_m=x, y_m=y, reason=reason)

    def _plan(self, plan: Plan) -> None:
        state = (plan.safety.value, plan.reason if plan.safety.value != "run" else "")
        before, self._safety = self._safety, state
        if [_without_numbers(part) for part in state] == [_without_numbers(part) for part in before]:
            return
        wanted = state[0] in ("run", "done", "return") or (state[0] == "hold" and self._phase in _AT_REST)
        severity = "info" if wanted else "warning"
        text = SAFETY_WORDS[state[0]] + (f": {state[1]}" if state[1] else "")
        self.add(plan.stamp_ns, "safety", text, severity, before=before[0])

    def _stage(self, health: StageHealth) -> None:
        before = self._health.get(health.service)
        self._health[health.service] = (health.ready, health.errors)
        if before is None:
            return
        if health.errors > before[1]:
            text = f"{health.service}: {health.last_error}"
            self.add(health.stamp_ns, "fault", text, "error", service=health.service)
        if health.ready != before[0]:
            text = f"{health.service} is {'ready' if health.ready else 'not ready'}"
            severity = "info" if health.ready else "warning"
            self.add(health.stamp_ns, "fault", text, severity, service=health.service)

    def _polygons(self, fences: Fences) -> None:
        before, self._fences = self._fences, fences.version
        if fences.version != before:
            names = ", ".join(fence.fence_id for fence in fences.fences) or "none"
            self.add(fences.stamp_ns, "fences", f"fences now: {names}", version=fences.version)

    def _answer(self, answer: CommandAnswer) -> None:
        word = "obeyed" if answer.accepted else "refused"
        severity = "info" if answer.accepted else "warning"
        text = f"{word} {answer.kind.value}: {answer.reason}"
        self.add(answer.stamp_ns, "command", text, severity, command_id=answer.command_id)

    def _judge(self, judge: JudgeReport) -> None:
        before, self._lost = self._lost, judge.lost
        if judge.lost and not before:
            self.add(judge.stamp_ns, "fault", f"robot lost: {judge.lost_reason}", "error")

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {
            "last_id": self.last_id,
            "events": [event.model_dump() for event in self.events],
            "target": self._target,
            "phase": self._phase,
            "safety": list(self._safety),
            "fences": self._fences,
            "given_up": self._given_up.state(),
            "lost": self._lost,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self.last_id = state["last_id"] + _SKIPPED_IDS
        self.events = deque(Event.model_validate(event) for event in state["events"])
        self._target, self._phase = state["target"], state["phase"]
        self._safety = (state["safety"][0], state["safety"][1])
        self._fences, self._lost = state["fences"], state["lost"]
        self._given_up.set_state(state["given_up"])
