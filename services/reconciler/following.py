"""The path that is being driven: where the robot is on it, how far it holds, and what to do when it cannot go on."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.contract import SECOND_NS, Stamp
from schemas.policy import LocalPolicy
from schemas.sensing import FollowerState, Odometry
from services.reconciler.config import Config
from services.reconciler.episode import Committed, Opened
from services.reconciler.path import STEP_M, Ground, clearance_at, first_hazard, project, resample, smooth
from services.reconciler.trail import Trail

_KEPT = ("at", "end", "changed", "why", "trouble_ns", "backing_ns")
"""What a snapshot holds as it is."""
_TRAIL_M = 2.0
_BACKING_S = 5.0
"""Backing off ends then at the latest."""


class Driven:
    """The committed policy as the robot drives it.

    at: index of the robot's place on the line. end: index up to which the line holds. changed: since the last plan.
    why: what was last decided about it. backing_ns: since when the robot backs off; -1: it does not.
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

    def commit(self, opened: Opened, policy: LocalPolicy, odometry: Odometry, ground: Ground) -> None:
        """Concatenate the kept prefix and the new policy (Eq. 19), smoothed."""
        self.committed = concatenate(opened, policy, ground, self._config)
        points = self.committed.points
        self.at, _ = project(points, odometry.pose.x_m, odometry.pose.y_m, 0, min(40, len(points) - 1))
        self.end = len(points) - 1
        self.changed, self.why = True, policy.reason

    def check_hazards(self, ground: Ground) -> None:
        """Truncate the path before the first place where the robot does not fit or the ground is unknown."""
        if self.committed is None or self.backing:
            return
        s, points = ground.spec, self.committed.points
        hazard = first_hazard(
            points, self.at + 2, ground.state, ground.clearance_m, s.resolution_m, s.ix0, s.iy0,
            self._needed_m(ground, points[self.at]),
        )  # fmt: skip
        end = len(points) - 1 if hazard < 0 else max(hazard - 3, self.at)
        if end != self.end:
            self.end, self.changed = end, True
            if hazard >= 0:
                self.why = f"hazard {(hazard - self.at) * STEP_M:.1f} m ahead"

    def _needed_m(self, ground: Ground, here: NDArray[np.float64]) -> float:
        """Clearance that the path has to keep; where the robot has not even that, what it has: it must get away."""
        c, s = self._config, ground.spec
        has_m = clearance_at(ground.clearance_m, s.resolution_m, s.ix0, s.iy0, float(here[0]), float(here[1]))
        least_m = c.footprint_radius_m - 0.05
        return max(least_m, min(least_m + c.clearance_margin_m, has_m - 0.02))

    def follow(self, now: Stamp, odometry: Odometry, follower: FollowerState | None, plan_id: int) -> bool:
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
        dropped |= self._meet_trouble(now, odometry, follower, plan_id)
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
            self._back_off(now, odometry)
        return True

    def _back_off(self, now: Stamp, odometry: Odometry) -> None:
        """Drive back a little on the way that the robot came, facing what is in its way."""
        x, y = odometry.pose.x_m, odometry.pose.y_m
        line = resample(self._trail.back(x, y, self._config.back_off_m))
        if len(line) > 1:
            nothing = np.zeros((0, 2), np.int64)
            self.committed = Committed(line, nothing, np.zeros(0, np.int64))
            self.end, self.backing_ns, self.why = len(line) - 1, now, "blocked: backs off"

    def drop(self, why: str) -> None:
        """Forget the path: the robot stands until there is another."""
        self.committed = None
        self.backing_ns = -1
        self.at = self.end = 0
        self.changed, self.why = True, why

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


def concatenate(opened: Opened, policy: LocalPolicy, ground: Ground, config: Config) -> Committed:
    """The prefix that an episode kept and the policy that answered it, as one smooth line with its nodes."""
    prefix = opened.prefix
    raw = np.concatenate([prefix, policy.path_xy_m[1:]]) if len(prefix) else policy.path_xy_m
    fixed = len(prefix) if opened.keeps_old else max(1, len(prefix) // 2)
    offset = len(raw) - len(policy.path_xy_m)
    points = smooth(raw, fixed, ground, config, offset + looked_along(policy))
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
