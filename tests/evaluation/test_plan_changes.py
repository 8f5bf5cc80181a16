"""Where a new plan leaves the old one and how it turns there; hazards that come down on the driven line."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plgrim.evaluation.plan_changes import (
    WATCHED_S,
    Area,
    PlanChanges,
    first_touch_m,
    junction,
)
from schemas.base import Pose
from schemas.contract import SECOND_NS
from schemas.policy import Plan, SafetyState
from schemas.sensing import Odometry


def line(*corners: tuple[float, float]) -> np.ndarray:
    """Through corners, a point every 0.1 m."""
    points = [corners[0]]
    for (ax, ay), (bx, by) in itertools.pairwise(corners):
        steps = round(math.hypot(bx - ax, by - ay) / 0.1)
        points += [(ax + (bx - ax) * i / steps, ay + (by - ay) * i / steps) for i in range(1, steps + 1)]
    return np.array(points)


def plan(number: int, points: np.ndarray, valid: bool = True) -> Plan:
    """A plan along a line."""
    zeros = np.zeros(len(points))
    return Plan(
        stamp_ns=0, plan_id=number, episode=number, valid=valid, safety=SafetyState.RUN, reason="", tau_s=0.0,
        kept_points=0, ttl_s=1.0, risk_stamp_ns=0, x_m=points[:, 0].copy(), y_m=points[:, 1].copy(), yaw_rad=zeros,
        speed_mps=zeros, time_s=zeros,
    )  # fmt: skip


def odometry(yaw_rad: float = 0.0, frame: Pose | None = None) -> Odometry:
    """The robot looks that way."""
    return Odometry(
        stamp_ns=0, pose=Pose(yaw_rad=yaw_rad), map_to_odom=frame or Pose(), speed_mps=0.0, turn_rate_radps=0.0,
        covariance=np.zeros((3, 3)),
    )  # fmt: skip


EAST = line((0.0, 0.0), (6.0, 0.0))


def test_a_plan_that_turns_off_has_its_junction_there() -> None:
    found = junction(EAST, line((0.0, 0.0), (3.0, 0.0), (3.0, 3.0)), 0.0)
    assert found is not None
    assert found.ahead_m == pytest.approx(3.0, abs=0.15)
    assert math.degrees(found.jump_rad) == pytest.approx(90.0, abs=15.0)


@given(st.floats(-math.pi, math.pi))
def test_one_that_leaves_at_once_is_compared_with_where_the_robot_looks(yaw_rad: float) -> None:
    found = junction(EAST, line((0.0, 0.0), (0.0, 4.0)), yaw_rad)
    assert found is not None and found.ahead_m <= 0.11
    assert found.jump_rad == pytest.approx(
        abs(math.remainder(math.pi / 2.0 - yaw_rad, 2.0 * math.pi)), abs=1e-9
    )


def test_one_that_goes_on_where_the_old_one_ended_leaves_it_there() -> None:
    straight = junction(EAST, line((0.0, 0.0), (9.0, 0.0)), 0.0)
    assert straight is not None
    assert straight.ahead_m == pytest.approx(6.0, abs=0.15)
    assert straight.jump_rad == pytest.approx(0.0, abs=1e-9)
    corner = junction(EAST, line((0.0, 0.0), (6.0, 0.0), (5.0, 1.0)), 0.0)
    assert corner is not None and math.degrees(corner.jump_rad) > 90.0


def test_the_same_line_a_cut_one_and_one_that_was_driven_on_are_no_junctions() -> None:
    assert junction(EAST, EAST, 1.0) is None
    assert junction(EAST, EAST[:20], 1.0) is None
    assert junction(EAST, EAST[15:] + 0.004, 1.0) is None
    assert junction(np.zeros((0, 2)), EAST, 1.0) is None
    assert junction(EAST, np.zeros((0, 2)), 1.0) is None


def test_where_a_disc_first_touches_an_area() -> None:
    block: Area = (3.0, -0.4, 3.8, 0.4)
    assert first_touch_m(EAST, block, 0.25) == pytest.approx(2.8, abs=0.06)
    assert first_touch_m(EAST + np.array([0.0, 0.7]), block, 0.25) is None
    assert first_touch_m(EAST + np.array([0.0, 0.6]), block, 0.25) is not None
    assert first_touch_m(np.zeros((0, 2)), block, 0.25) is None


def test_figures_of_junctions() -> None:
    seen = PlanChanges()
    seen.see_pose(odometry())
    for number, points in enumerate(
        (EAST, EAST, line((0.0, 0.0), (0.0, 5.0)), line((0.0, 0.0), (0.0, 9.0))), start=1
    ):
        seen.see_plan(plan(number, points), number)
    found = seen.result()
    assert found["junctions"] == 2
    assert found["heading_jump_deg"] == pytest.approx(45.0)  # 90 and 0
    assert found["sharp_jumps"] == 1
    assert found["junction_ahead_m"] == pytest.approx(2.5, abs=0.1)  # 0 and 5
    empty = PlanChanges().result()
    assert (empty["junctions"], empty["heading_jump_deg"], empty["hazard_reaction_s"]) == (0, None, None)


def hazard_run(after: list[tuple[float, Plan]], frame: Pose | None = None) -> dict[str, float]:
    """A block comes down at second 10 on a way to the east; the plans that follow, and when."""
    blocks: list[Area] = []
    seen = PlanChanges(0.25, lambda: blocks)
    seen.see_pose(odometry(0.0, frame))
    seen.see_plan(plan(1, EAST), 9 * SECOND_NS)
    blocks.append((3.0, -0.4, 3.8, 0.4))
    for at_s, following in after:
        seen.see_plan(following, int(at_s * SECOND_NS))
    return seen.result()


AROUND = line((0.0, 0.0), (1.0, 0.0), (1.0, 4.0))


def test_cut_and_reaction_are_timed_from_when_the_block_came_down() -> None:
    same, cut, around = plan(1, EAST), plan(2, EAST[:25]), plan(3, AROUND)
    found = hazard_run([(10.0, same), (10.5, cut), (11.0, cut), (12.0, around), (13.0, around)])
    assert (found["hazards"], found["hazard_cut_s"], found["hazard_reaction_s"]) == (1, 0.5, 2.0)


def test_a_stop_cuts_and_a_way_that_leads_on_does_both_at_once() -> None:
    found = hazard_run([(10.0, plan(1, EAST)), (10.2, plan(2, EAST, valid=False)), (14.0, plan(3, AROUND))])
    assert found["hazard_cut_s"] == pytest.approx(0.2)
    assert found["hazard_reaction_s"] == 4.0
    found = hazard_run([(10.0, plan(1, EAST)), (11.0, plan(3, AROUND))])
    assert (found["hazard_cut_s"], found["hazard_reaction_s"]) == (1.0, 1.0)


def test_a_block_beside_the_way_is_no_hazard_and_none_is_waited_for_for_ever() -> None:
    beside = hazard_run([(10.0, plan(1, EAST))], Pose(y_m=1.0))
    assert beside["hazards"] == 0
    found = hazard_run([(10.0, plan(1, EAST)), (40.0, plan(1, EAST)), (50.0, plan(2, AROUND))])
    assert (found["hazard_cut_s"], found["hazard_reaction_s"]) == (WATCHED_S, WATCHED_S)
