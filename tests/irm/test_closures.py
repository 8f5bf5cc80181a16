"""Loop closures: what irm keeps in `map` goes where its keyframes go, and nothing jumps in `odom`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from planning.footprint import clearance_m
from planning.frames import Planar
from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec, window_around
from schemas.base import Pose
from schemas.contract import SECOND_NS, Inputs
from schemas.sensing import Odometry, PoseGraph
from schemas.topics import COVERAGE, COVERAGE_SCAN, GLOBAL_IRM, LOCAL_IRM, ODOMETRY, POSE_GRAPH, RISK_MAP
from schemas.world import BREADCRUMB, FRONTIER, CoverageSummary, GridHeader, LocalIrm, RiskMap
from services.irm.config import Config
from services.irm.graph import ROBOT
from services.irm.keyframes import IDENTITY
from services.irm.resample import resample
from services.irm.roadmap import Roadmap
from services.irm.search import Search
from services.irm.stage import IrmStage
from services.irm.window import GROUND
from tests.irm.test_roadmap import lap, ring
from tests.irm.worlds import MAX_CLEARANCE_M, RADIUS_M, Belief, pose_graph, scan_at, two_rooms
from tests.riskmap.helpers import inputs, merged

RES = 0.2
WINDOW_M = 12.0
CONFIG = Config(size=21, sensor_range_m=4.0, max_edge_m=6.0, give_up_s=600.0, odometry_drift=0.05)
WIDE = GridSpec(RES, -50, -50, 200, 180)
STEPS = len(lap())


class Loop:
    """A robot that drives around the ring with a drifting odometry, and a SLAM that closes the loop when told to.

    The ring's dead end is filled: what is seen of it hangs on a hair's breadth.

    drift: x, y, yaw that dead reckoning errs by per metre.
    """

    def __init__(self, drift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.flat, self.drift = ring().fill(5.0, 3.0, 7.0, 7.0, LETHAL), drift
        self.stage = IrmStage(CONFIG)
        self.frame = IDENTITY
        self.true_keyframes: list[Planar] = []
        self.keyframes: dict[int, Planar] = {}
        self.step_count = 0
        self.path = np.concatenate((lap(), lap(), lap()))

    @property
    def true(self) -> Planar:
        x, y = self.path[self.step_count].tolist()
        return Planar(x, y, 0.1 * self.step_count)

    @property
    def odom_from_true(self) -> Planar:
        s = 0.5 * self.step_count
        return Planar(*(s * d for d in self.drift))

    def close(self, exact: bool = True) -> None:
        """SLAM finds out where all keyframes really are, or (not exact) takes that back."""
        if exact:
            self.before = dict(self.keyframes), self.frame
            self.keyframes = dict(enumerate(self.true_keyframes))
            self.frame = self.odom_from_true.inverse()
        else:
            self.keyframes, self.frame = dict(self.before[0]), self.before[1]

    def risk_map(self, odom: Planar) -> RiskMap:
        spec = window_around(odom.x_m, odom.y_m, WINDOW_M, RES)
        state = resample(self.flat.state, self.flat.spec, spec, self.odom_from_true, UNKNOWN)
        hazard = np.where(state == LETHAL, 2.0, np.where(state == FREE, 0.0, 1.0)).astype(np.float32)
        zeros = np.zeros(spec.shape, np.float32)
        return RiskMap(
            stamp_ns=1,
            grid=GridHeader(**spec._asdict()),
            robot_pose=Pose(x_m=odom.x_m, y_m=odom.y_m),
            footprint_radius_m=RADIUS_M,
            state=state,
            hazard_mean=hazard,
            hazard_variance=zeros,
            hazard_cvar=hazard,
            clearance_m=clearance_m(state == LETHAL, None, None, spec, MAX_CLEARANCE_M),
            elevation_m=zeros,
            top_m=np.zeros((0, 0), np.float32),
        )

    def feeds(self, graph: bool = True, frame: Planar | None = None) -> Inputs:
        """What irm gets now."""
        odom = self.odom_from_true.compose(self.true)
        if self.step_count % 2 == 0 and len(self.true_keyframes) <= self.step_count // 2:
            self.keyframes[len(self.true_keyframes)] = self.frame.compose(odom)
            self.true_keyframes.append(self.true)
        newest = len(self.true_keyframes) - 1
        m = self.frame if frame is None else frame
        odometry = Odometry(
            stamp_ns=1,
            pose=Pose(x_m=odom.x_m, y_m=odom.y_m, yaw_rad=odom.yaw_rad),
            map_to_odom=Pose(x_m=m.x_m, y_m=m.y_m, yaw_rad=m.yaw_rad),
            speed_mps=0.0,
            turn_rate_radps=0.0,
            covariance=np.zeros((3, 3)),
        )
        parts = [inputs((RISK_MAP, self.risk_map(odom))), inputs((ODOMETRY, odometry))]
        if graph:
            parts.append(inputs((POSE_GRAPH, pose_graph(self.keyframes))))
        for k in range(4):
            look = Planar(odom.x_m, odom.y_m, odom.yaw_rad + k * math.pi / 2)
            local = self.keyframes[newest].inverse().compose(self.frame.compose(look))
            scan = scan_at(look, newest, range_m=4.0, fov_rad=2.0)
            pose = Pose(x_m=local.x_m, y_m=local.y_m, yaw_rad=local.yaw_rad)
            parts.append(inputs((COVERAGE_SCAN, scan.model_copy(update={"pose_in_keyframe": pose}))))
        return merged(*parts)

    def step(self, **how: Any) -> list[Any]:
        """One second, without driving on."""
        self.now = getattr(self, "now", 0) + SECOND_NS
        return self.stage.step(self.now, self.feeds(**how))

    def drive(self, steps: int) -> list[Any]:
        """So many steps of half a metre."""
        found: list[Any] = []
        for _ in range(steps):
            found = self.step()
            self.step_count += 1
        self.step_count -= 1  # stays where it was seen last
        return found

    def layers(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """(ground, log-odds of coverage) in `map`."""
        assert self.stage._ground and self.stage._coverage
        return self.stage._ground.read(WIDE), self.stage._coverage.read(WIDE)

    def crumbs(self) -> dict[int, tuple[float, float]]:
        """Breadcrumbs in `map`."""
        nodes = self.stage._roadmap.graph.nodes(data=True)
        return {n: (d["x"], d["y"]) for n, d in nodes if d["kind"] == BREADCRUMB and n != ROBOT}

    def frontiers(self) -> list[tuple[float, float]]:
        return [(f.x_m, f.y_m) for f in self.stage._roadmap.manager.frontiers.values()]


DRIFT = (0.02, 0.015, 0.0005)
"""A metre and a bit at the end of the lap: more than twice what a LiDAR odometry drifts."""


def summary(outputs: list[Any]) -> CoverageSummary:
    found: CoverageSummary = next(o.message for o in outputs if o.topic.name == COVERAGE.name)
    return found


def near_share(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Share of the cells of `a` that lie within one cell of a cell of `b`."""
    padded = np.pad(b, 1)
    grown = np.zeros_like(b)
    for r in range(3):
        for c in range(3):
            grown |= padded[r : r + b.shape[0], c : c + b.shape[1]]
    return float((a & grown).sum() / a.sum())


