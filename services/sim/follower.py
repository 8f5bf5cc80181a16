"""A path follower: pure pursuit with a speed profile that foresees corners, slow points and the end."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.sim.config import RobotConfig

_SPACING_M = 0.05
"""The path is resampled to this."""
_CORNER_WINDOW_M = 0.3
_CORNER_CUT_M = 0.025
"""How far the pursuit may cut a corner; sets the speed there."""
_LOOKAHEAD_S, _LOOKAHEAD_MIN_M, _LOOKAHEAD_MAX_M = 0.45, 0.12, 0.5
_CREEP_MPS = 0.08
"""Lets the robot leave a point where the path's speed is zero."""
_BRAKING_SHARE = 0.7
_TURN_SHARE = 0.8
"""Shares of the robot's limits that the profile counts on; the rest is for corrections."""
_SPOT_BEGIN_RAD, _SPOT_END_RAD = math.radians(40.0), math.radians(12.0)
_SHARP_RAD = math.radians(50.0)
"""Vertices that turn by more are reached, turned at on the spot, and left."""
_ARRIVED_M, _AT_CORNER_M, _ALIGNED_RAD = 0.05, 0.04, 0.05
_SEARCH_BACK_M, _SEARCH_AHEAD_M, _SEARCH_FIRST_M = 0.3, 1.5, 4.0
_ALIKE_M = 0.05
"""Of legs that are this much alike in distance, the earliest is driven."""
_STUCK_S, _STUCK_MOVE_M, _STUCK_TURN_RAD = 3.0, 0.05, 0.1
_COMMANDED_MPS, _COMMANDED_RADPS = 0.02, 0.05


@dataclass(frozen=True, eq=False)
class TimedPath:
    """A path with times. All arrays are float64[n], n >= 1.

    Points at one place with different yaws are a turn on the spot; the follower makes it at the path's end
    only, as elsewhere the way on sets the heading. A path whose first yaw points against its way is driven backwards.
    Raises ValueError on empty or unequal arrays, numbers that
    are not finite, negative speeds, times that run backwards, or a `ttl_s` that is not positive.
    """

    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    t_s: NDArray[np.float64]
    """Offsets from `issued_s`. Speeds, not times, drive the follower: a late robot does not rush."""
    issued_s: float
    ttl_s: float
    """The path may be followed until `issued_s + ttl_s`."""

    def __post_init__(self) -> None:
        columns = (self.x_m, self.y_m, self.yaw_rad, self.speed_mps, self.t_s)
        if self.x_m.ndim != 1 or self.x_m.size == 0 or any(c.shape != self.x_m.shape for c in columns):
            raise ValueError(f"path columns of shapes {[c.shape for c in columns]}, need one length n >= 1")
        if not (np.isfinite(np.stack(columns)).all() and math.isfinite(self.issued_s)):
            raise ValueError("path holds a number that is not finite")
        if (self.speed_mps < 0.0).any() or (np.diff(self.t_s) < 0.0).any():
            raise ValueError("path has a negative speed or times that run backwards")
        if not 0.0 < self.ttl_s < math.inf:
            raise ValueError(f"path ttl {self.ttl_s} s is not positive")


class Command(NamedTuple):
    """What to drive now, and how the following goes."""

    speed_mps: float
    turn_rate_radps: float
    progress_m: float
    """Arc length along the path of the point nearest to the robot."""
    remaining_m: float
    tracking_error_m: float
    """Distance from the robot to the path."""
    active: bool
    """There is a path, neither finished nor expired."""
    arrived: bool
    """At the end of the path, and turned to its last yaw."""
    expired: bool
    """The time to live has run out: standing still."""
    stuck: bool
    """Commanded to move for 3 s without moving."""
    blocked: bool
    """A wall blocks the motion (contact)."""


class _Profile(NamedTuple):
    """The path resampled by arc length: columns float64[k], k >= 2."""

    s_m: NDArray[np.float64]
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    path_speed_mps: NDArray[np.float64]
    """The path's own speed."""
    safe_speed_mps: NDArray[np.float64]
    """Also slow enough for every corner, slow point and the end ahead."""
    leg_bounds_m: NDArray[np.float64]
    """Arc lengths of the start, of the sharp corners, and of the end."""
    backwards: bool
    """The robot's back goes first."""


