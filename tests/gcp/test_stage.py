"""The global planner's stage: its target, when it keeps it, and why."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from planning.reward import RewardWeights
from schemas.base import Message, Pose
from schemas.codec import Envelope, decode, encode
from schemas.contract import SECOND_NS, Inputs, Output, Received, StageSetup, Topic
from schemas.operation import FinishReason, MissionPhase, MissionState
from schemas.policy import GlobalPolicy
from schemas.sensing import Odometry
from schemas.topics import GCP_GRAPH_REQUEST, GLOBAL_IRM, GLOBAL_POLICY, MISSION, ODOMETRY
from schemas.world import GlobalIrm
from services.gcp import field, planner, ranking, roadnet
from services.gcp.stage import Config, GcpStage, spec, warm_up

Node = tuple[int, float, float, float]  # kind, x, y, gain
Edge = tuple[float, float]  # distance, risk

CRUMB, FRONTIER = 0, 1


def graph(
    version: int,
    nodes: dict[int, Node],
    edges: dict[tuple[int, int], Edge],
    robot_node: int = 1,
    base: int = 0,
) -> GlobalIrm:
    ids, pairs = sorted(nodes), sorted(edges)
    return GlobalIrm(
        stamp_ns=0,
        irm_version=version,
        base_version=base,
        robot_pose=Pose(),
        map_to_odom=Pose(),
        robot_node=robot_node,
        node_id=np.array(ids, np.int64),
        node_kind=np.array([nodes[i][0] for i in ids], np.uint8),
        node_xyz_m=np.array([(*nodes[i][1:3], 0.0) for i in ids], np.float64).reshape(-1, 3),
        node_gain=np.array([nodes[i][3] for i in ids], np.float64),
        node_coverage=np.zeros(len(ids), np.float32),
        edge_a=np.array([a for a, _ in pairs], np.int64),
        edge_b=np.array([b for _, b in pairs], np.int64),
        edge_distance_m=np.array([edges[p][0] for p in pairs], np.float64),
        edge_risk=np.array([edges[p][1] for p in pairs], np.float64),
        edge_driven=np.zeros(len(pairs), np.uint8),
        removed_node=np.empty(0, np.int64),
        removed_edge=np.empty((0, 2), np.int64),
    )


def fork(version: int = 1, gains: tuple[float, float] = (5.0, 5.0), **kwargs: Any) -> GlobalIrm:
    """A corridor of breadcrumbs 1 .. 5 on x = 0 .. 40 m; frontier 10 beyond 5, frontier 11 to the left of 1."""
    nodes: dict[int, Node] = {i: (CRUMB, 10.0 * (i - 1), 0.0, 0.0) for i in range(1, 6)}
    nodes[10] = (FRONTIER, 45.0, 0.0, gains[0])
    nodes[11] = (FRONTIER, 0.0, 30.0, gains[1])
    edges: dict[tuple[int, int], Edge] = {(i, i + 1): (10.0, 0.0) for i in range(1, 5)}
    edges[5, 10], edges[1, 11] = (5.0, 0.01), (30.0, 0.02)
    return graph(version, nodes, edges, **kwargs)


def odometry(x_m: float = 0.0, variance: float = 0.0) -> Odometry:
    return Odometry(
        stamp_ns=0,
        pose=Pose(x_m=x_m),
        map_to_odom=Pose(),
        speed_mps=0.0,
        turn_rate_radps=0.0,
        covariance=np.diag([variance, variance, 0.0]),
    )


def mission(
    phase: MissionPhase, finish: FinishReason = FinishReason.NONE, home_x_m: float = 0.0
) -> MissionState:
    return MissionState(
        stamp_ns=0,
        phase=phase,
        finish=finish,
        reason="",
        elapsed_s=0.0,
        time_budget_s=0.0,
        distance_m=0.0,
        return_distance_m=0.0,
        home=Pose(x_m=home_x_m),
        coverage=0.0,
        left=[],
    )


class Bench:
    """Steps a stage, with the QMDP unless told otherwise; messages are fresh, odometry stands at 0 unless given."""

    def __init__(self, **config: Any) -> None:
        self.stage = GcpStage(Config.model_validate({"solver": "qmdp", **config}), StageSetup("husky1", 7))
        self.now = 0
        self.requests = 0

    def outputs(self, *pairs: tuple[Topic[Any], Message]) -> list[Output]:
        self.now += SECOND_NS
        messages: dict[str, list[Received[Message]]] = {}
        if not any(topic is ODOMETRY for topic, _ in pairs):
            pairs = (*pairs, (ODOMETRY, odometry()))
        for topic, message in pairs:
            received = Received(message, topic.writer, 1, 1, self.now, 0, fresh=True, stale=False)
            messages.setdefault(topic.name, []).append(received)
        found = self.stage.step(self.now, Inputs(messages))
        self.requests += sum(output.topic is GCP_GRAPH_REQUEST for output in found)
        return found

    def step(self, *pairs: tuple[Topic[Any], Message]) -> GlobalPolicy:
        (policy,) = [o.message for o in self.outputs(*pairs) if o.topic is GLOBAL_POLICY]
        assert isinstance(policy, GlobalPolicy)
        return policy


def test_goes_to_the_frontier_that_pays_most() -> None:
    policy = Bench(policy_radius_m=60.0).step((GLOBAL_IRM, fork()))
    assert policy.target == 11
    assert policy.target_xyz_m == (0.0, 30.0, 0.0)
    assert policy.path_node.tolist() == [1, 11]
    assert policy.target_distance_m == pytest.approx(30.0)
    assert policy.target_risk == pytest.approx(0.02)
    assert policy.reason.startswith("frontier 11: gain 5.0, 30 m, risk 0.02; first target")
    assert not policy.switched
    by_id = dict(zip(policy.node_id.tolist(), policy.action.tolist(), strict=True))
    assert by_id == {1: 11, 2: 3, 3: 4, 4: 5, 5: 10, 10: -1, 11: -1}


def test_alternatives_name_every_frontier_with_its_q() -> None:
    policy = Bench().step((GLOBAL_IRM, fork()))
    assert [other.frontier for other in policy.alternatives] == [11, 10]
    first, second = policy.alternatives
    assert first.q == pytest.approx(policy.target_q)
    assert (second.gain, second.distance_m) == pytest.approx((5.0, 45.0))
    assert second.q < first.q


def test_q_is_the_discounted_gain_less_the_cost() -> None:
    """One edge of 30 m at rho 0.02: Q = -c' + gamma' g with the failures eliminated."""
    weights = RewardWeights()
    policy = Bench().step((GLOBAL_IRM, fork()))
    gamma = weights.gamma_per_m**30
    retry = 1 - gamma * 0.02
    cost = (weights.k_distance_per_m * 30 + weights.k_risk * 0.02) / retry
    assert policy.target_q == pytest.approx(gamma * 0.98 / retry * 5.0 - cost)
    assert policy.value[policy.node_id == 1] == pytest.approx(policy.target_q)


def test_keeps_the_target_for_a_slightly_better_one() -> None:
    bench = Bench()
    assert bench.step((GLOBAL_IRM, fork())).target == 11
    policy = bench.step((GLOBAL_IRM, fork(2, gains=(8.0, 5.0))))
    assert policy.alternatives[0].frontier == 10
    assert policy.target == 11
    assert policy.reason.endswith("kept")
    assert not policy.switched


def test_switches_for_a_much_better_one_and_says_so() -> None:
    bench = Bench()
    bench.step((GLOBAL_IRM, fork()))
    policy = bench.step((GLOBAL_IRM, fork(2, gains=(60.0, 5.0))))
    assert policy.target == 10
    assert policy.switched
    assert "switched" in policy.reason
    assert "frontier 11" in policy.reason
    assert not bench.step().switched


@pytest.mark.parametrize(
    ("absolute", "relative", "switches"),
    [(3.0, 0.5, True), (5.0, 0.5, False), (3.0, 3.0, False), (5.0, 3.0, False)],
)
def test_a_switch_takes_both_margins(absolute: float, relative: float, switches: bool) -> None:
    """Q of the target is about 1.6, and of the other 5.6: better by 4, which is 2.5 times the target's |Q|."""
    bench = Bench(switch_margin=absolute, switch_margin_relative=relative)
    bench.step((GLOBAL_IRM, fork()))
    policy = bench.step((GLOBAL_IRM, fork(2, gains=(14.4, 5.0))))
    best, kept = (next(o.q for o in policy.alternatives if o.frontier == f) for f in (10, 11))
    assert best - kept == pytest.approx(4.0, abs=0.5) and 2.2 < (best - kept) / kept < 2.8
    assert policy.switched == switches
    assert policy.target == (10 if switches else 11)