@pytest.fixture(scope="module")
def straight() -> Loop:
    """The drive without drift."""
    loop = Loop()
    loop.drive(STEPS)
    loop.drive(8)
    return loop


@pytest.mark.parametrize("first", ["together", "graph", "odometry"])
def test_after_a_closure_the_belief_is_that_of_a_drive_without_drift(straight: Loop, first: str) -> None:
    """Whether the pose graph or map_to_odom comes first: nothing is moved twice."""
    loop = Loop(DRIFT)
    loop.drive(STEPS)
    drifted = near_share(loop.layers()[0] == GROUND, straight.layers()[0] == GROUND)
    old = loop.frame
    loop.close()
    if first == "graph":
        loop.step(frame=old)
    elif first == "odometry":
        loop.step(graph=False)
    after = summary(loop.drive(8))
    wanted = summary(straight.step())
    assert after.covered_area_m2 == pytest.approx(wanted.covered_area_m2, rel=0.02)
    assert after.reachable_area_m2 == pytest.approx(wanted.reachable_area_m2, rel=0.02)
    for mine, theirs in zip(loop.layers(), straight.layers(), strict=True):
        a, b = (mine == GROUND, theirs == GROUND) if mine.dtype == np.uint8 else (mine > 0, theirs > 0)
        assert near_share(a, b) > 0.995 and near_share(b, a) > 0.995
    assert drifted < 0.95, "the drift was worth correcting"
    assert after.breadcrumbs == pytest.approx(wanted.breadcrumbs, abs=3)
    places = lap()
    for x, y in loop.crumbs().values():
        assert np.hypot(places[:, 0] - x, places[:, 1] - y).min() < 2 * RES, (
            "breadcrumbs lie on the way driven"
        )


