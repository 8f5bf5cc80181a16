"""What is played to the stages, wherever it comes from: moments along a drive, in the order of time."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.frames import Planar, wrap_angle
from schemas.contract import SECOND_NS, Stamp

CLEARANCE_M = 1.0
"""Where only poses are known, the ground is taken as free this far around the path."""
_SPEED_MPS, _TURN_RADPS = 1.0, 1.5
_LONGEST_STRIDE_M = 0.5
_SHORTEST_S = 0.1
_DRIFT_OVER_M = 10.0


class Moment(NamedTuple):
    """The robot at one time. odom, map: base_link in both frames. points_m: (n, 3) in the sensor's frame, or none.

    keyframe: whether this pose is one of the source's keyframes (None: by distance). jumped: not driven to from the
    moment before.
    """

    stamp_ns: Stamp
    odom: Planar
    map: Planar
    z_m: float
    points_m: NDArray[np.float32] | None
    keyframe: bool | None
    jumped: bool


@dataclass(slots=True)
class Recording:
    """A drive. sensor_height_m: of the points' frame above base_link. dropped: what was left out, by reason."""

    name: str
    moments: list[Moment]
    sensor_height_m: float = 0.0
    range_m: float = 1.0
    dropped: Counter[str] = field(default_factory=Counter)
    facts: dict[str, float | int | str] = field(default_factory=dict)

    @property
    def length_m(self) -> float:
        """Distance driven in `map`."""
        pairs = zip(self.moments[:-1], self.moments[1:], strict=True)
        return sum(math.dist(a.map[:2], b.map[:2]) for a, b in pairs if not b.jumped)

    @property
    def end_ns(self) -> Stamp:
        """Stamp of the last moment."""
        return self.moments[-1].stamp_ns

    @property
    def odometry_drift_rad(self) -> float:
        """How much odometry turns against `map` over 10 m driven: mean of such stretches, rad; 0: none."""
        turns: list[float] = []
        driven_m, turned = 0.0, wrap_angle(self.moments[0].odom.yaw_rad - self.moments[0].map.yaw_rad)
        for a, b in zip(self.moments[:-1], self.moments[1:], strict=True):
            driven_m += 0.0 if b.jumped else math.dist(a.map[:2], b.map[:2])
            if driven_m >= _DRIFT_OVER_M:
                now = wrap_angle(b.odom.yaw_rad - b.map.yaw_rad)
                turns.append(abs(wrap_angle(now - turned)))
                driven_m, turned = 0.0, now
        return sum(turns) / len(turns) if turns else 0.0


def of_poses(name: str, pose: NDArray[np.float64], gap: NDArray[np.bool_]) -> Recording:
    """A drive through keyframes at 1 m/s. pose: (n, 4) x, y, z, yaw. gap: (n,) not driven to from the one before."""
    moments: list[Moment] = []
    time_s = 0.0
    for k, row in enumerate(pose.tolist()):
        at = Planar(row[0], row[1], row[3])
        if k and not gap[k]:
            before = moments[-1]
            for share, part in _stride(before.map, at):
                time_s += part
                z_m = before.z_m + share * (row[2] - before.z_m)
                place = _between(before.map, at, share)
                moments.append(
                    Moment(round(time_s * SECOND_NS), place, place, z_m, None, share == 1.0, False)
                )
        else:
            time_s += 1.0 if k else 0.0
            moments.append(Moment(round(time_s * SECOND_NS), at, at, row[2], None, True, k > 0))
    return Recording(name, moments, range_m=CLEARANCE_M)


def _stride(a: Planar, b: Planar) -> Iterator[tuple[float, float]]:
    """(share of the way, seconds of this part) of the parts from one pose to the next."""
    length_m, turn_rad = math.dist(a[:2], b[:2]), abs(wrap_angle(b.yaw_rad - a.yaw_rad))
    parts = max(1, math.ceil(length_m / _LONGEST_STRIDE_M))
    whole_s = max(length_m / _SPEED_MPS, turn_rad / _TURN_RADPS, _SHORTEST_S * parts)
    for part in range(1, parts + 1):
        yield part / parts, whole_s / parts


def _between(a: Planar, b: Planar, share: float) -> Planar:
    if share == 1.0:
        return b
    turn = wrap_angle(b.yaw_rad - a.yaw_rad)
    return Planar(
        a.x_m + share * (b.x_m - a.x_m),
        a.y_m + share * (b.y_m - a.y_m),
        wrap_angle(a.yaw_rad + share * turn),
    )
