"""Each planner of the paper's experiments drives: the first half minute of a mission in lock-step, all stages real."""

from __future__ import annotations

import pytest

from plgrim.config import load_config
from plgrim.evaluation.campaign_plan import merged
from plgrim.evaluation.paper import PLANNERS
from plgrim.evaluation.recorder import MissionRecorder
from plgrim.registry import STAGES
from plgrim.runtime.lockstep import Lockstep
from schemas.contract import SECOND_NS, Stamp, Topic
from schemas.policy import LocalPhase, LocalPolicy
from schemas.topics import LOCAL_POLICY


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("planner", PLANNERS)
def test_it_covers_and_is_not_lost(planner: str) -> None:
    config = load_config(None, merged(PLANNERS[planner], {"seed": 101, "sim": {"world": "subway_1x"}}))
    recorder = MissionRecorder(101, "subway_1x", "lockstep")
    answers: list[LocalPolicy] = []

    def observe(topic: Topic, message: object, now: Stamp) -> None:  # type: ignore[type-arg]
        recorder.observe(topic, message, now)  # type: ignore[arg-type]
        if topic is LOCAL_POLICY:
            assert isinstance(message, LocalPolicy)
            answers.append(message)

    lockstep = Lockstep({name: config.options(name) for name in STAGES}, 101, observer=observe)
    lockstep.run_until(30 * SECOND_NS)
    judge = recorder.judge
    assert judge is not None and not judge.lost
    assert judge.covered_area_m2 > 150.0
    assert judge.distance_m > 8.0
    phases = {answer.phase for answer in answers}
    assert (LocalPhase.GUIDE if planner == "hfe" else LocalPhase.COVER) in phases
    assert all(
        (answer.simulations > 0) == (planner == "plgrim") for answer in answers if answer.phase == "cover"
    )
