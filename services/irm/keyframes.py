"""SLAM's keyframes as irm goes by them, and where `odom` lies in `map` for what hangs on them (REP-105).

Everything that irm keeps in `map` (breadcrumbs, frontiers, coverage, ground) belongs to a keyframe and goes where it
goes. A pose graph of thousands of keyframes comes every few seconds and most of it is as before, so it is compared in
whole columns, and only the ids of keyframes that moved are handed on.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.frames import Planar
from schemas.sensing import PoseGraph

IDENTITY = Planar(0.0, 0.0, 0.0)
NOBODY = -1
"""The keyframe of what belongs to none: it never moves."""

MOVED_M = 0.02
MOVED_RAD = math.radians(0.1)
"""Less is no motion: it adds up until it is one."""

_NEWEST_WITHIN_M = 10.0
_SAME_FRAME_M, _SAME_FRAME_RAD = 0.1, math.radians(1.0)
_WAIT_NS = 1_500_000_000


class Anchor(NamedTuple):
    """A keyframe and its pose in `map`."""

    keyframe: int = NOBODY
    pose: Planar = IDENTITY

    def local(self, x_m: float, y_m: float) -> tuple[float, float]:
        """A point of `map` in the keyframe's frame."""
        return self.pose.inverse().apply(x_m, y_m)


class Keyframes:
    """Poses in `map` and variances by id; a pose changes here when the keyframe has really moved."""

    def __init__(self) -> None:
        self._id = np.empty(0, np.int64)
        self._pose = np.empty((0, 3))
        self._variance_m2 = np.empty(0)
        self._told = np.empty((0, 4))
        self._changed: set[int] = set()

    def __len__(self) -> int:
        return self._id.size

    def read(self, graph: PoseGraph) -> tuple[dict[int, Planar], Planar]:
        """Take in a pose graph.

        Returns:
            The poses of the keyframes that moved (new ones did not move), and the motion in `map` of the newest of
            those known before, identity when it stayed.
        """
        ids, told, held = graph.keyframe_id, graph.pose_in_map, self._id.size
        self._variance_m2 = graph.covariance[:, 0] + graph.covariance[:, 1]
        if np.array_equal(ids[:held], self._id) and np.array_equal(told[:held], self._told):
            self._changed.update(ids[held:].tolist())
            self._pose = np.concatenate((self._pose, told[held:, [0, 1, 3]]))
            self._id, self._told = ids, told
            return {}, IDENTITY
        poses = told[:, [0, 1, 3]]
        new, old = _common(ids, self._id)
        before, after = self._pose[old], poses[new]
        moved = _moved_rows(before, after)
        poses[new[~moved]] = before[~moved]
        motion = IDENTITY
        if new.size and moved[-1]:
            motion = _planar(after[-1]).compose(_planar(before[-1]).inverse())
        changed = {int(ids[k]): _planar(poses[k]) for k in new[moved]}
        self._changed |= changed.keys()
        if new.size < ids.size:
            self._changed.update(np.delete(ids, new).tolist())
        self._id, self._pose, self._told = ids, poses, told
        return changed, motion

    def pose(self, keyframe: int) -> Planar | None:
        """Pose in `map`; None for a keyframe that is not known."""
        row = self._row(keyframe)
        return None if row < 0 else _planar(self._pose[row])

    def reference(self, x_m: float, y_m: float) -> Anchor:
        """The keyframe that what is seen from this place in `map` belongs to.

        The newest one, which odometry ties to the robot (one that only seems near may be an old one, a loop before
        its closure), unless SLAM has added none for long: then the nearest.
        """
        if not self._id.size:
            return Anchor()
        row = self._id.size - 1
        if math.dist(self._pose[row, :2].tolist(), (x_m, y_m)) > _NEWEST_WITHIN_M:
            row = int(np.argmin(np.hypot(self._pose[:, 0] - x_m, self._pose[:, 1] - y_m)))
        return Anchor(int(self._id[row]), _planar(self._pose[row]))

    def deviations_m(self, anchor: Anchor, radius_m: float, least_m: float, drift: float) -> dict[int, float]:
        """How uncertain the position is *relative to* a keyframe, of the keyframes within a radius of it, m.

        Marginal variances do not tell that, so the smaller of two bounds is taken: the difference of the standard
        deviations, which does not grow with what both have drifted from the start and is none for keyframes that a
        closure ties to each other; and `drift` (m/m) times the way between them along the keyframes, as odometry
        holds together what was driven lately whatever the rest of the graph says.

        Empty when none anywhere has more than `least_m`.
        """
        row = self._row(anchor.keyframe)
        if row < 0:
            return {}
        deviation = np.sqrt(self._variance_m2)
        relative = np.abs(deviation - deviation[row])
        if float(relative.max()) <= least_m:
            return {}
        along = np.concatenate((np.zeros(1), np.hypot(*np.diff(self._pose[:, :2], axis=0).T).cumsum()))
        relative = np.minimum(relative, drift * np.abs(along - along[row]))
        offset = self._pose[:, :2] - self._pose[row, :2]
        near = np.flatnonzero(np.hypot(offset[:, 0], offset[:, 1]) <= radius_m)
        return dict(zip(self._id[near].tolist(), relative[near].tolist(), strict=True))

    def _row(self, keyframe: int) -> int:
        row = int(np.searchsorted(self._id, keyframe))
        return row if row < self._id.size and int(self._id[row]) == keyframe else -1

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {"id": self._id, "pose": self._pose, "variance": self._variance_m2}

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self._id, self._pose, self._variance_m2 = state["id"], state["pose"], state["variance"]
        self._told = np.empty((0, 4))

    def take_changes(self) -> dict[str, Any]:
        """The keyframes that are new or have moved since the last call: for the journal."""
        changed, self._changed = self._changed, set()
        rows = [row for row in (self._row(k) for k in sorted(changed)) if row >= 0]
        return {"id": self._id[rows], "pose": self._pose[rows], "variance": self._variance_m2[rows]}

    def apply_changes(self, changes: dict[str, Any]) -> None:
        """Take in changes from the journal."""
        kept = ~np.isin(self._id, changes["id"])
        ids = np.concatenate((self._id[kept], changes["id"]))
        order = np.argsort(ids)
        self._id = ids[order]
        self._pose = np.concatenate((self._pose[kept], changes["pose"]))[order]
        self._variance_m2 = np.concatenate((self._variance_m2[kept], changes["variance"]))[order]
        self._told = np.empty((0, 4))


