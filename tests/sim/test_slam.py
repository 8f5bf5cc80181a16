"""The simulated SLAM: how it drifts, what a loop closure does, and what of it the stage publishes."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.frames import Planar, wrap_angle
from planning.randomness import stream
from schemas.base import Pose
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import COVERAGE_SCAN, JUDGE, ODOMETRY, POSE_GRAPH
from services.sim.config import SlamConfig
from services.sim.slam import Slam
from tests.sim.helpers import box
from tests.sim.test_stage import Bench, _config, _keep_alive

Points = list[tuple[float, float]]
DRIFT = {"drift_fraction": 0.01, "drift_yaw_deg_per_10m": 0.5}
SQUARE: Points = [(0.0, 0.0), (50.0, 0.0), (50.0, 50.0), (0.0, 50.0), (0.0, 0.0), (10.0, 0.0)]


class Drive:
    """Drives a SLAM along straight lines and notes both of its poses at every step."""

    def __init__(self, seed: int = 0, **config: Any) -> None:
        self.seed, self._tick = seed, 0
        self.slam = Slam(SlamConfig(**config), Planar(0.0, 0.0, 0.0), 0.0, stream(seed, "start"))
        self.slam.update(stream(seed, "first"))
        self.odom: list[Planar] = []
        self.map: list[Planar] = []
        self.revisions: list[int] = []

    def to(self, points: Points, step_m: float = 0.1) -> Drive:
        """Along the lines between the points."""
        for a, b in pairwise(points):
            yaw = math.atan2(b[1] - a[1], b[0] - a[0])
            count = max(1, round(math.dist(a, b) / step_m))
            for k in range(1, count + 1):
                share = k / count
                self.at(Planar(a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share, yaw))
        return self

    def at(self, true: Planar, z_m: float = 0.0) -> None:
        """One step of the true robot."""
        self.slam.move(true, z_m, stream(self.seed, "drift", self._tick))
        self.slam.look(stream(self.seed, "noise", self._tick))
        self.slam.update(stream(self.seed, "closure", self._tick))
        self._tick += 1
        self.odom.append(self.slam.odometry)
        self.map.append(self.slam.pose_in_map)
        self.revisions.append(self.slam.revision)

    def error_after_alignment_m(self) -> float:
        """Root mean square distance of the keyframes from the true ones, turned and shifted to fit best."""
        a, b = self.slam.keyframes[:, :2], self.slam._was_true[:, :2]
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        u, _, vt = np.linalg.svd(a.T @ b)
        turn = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        return float(np.sqrt(np.square(a @ turn - b).sum(axis=1).mean()))


def _rms(values: NDArray[np.float64] | list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# --- odometry -------------------------------------------------------------------------------------------------


def test_drift_over_ten_metres_has_the_configured_size() -> None:
    yaw, away = [], []
    for seed in range(300):
        end = (
            Drive(seed, pose_noise_m=0.0, yaw_noise_rad=0.0, **DRIFT)
            .to([(0.0, 0.0), (10.0, 0.0)], 1.0)
            .odom[-1]
        )
        yaw.append(math.degrees(end.yaw_rad))
        straight = Drive(seed, drift_fraction=0.01).to([(0.0, 0.0), (10.0, 0.0)], 1.0)
        away.append(math.dist(straight.odom[-1][:2], (10.0, 0.0)))
    assert _rms(yaw) == pytest.approx(0.5, rel=0.12)
    assert _rms(away) == pytest.approx(0.1, rel=0.12)
    assert abs(np.mean(yaw)) < 0.12  # as often to the left as to the right


def test_far_beyond_the_correlation_length_drift_grows_with_the_root_of_the_distance() -> None:
    config = {"drift_yaw_deg_per_10m": 0.5, "drift_correlation_m": 5.0}
    ends = {
        metres: _rms(
            [Drive(s, **config).to([(0.0, 0.0), (metres, 0.0)], 2.0).odom[-1].yaw_rad for s in range(150)]
        )
        for metres in (100.0, 400.0)
    }
    assert ends[400.0] / ends[100.0] == pytest.approx(2.0, rel=0.25)


def test_without_drift_odometry_is_the_truth_and_no_loop_is_closed() -> None:
    drive = Drive(1, pose_noise_m=0.0, yaw_noise_rad=0.0).to(SQUARE, 0.5)
    assert drive.odom[-1] == Planar(10.0, 0.0, 0.0)
    assert drive.slam.revision == 0
    assert drive.slam.map_to_odom.is_identity


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 1000), st.floats(0.0, 0.05), st.floats(0.0, 3.0), st.floats(3.0, 9.0))
def test_odometry_never_jumps_and_map_moves_only_with_a_closure(
    seed: int, fraction: float, yaw_deg: float, side: float
) -> None:
    drive = Drive(
        seed, drift_fraction=fraction, drift_yaw_deg_per_10m=yaw_deg, pose_noise_m=0.0, yaw_noise_rad=0.0
    )
    square: Points = [(0.0, 0.0), (side, 0.0), (side, side), (0.0, side), (0.0, 0.0)]
    drive.to([*square, *square, *square], 0.25)
    most_m = 0.29 * (1.01 + 5.0 * fraction)
    for k in range(1, len(drive.odom)):
        assert math.dist(drive.odom[k][:2], drive.odom[k - 1][:2]) < most_m
        if drive.revisions[k] == drive.revisions[k - 1]:
            assert math.dist(drive.map[k][:2], drive.map[k - 1][:2]) < most_m


def test_a_robot_that_stands_does_not_drift() -> None:
    drive = Drive(2, **DRIFT).to([(0.0, 0.0), (20.0, 0.0)])
    before = drive.odom[-1]
    for _ in range(50):
        drive.at(Planar(20.0, 0.0, 0.0))
    assert drive.odom[-1] == before


# --- loop closures --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_a_square_loop_that_is_metres_off_closes(seed: int) -> None:
    opened = Drive(seed, **DRIFT, closure_radius_m=0.0).to(SQUARE)
    drive = Drive(seed, **DRIFT).to(SQUARE)
    assert opened.slam.revision == 0 < drive.slam.revision
    end, true = drive.slam.pose_in_map, drive.slam._true
    odd_m = math.dist(opened.slam.pose_in_map[:2], true[:2])
    assert math.dist(end[:2], true[:2]) < 0.6 + 0.05 * odd_m
    # The closed loop leaves about a tenth of the distance drift, in places that no closure has seen.
    assert drive.error_after_alignment_m() < max(0.4, 0.3 * opened.error_after_alignment_m())


def test_a_two_metre_error_closes_to_less_than_thirty_centimetres() -> None:
    found = [(Drive(s, **DRIFT, closure_radius_m=0.0).to(SQUARE[:-1], 0.5), s) for s in range(30)]
    two = [s for drive, s in found if 1.5 < math.dist(drive.odom[-1][:2], (0.0, 0.0)) < 3.0]
    assert len(two) >= 4
    left = [Drive(s, **DRIFT).to(SQUARE, 0.5).error_after_alignment_m() for s in two]
    assert _rms(left) < 0.3
    # What is left is drift that bends to and fro within the loop: its end does not tell.
    assert max(left) < 0.5


def test_a_closure_moves_many_keyframes_and_the_robot_in_map_but_not_in_odom() -> None:
    drive = Drive(5, **DRIFT).to(SQUARE[:4]).to([(0.0, 50.0), (0.0, 2.5)])
    assert drive.slam.revision == 0
    before, odom, place = drive.slam.keyframes.copy(), drive.slam.estimate, drive.slam.pose_in_map
    drive.to([(0.0, 2.5), (0.0, 0.5)])
    slam = drive.slam
    assert slam.revision == 1
    moved = np.hypot(*(slam.keyframes[: len(before)] - before)[:, :2].T)
    assert moved[0] == 0.0
    assert (moved > 0.1).sum() > 50
    assert math.dist(slam.estimate[:2], odom[:2]) < 2.2
    assert math.dist(slam.pose_in_map[:2], place[:2]) > 2.3


def test_map_to_odom_after_the_estimate_is_the_pose_in_map_and_fits_its_keyframe() -> None:
    drive = Drive(3, **DRIFT).to(SQUARE)
    slam = drive.slam
    assert slam.revision > 0 and not slam.map_to_odom.is_identity
    assert slam.map_to_odom.compose(slam.estimate) == slam.pose_in_map
    index, inside = slam.nearest()
    x, y, _, yaw = slam.keyframes[index].tolist()
    again = Planar(x, y, yaw).compose(inside)
    assert math.dist(again[:2], slam.pose_in_map[:2]) < 1e-9
    assert abs(wrap_angle(again.yaw_rad - slam.pose_in_map.yaw_rad)) < 1e-9


def test_closures_keep_their_distances() -> None:
    """None before the loop is long enough, and not more often than the interval."""
    drive = Drive(3, **DRIFT, closure_interval_m=7.0).to([(0.0, 0.0), (16.0, 0.0), (3.0, 0.0)])
    assert drive.slam.revision == 0  # 29 m are not 30
    drive.to([(3.0, 0.0), (0.0, 0.0), (16.0, 0.0), (0.0, 0.0), (16.0, 0.0)])
    at_m = 0.1 * (1 + np.flatnonzero(np.diff([0, *drive.revisions])))
    assert 29.9 < at_m[0] < 31.0
    assert len(at_m) >= 5
    assert np.diff(at_m).min() > 6.9


def test_scans_hang_on_a_recent_keyframe_when_there_is_drift() -> None:
    """An old keyframe may seem near by an error of the map; its place relative to the robot is not known."""
    there_and_back: Points = [(0.0, 0.0), (12.0, 0.0), (0.0, 0.0)]
    drifting = Drive(4, **DRIFT).to(there_and_back)
    assert drifting.slam._paths_m[drifting.slam.nearest()[0]] > 24.0 - 10.1
    assert Drive(4, pose_noise_m=0.0).to(there_and_back).slam.nearest()[0] == 0


def test_variances_grow_until_a_closure_and_cover_the_error() -> None:
    opened = Drive(3, **DRIFT, closure_radius_m=0.0).to(SQUARE).slam
    closed = Drive(3, **DRIFT).to(SQUARE).slam
    grows = opened.keyframe_variances()
    assert (np.diff(grows[:, 2]) > 0.0).all()
    assert grows[50, 0] > 10 * grows[5, 0]
    assert closed.keyframe_variances()[-1, 0] < 0.05 * grows[-1, 0]
    assert closed.variances()[2] < 0.1 * opened.variances()[2]
    exact = Drive(3, pose_noise_m=0.02).to(SQUARE).slam
    np.testing.assert_allclose(exact.keyframe_variances()[:, 0], 0.02**2)


def test_normalised_errors_are_about_one() -> None:
    """The variances are honest: neither a tenth of the squared error, nor ten times as much."""
    ratios = []
    for seed in range(30):
        slam = Drive(seed, **DRIFT, closure_radius_m=0.0).to(SQUARE, 1.0).slam
        error = np.square(slam.keyframes[:, :2] - slam._was_true[:, :2])
        ratios.append((error / slam.keyframe_variances()[:, :2])[30::20].mean())
    assert 0.3 < np.mean(ratios) < 2.0


def test_height_is_the_true_one() -> None:
    drive = Drive(0, **DRIFT)
    for k in range(1, 31):
        drive.at(Planar(0.5 * k, 0.0, 0.0), z_m=0.1 * k)
    assert drive.slam.keyframes[-1, 2] == pytest.approx(3.0, abs=0.11)


@pytest.mark.parametrize("at", [300, 2050])
def test_goes_on_from_a_snapshot(at: int) -> None:
    """Before and after the first closure, byte by byte."""
    straight = Drive(7, **DRIFT)
    resumed = Drive(7, **DRIFT)
    track = Drive(0).to(SQUARE).odom
    for pose in track:
        straight.at(pose)
    for pose in track[:at]:
        resumed.at(pose)
    packed = pack_snapshot(resumed.slam.state())
    resumed.slam = Slam(SlamConfig(**DRIFT), Planar(0.0, 0.0, 0.0), 0.0, stream(99, "other"))
    resumed.slam.set_state(unpack_snapshot(packed))
    for pose in track[at:]:
        resumed.at(pose)
    assert straight.slam.revision > 0
    assert pack_snapshot(resumed.slam.state()) == pack_snapshot(straight.slam.state())


# --- in the stage ---------------------------------------------------------------------------------------------


LAPS: Points = [*([(4.0, 4.0), (12.0, 4.0), (12.0, 12.0), (4.0, 12.0)] * 2), (4.0, 4.0)]


def _bench(seed: int = 3) -> Bench:
    """A room, with more drift than usual and short loops."""
    slam = {
        "drift_fraction": 0.03, "drift_yaw_deg_per_10m": 5.0, "closure_min_path_m": 15.0, "closure_interval_m": 3.0,
    }  # fmt: skip
    return Bench(_config(slam=slam), box(16.0, 16.0, start=(4.0, 4.0, 0.0)), seed)


def _laps(seed: int = 3) -> Bench:
    """Two laps around it."""
    bench = _bench(seed)
    bench.run(110.0, _keep_alive(bench, LAPS))
    return bench


def _planar(pose: Pose) -> Planar:
    return Planar(pose.x_m, pose.y_m, pose.yaw_rad)


def test_the_robot_follows_what_the_plan_means_in_odom() -> None:
    """The estimate in odom goes along the plan to its end; the true robot does so but for the drift."""
    bench = _laps()
    odometry, judge = bench.last(ODOMETRY), bench.last(JUDGE)
    assert math.dist((odometry.pose.x_m, odometry.pose.y_m), (4.0, 4.0)) < 0.3
    off_m = math.dist((judge.true_pose.x_m, judge.true_pose.y_m), (4.0, 4.0))
    assert off_m > 0.5
    in_map = _planar(odometry.map_to_odom).compose(_planar(odometry.pose))
    assert math.dist(in_map[:2], (judge.true_pose.x_m, judge.true_pose.y_m)) < 0.5 * off_m


def test_the_wire_is_consistent_through_closures() -> None:
    bench = _laps()
    graphs, scans = bench.all(POSE_GRAPH), bench.all(COVERAGE_SCAN)
    assert graphs[-1].revision >= 3
    by_stamp = {o.stamp_ns: o for o in bench.all(ODOMETRY)}
    for scan in scans:
        graph = max((g for g in graphs if g.stamp_ns <= scan.stamp_ns), key=lambda g: g.stamp_ns)
        x, y, _, yaw = graph.pose_in_map[scan.keyframe_id].tolist()
        by_keyframe = Planar(x, y, yaw).compose(_planar(scan.pose_in_keyframe))
        by_odometry = _planar(by_stamp[scan.stamp_ns].map_to_odom).compose(_planar(scan.pose_in_odom))
        assert math.dist(by_keyframe[:2], by_odometry[:2]) < 1e-6
    jumps = [(b.stamp_ns, b.revision) for a, b in pairwise(graphs) if b.revision != a.revision]
    changes = [b.stamp_ns for a, b in pairwise(bench.all(ODOMETRY)) if a.map_to_odom != b.map_to_odom]
    assert [stamp for stamp, _ in jumps] == changes


def test_the_graph_is_published_on_change_or_every_two_seconds() -> None:
    bench = _laps()
    graphs = bench.all(POSE_GRAPH)
    for a, b in pairwise(graphs):
        news = len(b.keyframe_id) > len(a.keyframe_id) or b.revision > a.revision
        assert news or b.stamp_ns // 2_000_000_000 > a.stamp_ns // 2_000_000_000


def test_same_seed_same_bytes_with_drift_and_across_a_restart() -> None:
    whole = _laps()
    assert _laps(seed=4).payload() != whole.payload()
    resumed, seconds = _bench(), 70.0
    resumed.run(seconds, _keep_alive(resumed, LAPS))
    assert resumed.last(POSE_GRAPH).revision > 0
    snapshot, resumed.stage = resumed.stage.snapshot(), _bench(seed=99).stage
    resumed.stage._seed = whole.stage._seed
    resumed.stage.restore(snapshot)
    resumed.run(110.0 - seconds, _keep_alive(resumed, LAPS))
    assert resumed.payload() == whole.payload()
