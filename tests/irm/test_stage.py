"""The irm stage: when it publishes, what waits, what a loop closure does, and that it goes on from a snapshot."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
import pytest
from scipy import ndimage

from planning.frames import Planar
from schemas.base import Message
from schemas.codec import Envelope, decode, encode
from schemas.contract import SECOND_NS, Inputs, Outputs, StageSetup, Topic
from schemas.policy import LocalPhase, LocalPolicy
from schemas.sensing import FollowerState
from schemas.topics import (
    COVERAGE,
    COVERAGE_SCAN,
    COVERAGE_WINDOW,
    FOLLOWER,
    GCP_GRAPH_REQUEST,
    GLOBAL_IRM,
    GLOBAL_POLICY,
    LOCAL_IRM,
    LOCAL_POLICY,
    ODOMETRY,
    POSE_GRAPH,
    RISK_MAP,
)
from schemas.world import FRONTIER, CoverageSummary, CoverageWindow, GlobalIrm, GraphRequest, LocalIrm
from services.irm.stage import Config, IrmStage, create, spec
from tests.irm.worlds import Flat, pose_graph, room, scan_at
from tests.lcp.local_irms import global_policy
from tests.riskmap.helpers import inputs, merged, odometry
from tests.schemas.examples import example

M = TypeVar("M", bound=Message)

CONFIG = Config(size=11, sensor_range_m=3.0)
HALF = SECOND_NS // 2
ORIGIN = Planar(0.0, 0.0, 0.0)


def world() -> Flat:
    flat = room(-4.0, -3.0, 4.0, 3.0, 0.2)
    return flat.fill(1.0, -3.0, 1.4, 1.0, 2)


def feeds(
    flat: Flat,
    x_m: float = -2.5,
    y_m: float = 0.0,
    keyframes: dict[int, Planar] | None = None,
    scans: tuple[tuple[int, float], ...] = (),
    stale: bool = False,
    keyframe_at: Planar = ORIGIN,
) -> Inputs:
    """Risk map, odometry, pose graph, and scans given as (keyframe, yaw). keyframe_at: of a keyframe still to come."""
    parts = [
        inputs((RISK_MAP, flat.risk_map(x_m, y_m, stamp_ns=7)), stale=stale),
        inputs((ODOMETRY, odometry(x_m, y_m))),
    ]
    if keyframes is not None:
        parts.append(inputs((POSE_GRAPH, pose_graph(keyframes))))
    for keyframe, yaw in scans:
        at = (keyframes or {}).get(keyframe, keyframe_at)
        parts.append(inputs((COVERAGE_SCAN, scan_at(Planar(x_m, y_m, yaw), keyframe, at, fov_rad=2.0))))
    return merged(*parts)


def one(outputs: Outputs, topic: Topic[M]) -> M | None:
    found = [o.message for o in outputs if o.topic.name == topic.name]
    assert len(found) <= 1
    return found[0] if found else None  # type: ignore[return-value]


def wire(outputs: Outputs) -> dict[str, bytes]:
    """The bytes of each output, once through the real codec, within the table's limits."""
    found = {}
    for output in outputs:
        payload = encode(output.message, Envelope("husky1", "irm", 1, 1, 0, {}))
        decode(payload, output.topic.message, output.topic.max_bytes)
        found[output.topic.name] = payload
    return found


def covered(outputs: Outputs) -> float:
    summary = one(outputs, COVERAGE)
    assert summary is not None
    return summary.covered_area_m2


def test_nothing_comes_out_before_a_risk_map_and_a_pose_and_while_they_are_stale() -> None:
    stage = IrmStage(CONFIG)
    flat = world()
    assert stage.step(0, inputs()) == []
    assert stage.step(1, inputs((RISK_MAP, flat.risk_map()))) == []
    assert stage.step(2, inputs((ODOMETRY, odometry(0, 0)))) == []
    assert stage.step(3, feeds(flat, stale=True)) == []
    assert {o.topic.name for o in stage.step(4, feeds(flat))} == {
        t.name for t in (LOCAL_IRM, GLOBAL_IRM, COVERAGE, COVERAGE_WINDOW)
    }
    assert stage.step(5 * SECOND_NS, feeds(flat, stale=True)) == []


