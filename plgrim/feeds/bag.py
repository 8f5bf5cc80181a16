"""Recordings (mcap, rosbag2 folders, ROS 1 bags): planar laser scans with odometry and corrected poses."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore

from planning.frames import Planar, wrap_angle
from plgrim.feeds.errors import FeedError
from plgrim.feeds.laser import scan_cloud
from plgrim.feeds.recording import Moment, Recording
from schemas.contract import SECOND_NS

_SCAN = "sensor_msgs/msg/LaserScan"
_ODOMETRY = "nav_msgs/msg/Odometry"
_POSE_GAP_NS = SECOND_NS // 2
"""A scan needs a pose within so much time, or one on both sides within 5 s."""
_LONGEST_BRIDGE_NS = 5 * SECOND_NS


@dataclass(frozen=True, slots=True)
class BagOptions:
    """Which topics to read, and how.

    corrected_frames: take the corrected poses as odometry too, so that `map` and `odom` are one. longest_gap_s:
    longer pauses of the recording are cut to it. sensor_height_m: of the laser above the floor.
    """

    scan: str = "/scan"
    odometry: str = "/odom"
    corrected: str = "/pose_corrected"
    corrected_frames: bool = False
    longest_gap_s: float = 0.5
    sensor_height_m: float = 0.4


@dataclass(slots=True)
class _Track:
    """Poses over time: stamps (n,) ns and x, y, yaw (n, 3)."""

    stamp_ns: list[int] = field(default_factory=list)
    pose: list[Planar] = field(default_factory=list)

    def at(self, stamp_ns: int) -> Planar | None:
        """The pose at a time, between its neighbours; None where none is near."""
        after = int(np.searchsorted(self.stamp_ns, stamp_ns))
        if after < len(self.stamp_ns) and self.stamp_ns[after] == stamp_ns:
            return self.pose[after]
        if 0 < after < len(self.stamp_ns):
            a, b = self.stamp_ns[after - 1], self.stamp_ns[after]
            if b - a <= _LONGEST_BRIDGE_NS:
                return _between(self.pose[after - 1], self.pose[after], (stamp_ns - a) / (b - a))
        near = [k for k in (after - 1, after) if 0 <= k < len(self.stamp_ns)]
        best = min(near, key=lambda k: abs(self.stamp_ns[k] - stamp_ns), default=None)
        if best is None or abs(self.stamp_ns[best] - stamp_ns) > _POSE_GAP_NS:
            return None
        return self.pose[best]

    def in_order(self) -> _Track:
        """By time; of equal times the first."""
        first = sorted({stamp: k for k, stamp in reversed(list(enumerate(self.stamp_ns)))}.items())
        return _Track([stamp for stamp, _ in first], [self.pose[k] for _, k in first])


def _between(a: Planar, b: Planar, share: float) -> Planar:
    x, y = a.x_m + share * (b.x_m - a.x_m), a.y_m + share * (b.y_m - a.y_m)
    return Planar(x, y, wrap_angle(a.yaw_rad + share * wrap_angle(b.yaw_rad - a.yaw_rad)))


def read_bag(path: Path, options: BagOptions) -> Recording:
    """Read a recording. Raises FeedError: a file that cannot be read, a topic that is missing or of another type."""
    if not path.exists():
        raise FeedError(f"{path}: there is no such file")
    dropped: Counter[str] = Counter()
    wanted = {options.scan: _SCAN, options.corrected: _ODOMETRY}
    if not options.corrected_frames:
        wanted[options.odometry] = _ODOMETRY
    scans: list[tuple[int, Any]] = []
    tracks = {options.odometry: _Track(), options.corrected: _Track()}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            _check_topics(path, reader, wanted)
            connections = [c for c in reader.connections if c.topic in wanted]
            for connection, recorded_ns, raw in reader.messages(connections=connections):
                message = _decoded(reader, raw, connection, dropped)
                if message is None:
                    continue
                stamp_ns = _stamp_ns(message) or recorded_ns
                if connection.topic == options.scan:
                    scans.append((stamp_ns, message))
                else:
                    _add_pose(tracks[connection.topic], stamp_ns, message, connection.topic, dropped)
    except AnyReaderError as error:
        raise FeedError(f"{path}: not a recording that can be read: {error}") from error
    odometry = options.corrected if options.corrected_frames else options.odometry
    ordered = {topic: track.in_order() for topic, track in tracks.items()}
    recording = _play_back(path, scans, ordered[odometry], ordered[options.corrected], options, dropped)
    recording.facts.update(scans=len(scans), frames="corrected" if options.corrected_frames else "odometry")
    return recording


def _check_topics(path: Path, reader: AnyReader, wanted: dict[str, str]) -> None:
    there = {c.topic: str(c.msgtype) for c in reader.connections}
    listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(there.items())) or "nothing"
    for topic, kind in wanted.items():
        if topic not in there:
            raise FeedError(
                f"{path}: no topic {topic} ({kind}); the file holds {listed}: name the topic to read"
            )
        if there[topic] != kind:
            raise FeedError(f"{path}: {topic} is {there[topic]}, {kind} is wanted; the file holds {listed}")


def _decoded(reader: AnyReader, raw: bytes, connection: Any, dropped: Counter[str]) -> Any:
    try:
        return reader.deserialize(raw, connection.msgtype)
    except Exception:  # whatever a damaged message makes of the decoder
        dropped[f"{connection.topic}: cannot be decoded"] += 1
        return None


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def _add_pose(track: _Track, stamp_ns: int, message: Any, topic: str, dropped: Counter[str]) -> None:
    place, q = message.pose.pose.position, message.pose.pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    length = math.hypot(q.x, q.y, q.z, q.w)
    if not all(map(math.isfinite, (place.x, place.y, yaw))) or abs(length - 1.0) > 0.01:
        dropped[f"{topic}: pose is no pose"] += 1
        return
    track.stamp_ns.append(stamp_ns)
    track.pose.append(Planar(place.x, place.y, yaw))


def _play_back(
    path: Path,
    scans: list[tuple[int, Any]],
    odometry: _Track,
    corrected: _Track,
    options: BagOptions,
    dropped: Counter[str],
) -> Recording:
    """The scans with their poses, in order, with the recording's pauses cut."""
    moments: list[Moment] = []
    range_m, before_ns, time_ns = 1.0, -1, 0
    for stamp_ns, scan in sorted(scans, key=lambda pair: pair[0]):
        if stamp_ns == before_ns:
            dropped["scans of the same time"] += 1
            continue
        odom, in_map = odometry.at(stamp_ns), corrected.at(stamp_ns)
        points_m = _points(scan, options.sensor_height_m, dropped)
        if odom is None or in_map is None:
            dropped["scans without a pose"] += 1
        elif points_m is not None:
            if before_ns >= 0:
                time_ns += min(stamp_ns - before_ns, round(options.longest_gap_s * SECOND_NS))
            before_ns = stamp_ns
            range_m = max(range_m, min(float(scan.range_max), 1000.0))
            moments.append(Moment(time_ns, odom, in_map, 0.0, points_m, None, False))
    if not moments:
        reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(dropped.items())) or "no scans"
        raise FeedError(f"{path}: nothing to play: {reasons}")
    return Recording(path.stem, moments, options.sensor_height_m, range_m, dropped)


def _points(scan: Any, height_m: float, dropped: Counter[str]) -> NDArray[np.float32] | None:
    """The cloud of one scan, or None when there is nothing in it."""
    limits = (float(scan.range_min), float(scan.range_max))
    angles = (float(scan.angle_min), float(scan.angle_increment))
    if not all(map(math.isfinite, (*limits, *angles))) or angles[1] == 0.0 or limits[1] <= limits[0]:
        dropped["scans with a bad header"] += 1
        return None
    points_m = scan_cloud(np.asarray(scan.ranges, dtype=np.float64), angles, limits, height_m, dropped)
    if not len(points_m):
        dropped["scans without a range"] += 1
        return None
    return points_m
