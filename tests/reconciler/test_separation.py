"""Speed and separation: nobody is driven into, from wherever they come; who goes away or stays away slows nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.contract import SECOND_NS
from schemas.policy import SafetyState
from schemas.topics import MOVING
from schemas.world import MovingPoints
from services.reconciler.config import Config
from services.reconciler.separation import Guard, Separation, safe_share
from tests.reconciler.rig import Rig

RULES = Separation(distance_m=0.4, mover_mps=0.8, reaction_s=0.4, braking_mps2=0.8)
AHEAD = np.array([[0.0, 0.0], [10.0, 0.0]])
TICK_S = 0.05
SEEN_LATER = 5
"""Ticks from a sweep to the robot's braking because of it: 0.25 s, the 0.1 s between two sweeps on top."""


def share(*moving: tuple[float, float], line: NDArray[np.float64] = AHEAD) -> float:
    return safe_share(line, np.array(moving).reshape(-1, 2), 1.0, RULES)


def test_nobody_near_slows_nothing() -> None:
    assert share() == 1.0
    assert share((6.0, 0.0), (0.0, 5.0), (-2.5, 0.0)) == 1.0


def test_the_nearer_the_slower_and_within_reach_it_stands() -> None:
    shares = [share((x, 0.0)) for x in np.arange(4.0, 0.3, -0.1)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] == 1.0
    assert 0.0 < share((1.5, 0.0)) < 0.7
    assert share((0.7, 0.0)) == 0.0


def test_at_the_share_it_stops_out_of_reach_and_a_tenth_faster_it_does_not() -> None:
    for x in np.arange(0.9, 2.6, 0.17):
        found = share((x, 0.0))

        def left_m(s: float, x: float = x) -> float:
            way_m = s * RULES.reaction_s + s**2 / (2.0 * RULES.braking_mps2)
            return x - way_m - RULES.mover_mps * (RULES.reaction_s + s / RULES.braking_mps2)

        assert left_m(found) >= RULES.distance_m - 1e-6
        assert found == 1.0 or left_m(found + 0.1) < RULES.distance_m


def test_driving_off_is_always_allowed() -> None:
    assert share((-0.5, 0.0)) == 1.0
    assert share((0.0, 0.5)) == 1.0, "to the side: every metre is one farther off"
    assert share((0.3, 0.5)) < 1.0


def test_who_stands_beside_the_far_end_of_a_bend_counts_by_the_way_to_it() -> None:
    away = np.array([[0.0, 0.0], [0.0, 3.0], [2.0, 3.0], [2.0, 0.0]])
    assert share((1.5, 0.0), line=away) == 1.0
    assert share((1.5, 0.0)) < 1.0


def test_a_short_path_ends_before_anybody_is_met() -> None:
    assert share((2.2, 0.0), line=np.array([[0.0, 0.0], [0.2, 0.0]])) > share((2.2, 0.0))