def test_local_every_step_global_at_its_period_and_on_request_whole() -> None:
    stage, flat = IrmStage(CONFIG), world()
    versions, bases = [], []
    for k in range(7):
        found = feeds(flat)
        if k == 5:
            found = merged(found, inputs((GCP_GRAPH_REQUEST, GraphRequest(stamp_ns=1, have_version=0))))
        outputs = stage.step(k * HALF, found)
        local = one(outputs, LOCAL_IRM)
        assert local is not None and local.risk_stamp_ns == 7
        versions.append(local.irm_version)
        graph = one(outputs, GLOBAL_IRM)
        bases.append(None if graph is None else graph.base_version)
        wire(outputs)
    assert versions == [1, 2, 3, 4, 5, 6, 7]
    assert bases == [0, None, 1, None, 2, 0, None]


def test_a_scan_waits_for_its_keyframe() -> None:
    stage, flat = IrmStage(CONFIG), world()
    assert covered(stage.step(0, feeds(flat, scans=((3, 0.0),)))) == 0.0
    assert covered(stage.step(2 * HALF, feeds(flat, keyframes={1: ORIGIN}))) == 0.0
    seen = covered(stage.step(4 * HALF, feeds(flat, keyframes={1: ORIGIN, 3: ORIGIN})))
    assert seen > 3.0
    assert covered(stage.step(6 * HALF, feeds(flat))) == pytest.approx(seen)


def test_a_pose_graph_that_came_while_the_risk_map_was_stale_is_not_lost() -> None:
    stage, flat = IrmStage(CONFIG), world()
    stage.step(0, feeds(flat, keyframes={3: ORIGIN}, stale=True))
    assert covered(stage.step(HALF, feeds(flat, scans=((3, 0.0),)))) > 3.0


def test_scans_that_wait_for_ever_do_not_pile_up() -> None:
    stage, flat = IrmStage(CONFIG), world()
    for k in range(30):
        stage.step(k * HALF, feeds(flat, scans=tuple((9, 0.1 * i) for i in range(4))))
    assert len(stage._pending) <= 50


def test_looks_cover_ground_until_no_frontier_is_left() -> None:
    stage, flat = IrmStage(CONFIG), room(-2.0, -2.0, 2.0, 2.0, 0.2)
    keyframes = {0: ORIGIN}
    first = one(stage.step(0, feeds(flat, 0.0, 0.0, keyframes)), COVERAGE)
    assert isinstance(first, CoverageSummary)
    assert (first.covered_fraction, first.settled) == (0.0, False)
    assert first.frontiers >= 1 and first.frontier_gain > 0
    last = first
    for k in range(1, 5):
        scans = ((0, math.pi / 2 * k), (0, math.pi / 2 * k + 0.7))
        found = stage.step(k * SECOND_NS, feeds(flat, 0.0, 0.0, keyframes, scans))
        now = one(found, COVERAGE)
        assert isinstance(now, CoverageSummary)
        assert now.covered_fraction > last.covered_fraction
        assert now.reachable_area_m2 == pytest.approx(first.reachable_area_m2)
        last = now
    assert last.covered_fraction > 0.99 and last.settled and last.frontiers == 0
    assert last.reachable_area_m2 == pytest.approx(16.0, abs=1.0)


def test_a_moved_keyframe_moves_what_is_covered() -> None:
    stage, flat = IrmStage(CONFIG), room(-4.0, -4.0, 4.0, 4.0, 0.2)
    stays = Planar(0.5, 0.5, 0.0)  # the newest keyframe, which the robot is at
    outputs = stage.step(0, feeds(flat, -2.0, 0.1, {0: ORIGIN, 1: stays}, ((0, 0.0), (0, 2.0), (0, 4.0))))
    before = one(outputs, COVERAGE_WINDOW)
    outputs = stage.step(SECOND_NS, feeds(flat, -2.0, 0.1, {0: Planar(1.0, 0.4, 0.0), 1: stays}))
    after = one(outputs, COVERAGE_WINDOW)
    assert isinstance(before, CoverageWindow) and isinstance(after, CoverageWindow)
    seen, moved = before.cell == 2, after.cell == 2
    shifted = np.zeros_like(seen)
    shifted[2:, 5:] = seen[:-2, :-5]
    ground = np.isin(after.cell, (1, 2))
    assert seen.sum() > 300
    assert (moved & ground)[shifted & ground].mean() > 0.999
    # The foot of the walls was seen too: the left one now lies in the room, two cells of it.
    beside = ndimage.binary_dilation(shifted, np.ones((3, 3), np.bool_), 2)
    assert not (moved & ground & ~beside).any()


