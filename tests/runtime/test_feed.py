"""Inputs from files: what is read, what is refused and how, and what riskmap and irm make of it."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from planning.frames import Planar, wrap_angle
from plgrim.config import load_config
from plgrim.feeds.bag import BagOptions, read_bag
from plgrim.feeds.errors import FeedError, StackedFloorsError
from plgrim.feeds.g2o import read_g2o
from plgrim.feeds.laser import scan_cloud
from plgrim.feeds.picture import Canvas
from plgrim.feeds.recording import Moment, Recording, of_poses
from plgrim.feeds.run import play, read_pose_graph, read_recording
from plgrim.feeds.stage import FeedStage, driven_ground
from schemas.base import Message
from schemas.contract import SECOND_NS, Inputs
from schemas.sensing import CoverageScan, Odometry, PoseGraph
from schemas.world import CoverageWindow, GridHeader
from tests.runtime.helpers import REPOSITORY

STORE = get_typestore(Stores.ROS2_HUMBLE)
UNIT = "1 0 0 1 0 1"
UNIT_3D = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"

# --- g2o ------------------------------------------------------------------------------------------------------


def _file(tmp_path: Path, text: str, name: str = "graph.g2o") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


def _square(tmp_path: Path) -> Path:
    """A square of 4 m: vertices by a dead reckoning that turns too little, and a closure that says so."""
    lines, at = [], Planar(0.0, 0.0, 0.0)
    for k in range(17):
        lines.append(f"VERTEX_SE2 {k} {at.x_m} {at.y_m} {at.yaw_rad}")
        turn = math.pi / 2 if k % 4 == 3 else 0.0
        at = at.compose(Planar(1.0, 0.0, turn - 0.03))
        if k < 16:
            lines.append(f"EDGE_SE2 {k} {k + 1} 1 0 {turn} {UNIT}")
    lines += [f"EDGE_SE2 0 16 0 0 0 {UNIT}", "FIX 0", "", "# a comment"]
    return _file(tmp_path, "\n".join(lines))


def test_a_planar_graph_is_read_and_optimised(tmp_path: Path) -> None:
    graph = read_g2o(_square(tmp_path))
    assert (len(graph.ids), graph.edges, graph.closures, graph.spatial) == (17, 17, 1, False)
    assert graph.cost[1] < 1e-9 < graph.cost[0]
    np.testing.assert_allclose(graph.pose[-1, :2], [0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(graph.pose[8, :2], [4.0, 4.0], atol=1e-5)


def test_a_graph_in_space_is_read_with_height_and_heading(tmp_path: Path) -> None:
    half = math.sqrt(0.5)
    text = f"""VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 7 1.1 0 0.5 0 0 {half} {half}