def test_by_default_a_target_is_kept_for_one_that_is_better_by_ten_nats() -> None:
    bench = Bench()
    bench.step((GLOBAL_IRM, fork()))
    policy = bench.step((GLOBAL_IRM, fork(2, gains=(28.0, 5.0))))
    assert 9.0 < policy.alternatives[0].q - policy.target_q < 12.0
    assert policy.target == 11


@pytest.mark.parametrize(
    ("left", "near_m", "times", "switches"),
    [
        (0.5, 10.0, 8.0, True), (5.0, 10.0, 8.0, False), (0.9, 30.0, 8.0, False), (0.5, 30.0, 8.0, True),
        (0.5, 30.0, 0.0, False),
    ],
)  # fmt: skip
def test_a_crumb_of_a_far_target_is_no_reason_to_pass_others(
    left: float, near_m: float, times: float, switches: bool
) -> None:
    """Chosen for 20 nats, it has `left` of them: the frontier on the way is better, but by less than the margins."""

    def world(version: int, gain: float) -> GlobalIrm:
        nodes: dict[int, Node] = {
            1: (CRUMB, 0.0, 0.0, 0.0), 10: (FRONTIER, 45.0, 0.0, gain), 11: (FRONTIER, near_m, 0.0, 6.0),
        }  # fmt: skip
        return graph(version, nodes, {(1, 10): (45.0, 0.0), (1, 11): (near_m, 0.0)})

    bench = Bench(crumb_times=times)
    assert bench.step((GLOBAL_IRM, world(1, 20.0))).target == 10
    policy = bench.step((GLOBAL_IRM, world(2, left)))
    assert policy.switched == switches
    assert policy.target == (11 if switches else 10)


