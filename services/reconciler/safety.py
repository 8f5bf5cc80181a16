"""The safety state machine: pure, the most severe reason wins."""

from __future__ import annotations

from typing import NamedTuple

from schemas.operation import MissionPhase
from schemas.policy import SafetyState

_SEVERITY = [SafetyState.RUN, SafetyState.DEGRADED, SafetyState.HOLD, SafetyState.RETURN, SafetyState.DONE]


class SafetyLimits(NamedTuple):
    """Ages from which inputs are stale, s."""

    risk_s: float
    odometry_s: float
    irm_s: float
    policy_silent_s: float


class SafetyInputs(NamedTuple):
    """What the machine looks at: ages of inputs in seconds (None: never came), and the mission's phase.

    in_the_way: somebody moves so near that the robot must stand (see `separation`). fences_missing: the mission has
    fences that have not been heard of here.
    """

    risk_age_s: float | None
    odometry_age_s: float | None
    irm_age_s: float | None
    policy_silence_s: float
    phase: MissionPhase | None
    in_the_way: bool = False
    fences_missing: bool = False


class Verdict(NamedTuple):
    """The safety state, why, whether the robot may move, and whether it has to be slow (a return can be degraded)."""

    state: SafetyState
    reason: str
    may_move: bool
    slow: bool


def judge(limits: SafetyLimits, inputs: SafetyInputs) -> Verdict:
    """The most severe state that any input asks for, with its reason.

    DONE and HOLD stop the robot. RETURN moves, unless something also asks for a hold.
    """
    asked = [*_stale(limits, inputs), *_mission(inputs.phase)]
    if inputs.in_the_way:
        asked.append((SafetyState.HOLD, "somebody moves in the way"))
    if inputs.fences_missing:
        asked.append((SafetyState.HOLD, "the mission's fences have not come yet"))
    if not asked:
        return Verdict(SafetyState.RUN, "", True, False)
    state, reason = max(asked, key=lambda entry: _SEVERITY.index(entry[0]))
    stops = [r for s, r in asked if s in (SafetyState.HOLD, SafetyState.DONE)]
    slow = any(s == SafetyState.DEGRADED for s, _ in asked)
    return Verdict(state, "; ".join(stops) if stops else reason, not stops, slow)


def _stale(limits: SafetyLimits, inputs: SafetyInputs) -> list[tuple[SafetyState, str]]:
    found = []
    if inputs.risk_age_s is None or inputs.risk_age_s > limits.risk_s:
        found.append((SafetyState.HOLD, _text("risk map", inputs.risk_age_s)))
    if inputs.odometry_age_s is None or inputs.odometry_age_s > limits.odometry_s:
        found.append((SafetyState.HOLD, _text("odometry", inputs.odometry_age_s)))
    if inputs.irm_age_s is None or inputs.irm_age_s > limits.irm_s:
        found.append((SafetyState.DEGRADED, _text("Local IRM", inputs.irm_age_s)))
    if inputs.policy_silence_s > limits.policy_silent_s:
        found.append((SafetyState.DEGRADED, f"no answer from lcp for {inputs.policy_silence_s:.1f} s"))
    return found


def _text(name: str, age_s: float | None) -> str:
    return f"no {name} yet" if age_s is None else f"{name} is {age_s:.1f} s old"


def _mission(phase: MissionPhase | None) -> list[tuple[SafetyState, str]]:
    if phase is None:
        return [(SafetyState.HOLD, "no mission state yet")]
    if phase == MissionPhase.EXPLORE:
        return []
    if phase == MissionPhase.RETURN:
        return [(SafetyState.RETURN, "returning")]
    if phase in (MissionPhase.DONE, MissionPhase.STOPPED):
        return [(SafetyState.DONE, f"mission {phase.value}")]
    return [(SafetyState.HOLD, f"mission {phase.value}")]