@dataclass(frozen=True)
class FollowerState:
    """All that changes from step to step, besides the path."""

    progress_m: float = 0.0
    leg: int = 0
    first: bool = True
    on_spot: bool = False
    arrived: bool = False
    anchor: tuple[float, float, float] | None = None
    """Pose (x, y, yaw) since when the robot has not moved although commanded."""
    anchor_s: float = 0.0


@dataclass
class Follower:
    """Follows one path at a time, in the frame of the pose it is given. `state` and `path` are its memory."""

    robot: RobotConfig
    path: TimedPath | None = None
    state: FollowerState = field(default_factory=FollowerState)
    _profile: _Profile | None = None

    def set_path(self, path: TimedPath | None) -> None:
        """Follow another path from now on; None stops. What is known of being stuck is kept."""
        self.path = path
        self._profile = None
        self.state = FollowerState(anchor=self.state.anchor, anchor_s=self.state.anchor_s)

    def refresh(self, issued_s: float, ttl_s: float) -> None:
        """The path was sent again: it lives longer, and progress along it stays. Without a path nothing happens."""
        if self.path is not None:
            self.path = replace(self.path, issued_s=issued_s, ttl_s=ttl_s)

    def step(self, x_m: float, y_m: float, yaw_rad: float, now_s: float, blocked: bool = False) -> Command:
        """Command for the pose at `now_s`."""
        if self.path is None:
            self.state = FollowerState()
            return Command(0.0, 0.0, 0.0, 0.0, 0.0, False, False, False, False, blocked)
        if self._profile is None:
            self._profile = _resample(self.path, self.robot)
        profile = self._profile
        progress, error = self._project(profile, x_m, y_m)
        remaining = float(profile.s_m[-1]) - progress
        expired = now_s >= self.path.issued_s + self.path.ttl_s
        speed, turn = (0.0, 0.0) if expired else self._drive(profile, x_m, y_m, yaw_rad, remaining)
        stuck = self._is_stuck((x_m, y_m, yaw_rad), speed, turn, now_s)
        active, arrived = not (expired or self.state.arrived), self.state.arrived
        return Command(
            speed, turn, progress, remaining, error, active, arrived, expired, stuck, blocked
        )  # fmt: skip

    def _project(self, profile: _Profile, x_m: float, y_m: float) -> tuple[float, float]:
        """(arc length, distance) of the nearest point of the current leg, near the last progress.

        Legs end at sharp corners, and the next begins when its corner is reached: so a way into a dead end and
        back over the same ground is driven whole, and a path that passes itself is not cut short.
        """
        legs, last = profile.leg_bounds_m, profile.leg_bounds_m.size - 2
        if self.state.first:
            near = [
                _nearest(profile, low, min(high, _SEARCH_FIRST_M), x_m, y_m)
                for low, high in itertools.pairwise(legs.tolist())
                if low < _SEARCH_FIRST_M
            ]
            closest = min(distance for _, distance in near)
            leg = next(k for k, (_, d) in enumerate(near) if d <= closest + _ALIKE_M)
            progress, error = near[leg]
        else:
            leg = self.state.leg
            low = max(self.state.progress_m - _SEARCH_BACK_M, float(legs[leg]))
            high = min(self.state.progress_m + _SEARCH_AHEAD_M, float(legs[leg + 1]))
            progress, error = _nearest(profile, low, high, x_m, y_m)
        if leg < last and progress >= legs[leg + 1] - _AT_CORNER_M:
            leg, progress = leg + 1, float(legs[leg + 1])
        self.state = replace(self.state, progress_m=progress, leg=leg, first=False)
        return progress, error

    def _drive(
        self, profile: _Profile, x_m: float, y_m: float, yaw_rad: float, remaining_m: float
    ) -> tuple[float, float]:
        """(speed, turn rate) towards the lookahead point; at the end, towards the last yaw."""
        assert self.path is not None
        if self.state.arrived or remaining_m < _ARRIVED_M:
            error = math.remainder(float(self.path.yaw_rad[-1]) - yaw_rad, 2.0 * math.pi)
            self.state = replace(self.state, arrived=self.state.arrived or abs(error) < _ALIGNED_RAD)
            return 0.0, 0.0 if self.state.arrived else self._turn_rate(error)
        progress = self.state.progress_m
        limit = max(_at(profile, profile.path_speed_mps, progress), _CREEP_MPS)
        speed = min(limit, max(_at(profile, profile.safe_speed_mps, progress), _CREEP_MPS))
        lookahead = min(max(_LOOKAHEAD_S * speed, _LOOKAHEAD_MIN_M), _LOOKAHEAD_MAX_M)
        goal = progress + lookahead
        if self.state.leg < profile.leg_bounds_m.size - 2:  # never past a sharp corner: it would be cut
            goal = min(goal, float(profile.leg_bounds_m[self.state.leg + 1]))
        goal_x, goal_y = _point(profile, goal)
        ahead_rad = yaw_rad + (math.pi if profile.backwards else 0.0)
        bearing = math.remainder(math.atan2(goal_y - y_m, goal_x - x_m) - ahead_rad, 2.0 * math.pi)
        on_spot = abs(bearing) > (_SPOT_END_RAD if self.state.on_spot else _SPOT_BEGIN_RAD)
        self.state = replace(self.state, on_spot=on_spot)
        if on_spot:
            return 0.0, self._turn_rate(bearing)
        curvature = 2.0 * math.sin(bearing) / max(math.hypot(goal_x - x_m, goal_y - y_m), 1e-6)
        if abs(curvature) * speed > self.robot.max_turn_rate_radps:
            speed = self.robot.max_turn_rate_radps / abs(curvature)
        return -speed if profile.backwards else speed, curvature * speed

    def _turn_rate(self, error_rad: float) -> float:
        """Turn on the spot, slow enough to stop at the goal."""
        braking = math.sqrt(_BRAKING_SHARE * 2.0 * self.robot.max_turn_acceleration_radps2 * abs(error_rad))
        rate = min(self.robot.max_turn_rate_radps, braking, 4.0 * abs(error_rad))
        return math.copysign(max(rate, 0.1), error_rad)

    def _is_stuck(self, pose: tuple[float, float, float], speed: float, turn: float, now_s: float) -> bool:
        """Whether commands have moved nothing for long enough."""
        commanded = abs(speed) > _COMMANDED_MPS or abs(turn) > _COMMANDED_RADPS
        anchor = self.state.anchor
        if anchor is None or not commanded or _moved(anchor, pose):
            self.state = replace(self.state, anchor=pose if commanded else None, anchor_s=now_s)
            return False
        return now_s - self.state.anchor_s >= _STUCK_S