def test_it_falls_at_once_and_rises_as_fast_as_the_robot_may_speed_up() -> None:
    config = Config()
    guard = Guard(config)
    near, nobody = np.array([[0.7, 0.0]], np.float32), np.zeros((0, 2), np.float32)
    guard.watch(0, nobody, AHEAD)
    assert guard.share == 1.0
    guard.watch(SECOND_NS // 10, near, AHEAD)
    assert guard.share == 0.0
    other = Guard(config)
    other.load(guard.state())
    for k in range(2, 40):
        guard.watch(k * SECOND_NS // 10, nobody, AHEAD)
        allowed = (k - 1) * 0.1 * config.max_acceleration_mps2 / config.max_speed_mps
        assert guard.share == pytest.approx(min(1.0, math.floor(10.0 * allowed + 1e-6) / 10.0))
    other.watch(3 * SECOND_NS // 10, None, AHEAD)
    assert other.share == 0.0, "it goes on from its state; what was told last holds"
    for k in range(20, 30):
        other.watch(k * SECOND_NS // 10, None, AHEAD)
    assert other.share > 0.0, "but not for ever: grids alone tell nothing of what moves"


class Walker:
    """Walks on a straight line at constant speed. Its visible surface: the half disc towards the robot."""

    def __init__(self, at: NDArray[np.float64], bearing_rad: float, speed_mps: float) -> None:
        self.at = at
        self.velocity = speed_mps * np.array([math.cos(bearing_rad), math.sin(bearing_rad)])

    def surface(self, robot: NDArray[np.float64], radius_m: float = 0.3) -> NDArray[np.float32]:
        towards = math.atan2(*(robot - self.at)[::-1])
        angles = towards + np.linspace(-1.2, 1.2, 9)
        return (self.at + radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)).astype(np.float32)


@settings(max_examples=300, deadline=None)
@given(
    bearing=st.floats(-math.pi, math.pi),
    speed_mps=st.floats(0.0, 0.8),
    meets_s=st.floats(1.5, 6.0),
    misses_m=st.floats(-0.5, 0.5),
)
def test_it_drives_into_nobody_from_wherever_they_come(
    bearing: float, speed_mps: float, meets_s: float, misses_m: float
) -> None:
    """The robot drives straight on at 1 m/s; somebody crosses its way, about where it would be after a while.

    It stands before they touch, or they come upon it from where it does not drive to.
    """
    config = Config()
    guard, robot, speed = Guard(config), np.zeros(2), 1.0
    meets = np.array([meets_s + misses_m, 0.0])
    begins = meets - speed_mps * meets_s * np.array([math.cos(bearing), math.sin(bearing)])
    walker = Walker(begins, bearing, speed_mps)
    if math.dist(robot, walker.at) < 3.0:
        return
    seen: list[NDArray[np.float32]] = []
    for tick in range(round(10.0 / TICK_S)):
        if tick % 2 == 0:
            seen.append(walker.surface(robot))
            late = len(seen) - 1 - math.ceil(SEEN_LATER / 2)
            line = np.stack([robot, robot + np.array([12.0, 0.0])])
            guard.watch(tick * SECOND_NS // 20, seen[late] if late >= 0 else None, line)
        wanted = guard.share * config.max_speed_mps
        speed += min(
            max(wanted - speed, -config.max_acceleration_mps2 * TICK_S), config.max_acceleration_mps2 * TICK_S
        )
        robot = robot + np.array([speed * TICK_S, 0.0])
        walker.at = walker.at + walker.velocity * TICK_S
        gap_m = math.dist(robot, walker.at) - config.footprint_radius_m - 0.3
        if gap_m <= 0.0:
            nearing_mps = speed * float((walker.at - robot)[0]) / math.dist(robot, walker.at)
            assert nearing_mps <= 0.02, f"driven into at {nearing_mps:.2f} m/s after {tick * TICK_S:.1f} s"
            return


def test_the_stage_stands_while_somebody_is_in_the_way_and_drives_on_after() -> None:
    rig = Rig()
    rig.run(3.0)
    assert rig.last().valid and rig.speed_mps > 0.5
    episodes = len(rig.requests)

    def somebody(ahead_m: float) -> None:
        for _ in range(round(0.5 * 10)):
            at = rig.x_m + ahead_m * math.cos(rig.yaw_rad), rig.y_m + ahead_m * math.sin(rig.yaw_rad)
            points = np.array([at], np.float32)
            rig.reconciler.put(MOVING, MovingPoints(stamp_ns=rig.now, points_m=points), rig.now)
            rig.tick()

    somebody(1.6)
    assert rig.last().valid and 0.0 < rig.last().speed_mps.max() < 0.8
    somebody(0.6)
    plan = rig.last()
    assert not plan.valid and plan.safety is SafetyState.HOLD and plan.reason == "somebody moves in the way"
    assert rig.speed_mps == 0.0
    rig.run(1.5)
    assert not rig.last().valid, "what was told last holds"
    nobody = np.zeros((0, 2), np.float32)
    for _ in range(20):
        rig.reconciler.put(MOVING, MovingPoints(stamp_ns=rig.now, points_m=nobody), rig.now)
        rig.tick()
    assert rig.last().valid and rig.speed_mps > 0.5
    assert len(rig.requests) > episodes
