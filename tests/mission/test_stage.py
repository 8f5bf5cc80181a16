"""The mission stage with messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from schemas.base import Message, Pose
from schemas.contract import SECOND_NS, Inputs, Received, Topic
from schemas.operation import CommandKind, FinishReason, MissionCommand, MissionPhase, MissionState
from schemas.sensing import Odometry
from schemas.topics import COMMAND, COVERAGE, GLOBAL_IRM, MISSION, MISSION_GRAPH_REQUEST, ODOMETRY
from schemas.world import CoverageSummary, GlobalIrm
from services.mission.stage import Config, MissionStage, spec


def odometry(x_m: float, map_to_odom: Pose | None = None) -> Odometry:
    return Odometry(
        stamp_ns=0,
        pose=Pose(x_m=x_m),
        map_to_odom=map_to_odom or Pose(),
        speed_mps=0.0,
        turn_rate_radps=0.0,
        covariance=np.zeros((3, 3)),
    )


def coverage(settled: bool, area_m2: float = 10.0) -> CoverageSummary:
    return CoverageSummary(
        stamp_ns=0,
        irm_version=1,
        reachable_area_m2=max(100.0, area_m2),
        covered_area_m2=area_m2,
        covered_fraction=area_m2 / max(100.0, area_m2),
        entropy_left=0.0,
        frontiers=1,
        frontier_gain=1.0,
        breadcrumbs=3,
        settled=settled,
        unreachable_xy_m=np.array([[7.0, 8.0]]),
        unreachable_gain=np.array([4.0]),
        unreachable_reason=["behind rubble"],
    )


def corridor(version: int, base: int = 0) -> GlobalIrm:
    """Breadcrumbs at 0, 10 and 20 m joined by a detour of 15 m an edge, and a frontier at 30 m."""
    return GlobalIrm(
        stamp_ns=0,
        irm_version=version,
        base_version=base,
        robot_pose=Pose(),
        map_to_odom=Pose(),
        robot_node=3,
        node_id=np.array([1, 2, 3, 4]),
        node_kind=np.array([0, 0, 0, 1], np.uint8),
        node_xyz_m=np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0], [30, 0, 0]]),
        node_gain=np.array([0.0, 0, 0, 2.0]),
        node_coverage=np.zeros(4, np.float32),
        edge_a=np.array([1, 2, 3]),
        edge_b=np.array([2, 3, 4]),
        edge_distance_m=np.array([15.0, 15, 10]),
        edge_risk=np.zeros(3),
        edge_driven=np.ones(3, np.uint8),
        removed_node=np.empty(0, np.int64),
        removed_edge=np.empty((0, 2), np.int64),
    )


class Bench:
    """Steps the stage every half second."""

    def __init__(self, **config: Any) -> None:
        self.stage = MissionStage(Config.model_validate(config))
        self.now = 0
        self.requests = 0

    def step(self, *pairs: tuple[Topic[Any], Message]) -> MissionState:
        self.now += SECOND_NS // 2
        messages: dict[str, list[Received[Message]]] = {}
        for topic, message in pairs:
            received = Received(message, topic.writer, 1, 1, self.now, 0, fresh=True, stale=False)
            messages.setdefault(topic.name, []).append(received)
        found = {o.topic.name: o.message for o in self.stage.step(self.now, Inputs(messages))}
        self.requests += MISSION_GRAPH_REQUEST.name in found
        state = found[MISSION.name]
        assert isinstance(state, MissionState)
        return state


def test_way_home_is_by_the_graph() -> None:
    bench = Bench()
    bench.step((ODOMETRY, odometry(0.0)))
    for x_m in np.arange(1.0, 22.0):
        state = bench.step((ODOMETRY, odometry(float(x_m))))
    assert state.return_distance_m == pytest.approx(21.0)  # no graph yet: the way that was driven
    assert state.distance_m == pytest.approx(21.0)
    state = bench.step((ODOMETRY, odometry(22.0)), (GLOBAL_IRM, corridor(1)))
    assert state.return_distance_m == pytest.approx(2.0 + 30.0)


def test_home_and_place_are_in_the_map() -> None:
    bench = Bench()
    frame = Pose(x_m=5.0, yaw_rad=math.pi / 2)
    state = bench.step((ODOMETRY, odometry(3.0, frame)))
    assert (state.home.x_m, state.home.y_m) == pytest.approx((5.0, 3.0))
    state = bench.step((ODOMETRY, odometry(3.0, Pose(x_m=9.0, yaw_rad=math.pi / 2))))
    assert state.distance_m == 0.0  # a loop closure is not travel


def test_asks_for_the_graph_now_and_then() -> None:
    bench = Bench(ask_again_s=2.0)
    for version in range(5, 12):
        bench.step((GLOBAL_IRM, corridor(version, base=version - 1)))
    assert bench.requests == 2
    bench.step((GLOBAL_IRM, corridor(12)))
    bench.step()
    assert bench.requests == 2


def test_left_says_what_and_why() -> None:
    bench = Bench(settle_s=1.0)
    bench.step((ODOMETRY, odometry(0.0)), (GLOBAL_IRM, corridor(1)))
    state = bench.step((COVERAGE, coverage(settled=False)))
    assert [(place.x_m, place.gain, place.reason) for place in state.left] == [
        (7.0, 4.0, "behind rubble"),
        (30.0, 2.0, "not visited yet"),
    ]
    for _ in range(3):
        state = bench.step((COVERAGE, coverage(settled=True)))
    state = bench.step()
    assert (state.phase, state.finish) == (MissionPhase.DONE, FinishReason.COVERED)
    assert state.left[1].reason == "the mission ended first (covered)"
    assert state.coverage == pytest.approx(0.1)


def test_snapshot_and_restore() -> None:
    bench = Bench()
    bench.step((ODOMETRY, odometry(0.0)), (GLOBAL_IRM, corridor(1)), (COVERAGE, coverage(settled=False)))
    bench.step((ODOMETRY, odometry(1.5)))
    pause = MissionCommand(stamp_ns=0, command_id="p", kind=CommandKind.PAUSE)
    bench.step((COMMAND, pause))
    twin = Bench()
    twin.stage.restore(bench.stage.snapshot())
    twin.now = bench.now
    for message in (odometry(1.5), odometry(2.5)):
        assert bench.step((ODOMETRY, message)) == twin.step((ODOMETRY, message))
    assert twin.stage.snapshot() == bench.stage.snapshot()


def test_fresh_restores_before_anything_came() -> None:
    twin = Bench()
    twin.stage.restore(Bench().stage.snapshot())
    assert twin.step().phase == MissionPhase.IDLE


def test_spec_and_unknown_keys() -> None:
    assert spec(Config(period_s=0.5)).period_ns == SECOND_NS // 2
    with pytest.raises(ValueError, match="no_such_key"):
        Config.model_validate({"no_such_key": 1})


@pytest.mark.parametrize(
    ("worth_m_per_nat", "area_m2", "covered"),
    [
        (4.0, 1000.0, True),  # 2 nats at 10 m are worth 8 m, and little beside 1000 m2
        (6.0, 1000.0, False),  # worth 12 m
        (4.0, 100.0, False),  # as much as 2 % of the ground known is not left
        (0.0, 1000.0, False),  # all is worth any way
    ],
)
def test_little_that_is_far_away_is_left(worth_m_per_nat: float, area_m2: float, covered: bool) -> None:
    bench = Bench(settle_s=1.0, worth_m_per_nat=worth_m_per_nat)
    bench.step((ODOMETRY, odometry(20.0)), (GLOBAL_IRM, corridor(1)))
    for _ in range(5):
        state = bench.step((COVERAGE, coverage(settled=False, area_m2=area_m2)))
    assert (state.phase == MissionPhase.DONE) == covered
    if covered:
        assert "places are left" in state.reason


def test_a_robot_that_stands_drives_no_way_whatever_the_noise_of_its_pose() -> None:
    bench = Bench()
    bench.step((ODOMETRY, odometry(0.0)))
    for n in range(200):
        state = bench.step((ODOMETRY, odometry(0.03 * (-1) ** n)))
    assert state.distance_m == 0.0
    for n in range(100):
        state = bench.step((ODOMETRY, odometry(0.04 * n)))  # slower than the noise, a step
    assert state.distance_m == pytest.approx(4.0, abs=0.2)
