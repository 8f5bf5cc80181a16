"""The path that is being driven: where the robot is on it, how far it holds, and what to do when it cannot go on."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.contract import SECOND_NS, Stamp
from schemas.policy import LocalPolicy
from schemas.sensing import FollowerState, Odometry
from services.reconciler.config import Config
from services.reconciler.episode import Committed, Opened
from services.reconciler.path import (
    ARC_POINTS,
    STEP_M,
    Ground,
    clearance_at,
    first_hazard,
    project,
    resample,
    round_corners,
    smooth,
)
from services.reconciler.trail import Trail

_KEPT = ("at", "end", "changed", "why", "trouble_ns", "backing_ns", "idle_ns")
"""What a snapshot holds as it is."""
_TRAIL_M = 6.0
_BACKING_S = 5.0
"""Backing off ends then at the latest."""
_ON_SPOT_RAD = math.radians(40.0)
"""From about so much on followers turn on the spot."""
_MORE_ROOM_M = 0.05
_NEAR_POINTS = 2
"""So far before the robot the line stays as it is."""
_REACTION_S = 0.2
"""So long it goes on as it goes before it brakes."""
_ROOM_WITHIN_M = 1.5
"""The robot goes back before it turns if there is room so near on its trail."""
_WAY_OUT_M = 0.6
"""Over this a robot in a tight place may have less clearance than paths keep."""


class Driven:
    """The committed policy as the robot drives it.

    at: index of the robot's place on the line. end: index up to which the line holds. changed: since the last plan.
    why: what was last decided about it. backing_ns, idle_ns: since when the robot backs off, or has no way on; -1: it
    does not, or has.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self.committed: Committed | None = None
        self.at = 0
        self.end = 0
        self.changed = False
        self.why = "starting"
        self.trouble_ns = -1
        self.backing_ns = -1
        self.idle_ns = -1
        self._trail = Trail(_TRAIL_M)

    @property
    def backing(self) -> bool:
        """Whether the robot backs off."""
        return self.backing_ns >= 0

    def left_m(self) -> float:
        """How much of the line is left to drive."""
        return max(0, self.end - self.at) * STEP_M if self.committed is not None else 0.0

    def ahead(self, odometry: Odometry) -> NDArray[np.float64]:
        """The line from the robot on as far as it holds, (k, 2) m, k >= 1."""
        here = np.array([[odometry.pose.x_m, odometry.pose.y_m]])
        if self.committed is None:
            return here
        return np.concatenate([here, self.committed.points[self.at + 1 : self.end + 1]])

    def commit(self, opened: Opened, policy: LocalPolicy, odometry: Odometry, ground: Ground) -> int:
        """Concatenate the kept prefix and the new policy (Eq. 19), smoothed. Returns how many points of the old policy
        were kept."""
        here = (odometry.pose.x_m, odometry.pose.y_m)
        self.committed = concatenate(opened, policy, ground, self._config, here)
        points = self.committed.points
        self.at, _ = project(points, odometry.pose.x_m, odometry.pose.y_m, 0, min(40, len(points) - 1))
        self.end = len(points) - 1
        self.changed, self.why = True, policy.reason
        if not opened.keeps_old:
            return 0
        same = (points[: len(opened.prefix)] == opened.prefix[: len(points)]).all(axis=1)
        return len(same) if same.all() else int(np.argmin(same))

    def check_hazards(self, ground: Ground) -> None:
        """Truncate the path before the first place where the robot does not fit or the ground is unknown."""
        if self.committed is None:
            return
        points = self.committed.points
        has_m = self._clearance_m(ground, points[self.at]) - 0.02
        out = min(self.at + 2 + round(_WAY_OUT_M / STEP_M), len(points))
        least_m = (
            self._config.footprint_radius_m
            - 0.05
            + (0.0 if self.backing else self._config.clearance_margin_m)
        )
        hazard = self._first_hazard(ground, points[:out], self.at + 2, min(least_m, has_m))
        if hazard < 0 and not self.backing:
            hazard = self._first_hazard(ground, points, out, least_m)
        end = len(points) - 1 if hazard < 0 else max(hazard - 3, self.at)
        if end != self.end:
            self.end, self.changed = end, True
            if hazard >= 0:
                x_m, y_m = points[hazard].tolist()
                what = "fence" if ground.is_shut(x_m, y_m, least_m) else "hazard"
                self.why = f"{what} {(hazard - self.at) * STEP_M:.1f} m ahead"

    @staticmethod
    def _clearance_m(ground: Ground, at: NDArray[np.float64]) -> float:
        s = ground.spec
        return clearance_at(ground.clearance_m, s.resolution_m, s.ix0, s.iy0, float(at[0]), float(at[1]))

    @staticmethod
    def _first_hazard(ground: Ground, points: NDArray[np.float64], begin: int, needed_m: float) -> int:
        s = ground.spec
        return first_hazard(
            points, begin, ground.state, ground.clearance_m, s.resolution_m, s.ix0, s.iy0, needed_m
        )

    def follow(
        self,
        now: Stamp,
        odometry: Odometry,
        follower: FollowerState | None,
        plan_id: int,
        ground: Ground,
    ) -> bool:
        """Where the robot is on its path. Returns whether the path was dropped: left, or no way on along it.

        plan_id: of the newest plan.
        """
        self._trail.add(odometry.pose.x_m, odometry.pose.y_m)
        if self.committed is None:
            return False
        points = self.committed.points
        self.at, off = project(
            points,
            odometry.pose.x_m,
            odometry.pose.y_m,
            max(self.at - 3, 0),
            min(self.at + 25, len(points) - 1),
        )
        dropped = off > self._config.off_path_m
        if dropped:
            self.drop("off the path")
        else:
            dropped = self._meet_trouble(now, odometry, follower, plan_id)
            dropped = dropped or self._leave_tight_place(now, odometry, ground)
        if self.backing and (self.left_m() < STEP_M or now - self.backing_ns > _BACKING_S * SECOND_NS):
            self.drop("backed off")
            dropped = True
        return dropped

    def _meet_trouble(
        self, now: Stamp, odometry: Odometry, follower: FollowerState | None, plan_id: int
    ) -> bool:
        """Blocked or stuck for long, the robot drops its path and backs off, once. Returns whether it was dropped."""
        trouble = follower is not None and (follower.blocked or follower.stuck)
        # Only a follower that has the newest plan and is well ends the trouble: a new plan every second would, else.
        if not trouble:
            if follower is None or follower.plan_id == plan_id:
                self.trouble_ns = -1
            return False
        if self.trouble_ns < 0:
            self.trouble_ns = now
        if now - self.trouble_ns <= self._config.blocked_s * SECOND_NS:
            return False
        self.trouble_ns = -1
        backing = self.backing
        self.drop("blocked")
        if not backing:
            self._back_off(now, odometry, self._config.back_off_m, "blocked: backs off")
        return True

    def _leave_tight_place(self, now: Stamp, odometry: Odometry, ground: Ground) -> bool:
        """Before the path makes the robot turn on the spot where its feet would meet something, it goes back, in
        reverse, to where it has room. Returns whether the path was dropped."""
        assert self.committed is not None
        pose, points = odometry.pose, self.committed.points
        needed_m = self._config.footprint_radius_m + self._config.turn_room_m
        if self.backing or self._config.turn_room_m == 0.0 or self.left_m() < STEP_M:
            return False
        here, v = np.array([pose.x_m, pose.y_m]), odometry.speed_mps
        stop_m = v * _REACTION_S + v * abs(v) / (2.0 * self._config.max_acceleration_mps2)
        stop = here + stop_m * np.array([math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)])
        if min(self._clearance_m(ground, at) for at in (here, stop)) >= needed_m:
            return False
        soon = points[self.at : min(self.at + 3 + math.ceil(stop_m / STEP_M) + 2, self.end + 1)]
        legs = soon[2:] - soon[:-2]
        off = np.angle(np.exp(1j * (np.arctan2(legs[:, 1], legs[:, 0]) - pose.yaw_rad)))
        if not (np.abs(off) > _ON_SPOT_RAD).any():
            return False
        back = resample(self._trail.back(pose.x_m, pose.y_m, _ROOM_WITHIN_M))
        enough_m = needed_m + _MORE_ROOM_M
        room = next((k for k, at in enumerate(back) if self._clearance_m(ground, at) >= enough_m), -1)
        if room < 0:
            return False
        self.drop("tight")
        self._back_off(now, odometry, max(room, 2) * STEP_M, "tight: goes back before it turns")
        return True

    def leave_if_idle(self, now: Stamp, odometry: Odometry, wanted: bool) -> None:
        """With no way on for long, the robot goes back on the way that it came: it stands where nothing leads out.

        wanted: it is to drive.
        """
        if not wanted or self.backing or self.left_m() >= STEP_M:
            self.idle_ns = -1
        elif self.idle_ns < 0:
            self.idle_ns = now
        elif now - self.idle_ns > self._config.idle_s * SECOND_NS:
            self.idle_ns = -1
            self.drop("no way on")
            self._back_off(now, odometry, 2.0 * self._config.back_off_m, "no way on: goes back")

    def _back_off(self, now: Stamp, odometry: Odometry, distance_m: float, why: str) -> None:
        """Drive back on the way that the robot came, facing what is in its way."""
        x, y = odometry.pose.x_m, odometry.pose.y_m
        line = resample(self._trail.back(x, y, distance_m))
        if len(line) > 1:
            nothing = np.zeros((0, 2), np.int64)
            self.committed = Committed(line, nothing, np.zeros(0, np.int64))
            self.end, self.backing_ns, self.why = len(line) - 1, now, why

    def drop(self, why: str) -> None:
        """Forget the path: the robot stands until there is another."""
        self.committed = None
        self.backing_ns = self.trouble_ns = -1
        self.at = self.end = 0
        self.changed, self.why = True, why

    def forget_trail(self) -> None:
        """The robot is not where the trail ends any more."""
        self._trail.load([])

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {
            **{name: getattr(self, name) for name in _KEPT},
            "committed": None if self.committed is None else asdict(self.committed),
            "trail": self._trail.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        for name in _KEPT:
            setattr(self, name, state[name])
        self.committed = None if state["committed"] is None else Committed(**state["committed"])
        self._trail.load(state["trail"])


def concatenate(
    opened: Opened, policy: LocalPolicy, ground: Ground, config: Config, robot: tuple[float, float]
) -> Committed:
    """The prefix that an episode kept and the policy that answered it, as one smooth line with its nodes.

    robot: where it is, m. Of a prefix that was kept, at most the last half metre changes: the corner at the junction.
    """
    prefix = opened.prefix
    raw = np.concatenate([prefix, policy.path_xy_m[1:]]) if len(prefix) else policy.path_xy_m
    fixed = len(prefix) if opened.keeps_old else max(1, len(prefix) // 2)
    offset = len(raw) - len(policy.path_xy_m)
    points = smooth(raw, fixed, ground, config, offset + looked_along(policy))
    g = ground.spec
    near, _ = project(points, *robot, 0, min(40, len(points) - 1))
    begin = max(near + _NEAR_POINTS, len(prefix) - 2 - ARC_POINTS if opened.keeps_old else 0)
    round_corners(points, begin, ground.clearance_m, g.resolution_m, g.ix0, g.iy0, config.comfort_clearance_m)
    lattice = np.concatenate([opened.kept_lattice, policy.path_lattice[1:].astype(np.int64)])
    anchors = policy.path_xy_m[policy.path_node_point[1:]]
    node_point = list(opened.kept_point)
    at = int(node_point[-1]) if node_point else 0
    for x, y in anchors:
        at, _ = project(points, float(x), float(y), min(at, len(points) - 1), min(at + 30, len(points) - 1))
        node_point.append(at)
    return Committed(points, lattice, np.array(node_point, np.int64), policy.target)


def looked_along(policy: LocalPolicy) -> NDArray[np.int64]:
    """Indices in the path's line of both ends of every step that a look hangs on."""
    steps = np.flatnonzero(policy.path_look)
    ends = np.unique(np.concatenate([np.maximum(steps - 1, 0), steps]))
    return policy.path_node_point[ends].astype(np.int64)