def _moved(a: tuple[float, float, float], b: tuple[float, float, float]) -> bool:
    turned = abs(math.remainder(a[2] - b[2], 2.0 * math.pi))
    return math.hypot(a[0] - b[0], a[1] - b[1]) > _STUCK_MOVE_M or turned > _STUCK_TURN_RAD


def _at(profile: _Profile, column: NDArray[np.float64], s_m: float) -> float:
    return float(np.interp(s_m, profile.s_m, column))


def _nearest(profile: _Profile, low_m: float, high_m: float, x_m: float, y_m: float) -> tuple[float, float]:
    """(arc length, distance) of the point nearest to (x, y) among the path's arc lengths [low, high]."""
    inner = (profile.s_m > low_m) & (profile.s_m < high_m)
    s = np.concatenate([[low_m], profile.s_m[inner], [high_m]])
    x, y = np.interp(s, profile.s_m, profile.x_m), np.interp(s, profile.s_m, profile.y_m)
    dx, dy = np.diff(x), np.diff(y)
    along = ((x_m - x[:-1]) * dx + (y_m - y[:-1]) * dy) / np.maximum(dx**2 + dy**2, 1e-18)
    along = np.clip(along, 0.0, 1.0)
    distance = np.hypot(x[:-1] + along * dx - x_m, y[:-1] + along * dy - y_m)
    best = int(np.argmin(distance))
    return float(s[best] + along[best] * (s[best + 1] - s[best])), float(distance[best])