def test_a_closure_there_and_back_restores_every_layer() -> None:
    loop = Loop(DRIFT)
    loop.drive(STEPS - 22)
    loop.step(graph=True)
    before, crumbs, frontiers = loop.layers(), loop.crumbs(), loop.frontiers()
    loop.close()
    stage = loop.stage
    stage._read_pose_graph(inputs((POSE_GRAPH, pose_graph(loop.keyframes))))
    assert near_share(loop.layers()[0] == GROUND, before[0] == GROUND) < 0.98
    moved = loop.crumbs()
    assert max(math.dist(moved[n], crumbs[n]) for n in crumbs) > 0.6
    assert max(math.dist(a, b) for a, b in zip(frontiers, loop.frontiers(), strict=True)) > 0.3
    loop.close(exact=False)
    stage._read_pose_graph(inputs((POSE_GRAPH, pose_graph(loop.keyframes))))
    ground, coverage = loop.layers()
    assert (ground != before[0]).mean() < 1e-3
    np.testing.assert_allclose(coverage, before[1], atol=1e-4)
    restored = loop.crumbs()
    assert all(math.dist(restored[n], crumbs[n]) < 1e-9 for n in crumbs)
    np.testing.assert_allclose(loop.frontiers(), frontiers, atol=1e-9)
    twice = loop.layers()
    loop.close()
    stage._read_pose_graph(inputs((POSE_GRAPH, pose_graph(loop.keyframes))))
    loop.close(exact=False)
    stage._read_pose_graph(inputs((POSE_GRAPH, pose_graph(loop.keyframes))))
    assert np.array_equal(loop.layers()[0], twice[0]), "put together anew, always from what was seen"


def test_nothing_jumps_in_odom() -> None:
    loop = Loop(DRIFT)
    loop.drive(STEPS)
    before = next(o.message for o in loop.step() if o.topic.name == LOCAL_IRM.name)
    loop.close()
    after = next(o.message for o in loop.step() if o.topic.name == LOCAL_IRM.name)
    assert isinstance(before, LocalIrm) and isinstance(after, LocalIrm)
    assert (after.ix0, after.iy0) == (before.ix0, before.iy0)
    assert after.robot_pose == before.robot_pose
    assert after.map_to_odom != before.map_to_odom
    both = (before.state == 1) & (after.state == 1)
    assert both.sum() > 0.98 * (before.state == 1).sum() > 20
    assert np.array_equal(before.anchor_m[both], after.anchor_m[both])
    kept = np.isclose(before.edge_distance_m[both], after.edge_distance_m[both])
    assert kept.mean() > 0.98


def test_edges_go_along_and_reach_at_least_from_end_to_end() -> None:
    loop = Loop(DRIFT)
    loop.drive(STEPS)
    loop.close()
    loop.drive(20)
    graph = loop.stage._roadmap.graph
    for a, b, d in graph.edges(data=True):
        p, q = ((graph.nodes[n]["x"], graph.nodes[n]["y"]) for n in (a, b))
        assert d["distance"] >= math.dist(p, q) - 4 * math.sqrt(2) * RES - 0.05
    crumbs = loop.crumbs()
    start = [n for n, p in crumbs.items() if math.dist(p, (1.5, 1.5)) < 3.0]
    old, new = min(start), max(crumbs)
    assert any(math.dist(crumbs[new], crumbs[n]) < CONFIG.max_edge_m for n in start)
    joined = {n for k in crumbs if k > 12 for n in graph.neighbors(k)}
    assert old in joined or any(graph.has_edge(old, n) for n in crumbs if n > 12), (
        "both ends of the lap are joined"
    )


