"""The safety state machine: every combination of ages and phases, and each limit stepped over."""

from __future__ import annotations

import itertools

import pytest

from schemas.operation import MissionPhase
from schemas.policy import SafetyState
from services.reconciler.safety import SafetyInputs, SafetyLimits, Verdict, judge

LIMITS = SafetyLimits(risk_s=1.5, odometry_s=0.5, irm_s=3.0, policy_silent_s=6.0)
RUN, DEGRADED, HOLD, RETURN, DONE = SafetyState

ASKED_BY_PHASE = {
    None: HOLD,
    MissionPhase.IDLE: HOLD,
    MissionPhase.EXPLORE: RUN,
    MissionPhase.PAUSED: HOLD,
    MissionPhase.RETURN: RETURN,
    MissionPhase.STOPPED: DONE,
    MissionPhase.DONE: DONE,
}


def ages(limit_s: float) -> tuple[tuple[float | None, bool], ...]:
    """(age, too old): never, fresh, exactly at the limit, just over it, long over it."""
    return ((None, True), (0.0, False), (limit_s, False), (limit_s + 1e-6, True), (100.0, True))


def test_every_combination() -> None:
    silences = ((0.0, False), (6.0, False), (6.1, True))
    for (risk, risk_old), (odometry, odometry_old), (irm, irm_old), (
        silence,
        silent,
    ), phase in itertools.product(ages(1.5), ages(0.5), ages(3.0), silences, ASKED_BY_PHASE):
        verdict = judge(LIMITS, SafetyInputs(risk, odometry, irm, silence, phase))
        asked = {ASKED_BY_PHASE[phase]}
        asked |= {HOLD} if risk_old or odometry_old else set()
        asked |= {DEGRADED} if irm_old or silent else set()
        most_severe = max(asked, key=list(SafetyState).index)
        case = (risk, odometry, irm, silence, phase)
        assert verdict.state is most_severe, case
        assert verdict.may_move == (not asked & {HOLD, DONE}), case
        assert bool(verdict.reason) == (most_severe is not RUN), case
        assert verdict.slow == (DEGRADED in asked), case


def good(phase: MissionPhase = MissionPhase.EXPLORE) -> SafetyInputs:
    return SafetyInputs(0.1, 0.02, 0.4, 0.0, phase)


@pytest.mark.parametrize(
    ("name", "limit_s", "over"),
    [
        ("risk_age_s", 1.5, HOLD),
        ("odometry_age_s", 0.5, HOLD),
        ("irm_age_s", 3.0, DEGRADED),
        ("policy_silence_s", 6.0, DEGRADED),
    ],
)
def test_stepping_time_over_each_limit_and_back(name: str, limit_s: float, over: SafetyState) -> None:
    for tenth in range(200):
        age = tenth / 10
        verdict = judge(LIMITS, SafetyInputs(**{**good()._asdict(), name: age}))
        assert verdict.state is (over if age > limit_s else RUN), age
    assert judge(LIMITS, good()) == Verdict(RUN, "", True, False), "it has no memory: what is well again runs"


def test_a_return_stops_when_something_asks_for_a_hold_and_says_so() -> None:
    verdict = judge(LIMITS, good(MissionPhase.RETURN)._replace(risk_age_s=9.0))
    assert verdict.state is RETURN
    assert not verdict.may_move
    assert "risk map" in verdict.reason


@pytest.mark.parametrize("failed", ["riskmap", "irm", "gcp", "lcp", "mission", "sim"])
def test_a_failed_stage_that_is_needed_holds(failed: str) -> None:
    verdict = judge(LIMITS, good()._replace(failed=(failed,)))
    assert verdict.state is HOLD
    assert not verdict.may_move
    assert f"{failed} failed" in verdict.reason
    assert not judge(LIMITS, good(MissionPhase.RETURN)._replace(failed=(failed,))).may_move


def test_a_failed_status_page_and_a_full_disk_degrade_but_do_not_slow() -> None:
    for changed in (good()._replace(failed=("status",)), good()._replace(unsaved=("irm",))):
        verdict = judge(LIMITS, changed)
        assert (verdict.state, verdict.may_move, verdict.slow) == (DEGRADED, True, False)
        assert "status" in verdict.reason or "irm cannot write" in verdict.reason
    assert judge(LIMITS, good()._replace(unsaved=("irm",), irm_age_s=9.0)).slow


def test_every_reason_to_stop_is_named() -> None:
    verdict = judge(LIMITS, SafetyInputs(9.0, None, None, 9.0, MissionPhase.PAUSED))
    assert not verdict.may_move
    for word in ("risk map is 9.0 s old", "no odometry yet", "mission paused"):
        assert word in verdict.reason