def test_a_target_that_is_gone_is_replaced_without_a_switch() -> None:
    bench = Bench()
    bench.step((GLOBAL_IRM, fork()))
    nodes: dict[int, Node] = {1: (CRUMB, 0.0, 0.0, 0.0), 12: (FRONTIER, 5.0, 0.0, 1.0)}
    policy = bench.step((GLOBAL_IRM, graph(2, nodes, {(1, 12): (5.0, 0.0)})))
    assert policy.target == 12
    assert not policy.switched
    assert "frontier 11 is covered or out of reach" in policy.reason


def test_a_frontier_with_a_new_id_at_the_place_is_the_same_target() -> None:
    bench = Bench()
    bench.step((GLOBAL_IRM, fork()))
    nodes: dict[int, Node] = {
        1: (CRUMB, 0.0, 0.0, 0.0),
        12: (FRONTIER, 0.5, 31.0, 5.0),
        13: (FRONTIER, 5.0, 0.0, 2.5),
    }
    policy = bench.step((GLOBAL_IRM, graph(2, nodes, {(1, 12): (30.0, 0.0), (1, 13): (5.0, 0.0)})))
    assert policy.alternatives[0].frontier == 13
    assert policy.target == 12
    assert policy.reason.endswith("kept")


def test_a_target_that_cannot_be_reached_any_more_is_given_up() -> None:
    bench = Bench()
    bench.step((GLOBAL_IRM, fork()))
    message = fork(2)
    keep = np.array([(a, b) != (1, 11) for a, b in zip(message.edge_a, message.edge_b, strict=True)])
    columns = ("edge_a", "edge_b", "edge_distance_m", "edge_risk", "edge_driven")
    cut = message.model_copy(update={name: getattr(message, name)[keep] for name in columns})
    policy = bench.step((GLOBAL_IRM, cut))
    assert policy.target == 10
    assert not policy.switched
    assert [other.frontier for other in policy.alternatives] == [10]


def test_far_frontiers_are_visited_even_at_a_loss() -> None:
    """The cost of 500 m is more than the gain, yet what is left must be covered."""
    nodes: dict[int, Node] = {1: (CRUMB, 0.0, 0.0, 0.0), 2: (FRONTIER, 500.0, 0.0, 0.5)}
    policy = Bench().step((GLOBAL_IRM, graph(1, nodes, {(1, 2): (500.0, 0.1)})))
    assert policy.target == 2
    assert policy.target_q < 0