class OdomInMap:
    """Pose of `odom` in `map`, in step with the keyframes.

    At a loop closure map_to_odom (on every odometry) and the keyframes (in the pose graph) jump together but arrive one
    after the other. What is seen between the two would be put into `map` at the wrong place and then be moved once more
    with its keyframe. So the frame follows the keyframes, and map_to_odom as soon as both agree, or when after
    a while they still do not.
    """

    def __init__(self) -> None:
        self.pose = IDENTITY
        self._apart_ns = -1
        self._ahead = False

    def follow(self, motion: Planar) -> None:
        """The newest keyframe has moved in `map`: late, if map_to_odom has been gone by already."""
        ahead, self._ahead = self._ahead, False
        if not motion.is_identity and not ahead:
            self.pose = motion.compose(self.pose)

    def update(self, told: Planar, now_ns: int, known: bool) -> Planar:
        """The frame to go by. told: map_to_odom; known: whether there are keyframes at all."""
        apart = known and not is_near(told, self.pose, _SAME_FRAME_M, _SAME_FRAME_RAD)
        if apart and self._apart_ns < 0:
            self._apart_ns = now_ns
        if not apart or now_ns - self._apart_ns >= _WAIT_NS:
            self._ahead |= apart
            self.pose, self._apart_ns = told, -1
        return self.pose

    def state(self) -> list[Any]:
        """For a snapshot."""
        return [list(self.pose), self._apart_ns, self._ahead]

    def set_state(self, state: list[Any]) -> None:
        """From a snapshot."""
        self.pose, self._apart_ns, self._ahead = Planar(*state[0]), state[1], bool(state[2])


def is_near(a: Planar, b: Planar, within_m: float, within_rad: float) -> bool:
    """Whether two poses differ by no more than that."""
    turned = abs(math.remainder(a.yaw_rad - b.yaw_rad, math.tau))
    return math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) <= within_m and turned <= within_rad


def has_moved(a: Planar, b: Planar) -> bool:
    """Whether two poses of a keyframe differ by more than noise."""
    return not is_near(a, b, MOVED_M, MOVED_RAD)


def _moved_rows(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The same for rows of x, y, yaw."""
    turned = np.abs((a[:, 2] - b[:, 2] + math.pi) % (2.0 * math.pi) - math.pi)
    moved: NDArray[np.bool_] = np.hypot(a[:, 0] - b[:, 0], a[:, 1] - b[:, 1]) > MOVED_M
    return moved | (turned > MOVED_RAD)


def _common(new: NDArray[np.int64], old: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the ids that both have, ascending by id; mostly `new` goes on where `old` ended."""
    if new.size >= old.size and np.array_equal(new[: old.size], old):
        rows = np.arange(old.size)
        return rows, rows
    _, of_new, of_old = np.intersect1d(new, old, assume_unique=True, return_indices=True)
    return of_new, of_old


def _planar(row: NDArray[np.float64]) -> Planar:
    return Planar(float(row[0]), float(row[1]), float(row[2]))