def test_a_message_after_a_closure_tells_of_the_moved_nodes_as_a_difference() -> None:
    loop = Loop(DRIFT)
    loop.drive(STEPS)
    crumbs = loop.crumbs()
    loop.close()
    message = next(o.message for o in loop.step() if o.topic.name == GLOBAL_IRM.name)
    assert message.base_version == message.irm_version - 1
    told = dict(zip(message.node_id.tolist(), message.node_xyz_m.tolist(), strict=True))
    now = loop.crumbs()
    shifted = {n for n in crumbs if math.dist(crumbs[n], now[n]) > 0.03}
    assert len(shifted) > 10 and shifted <= told.keys()
    assert all(told[n][:2] == [*now[n]] for n in shifted)
    frame = loop.frame
    assert (message.map_to_odom.x_m, message.map_to_odom.yaw_rad) == (frame.x_m, frame.yaw_rad)


def test_a_snapshot_between_drift_and_closure_goes_on_alike() -> None:
    loops = [Loop(DRIFT), Loop(DRIFT)]
    for loop in loops:
        loop.drive(30)
    restored = IrmStage(CONFIG)
    restored.restore(loops[1].stage.snapshot())
    assert restored.snapshot() == loops[1].stage.snapshot()
    loops[1].stage = restored
    for loop in loops:
        loop.close()
        loop.drive(4)
    for a, b in zip(loops[0].layers(), loops[1].layers(), strict=True):
        assert np.array_equal(a, b)
    assert loops[0].crumbs() == loops[1].crumbs()
    assert loops[0].frontiers() == loops[1].frontiers()


def test_a_journal_across_a_closure_leads_to_the_same_belief() -> None:
    loop = Loop(DRIFT)
    loop.drive(20)
    twin = IrmStage(CONFIG)
    twin.restore(loop.stage.snapshot())
    loop.stage.journal([])  # what the snapshot holds need not be told again
    for closes in (False, False, True, False):
        loop.step_count += 1
        for _ in range(8):
            if closes:
                loop.close()
                closes = False
            found = loop.step()
            loop.step_count += 1
            twin.replay(loop.stage.journal(found))
        loop.step_count -= 1
    mine, theirs = loop.layers(), (twin._ground.read(WIDE), twin._coverage.read(WIDE))  # type: ignore[union-attr]
    assert (mine[0] != theirs[0]).mean() < 1e-3
    np.testing.assert_allclose(mine[1], theirs[1], atol=1e-4)
    nodes = twin._roadmap.graph.nodes
    assert {n: (d["x"], d["y"]) for n, d in loop.stage._roadmap.graph.nodes(data=True)} == {
        n: (d["x"], d["y"]) for n, d in nodes(data=True)
    }
    assert twin._odom.pose == loop.stage._odom.pose
    back = dict(loop.keyframes)
    loop.close(exact=False)
    for stage in (loop.stage, twin):
        stage._read_pose_graph(inputs((POSE_GRAPH, pose_graph({**back, **loop.keyframes}))))
    assert {n: d["x"] for n, d in nodes(data=True) if n != ROBOT} == pytest.approx(
        {n: d["x"] for n, d in loop.stage._roadmap.graph.nodes(data=True) if n != ROBOT}
    ), "keyframes that move while it is down move what belongs to them"


def test_frontiers_out_of_the_window_move_with_the_keyframe_they_were_seen_from() -> None:
    loop = Loop(DRIFT)
    loop.drive(30)
    manager = loop.stage._roadmap.manager
    before = {k: (f.x_m, f.y_m, f.keyframe) for k, f in manager.frontiers.items()}
    old = dict(loop.keyframes)
    loop.close()
    loop.stage._read_pose_graph(inputs((POSE_GRAPH, pose_graph(loop.keyframes))))
    assert before
    for k, (x, y, keyframe) in before.items():
        local = old[keyframe].inverse().apply(x, y)
        f = manager.frontiers[k]
        assert (f.x_m, f.y_m) == pytest.approx(loop.keyframes[keyframe].apply(*local))
    graph = loop.stage._roadmap.graph
    for n, d in graph.nodes(data=True):
        if d["kind"] == FRONTIER:
            assert (d["x"], d["y"]) == (manager.frontiers[n].x_m, manager.frontiers[n].y_m)