def test_where_the_follower_is_blocked_the_edge_ahead_becomes_riskier_and_is_forgiven_later() -> None:
    stage, flat = IrmStage(CONFIG), room(-4.0, -4.0, 4.0, 4.0, 0.2)
    blocked = FollowerState(
        stamp_ns=1, plan_id=1, progress_m=0.0, tracking_error_m=0.0, stuck=False, blocked=True, contacts=0
    )

    def risk(now: int, found: Inputs) -> float:
        local = one(stage.step(now, found), LOCAL_IRM)
        assert isinstance(local, LocalIrm)
        node = (0 - local.iy0) * local.size + (0 - local.ix0)
        return float(local.edge_risk[node, 0])

    calm = risk(0, feeds(flat, 0.5, 0.5))
    assert risk(1, merged(feeds(flat, 0.5, 0.5), inputs((FOLLOWER, blocked)))) > calm + 0.2
    assert risk(2, feeds(flat, 0.5, 0.5)) > calm + 0.2
    later = 1 + int(CONFIG.blocked_memory_s * SECOND_NS)
    assert risk(later, feeds(flat, 0.5, 0.5)) == pytest.approx(calm)


def drive(k: int) -> dict[str, Any]:
    """The inputs of step k of a short drive: scans whose keyframes come one step late."""
    x = -2.5 + 0.1 * k
    keyframes = {i: Planar(-2.5 + 0.1 * i + (0.2 if k >= 9 else 0.0), 0.0, 0.0) for i in range(k)}
    scans = ((k, 0.3 * k), (k, 2.0 + 0.3 * k))
    return {"x_m": x, "keyframes": keyframes, "scans": scans, "keyframe_at": Planar(x, 0.0, 0.0)}


@pytest.mark.parametrize("at", [1, 6, 9])
def test_a_snapshot_goes_on_with_the_same_outputs(at: int) -> None:
    """Byte for byte, the differences of the Global IRM too."""
    flat = world()
    one_stage, other = create(CONFIG, StageSetup("husky1", 1)), create(CONFIG, StageSetup("husky1", 1))
    for k in range(at):
        one_stage.step(k * HALF, feeds(flat, **drive(k)))
    other.restore(one_stage.snapshot())
    assert other.snapshot() == one_stage.snapshot()
    for k in range(at, at + 6):
        found = [wire(s.step(k * HALF, feeds(flat, **drive(k)))) for s in (one_stage, other)]
        assert found[0] == found[1]


def test_an_empty_stage_goes_on_from_its_snapshot() -> None:
    first, second = IrmStage(CONFIG), IrmStage(CONFIG)
    first.step(0, merged(*[inputs((COVERAGE_SCAN, scan_at(ORIGIN, 5)))]))
    second.restore(first.snapshot())
    assert second.snapshot() == first.snapshot()
    assert len(second._pending) == 1


def test_it_runs_at_the_period_of_the_local_irm() -> None:
    assert spec(CONFIG).period_ns == HALF
    assert spec(CONFIG).name == "irm"


@pytest.mark.parametrize("change", [{"sensor_range_m": 16.0}, {"spacing_m": 0.3}, {"size": 40}])
def test_a_config_that_cannot_go_over_the_wire_is_refused(change: dict[str, float]) -> None:
    """A row of sight is a 32-bit word: the sensor's range is 15 nodes at most; the robot has a middle node."""
    with pytest.raises(ValueError, match=r"range|odd"):
        Config(**change)


def test_a_gap_in_the_inputs_is_not_time_beside_a_frontier() -> None:
    stage, flat = IrmStage(CONFIG), room(-2.0, -2.0, 2.0, 2.0, 0.2)
    for now_s in (5, 300, 600):
        summary = one(stage.step(now_s * SECOND_NS, feeds(flat, 0.0, 0.0)), COVERAGE)
        assert isinstance(summary, CoverageSummary)
        assert summary.frontiers == 1 and summary.unreachable_reason == []