def test_without_frontiers_there_is_no_target() -> None:
    nodes: dict[int, Node] = {1: (CRUMB, 0.0, 0.0, 0.0), 2: (CRUMB, 10.0, 0.0, 0.0)}
    policy = Bench().step((GLOBAL_IRM, graph(1, nodes, {(1, 2): (10.0, 0.0)})))
    assert policy.target == -1
    assert policy.reason == "no target: no frontier is left"
    assert policy.node_id.size == 0
    assert policy.path_node.size == 0


def test_frontiers_out_of_reach_are_no_target() -> None:
    nodes: dict[int, Node] = {1: (CRUMB, 0.0, 0.0, 0.0), 2: (FRONTIER, 10.0, 0.0, 3.0)}
    policy = Bench().step((GLOBAL_IRM, graph(1, nodes, {})))
    assert policy.target == -1
    assert "none of 1 frontiers" in policy.reason


def test_value_to_go_leaves_out_what_is_near() -> None:
    """From breadcrumb 5, 5 m from frontier 10, only frontier 11 counts for the rest of the mission."""
    bench = Bench(local_range_m=18.0, policy_radius_m=60.0)
    policy = bench.step((GLOBAL_IRM, fork(robot_node=5)), (ODOMETRY, odometry(40.0)))
    value = dict(zip(policy.node_id.tolist(), policy.value.tolist(), strict=True))
    to_go = dict(zip(policy.node_id.tolist(), policy.value_to_go.tolist(), strict=True))
    assert policy.target == 10
    assert value[5] > to_go[5]
    assert to_go[1] == pytest.approx(value[1])
    assert to_go[1] > to_go[2] > to_go[5]
    alone = Bench(local_range_m=100.0, policy_radius_m=60.0)
    policy = alone.step((GLOBAL_IRM, fork(robot_node=5)), (ODOMETRY, odometry(40.0)))
    assert policy.value_to_go.tolist() == [0.0] * 7


def hook(version: int = 1) -> GlobalIrm:
    """A way of 200 m out along y = 0 and back along y = 10, to a frontier 10 m beside the robot."""
    nodes: dict[int, Node] = {1 + i: (CRUMB, 10.0 * i, 0.0, 0.0) for i in range(21)}
    nodes |= {22 + i: (CRUMB, 200.0 - 10.0 * i, 10.0, 0.0) for i in range(20)}
    nodes[42] = (FRONTIER, 0.0, 10.0, 50.0)
    return graph(version, nodes, {(i, i + 1): (10.0, 0.0) for i in range(1, 42)})


def test_of_the_way_is_told_what_lies_around_the_robot() -> None:
    policy = Bench(policy_radius_m=32.0).step((GLOBAL_IRM, hook()))
    assert policy.target_distance_m == pytest.approx(410.0)
    assert policy.path_node.tolist() == [1, 2, 3, 4, 5, 38, 39, 40, 41, 42]
    assert policy.path_piece.tolist() == [0] * 5 + [1] * 5
    assert policy.path_xyz_m[4].tolist() == [40.0, 0.0, 0.0]
    assert len(policy.route_xyz_m) == 16
    assert policy.route_xyz_m[0].tolist() == [0.0, 0.0, 0.0]
    assert policy.route_xyz_m[-1].tolist() == [0.0, 10.0, 0.0]


def test_a_message_does_not_grow_with_the_way() -> None:
    """Ten times as many tunnels behind, and the way ten times as long: the same bytes but for a few digits."""
    sizes = []
    for crumbs in (100, 1000):
        nodes: dict[int, Node] = {1 + i: (CRUMB, 5.0 * i, 0.0, 0.0) for i in range(crumbs)}
        nodes[crumbs + 1] = (FRONTIER, 5.0 * crumbs, 0.0, 50.0)
        message = graph(1, nodes, {(i, i + 1): (5.0, 0.0) for i in range(1, crumbs + 1)})
        sizes.append(len(encode(Bench().step((GLOBAL_IRM, message)), Envelope("husky1", "gcp", 1, 1, 0))))
    assert sizes[1] <= sizes[0] + 8