EDGE_SE3:QUAT 0 7 1 0 0.4 0 0 {half} {half} {UNIT_3D}
"""
    graph = read_g2o(_file(tmp_path, text))
    assert graph.spatial and graph.ids.tolist() == [0, 7]
    np.testing.assert_allclose(graph.pose[1], [1.0, 0.0, 0.4, math.pi / 2], atol=1e-6)


V = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "holds no vertices and edges"),
        (f"EDGE_SE2 0 1 1 0 0 {UNIT}\n", "holds edges but no VERTEX_SE2"),
        (V + "VERTEX_SE3:QUAT 2 0 0 0 0 0 0 1\n", "mixes SE2 and SE3"),
        (V + "EDGE_SE2_XY 0 1 1 0 1 0 1\n", ":3: record 'EDGE_SE2_XY' is not supported"),
        (V + "EDGE_SE2 0 1 1 0 0 1 0 0\n", ":3: EDGE_SE2 has 8 values, 11 are wanted"),
        (V + f"EDGE_SE2 0 1 1 nan 0 {UNIT}\n", ":3: EDGE_SE2 holds a number that is not finite"),
        (V + f"EDGE_SE2 0 1 1 x 0 {UNIT}\n", ":3: EDGE_SE2: could not convert"),
        (V + f"EDGE_SE2 0 5 1 0 0 {UNIT}\n", ":3: EDGE_SE2 names vertex 5, which is missing"),
        (V + f"EDGE_SE2 1 1 1 0 0 {UNIT}\n", ":3: EDGE_SE2 leads from a vertex to itself"),
        (V + "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 -1\n", ":3: EDGE_SE2: the information matrix is not positive"),
        (V + "VERTEX_SE2 1 0 0 0\n", ":3: vertex 1 stands in line 2 too"),
        ("VERTEX_SE2 0.5 0 0 0\n", ":1: VERTEX_SE2: an id is a whole number"),
        (V, "2 parts: no edges lead from vertex 0 to vertex 1"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 2\n", ":1: a quaternion (x, y, z, w) of length 2"),
    ],
)
def test_a_bad_graph_is_refused_with_file_line_and_mend(tmp_path: Path, text: str, says: str) -> None:
    path = _file(tmp_path, text)
    with pytest.raises(FeedError) as error:
        read_g2o(path)
    assert str(path) in str(error.value) and says in str(error.value)


def test_files_that_are_no_text_or_not_there_or_of_another_kind_are_refused(tmp_path: Path) -> None:
    binary = tmp_path / "x.g2o"
    binary.write_bytes(b"\xff\xfe\x00")
    for path, says in (
        (binary, "not a g2o file"),
        (tmp_path / "none.g2o", "cannot be read"),
        (tmp_path / "x.csv", "unknown kind of file"),
        (tmp_path / "none.mcap", "no such file"),
    ):
        with pytest.raises(FeedError, match=says):
            read_recording(path, BagOptions(), None)
    with pytest.raises(FeedError, match="--floor is for pose graphs"):
        read_recording(tmp_path / "x.mcap", BagOptions(), 1.0)


def _storeys(tmp_path: Path, rise_m: float) -> Path:
    """Out on one floor, up, and back above it."""
    path = [(float(x), 0.0) for x in range(6)] + [(float(x), rise_m) for x in range(5, -1, -1)]
    lines = [f"VERTEX_SE3:QUAT {k + 10} {x} 0 {z} 0 0 0 1" for k, (x, z) in enumerate(path)]
    for k, (a, b) in enumerate(pairwise(path)):
        lines.append(f"EDGE_SE3:QUAT {k + 10} {k + 11} {b[0] - a[0]} 0 {b[1] - a[1]} 0 0 0 1 {UNIT_3D}")
    return _file(tmp_path, "\n".join(lines))


def test_floors_above_one_another_are_refused_by_name_and_one_can_be_taken(tmp_path: Path) -> None:
    path = _storeys(tmp_path, 3.0)
    with pytest.raises(StackedFloorsError) as error:
        read_pose_graph(path, None)
    text = str(error.value)
    assert "floors above one another are not supported (keyframes 10 and 19 lie within 2 m" in text
    assert "--floor Z, 0.0 to 3.0 m" in text
    upper = read_pose_graph(path, 3.0)
    assert {m.z_m for m in upper.moments} == {3.0}
    assert upper.length_m == pytest.approx(5.0)
    with pytest.raises(FeedError, match=r"0 keyframes within 0\.75 m of --floor 9"):
        read_pose_graph(path, 9.0)


def test_a_ramp_under_the_robots_height_is_one_floor(tmp_path: Path) -> None:
    assert len(read_pose_graph(_storeys(tmp_path, 1.4), None).moments) >= 12


# --- drives made of poses -------------------------------------------------------------------------------------


def test_poses_become_a_drive_in_short_strides_that_breaks_at_gaps() -> None:
    pose = np.array([[0.0, 0.0, 0.0, 0.0], [2.0, 0.0, 1.0, 3.0], [9.0, 9.0, 1.0, 0.0]])
    drive = of_poses("x", pose, np.array([False, False, True]))
    assert [m.jumped for m in drive.moments] == [False] * 5 + [True]
    assert [m.keyframe for m in drive.moments] == [True, False, False, False, True, True]
    assert drive.moments[2].map[:2] == (1.0, 0.0) and drive.moments[2].z_m == 0.5
    stamps = [m.stamp_ns for m in drive.moments]
    assert all(b > a for a, b in pairwise(stamps))
    assert drive.length_m == pytest.approx(2.0)


def test_driven_ground_is_free_within_a_metre_of_the_way_and_nothing_else_is_known() -> None:
    way = [Planar(0.0, 0.0, 0.0), Planar(3.0, 0.0, 0.0), Planar(3.0, 2.0, 0.0)]
    grid = driven_ground(way, 5)
    rows, columns = np.mgrid[: grid.height, : grid.width]
    x = grid.origin_x_m + (columns + 0.5) * grid.resolution_m
    y = grid.origin_y_m + (rows + 0.5) * grid.resolution_m
    to_first = np.hypot(x - np.clip(x, 0.0, 3.0), y)
    to_second = np.hypot(x - 3.0, y - np.clip(y, 0.0, 2.0))
    np.testing.assert_array_equal(grid.occupancy == 0, np.minimum(to_first, to_second) <= 1.0)
    assert set(np.unique(grid.occupancy)) == {-1, 0}
    assert driven_ground(way[:1], 5).occupancy.max() == 0


def test_the_feed_is_consistent_and_goes_on_from_a_snapshot() -> None:
    pose = np.column_stack([np.linspace(0.0, 9.0, 10), np.zeros((10, 2)), np.linspace(0.0, 1.0, 10)])
    recording = of_poses("x", pose, np.zeros(10, dtype=np.bool_))

    def run(restart: bool) -> list[tuple[str, Message]]:
        feed, found = FeedStage(recording), []
        for k in range(300):
            if restart and k == 100:
                packed, feed = feed.snapshot(), FeedStage(recording)
                feed.restore(packed)
            found += [(o.topic.name, o.message) for o in feed.step(k * SECOND_NS // 20, Inputs({}))]
        return found

    whole = run(False)
    graph: PoseGraph | None = None
    for _, message in whole:
        graph = message if isinstance(message, PoseGraph) else graph
        if isinstance(message, CoverageScan):
            assert graph is not None
            x, y, _, yaw = graph.pose_in_map[message.keyframe_id].tolist()
            inside = message.pose_in_keyframe
            again = Planar(x, y, yaw).compose(Planar(inside.x_m, inside.y_m, inside.yaw_rad))
            assert math.dist(again[:2], (message.pose_in_odom.x_m, message.pose_in_odom.y_m)) < 1e-9
    assert graph is not None and len(graph.keyframe_id) == 10
    assert [str(m) for _, m in run(True)] == [str(m) for _, m in whole]


# --- laser scans ----------------------------------------------------------------------------------------------


def test_a_scan_becomes_hits_at_the_lasers_height_and_floor_before_them() -> None:
    dropped: Counter[str] = Counter()
    ranges = np.array([2.0, 3.0, np.nan, np.inf, 0.05, 80.0])
    cloud = scan_cloud(ranges, (0.0, 0.1), (0.1, 20.0), 0.4, dropped)
    hits, floor = cloud[cloud[:, 2] == 0.0], cloud[cloud[:, 2] < 0.0]
    np.testing.assert_allclose(np.hypot(*hits[:, :2].T), [2.0, 3.0], rtol=1e-6)
    np.testing.assert_allclose(floor[:, 2], -0.4, rtol=1e-6)
    bearing = np.arctan2(floor[:, 1], floor[:, 0])
    assert bearing.max() < 0.1 + 1e-6  # none beside the beams that have no range
    between = (bearing > 0.01) & (bearing < 0.09)
    assert np.hypot(*floor[between, :2].T).max() <= 1.85 + 1e-6  # up to the shorter neighbour
    assert dropped == {"ranges that are NaN": 1, "ranges below range_min": 1, "ranges from range_max": 2}


Kinds = dict[str, str]
KINDS: Kinds = {
    "/scan": "sensor_msgs/msg/LaserScan",
    "/odom": "nav_msgs/msg/Odometry",
    "/pose_corrected": "nav_msgs/msg/Odometry",
}


def _header(stamp_ns: int, frame: str) -> Any:
    t = STORE.types
    time = t["builtin_interfaces/msg/Time"](sec=stamp_ns // SECOND_NS, nanosec=stamp_ns % SECOND_NS)
    return t["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _scan(stamp_ns: int, ranges: list[float], increment: float = 0.02) -> Any:
    values = np.array(ranges, dtype=np.float32)
    return STORE.types[KINDS["/scan"]](
        header=_header(stamp_ns, "laser"), angle_min=-0.5 * increment * (len(ranges) - 1), angle_max=1.0,
        angle_increment=increment, time_increment=0.0, scan_time=0.0, range_min=0.05, range_max=30.0,
        ranges=values, intensities=np.zeros(0, dtype=np.float32),
    )  # fmt: skip


def _pose(stamp_ns: int, x: float, y: float, yaw: float) -> Any:
    t = STORE.types
    pose = t["geometry_msgs/msg/Pose"](
        position=t["geometry_msgs/msg/Point"](x=x, y=y, z=0.0),
        orientation=t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2)),
    )
    nothing = t["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    return t[KINDS["/odom"]](
        header=_header(stamp_ns, "odom"), child_frame_id="base_link",
        pose=t["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=t["geometry_msgs/msg/TwistWithCovariance"](
            twist=t["geometry_msgs/msg/Twist"](linear=nothing, angular=nothing), covariance=np.zeros(36)
        ),
    )  # fmt: skip


def _bag(tmp_path: Path, messages: list[tuple[str, int, Any]], kinds: Kinds = KINDS) -> Path:
    path = tmp_path / "bag"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=STORE) for topic, kind in kinds.items()
        }
        for topic, stamp_ns, message in messages:
            raw = message if isinstance(message, bytes) else STORE.serialize_cdr(message, kinds[topic])
            writer.write(connections[topic], stamp_ns, raw)
    return path


def _corridor(count: int = 30, drift_m: float = 0.02) -> list[tuple[str, int, Any]]:
    """A drive along a corridor 3 m wide and closed at 14 m; odometry falls behind the corrected pose."""
    bearings = 0.02 * (np.arange(157) - 78)
    messages: list[tuple[str, int, Any]] = []
    for k in range(count):
        stamp, x = (k + 1) * SECOND_NS, 0.25 * k
        with np.errstate(divide="ignore"):
            ranges = np.minimum(
                1.5 / np.abs(np.sin(bearings)), (14.0 - x) / np.maximum(np.cos(bearings), 1e-9)
            )
        messages += [
            ("/scan", stamp, _scan(stamp, ranges.tolist())),
            ("/odom", stamp, _pose(stamp, x - drift_m * k, 0.0, 0.0)),
            ("/pose_corrected", stamp, _pose(stamp, x, 0.0, 0.0)),
        ]
    return messages


def test_a_recording_is_read_in_both_frames(tmp_path: Path) -> None:
    path = _bag(tmp_path, _corridor())
    odometry, corrected = read_bag(path, BagOptions()), read_bag(path, BagOptions(corrected_frames=True))
    assert len(odometry.moments) == len(corrected.moments) == 30
    last = odometry.moments[-1]
    assert last.map.x_m == pytest.approx(7.25) and last.odom.x_m == pytest.approx(7.25 - 0.58)
    assert all(m.odom == m.map for m in corrected.moments)
    assert odometry.end_ns == 29 * SECOND_NS // 2  # pauses of 1 s are cut to 0.5 s
    feed = FeedStage(odometry)
    told = [o.message for k in range(400) for o in feed.step(k * SECOND_NS // 20, Inputs({}))]
    frames = {round(m.map_to_odom.x_m, 6) for m in told if isinstance(m, Odometry)}
    assert frames == {round(0.02 * k, 6) for k in range(30)}


@pytest.mark.parametrize("turn_deg", [0.0, -8.0])
def test_the_turn_of_odometry_is_told_per_ten_metres_and_across_the_half_turn(turn_deg: float) -> None:
    """The building turns with odometry; a corrected heading near pi must not be read as a whole turn."""
    moments = []
    for k in range(101):
        yaw = math.pi - 0.01 + 0.02 * (k % 2)
        odom = Planar(0.5 * k, 0.0, wrap_angle(yaw + math.radians(turn_deg) * 0.05 * k))
        moments.append(Moment(k, odom, Planar(0.5 * k, 0.0, wrap_angle(yaw)), 0.0, None, None, False))
    drift_rad = Recording("turning", moments).odometry_drift_rad
    assert math.degrees(drift_rad) == pytest.approx(abs(turn_deg), abs=1e-6)
    assert Recording("short", moments[:15]).odometry_drift_rad == 0.0


def test_a_missing_topic_or_another_type_is_refused_with_what_is_there(tmp_path: Path) -> None:
    path = _bag(tmp_path, _corridor(2))
    with pytest.raises(FeedError) as error:
        read_bag(path, BagOptions(scan="/laser"))
    assert "no topic /laser (sensor_msgs/msg/LaserScan)" in str(error.value)
    assert "/odom (nav_msgs/msg/Odometry)" in str(error.value)
    with pytest.raises(
        FeedError, match="/odom is nav_msgs/msg/Odometry, sensor_msgs/msg/LaserScan is wanted"
    ):
        read_bag(path, BagOptions(scan="/odom", odometry="/pose_corrected"))
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"this is no mcap")
    with pytest.raises(FeedError, match="not a recording that can be read"):
        read_bag(broken, BagOptions())


def test_what_cannot_be_used_is_left_out_and_counted(tmp_path: Path) -> None:
    messages = _corridor(6)
    late = 100 * SECOND_NS
    messages += [
        ("/scan", late, _scan(late, [1.0, 1.0])),
        ("/scan", 2 * SECOND_NS, _scan(2 * SECOND_NS, [1.0, 1.0])),
        ("/scan", 3 * SECOND_NS + 1, _scan(3 * SECOND_NS + 1, [math.nan, math.inf])),
        ("/scan", 3 * SECOND_NS + 2, _scan(3 * SECOND_NS + 2, [1.0, 1.0], increment=math.nan)),
        ("/odom", 4 * SECOND_NS, _pose(4 * SECOND_NS, math.nan, 0.0, 0.0)),
        ("/scan", 5 * SECOND_NS, b"\x00\x01\x00\x00\x07"),
    ]
    recording = read_bag(_bag(tmp_path, messages), BagOptions())
    assert len(recording.moments) == 6
    assert recording.dropped == {
        "scans without a pose": 1, "scans of the same time": 1, "scans without a range": 1,
        "ranges that are NaN": 1, "ranges from range_max": 1, "scans with a bad header": 1,
        "/odom: pose is no pose": 1, "/scan: cannot be decoded": 1,
    }  # fmt: skip


def test_a_recording_with_nothing_to_play_says_why(tmp_path: Path) -> None:
    scans = [m for m in _corridor(3) if m[0] == "/scan"]
    with pytest.raises(FeedError, match="nothing to play: 3 scans without a pose"):
        read_bag(_bag(tmp_path, scans), BagOptions())


def test_scans_between_two_poses_get_a_pose_between_them(tmp_path: Path) -> None:
    stamps = (SECOND_NS, 2 * SECOND_NS)
    messages: list[tuple[str, int, Any]] = [
        ("/scan", 5 * SECOND_NS // 4, _scan(5 * SECOND_NS // 4, [1.0, 1.0]))
    ]
    for topic in ("/odom", "/pose_corrected"):
        messages += [(topic, s, _pose(s, 4.0 * k, 0.0, 3.1 if k else -3.1)) for k, s in enumerate(stamps)]
    moment = read_bag(_bag(tmp_path, messages), BagOptions()).moments[0]
    assert moment.map.x_m == pytest.approx(1.0)
    assert abs(moment.map.yaw_rad) > 3.1 - 1e-9  # the short way around


# --- played to the stages -------------------------------------------------------------------------------------


def test_canvas_keeps_ground_that_a_later_window_cannot_reach() -> None:
    canvas = Canvas()

    def window(ix0: int, cells: list[int]) -> CoverageWindow:
        header = GridHeader(resolution_m=0.1, ix0=ix0, iy0=0, width=len(cells), height=1)
        return CoverageWindow(stamp_ns=0, grid=header, cell=np.array([cells], dtype=np.uint8))

    canvas.add(window(0, [1, 2, 2, 0, 3]))
    canvas.add(window(1, [4, 1, 0, 0, 4]))
    assert canvas.cell.tolist() == [[1, 2, 1, 0, 3, 4]]
    assert canvas.areas_m2()["covered"] == pytest.approx(0.01)


def test_a_pose_graph_played_gives_breadcrumbs_and_covered_ground(tmp_path: Path) -> None:
    recording = read_pose_graph(_square(tmp_path), None)
    result = play(recording, load_config(), tmp_path / "out")
    assert result["keyframes"] == 17 and result["dropped_messages"] == {}
    assert result["breadcrumbs"] >= 4
    # A ring of 16 m by 2 m, its corners outside not quite, and the hole of 2 m by 2 m left.
    assert 28.0 < result["covered_area_m2"] < 36.5
    assert result["coverage"] > 0.9
    again = play(recording, load_config(), tmp_path / "again")
    assert again["digest"] == result["digest"]
    written = json.loads((tmp_path / "out" / "result.json").read_text())
    assert written["covered_area_m2"] == result["covered_area_m2"]
    for picture in ("map.png", "area.png", "coverage.png"):
        assert (tmp_path / "out" / picture).stat().st_size > 5000


def test_scans_played_give_the_map_of_the_corridor(tmp_path: Path) -> None:
    recording = read_bag(_bag(tmp_path, _corridor()), BagOptions(corrected_frames=True))
    result = play(recording, load_config(), tmp_path / "out", with_gcp=True)
    assert result["dropped_messages"] == {}
    # From x = -0.5 or so to 14, 3 m wide; the sensor sees 6 m beyond the last pose at 7.25.
    assert 33.0 < result["covered_area_m2"] < 42.0
    assert result["picture_m2"]["obstacle"] > 2.0
    assert result["breadcrumbs"] >= 3 and result["frontiers"] >= 1


def test_the_command_says_what_is_wrong_in_one_line(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "plgrim", "feed", str(_storeys(tmp_path, 3.0)), "--out", str(tmp_path / "out")],
        cwd=REPOSITORY, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == FeedError.exit_code
    assert done.stderr.startswith("plgrim: ") and "floors above one another" in done.stderr
    assert "Traceback" not in done.stderr and not (tmp_path / "out").exists()


# --- third-party files ----------------------------------------------------------------------------------------


def test_the_intel_graph_is_one_floor_and_its_optimum_is_known(
    third_party_data: Callable[[str], Path],
) -> None:
    path = third_party_data("posegraphs/intel.g2o")
    graph = read_g2o(path)
    assert (len(graph.ids), graph.edges, graph.closures) == (1728, 2512, 785)
    assert graph.cost[1] == pytest.approx(22.5023, rel=1e-4)
    assert read_pose_graph(path, None).length_m == pytest.approx(514.5, rel=0.01)


def test_the_parking_garage_is_refused_by_name(third_party_data: Callable[[str], Path]) -> None:
    path = third_party_data("posegraphs/parking-garage.g2o")
    with pytest.raises(StackedFloorsError, match="floors above one another are not supported"):
        read_pose_graph(path, None)


def test_the_intel_recording_is_read_whole(third_party_data: Callable[[str], Path]) -> None:
    recording = read_bag(third_party_data("bags/intel_research_lab.mcap"), BagOptions())
    assert len(recording.moments) == 910
    assert set(recording.dropped) == {"ranges from range_max"}
    assert recording.length_m == pytest.approx(500.0, rel=0.01)