@pytest.mark.parametrize(("share", "frontiers"), [(0.0, 1), (0.1, 0)])
def test_what_is_worth_a_trip_goes_by_the_ground_that_is_known(share: float, frontiers: int) -> None:
    """The corner that a look around does not reach is 1.4 m2 of 16: a nat, which is less than a tenth of all."""
    config = CONFIG.model_copy(update={"frontier_min_share": share, "frontier_enough_gain": 10.0})
    stage, flat = IrmStage(config), room(-2.0, -2.0, 2.0, 2.0, 0.2)
    scans = tuple((0, math.pi / 2 * k) for k in range(4))
    for k in range(2):
        summary = one(stage.step(k * SECOND_NS, feeds(flat, 0.9, 0.9, {0: ORIGIN}, scans)), COVERAGE)
        assert isinstance(summary, CoverageSummary)
        assert summary.frontiers == frontiers
        assert summary.reachable_area_m2 - summary.covered_area_m2 == pytest.approx(1.4, abs=0.25)


@pytest.mark.parametrize(("offset", "given_up"), [(0, True), (1000, False)])
def test_the_frontier_that_the_global_planner_pursues_in_vain_is_given_up(
    offset: int, given_up: bool
) -> None:
    """The policy's target and distance count, by the time between rounds; a target that is no frontier is ignored."""
    config = CONFIG.model_copy(update={"pursue_s": 5.0, "give_up_s": 600.0, "second_chance_gain": 999.0})
    stage, flat = IrmStage(config), room(-4.0, -4.0, 4.0, 4.0, 0.2)
    names: list[int] = []
    reasons: list[list[str]] = []
    for k in range(8):
        found = feeds(flat, 0.5, 0.5)
        if names:
            policy = global_policy([(0.5, 0.5), (3.0, 3.0)]).model_copy(
                update={"target": names[0] + offset, "target_distance_m": 4.0}
            )
            found = merged(found, inputs((GLOBAL_POLICY, policy)))
        outputs = stage.step(k * SECOND_NS, found)
        graph, summary = one(outputs, GLOBAL_IRM), one(outputs, COVERAGE)
        assert isinstance(graph, GlobalIrm) and isinstance(summary, CoverageSummary)
        if not names:
            names = graph.node_id[graph.node_kind == FRONTIER].tolist()
        reasons.append(summary.unreachable_reason)
    assert all(r == [] for r in reasons[:7]), "one round for the distance, then five seconds"
    assert (len(reasons[7]) == 1) == given_up
    assert all("no nearer" in r for r in reasons[7])


@pytest.mark.parametrize(("says", "rounds"), [(0, 2), (1000, 7), (None, 7)])
def test_time_in_vain_goes_faster_where_the_local_planner_finds_no_way(says: int | None, rounds: int) -> None:
    """Five seconds in vain are over in one, if it is of this target that it says so."""
    config = CONFIG.model_copy(update={"pursue_s": 5.0, "give_up_s": 600.0, "second_chance_gain": 999.0})
    stage, flat = IrmStage(config), room(-4.0, -4.0, 4.0, 4.0, 0.2)
    outputs = stage.step(0, feeds(flat, 0.5, 0.5))
    graph = one(outputs, GLOBAL_IRM)
    assert isinstance(graph, GlobalIrm)
    target = int(graph.node_id[graph.node_kind == FRONTIER][0])
    policy = global_policy([(0.5, 0.5), (3.0, 3.0)])
    policy = policy.model_copy(update={"target": target, "target_distance_m": 4.0})
    no_way = example(LocalPolicy).model_copy(
        update={"phase": LocalPhase.NONE, "target": target + (says or 0)}
    )
    told = [inputs((LOCAL_POLICY, no_way))] if says is not None else []
    for k in range(1, 9):
        found = merged(feeds(flat, 0.5, 0.5), inputs((GLOBAL_POLICY, policy)), *told)
        summary = one(stage.step(k * SECOND_NS, found), COVERAGE)
        assert isinstance(summary, CoverageSummary)
        if summary.unreachable_reason:
            break
    assert k == rounds