def test_way_home() -> None:
    bench = Bench()
    bench.step((GLOBAL_IRM, fork(robot_node=4)), (ODOMETRY, odometry(31.0)))
    home = mission(MissionPhase.RETURN, home_x_m=-0.5)
    policy = bench.step((MISSION, home), (ODOMETRY, odometry(31.0)))
    assert policy.target == 1
    assert policy.path_node.tolist() == [4, 3, 2, 1, 1]
    assert policy.path_xyz_m[-1].tolist() == [-0.5, 0.0, 0.0]
    assert policy.target_xyz_m == (-0.5, 0.0, 0.0)
    assert policy.reason.startswith("home: 30 m")
    assert not policy.switched


def test_no_target_when_the_mission_is_over() -> None:
    bench = Bench()
    bench.step((GLOBAL_IRM, fork()))
    policy = bench.step((MISSION, mission(MissionPhase.DONE, FinishReason.COVERED)))
    assert policy.target == -1
    assert "covered" in policy.reason


def test_waits_for_the_graph_and_the_odometry() -> None:
    bench = Bench()
    assert bench.outputs() == []
    found = bench.outputs((GLOBAL_IRM, fork(3, base=2)))
    assert [output.topic for output in found] == [GCP_GRAPH_REQUEST]
    bench.outputs((GLOBAL_IRM, fork(4, base=3)))
    assert bench.requests == 1
    bench.outputs((GLOBAL_IRM, fork(5, base=4)))
    assert bench.requests == 2
    assert bench.step((GLOBAL_IRM, fork(6))).irm_version == 6


def test_robot_node_that_is_not_in_the_graph() -> None:
    assert Bench().step((GLOBAL_IRM, fork(robot_node=99))).path_node.tolist() == [1, 11]


def test_pose_belief_is_seeded_and_lowers_the_value() -> None:
    """A spread-out belief must first find its way to the node; the same seed and tick give the same bytes."""
    sharp = Bench().step((GLOBAL_IRM, fork()))
    first = Bench().step((GLOBAL_IRM, fork()), (ODOMETRY, odometry(variance=4.0)))
    second = Bench().step((GLOBAL_IRM, fork()), (ODOMETRY, odometry(variance=4.0)))
    assert first.target_q == second.target_q
    assert first.target_q < sharp.target_q
    bench = Bench()
    bench.step((GLOBAL_IRM, fork()), (ODOMETRY, odometry(variance=4.0)))
    assert bench.step((ODOMETRY, odometry(variance=4.0))).target_q != first.target_q


def test_snapshot_keeps_graph_target_and_tick() -> None:
    bench = Bench()
    bench.step((GLOBAL_IRM, fork()), (ODOMETRY, odometry(variance=1.0)))
    twin = Bench()
    twin.stage.restore(bench.stage.snapshot())
    twin.now = bench.now
    better = (GLOBAL_IRM, fork(2, gains=(8.0, 5.0)))
    a, b = bench.step(better), twin.step(better)
    envelope = Envelope("husky1", "gcp", 1, 1, 0)
    assert encode(a, envelope) == encode(b, envelope)
    assert b.reason.endswith("kept")
    assert twin.stage.snapshot() == bench.stage.snapshot()


def test_the_policy_goes_over_the_wire() -> None:
    policy = Bench().step((GLOBAL_IRM, fork()))
    decoded, _ = decode(encode(policy, Envelope("husky1", "gcp", 1, 1, 0)), GlobalPolicy, 1 << 20)
    assert decoded.target_xyz_m == policy.target_xyz_m


def test_spec_and_unknown_keys() -> None:
    assert spec(Config()).triggers == (GLOBAL_IRM.name,)
    for wrong in ({"gama": 1}, {"reward": {"k_typo": 1.0}}):
        with pytest.raises(ValueError, match="extra"):
            Config.model_validate(wrong)


def test_warm_up_compiles_what_a_step_uses() -> None:
    """After it a step compiles nothing: the kernels get no new signatures."""
    warm_up()
    modules = (field, planner, ranking, roadnet)
    kernels = [k for m in modules for k in vars(m).values() if hasattr(k, "signatures")]
    before = [len(kernel.signatures) for kernel in kernels]
    bench = Bench()
    bench.step((GLOBAL_IRM, fork()))
    bench.step((MISSION, mission(MissionPhase.RETURN)))
    assert len(kernels) > 5
    assert [len(kernel.signatures) for kernel in kernels] == before
