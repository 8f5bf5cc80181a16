"""Small makers of ROS 2 messages from numbers and arrays. stamp_ns: mission clock. Lengths in metres, angles in rad."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plgrim.recording.envelope import typestore
from schemas.base import Pose
from schemas.contract import SECOND_NS

LINE_LIST, CUBE_LIST, SPHERE_LIST = 5, 6, 7
"""Kinds of visualization_msgs/Marker."""
Rgba = tuple[float, float, float, float]
_FLOAT32 = 7
_LONGEST_PATH = 500


def _new(kind: str, *values: Any) -> Any:
    package, name = kind.split("/")
    return typestore().types[f"{package}/msg/{name}"](*values)


def time_of(stamp_ns: int) -> Any:
    """builtin_interfaces/Time."""
    return _new("builtin_interfaces/Time", stamp_ns // SECOND_NS, stamp_ns % SECOND_NS)


def header(stamp_ns: int, frame: str) -> Any:
    """std_msgs/Header."""
    return _new("std_msgs/Header", time_of(stamp_ns), frame)


def point(x: float, y: float, z: float) -> Any:
    """geometry_msgs/Point."""
    return _new("geometry_msgs/Point", float(x), float(y), float(z))


def _vector(x: float, y: float, z: float) -> Any:
    return _new("geometry_msgs/Vector3", float(x), float(y), float(z))


def quaternion(roll: float, pitch: float, yaw: float) -> Any:
    """geometry_msgs/Quaternion of roll, pitch, yaw about fixed axes (REP-103)."""
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return _new(
        "geometry_msgs/Quaternion",
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def _pose(p: Pose) -> Any:
    return _new(
        "geometry_msgs/Pose", point(p.x_m, p.y_m, p.z_m), quaternion(p.roll_rad, p.pitch_rad, p.yaw_rad)
    )


def pose_stamped(stamp_ns: int, frame: str, pose: Pose) -> Any:
    """geometry_msgs/PoseStamped."""
    return _new("geometry_msgs/PoseStamped", header(stamp_ns, frame), _pose(pose))


def pose_array(stamp_ns: int, frame: str, poses: NDArray[np.float64]) -> Any:
    """geometry_msgs/PoseArray of (n, 4) x, y, z, yaw."""
    found = [_pose(Pose(x_m=x, y_m=y, z_m=z, yaw_rad=yaw)) for x, y, z, yaw in poses.tolist()]
    return _new("geometry_msgs/PoseArray", header(stamp_ns, frame), found)


def transforms(stamp_ns: int, found: Sequence[tuple[str, str, Pose]]) -> Any:
    """tf2_msgs/TFMessage of (parent, child, pose of the child in the parent)."""
    return _new("tf2_msgs/TFMessage", [
        _new(
            "geometry_msgs/TransformStamped", header(stamp_ns, parent), child,
            _new("geometry_msgs/Transform", _vector(p.x_m, p.y_m, p.z_m),
                 quaternion(p.roll_rad, p.pitch_rad, p.yaw_rad)),
        )
        for parent, child, p in found
    ])  # fmt: skip


def odometry(
    stamp_ns: int, pose: Pose, speed_mps: float, turn_radps: float, covariance: NDArray[np.float64]
) -> Any:
    """nav_msgs/Odometry of base_link in odom. covariance: (3, 3) of x, y, yaw."""
    wide = np.zeros((6, 6))
    wide[np.ix_([0, 1, 5], [0, 1, 5])] = covariance
    twist = _new("geometry_msgs/Twist", _vector(speed_mps, 0, 0), _vector(0, 0, turn_radps))
    return _new(
        "nav_msgs/Odometry", header(stamp_ns, "odom"), "base_link",
        _new("geometry_msgs/PoseWithCovariance", _pose(pose), wide.ravel()),
        _new("geometry_msgs/TwistWithCovariance", twist, np.zeros(36)),
    )  # fmt: skip


def point_cloud(stamp_ns: int, frame: str, columns: Mapping[str, NDArray[Any]]) -> Any:
    """sensor_msgs/PointCloud2 of float32 columns (n,) by name: x, y, z and others."""
    names, n = list(columns), len(next(iter(columns.values())))
    fields = [_new("sensor_msgs/PointField", name, 4 * i, _FLOAT32, 1) for i, name in enumerate(names)]
    rows = np.column_stack([columns[name] for name in names]).astype("<f4")
    width = 4 * len(names)
    data = np.frombuffer(rows.tobytes(), np.uint8)
    return _new(
        "sensor_msgs/PointCloud2", header(stamp_ns, frame), 1, n, fields, False, width, width * n, data, True
    )


def grid(
    stamp_ns: int, frame: str, resolution_m: float, x_m: float, y_m: float, cells: NDArray[np.int8]
) -> Any:
    """nav_msgs/OccupancyGrid of (h, w) percent, row 0 the lowest y, -1 unknown. x_m, y_m: its lower left corner."""
    height, width = cells.shape
    info = _new(
        "nav_msgs/MapMetaData", time_of(stamp_ns), resolution_m, width, height, _pose(Pose(x_m=x_m, y_m=y_m))
    )
    flat = np.ascontiguousarray(cells, np.int8).ravel()
    return _new("nav_msgs/OccupancyGrid", header(stamp_ns, frame), info, flat)


def path(
    stamp_ns: int, frame: str, xyz_m: NDArray[np.float64], yaw_rad: NDArray[np.float64] | None = None
) -> Any:
    """nav_msgs/Path of (n, 3) points, thinned when it has very many. yaw_rad: (n,), else 0."""
    every = max(1, -(-len(xyz_m) // _LONGEST_PATH))
    yaws = np.zeros(len(xyz_m)) if yaw_rad is None else yaw_rad
    poses = [
        pose_stamped(stamp_ns, frame, Pose(x_m=x, y_m=y, z_m=z, yaw_rad=yaw))
        for (x, y, z), yaw in zip(xyz_m[::every].tolist(), yaws[::every].tolist(), strict=True)
    ]
    return _new("nav_msgs/Path", header(stamp_ns, frame), poses)


class MarkerSpec(NamedTuple):
    """A marker: its name, kind, points (n, 3), size in m, colour."""

    name: str
    kind: int
    points_m: NDArray[np.float64]
    size_m: float
    colour: Rgba


def markers(stamp_ns: int, frame: str, specs: Sequence[MarkerSpec]) -> Any:
    """visualization_msgs/MarkerArray; each replaces the one of the same name."""
    return _new("visualization_msgs/MarkerArray", [_marker(stamp_ns, frame, spec) for spec in specs])


def _marker(stamp_ns: int, frame: str, spec: MarkerSpec) -> Any:
    file = _new("visualization_msgs/MeshFile", "", np.zeros(0, np.uint8))
    image = _new("sensor_msgs/CompressedImage", header(0, ""), "", np.zeros(0, np.uint8))
    # A marker without points is an error in some viewers: it is deleted instead.
    action = 0 if len(spec.points_m) else 2
    return _new(
        "visualization_msgs/Marker", header(stamp_ns, frame), spec.name, 0, spec.kind, action, _pose(Pose()),
        _vector(spec.size_m, spec.size_m, spec.size_m), _new("std_msgs/ColorRGBA", *spec.colour),
        _new("builtin_interfaces/Duration", 0, 0), False, [point(*p) for p in spec.points_m.tolist()], [],
        "", image, [], "", "", file, False,
    )  # fmt: skip


def number(value: float) -> Any:
    """std_msgs/Float64."""
    return _new("std_msgs/Float64", float(value))


def log(stamp_ns: int, level: int, name: str, text: str) -> Any:
    """rcl_interfaces/Log."""
    return _new("rcl_interfaces/Log", time_of(stamp_ns), level, name, text, "", "", 0)


def diagnostics(stamp_ns: int, name: str, level: int, text: str, values: Mapping[str, str]) -> Any:
    """diagnostic_msgs/DiagnosticArray of one service. level: 0 ok, 1 warning, 2 error."""
    pairs = [_new("diagnostic_msgs/KeyValue", key, value) for key, value in values.items()]
    status = _new("diagnostic_msgs/DiagnosticStatus", level, f"plgrim: {name}", text, "plgrim", pairs)
    return _new("diagnostic_msgs/DiagnosticArray", header(stamp_ns, ""), [status])