def _point(profile: _Profile, s_m: float) -> tuple[float, float]:
    """Point at an arc length; beyond the end, on the straight line that the path ends with."""
    beyond = max(0.0, s_m - float(profile.s_m[-1]))
    last_m = float(profile.s_m[-1] - profile.s_m[-2])
    scale = beyond / last_m if last_m > 0.0 else 0.0
    x = _at(profile, profile.x_m, s_m) + scale * float(profile.x_m[-1] - profile.x_m[-2])
    y = _at(profile, profile.y_m, s_m) + scale * float(profile.y_m[-1] - profile.y_m[-2])
    return x, y


def _resample(path: TimedPath, robot: RobotConfig) -> _Profile:
    """The path at even spacing, with its own speed and the speed that is safe for what lies ahead."""
    steps = np.hypot(np.diff(path.x_m), np.diff(path.y_m))
    keep = np.concatenate([[True], steps > 1e-6])
    s = np.concatenate([[0.0], np.cumsum(steps)])[keep]
    length = float(s[-1])
    # Keep the vertices: resampling alone would round every corner.
    even = np.linspace(0.0, length, max(2, math.ceil(length / _SPACING_M) + 1))
    at = np.union1d(even, s) if length > 0.0 else np.zeros(2)
    x, y = np.interp(at, s, path.x_m[keep]), np.interp(at, s, path.y_m[keep])
    # Constant acceleration between points: the square of the speed is linear in the way.
    speed = np.sqrt(np.interp(at, s, path.speed_mps[keep] ** 2))
    speed = np.minimum(speed, robot.max_speed_mps)
    corners = s[1:-1][_turns(path.x_m[keep], path.y_m[keep]) > _SHARP_RAD]
    safe = np.minimum(speed, _corner_speed(at, x, y, corners, robot))
    safe[-1] = 0.0
    twice = 2.0 * _BRAKING_SHARE * robot.max_acceleration_mps2
    safe = np.sqrt(np.maximum(np.minimum.accumulate((safe**2 + twice * at)[::-1])[::-1] - twice * at, 0.0))
    bounds = np.concatenate([[0.0], corners, [length]])
    return _Profile(at, x, y, speed, safe, bounds, _is_backwards(path))


def _is_backwards(path: TimedPath) -> bool:
    """Whether the path's first yaw points against its first step."""
    moving = np.flatnonzero(np.hypot(np.diff(path.x_m), np.diff(path.y_m)) > 1e-6)
    if moving.size == 0:
        return False
    i = int(moving[0])
    way = math.atan2(path.y_m[i + 1] - path.y_m[i], path.x_m[i + 1] - path.x_m[i])
    return math.cos(way - float(path.yaw_rad[i])) < 0.0


def _turns(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle in radians between the segments at each inner vertex, shape (n - 2,)."""
    dx, dy = np.diff(x), np.diff(y)
    cross, dot = dx[:-1] * dy[1:] - dy[:-1] * dx[1:], dx[:-1] * dx[1:] + dy[:-1] * dy[1:]
    return np.abs(np.arctan2(cross, dot))


def _corner_speed(
    s: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    corners: NDArray[np.float64],
    robot: RobotConfig,
) -> NDArray[np.float64]:
    """Speed at which a circle that cuts the local bend by `_CORNER_CUT_M` keeps within the turn rate.

    The bend at a point is the angle between the chords to the points `_CORNER_WINDOW_M` before and after, or to
    the nearest sharp corner (arc lengths `corners`) if that is nearer. At a sharp corner itself: creep.
    """
    bounds = np.concatenate([s[:1], corners, s[-1:]])
    before = np.maximum(s - _CORNER_WINDOW_M, bounds[np.searchsorted(bounds, s, side="right") - 1])
    after = np.minimum(s + _CORNER_WINDOW_M, bounds[np.searchsorted(bounds, s, side="left")])
    ax, ay = x - np.interp(before, s, x), y - np.interp(before, s, y)
    bx, by = np.interp(after, s, x) - x, np.interp(after, s, y) - y
    angle = np.abs(np.arctan2(ax * by - ay * bx, ax * bx + ay * by))
    bulge = 1.0 / np.cos(np.minimum(angle, 3.1) / 2.0) - 1.0
    speed = _TURN_SHARE * robot.max_turn_rate_radps * _CORNER_CUT_M / np.maximum(bulge, 1e-9)
    return np.where(np.isin(s, corners), _CREEP_MPS, np.clip(speed, _CREEP_MPS, robot.max_speed_mps))
