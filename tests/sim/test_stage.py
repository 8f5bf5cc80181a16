"""The sim stage: what it publishes and when, how plans drive it, and that it is its seed and its snapshot."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from pydantic import ValidationError

from planning.frames import Planar
from planning.grid import GridSpec
from schemas.base import Message, Pose
from schemas.codec import Envelope, decode, encode
from schemas.contract import SECOND_NS, Inputs, Output, Received, StageSetup, Topic
from schemas.operation import FinishReason, JudgeReport, MissionPhase, MissionState
from schemas.policy import Plan, SafetyState
from schemas.sensing import CoverageScan, PoseGraph
from schemas.topics import (
    CLOUD,
    COVERAGE_SCAN,
    FOLLOWER,
    JUDGE,
    MISSION,
    ODOMETRY,
    PLAN,
    POSE_GRAPH,
    WORLD_PICTURE,
    written_by,
)
from services.sim.config import CoverageSensorConfig, SimConfig
from services.sim.stage import Config, SimStage, create, spec, warm_up
from services.sim.world import StartError, UnknownWorldError, World
from tests.sim.helpers import box, with_walls

STEP_NS = SECOND_NS // 20
SMALL_LIDAR: dict[str, Any] = {"rings": 4, "azimuths": 60}
M = TypeVar("M", bound=Message)


def _config(**data: Any) -> SimConfig:
    return SimConfig.model_validate({"lidar": SMALL_LIDAR, **data})


def _room() -> World:
    return with_walls(box(12.0, 8.0, start=(2.0, 4.0, 0.0)), (6.0, 0.0, 6.3, 3.0))


def _plan(
    points: list[tuple[float, float]], stamp_s: float = 0.0, plan_id: int = 1, speed: float = 0.8, **more: Any
) -> Plan:
    """A plan through the points at one speed, at rest at the end."""
    x, y = np.array(points, dtype=np.float64).reshape(-1, 2).T
    steps = np.hypot(np.diff(x), np.diff(y))
    yaw = np.arctan2(np.diff(y), np.diff(x))
    speeds = np.full(x.shape, speed)
    speeds[-1:] = 0.0
    values: dict[str, Any] = {
        "valid": True,
        "ttl_s": 1.5,
        "yaw_rad": np.append(yaw, yaw[-1:]) if x.size > 1 else np.zeros(x.size),
        "speed_mps": speeds,
        "time_s": np.concatenate([[0.0], np.cumsum(steps) / speed])[: x.size],
        **more,
    }
    return Plan(
        stamp_ns=round(stamp_s * SECOND_NS), plan_id=plan_id, episode=1, safety=SafetyState.RUN, reason="",
        tau_s=0.0, kept_points=0, risk_stamp_ns=0, x_m=x.copy(), y_m=y.copy(), **values,
    )  # fmt: skip


def _mission(phase: MissionPhase, stamp_ns: int) -> MissionState:
    return MissionState(
        stamp_ns=stamp_ns, phase=phase, finish=FinishReason.NONE, reason="", elapsed_s=0.0, time_budget_s=0.0,
        distance_m=0.0, return_distance_m=0.0, home=Pose(), coverage=0.0, left=[],
    )  # fmt: skip


class Bench:
    """Steps a stage every 50 ms and keeps what it publishes; messages to it stay until they are replaced."""

    def __init__(self, config: SimConfig | None = None, world: World | None = None, seed: int = 3) -> None:
        self.stage = SimStage(config or _config(), world or _room(), seed)
        self.now = 0
        self.messages: dict[str, list[Received[Message]]] = {}
        self.published: list[tuple[int, Output]] = []

    def send(self, topic: Topic[Any], message: Message) -> None:
        """Deliver a message before the next step, through the codec."""
        payload = encode(message, Envelope("robot", topic.writer, 1, 1, self.now))
        decoded, _ = decode(payload, topic.message, topic.max_bytes)
        self.messages[topic.name] = [Received(decoded, topic.writer, 1, 1, self.now, 0, True, False)]

    def step(self, gap_ns: int = STEP_NS) -> list[Output]:
        """One step, and the clock after it."""
        found = self.stage.step(self.now, Inputs(self.messages))
        self.published += [(self.now, output) for output in found]
        self.now += gap_ns
        return found

    def run(self, seconds: float, each: Callable[[], None] = lambda: None) -> None:
        """Steps for so long, `each` before every one."""
        for _ in range(round(seconds * 20)):
            each()
            self.step()

    def all(self, topic: Topic[M]) -> list[M]:
        """Every message of a topic so far."""
        return [o.message for _, o in self.published if o.topic.name == topic.name]  # type: ignore[misc]

    def last(self, topic: Topic[M]) -> M:
        """The newest message of a topic."""
        return self.all(topic)[-1]

    def true_pose(self) -> tuple[float, float, float]:
        """Of the robot."""
        return self.stage._robot.state[:3]

    def payload(self) -> bytes:
        """All that was published, as bytes."""
        return b"".join(encode(o.message, Envelope("robot", "sim", 1, 1, now)) for now, o in self.published)


def _keep_alive(bench: Bench, points: list[tuple[float, float]], **more: Any) -> Callable[[], None]:
    """Sends the same plan again and again, as the reconciler does."""
    return lambda: bench.send(PLAN, _plan(points, bench.now / SECOND_NS, **more))


# --- what is published, and when ------------------------------------------------------------------------------


def test_spec_and_first_step_publish_every_topic_of_the_table_but_ready_grids() -> None:
    assert (spec(Config()).name, spec(Config()).period_ns, spec(Config()).latency_ns) == ("sim", STEP_NS, 0)
    first = [output.topic.name for output in Bench().step()]
    assert sorted(first) == sorted(t.name for t in written_by("sim") if t.name != "sim/ready_grid")
    assert first.index(POSE_GRAPH.name) < first.index(COVERAGE_SCAN.name)


def test_periods_of_a_standing_robot() -> None:
    bench = Bench()
    bench.run(20.0)
    counts = Counter(output.topic.name for _, output in bench.published)
    assert counts == {
        ODOMETRY.name: 400, FOLLOWER.name: 400, CLOUD.name: 200, COVERAGE_SCAN.name: 200, JUDGE.name: 40,
        POSE_GRAPH.name: 10, WORLD_PICTURE.name: 2,
    }  # fmt: skip


def test_late_and_early_timers_keep_the_rates() -> None:
    bench, rng = Bench(), np.random.default_rng(0)
    for k in range(200):
        bench.step(0)
        bench.now = (k + 1) * STEP_NS + int(rng.integers(-8_000_000, 8_000_000))
    assert len(bench.all(CLOUD)) == len(bench.all(COVERAGE_SCAN)) == 100
    assert len(bench.all(JUDGE)) == 20


def test_every_message_passes_the_codec_and_its_size_limit() -> None:
    bench = Bench(SimConfig(coverage_sensor=CoverageSensorConfig(fov_deg=360.0, detection_probability=1.0)))
    bench.run(1.0, _keep_alive(bench, [(2.0, 4.0), (4.0, 4.0)]))
    for now, output in bench.published:
        payload = encode(output.message, Envelope("robot", "sim", 1, 1, now))
        decode(payload, output.topic.message, output.topic.max_bytes)
        assert output.message.stamp_ns == now


def test_clouds_and_scans_lie_on_walls_seen_from_the_estimated_pose() -> None:
    config = _config(lidar={**SMALL_LIDAR, "range_noise_m": 0.0}, slam={"pose_noise_m": 0.05})
    bench = Bench(config)
    bench.step()
    cloud, scan, odometry = bench.last(CLOUD), bench.last(COVERAGE_SCAN), bench.last(ODOMETRY)
    assert cloud.sensor_in_odom == odometry.pose.model_copy(update={"z_m": 0.8})
    assert scan.pose_in_odom == odometry.pose.model_copy(update={"z_m": 0.8})
    assert scan.detection_probability == 0.95
    assert (odometry.pose.x_m, odometry.pose.y_m) != bench.true_pose()[:2]
    true = Planar(*bench.true_pose())
    walls = np.array([true.apply(float(x), float(y)) for x, y, z in cloud.points_m if z + 0.8 > 0.01])
    assert len(walls) > 20
    world = _room()
    assert all(world.clearance_m(float(x), float(y), 1.0) < 1e-3 for x, y in walls)


def test_pose_noise_has_its_size_and_its_covariance() -> None:
    bench = Bench(_config(slam={"pose_noise_m": 0.02, "yaw_noise_rad": 0.01}))
    bench.run(50.0)
    poses = np.array([(m.pose.x_m, m.pose.y_m, m.pose.yaw_rad) for m in bench.all(ODOMETRY)])
    variances = np.diag(bench.last(ODOMETRY).covariance)
    assert variances == pytest.approx([4e-4, 4e-4, 1e-4])
    assert poses.mean(axis=0) == pytest.approx(bench.true_pose(), abs=0.003)
    assert poses.var(axis=0) == pytest.approx(variances, rel=0.2)
    exact = Bench(_config(slam={"pose_noise_m": 0.0, "yaw_noise_rad": 0.0}))
    exact.step()
    assert (np.diag(exact.last(ODOMETRY).covariance) == 1e-6).all()


def test_keyframes_come_with_distance_and_scans_hang_on_the_nearest() -> None:
    bench = Bench()
    bench.run(9.0, _keep_alive(bench, [(2.0, 4.0), (7.5, 4.0)]))
    graph = bench.last(POSE_GRAPH)
    count = len(graph.keyframe_id)
    assert 5 <= count <= 6
    assert list(graph.keyframe_id) == list(range(count))
    gaps = np.hypot(*np.diff(graph.pose_in_map[:, :2], axis=0).T)
    assert (gaps >= 1.0).all()
    assert (gaps < 1.2).all()
    assert graph.covariance.shape == (count, 3)
    known = graph.pose_in_map[:0]
    for _, output in bench.published:
        if isinstance(output.message, PoseGraph):
            known = output.message.pose_in_map
        if not isinstance(output.message, CoverageScan):
            continue
        scan = output.message
        here = np.array([scan.pose_in_odom.x_m, scan.pose_in_odom.y_m])
        assert scan.keyframe_id == np.argmin(np.hypot(*(known[:, :2] - here).T))
        keyframe = Planar(*known[scan.keyframe_id, [0, 1, 3]].tolist())
        inside = Planar(scan.pose_in_keyframe.x_m, scan.pose_in_keyframe.y_m, scan.pose_in_keyframe.yaw_rad)
        back = keyframe.compose(inside)
        assert back == pytest.approx((here[0], here[1], scan.pose_in_odom.yaw_rad), abs=1e-9)


# --- plans ----------------------------------------------------------------------------------------------------


def test_it_follows_a_plan_to_its_end() -> None:
    bench = Bench()
    bench.run(14.05, _keep_alive(bench, [(2.0, 4.0), (5.0, 6.0), (9.0, 6.0)]))
    x, y, _ = bench.true_pose()
    assert math.hypot(x - 9.0, y - 6.0) < 0.15
    states = bench.all(FOLLOWER)
    assert max(state.tracking_error_m for state in states) < 0.3
    assert states[-1].plan_id == 1
    assert states[-1].progress_m == pytest.approx(math.hypot(3.0, 2.0) + 4.0, abs=0.1)
    assert not any(state.stuck or state.blocked for state in states)
    judge = bench.last(JUDGE)
    assert judge.distance_m == pytest.approx(7.6, abs=0.3)
    assert judge.true_pose.x_m == x


def test_it_stops_when_the_time_to_live_has_run_out() -> None:
    bench = Bench()
    bench.send(PLAN, _plan([(2.0, 4.0), (10.0, 4.0)], ttl_s=1.5))
    bench.run(1.5)
    assert bench.last(ODOMETRY).speed_mps > 0.5
    bench.run(1.5)
    assert bench.last(ODOMETRY).speed_mps == 0.0
    x = bench.true_pose()[0]
    bench.run(2.0)
    assert bench.true_pose()[0] == x < 4.0


def test_a_stamp_from_the_future_does_not_lengthen_the_life() -> None:
    bench = Bench()
    bench.send(PLAN, _plan([(2.0, 4.0), (10.0, 4.0)], stamp_s=100.0))
    bench.run(3.5)
    assert bench.last(ODOMETRY).speed_mps == 0.0


@pytest.mark.parametrize("stop", ["invalid", "empty", "backwards"])
def test_an_invalid_plan_stops(stop: str) -> None:
    bench = Bench()
    points = [(2.0, 4.0), (10.0, 4.0)]
    bench.run(2.0, _keep_alive(bench, points, ttl_s=1000.0))
    assert bench.last(ODOMETRY).speed_mps > 0.5
    if stop == "invalid":
        bench.send(PLAN, _plan(points, 2.0, plan_id=2, ttl_s=1000.0, valid=False))
    elif stop == "empty":
        bench.send(PLAN, _plan([], 2.0, plan_id=2, ttl_s=1000.0))
    else:
        bench.send(PLAN, _plan(points, 2.0, plan_id=2, ttl_s=1000.0, time_s=np.array([1.0, 0.0])))
    bench.run(1.5)
    assert bench.last(ODOMETRY).speed_mps == 0.0
    assert bench.last(FOLLOWER).plan_id == 2
    assert bench.stage.bad_plans == (1 if stop == "backwards" else 0)


def test_a_plan_that_turns_invalid_under_its_id_stops_and_can_come_back() -> None:
    bench = Bench()
    points = [(2.0, 4.0), (10.0, 4.0)]
    bench.run(1.0, _keep_alive(bench, points))
    bench.run(1.5, _keep_alive(bench, points, valid=False))
    assert bench.last(ODOMETRY).speed_mps == 0.0
    bench.run(1.0, _keep_alive(bench, points))
    assert bench.last(ODOMETRY).speed_mps > 0.5


def test_a_keep_alive_does_not_reset_progress() -> None:
    """A way into a dead end and back over the same ground: a fresh projection would fall back on the first leg."""
    bench = Bench()
    points = [(2.0, 4.0), (5.0, 4.0), (3.0, 4.0)]
    bench.run(14.0, _keep_alive(bench, points))
    progress = [state.progress_m for state in bench.all(FOLLOWER)]
    assert min(np.diff(progress)) > -0.1
    assert progress[-1] == pytest.approx(5.0, abs=0.1)
    assert bench.true_pose()[0] == pytest.approx(3.0, abs=0.12)


@pytest.mark.parametrize("behind_m", [0.0, 0.4, 1.0])
def test_a_new_plan_may_begin_behind_the_robot(behind_m: float) -> None:
    bench = Bench()
    bench.run(3.0, _keep_alive(bench, [(2.0, 4.0), (8.0, 4.0)]))
    before = bench.true_pose()[0]
    bench.run(0.5, _keep_alive(bench, [(before - behind_m, 4.0), (before + 4.0, 4.5)], plan_id=2))
    states = bench.all(FOLLOWER)[-10:]
    assert [state.plan_id for state in states] == [2] * 10
    assert states[0].progress_m == pytest.approx(behind_m, abs=0.15)
    assert min(message.speed_mps for message in bench.all(ODOMETRY)[-10:]) > 0.6
    assert bench.true_pose()[0] > before + 0.25


# --- walls ----------------------------------------------------------------------------------------------------


def test_a_wall_blocks_and_then_the_follower_is_stuck() -> None:
    bench = Bench()
    bench.run(18.0, _keep_alive(bench, [(2.0, 4.0), (5.0, 1.5), (9.0, 1.5)], speed=0.4))
    state = bench.last(FOLLOWER)
    assert state.blocked
    assert state.stuck
    assert state.contacts == 1
    assert not bench.last(JUDGE).lost


def test_a_lost_robot_is_reported_at_once_and_never_moves_again() -> None:
    bench = Bench(world=box(8.0, 8.0, start=(2.0, 4.0, 0.0)))
    while not bench.stage._robot.state.lost:
        bench.send(PLAN, _plan([(2.0, 4.0), (12.0, 4.0)], bench.now / SECOND_NS, speed=1.0))
        bench.step()
        assert bench.now < 20 * SECOND_NS
    report = bench.last(JUDGE)
    assert report.stamp_ns == bench.now - STEP_NS
    assert report.lost
    assert "wall" in report.lost_reason
    pose = bench.true_pose()
    bench.run(3.0, _keep_alive(bench, [(7.0, 4.0), (1.0, 4.0)], plan_id=2))
    assert bench.true_pose() == pose
    assert bench.last(ODOMETRY).speed_mps == 0.0


# --- the judge ------------------------------------------------------------------------------------------------


def test_coverage_grows_with_the_way_and_only_from_true_poses() -> None:
    bench = Bench(_config(coverage_sensor={"range_m": 2.0}))
    bench.run(12.0, _keep_alive(bench, [(2.0, 4.0), (9.0, 4.0)]))
    coverage = [report.coverage for report in bench.all(JUDGE)]
    assert (np.diff(coverage) >= 0.0).all()
    assert coverage[-1] > coverage[0] + 0.1
    report = bench.last(JUDGE)
    assert report.covered_area_m2 == pytest.approx(report.coverage * report.reachable_area_m2)
    assert report.world == "box"


def test_the_end_of_the_mission_brings_a_report_and_a_picture_once() -> None:
    bench = Bench()
    bench.send(MISSION, _mission(MissionPhase.EXPLORE, 0))
    bench.run(1.15)
    assert len(bench.all(WORLD_PICTURE)) == 1
    bench.send(MISSION, _mission(MissionPhase.DONE, bench.now))
    bench.run(0.2)
    assert len(bench.all(WORLD_PICTURE)) == 2
    assert bench.last(WORLD_PICTURE).stamp_ns == bench.last(JUDGE).stamp_ns == 1_150_000_000


def test_the_picture_shows_the_judges_cells() -> None:
    bench = Bench()
    bench.step()
    picture, judge = bench.last(WORLD_PICTURE), bench.stage._judge
    assert picture.resolution_m == judge.spec.resolution_m
    assert ((picture.cell == 0) == judge.occupied).all()
    assert ((picture.cell >= 2) == judge.reachable).all()
    assert ((picture.cell == 3) == judge.covered).all()
    assert judge.covered.any()


def test_a_large_world_is_joined_on_aligned_cells_and_keeps_thin_walls() -> None:
    grid = GridSpec(0.1, -7, 5, 3201, 40)
    occupied = np.zeros(grid.shape, dtype=np.bool_)
    occupied[:, 1600] = True
    world = World("long", grid, occupied, (2.0, 2.5, 0.0))
    bench = Bench(world=world)
    bench.step()
    picture = bench.last(WORLD_PICTURE)
    rows, columns = picture.cell.shape
    assert max(rows, columns) <= 1500
    assert picture.resolution_m == pytest.approx(0.3)
    assert picture.ix0 * 3 <= grid.ix0 < (picture.ix0 + 1) * 3
    assert (picture.cell[:, (1600 + grid.ix0) // 3 - picture.ix0] == 0).all()
    column, row = (math.floor(v / 0.3) for v in (3.0, 2.5))
    assert picture.cell[row - picture.iy0, column - picture.ix0] == 3


# --- randomness and snapshots ---------------------------------------------------------------------------------


def _journey(bench: Bench, seconds: float) -> None:
    points = [(2.0, 4.0), (5.0, 6.0), (9.0, 6.0), (9.0, 2.0)]
    for k in range(round(seconds * 20)):
        if k % 4 == 0:
            plan_id = 1 + bench.now // (3 * SECOND_NS)
            bench.send(PLAN, _plan(points, bench.now / SECOND_NS, plan_id))
        bench.step()


def test_same_seed_same_bytes_and_another_seed_others() -> None:
    benches = [Bench(seed=5), Bench(seed=5), Bench(seed=6)]
    for bench in benches:
        _journey(bench, 6.0)
    assert benches[0].payload() == benches[1].payload()
    assert benches[0].payload() != benches[2].payload()


@pytest.mark.parametrize("at_s", [0.05, 3.15, 7.3])
def test_a_restored_stage_goes_on_identically(at_s: float) -> None:
    whole, part = Bench(), Bench()
    _journey(whole, at_s)
    snapshot = whole.stage.snapshot()
    part.stage.restore(snapshot)
    assert part.stage.snapshot() == snapshot
    part.now, part.messages = whole.now, dict(whole.messages)
    whole.published.clear()
    for bench in (whole, part):
        _journey(bench, 5.0)
    assert whole.payload() == part.payload()
    assert part.stage.snapshot() == whole.stage.snapshot()


def test_a_stuck_follower_is_restored_as_such() -> None:
    whole, part = Bench(), Bench()
    plan = _plan([(2.0, 4.0), (5.0, 1.5), (9.0, 1.5)], speed=0.4, ttl_s=100.0)
    whole.send(PLAN, plan)
    whole.run(14.0)
    assert not whole.last(FOLLOWER).stuck
    part.stage.restore(whole.stage.snapshot())
    part.now, part.messages = whole.now, dict(whole.messages)
    whole.published.clear()
    for bench in (whole, part):
        bench.run(3.0)
    assert whole.payload() == part.payload()
    assert part.last(FOLLOWER).stuck


def test_a_long_pause_moves_the_robot_by_a_quarter_second_at_most() -> None:
    bench = Bench()
    bench.run(3.0, _keep_alive(bench, [(2.0, 4.0), (11.0, 4.0)], ttl_s=100.0))
    before = bench.true_pose()
    bench.now += 5 * SECOND_NS
    bench.step()
    after = bench.true_pose()
    assert 0.1 < math.hypot(after[0] - before[0], after[1] - before[1]) < 0.25
    bench.now -= SECOND_NS
    bench.step()
    assert bench.true_pose() == after  # a clock that runs backwards moves nothing


# --- making one -----------------------------------------------------------------------------------------------


def test_create_builds_the_configured_world_and_names_faults() -> None:
    setup = StageSetup("robot", 1)
    stage = create(Config.model_validate({"world": "maze", "seed": 4, "lidar": SMALL_LIDAR}), setup)
    found = stage.step(0, Inputs({}))
    report = next(o.message for o in found if o.topic.name == JUDGE.name)
    assert isinstance(report, JudgeReport)
    assert report.world == "maze"
    with pytest.raises(UnknownWorldError, match="subway_1x"):
        create(Config(world="moon"), setup)
    with pytest.raises(StartError):
        create(Config.model_validate({"start": {"x_m": -500.0, "y_m": 0.0}}), setup)
    with pytest.raises(ValidationError, match="typo"):
        Config.model_validate({"lidar": {"typo": 1}})


def test_a_map_file_is_a_world_too(tmp_path: Path) -> None:
    from PIL import Image

    image = np.full((80, 80), 254, dtype=np.uint8)
    image[[0, -1], :] = 0
    image[:, [0, -1]] = 0
    Image.fromarray(image).save(tmp_path / "room.png")
    text = "image: room.png\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    (tmp_path / "room.yaml").write_text(text)
    config = Config.model_validate({"map_file": str(tmp_path / "room.yaml"), "lidar": SMALL_LIDAR})
    found = create(config, StageSetup("robot", 1)).step(0, Inputs({}))
    report = next(o.message for o in found if o.topic.name == JUDGE.name)
    assert isinstance(report, JudgeReport)
    assert report.reachable_area_m2 == pytest.approx(7.8**2, rel=0.02)


def test_warm_up_runs() -> None:
    warm_up()
