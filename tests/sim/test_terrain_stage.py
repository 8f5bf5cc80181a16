"""The stage on rough ground and with doors: heights and attitude on the wire, snapshots, lost by name."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.codec import Envelope, encode
from schemas.operation import JudgeReport
from schemas.sensing import CoverageScan, Odometry, PointCloud
from schemas.topics import CLOUD, COVERAGE_SCAN, JUDGE, ODOMETRY, PLAN, WORLD_PICTURE
from services.sim.config import SimConfig
from services.sim.stage import SimStage
from services.sim.terrain import rotation
from services.sim.world import Door, Mover, World
from services.sim.worlds import make_world
from tests.sim.helpers import box
from tests.sim.terrains import ground, ledge
from tests.sim.test_stage import Bench, _plan

EXACT = SimConfig.model_validate(
    {
        "lidar": {"rings": 8, "azimuths": 120, "range_noise_m": 0.0, "dropout_probability": 0.0},
        "slam": {"pose_noise_m": 0.0, "yaw_noise_rad": 0.0},
    }
)
ENVELOPE = Envelope("robot", "sim", 1, 1, 0)


def _slope() -> World:
    return ground(14.0, 8.0, lambda x, y: 0.25 * x - 0.1 * y, (4.0, 4.0, 0.3))


def test_poses_carry_height_and_attitude_and_clouds_fit_the_ground() -> None:
    bench = Bench(EXACT, _slope())
    bench.send(PLAN, _plan([(4.0, 4.0), (8.0, 5.0)]))
    bench.run(3.0)
    cloud: PointCloud = bench.last(CLOUD)
    pose = cloud.sensor_in_odom
    turn = rotation(pose.roll_rad, pose.pitch_rad, pose.yaw_rad)
    points = cloud.points_m @ turn.T + [pose.x_m, pose.y_m, pose.z_m]
    low = points[points[:, 2] < 0.25 * points[:, 0] - 0.1 * points[:, 1] + 0.002]  # the others are of walls
    assert len(low) > 200
    assert low[:, 2] == pytest.approx(0.25 * low[:, 0] - 0.1 * low[:, 1], abs=2e-3)
    odometry: Odometry = bench.last(ODOMETRY)
    base = odometry.pose
    assert base.z_m == pytest.approx(0.25 * base.x_m - 0.1 * base.y_m, abs=0.01)
    assert base.pitch_rad < -0.1
    assert cloud.ground_z_m == pytest.approx(base.z_m, abs=0.02)
    report: JudgeReport = bench.last(JUDGE)
    assert report.true_pose.roll_rad == pytest.approx(base.roll_rad, abs=0.02)
    scan: CoverageScan = bench.last(COVERAGE_SCAN)
    assert scan.pose_in_odom.z_m == pytest.approx(base.z_m + EXACT.lidar.height_m, abs=0.02)


def test_a_drop_is_named_in_the_report() -> None:
    bench = Bench(EXACT, ground(12.0, 4.0, ledge(-1.0, 5.0), (2.0, 2.0, 0.0)))
    bench.send(PLAN, _plan([(2.0, 2.0), (9.0, 2.0)], ttl_s=60.0))
    bench.run(8.0)
    report = bench.last(JUDGE)
    assert report.lost
    assert report.lost_reason == "dropped off a ledge"


def test_a_snapshot_goes_on_byte_for_byte_on_rough_ground() -> None:
    world = _slope()
    plan = _plan([(4.0, 4.0), (8.0, 5.0)], ttl_s=60.0)
    one = Bench(EXACT, world)
    one.send(PLAN, plan)
    one.run(2.0)
    other = Bench(EXACT, world)
    other.stage.restore(one.stage.snapshot())
    other.now = one.now
    other.send(PLAN, plan)
    assert other.stage.snapshot() == one.stage.snapshot()
    for _ in range(40):
        first = [encode(o.message, ENVELOPE) for o in one.step()]
        assert first == [encode(o.message, ENVELOPE) for o in other.step()]
    assert other.stage.snapshot() == one.stage.snapshot()
    assert one.stage._robot.state.z_m != 0.0


def test_doors_and_people_are_in_the_snapshot() -> None:
    room = box(12.0, 4.0)
    world = World(
        "d", room.spec, room.occupied, (2.0, 2.0, 0.0), doors=(Door((6.0, 0.0, 6.2, 4.0), 1.0),),
        movers=(Mover((4.0, 0.5), (4.0, 3.5), 0.5),),
    )  # fmt: skip
    one = Bench(EXACT, world)
    one.run(0.9)
    reachable = one.last(JUDGE).reachable_area_m2
    one.run(1.0)
    assert one.last(JUDGE).reachable_area_m2 < reachable - 5.0
    other = Bench(EXACT, world)
    other.stage.restore(one.stage.snapshot())
    other.now = one.now
    for _ in range(20):
        first, second = one.step(), other.step()
        assert [o.message.stamp_ns for o in first] == [o.message.stamp_ns for o in second]
    assert (one.last(CLOUD).points_m == other.last(CLOUD).points_m).all()
    assert other.last(JUDGE) == one.last(JUDGE)
    assert other.stage._scene.closed == [True]


def test_the_picture_tells_reachable_from_other_free_ground() -> None:
    stage = SimStage(EXACT, make_world("lava_tube", 2), 0)
    bench = Bench(EXACT, make_world("lava_tube", 2))
    bench.stage = stage
    bench.step()
    cells = bench.last(WORLD_PICTURE).cell
    assert {0, 1, 2} <= set(np.unique(cells).tolist())