def doubts(loop: Loop) -> PoseGraph:
    """The pose graph of a SLAM that says how unsure it is: a standard deviation of 5 % of the path, until a closure."""
    graph = pose_graph(loop.keyframes)
    path_m = np.arange(len(loop.keyframes), dtype=np.float64)
    deviation = 0.0 * path_m if loop.frame is not IDENTITY else 0.05 * path_m
    return graph.model_copy(update={"covariance": np.stack([deviation**2, 0 * path_m, 0 * path_m], axis=1)})


def unsure_drive(steps: int) -> Loop:
    """Around the ring and on, without a closure: what was seen at first lies more than a metre from where it is."""
    loop = Loop(DRIFT)
    for _ in range(steps):
        loop.now = getattr(loop, "now", 0) + SECOND_NS
        feeds = loop.feeds(graph=False)
        loop.stage.step(loop.now, merged(feeds, inputs((POSE_GRAPH, doubts(loop)))))
        loop.step_count += 1
    loop.step_count -= 1
    return loop


def test_before_a_closure_nothing_is_joined_to_what_only_seems_near() -> None:
    loop = unsure_drive(STEPS + 12)
    graph, crumbs = loop.stage._roadmap.graph, loop.crumbs()
    first_lap = [n for n in crumbs if graph.nodes[n]["keyframe"] < 10]
    second_lap = [n for n in crumbs if graph.nodes[n]["keyframe"] >= STEPS // 2]
    assert len(first_lap) >= 3 and len(second_lap) >= 2, (
        "an old breadcrumb is no reason not to drop a new one"
    )
    assert any(math.dist(crumbs[a], crumbs[b]) < 3.0 for a in first_lap for b in second_lap)
    assert not any(graph.has_edge(a, b) for a in first_lap for b in (*second_lap, ROBOT))
    loop.close()
    for _ in range(30):
        loop.now += SECOND_NS
        feeds = loop.feeds(graph=False)
        loop.stage.step(loop.now, merged(feeds, inputs((POSE_GRAPH, doubts(loop)))))
    assert any(graph.has_edge(a, b) for a in first_lap for b in second_lap), "after it they are"


def test_before_a_closure_the_ground_of_long_ago_is_no_ground_here() -> None:
    loop = unsure_drive(STEPS + 4)
    stage, spec = loop.stage, GridSpec(RES, -10, -10, 60, 60)
    assert stage._ground_store is not None and stage._ground is not None
    known = stage._ground_store.window(spec, stage._odom.pose, stage._doubtful)
    everything = stage._ground_store.window(spec, stage._odom.pose, frozenset())
    assert stage._doubtful and (known != 0).sum() < (everything != 0).sum()
    assert ((everything == GROUND) == (stage._ground.read(spec) == GROUND)).mean() > 0.97


@pytest.mark.parametrize(("shift_m", "kept", "driven"), [(0.4, True, 1), (2.0, True, 0), (9.0, False, 0)])
def test_an_edge_that_a_closure_tears_apart_was_not_driven_there(
    shift_m: float, kept: bool, driven: int
) -> None:
    road = Roadmap(CONFIG)
    for node, x in ((1, 0.0), (2, 2.0)):
        road.road.set_node(node, x, 0.0, 0.0, BREADCRUMB, 0.0, 1.0)
        road.road.belong(node, node, (0.0, 0.0))
    road.road.set_edge(1, 2, 2.1, 0.0, 1)
    road.follow({2: Planar(2.0 + shift_m, 0.0, 0.0)})
    assert road.graph.has_edge(1, 2) is kept
    if kept:
        edge = road.graph.edges[1, 2]
        assert (edge["driven"], edge["distance"]) == (driven, pytest.approx(2.0 + shift_m))


def test_no_edge_reaches_through_a_thin_wall() -> None:
    flat = two_rooms(door_m=0.0, resolution_m=RES)
    belief = Belief.new(CONFIG, RES)
    window = belief.window(flat.risk_map(), -2.0, 0.0)
    search = Search(window)
    search.run(window.robot_cell, 6.0)
    assert math.isfinite(search.to(-0.5, 0.0)[0])
    assert search.to(0.3, 0.0) == (math.inf, 1.0)
