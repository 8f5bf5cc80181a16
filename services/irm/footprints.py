"""Coverage footprints, computed when the scan is taken and kept with their keyframe (paper, Algorithm 1; DESIGN).

A footprint is a set of cells. All scans that are joined to a keyframe make one footprint, which is one Bayes update
of the cells in it. When SLAM moves the keyframe, its footprint moves along: what it added to the coverage is taken
back and added where it now lies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.coverage import look_log_odds
from planning.frames import Planar
from planning.grid import FREE, GridSpec, overlap
from planning.rays import visible_cells
from schemas.sensing import CoverageScan
from services.irm.tiles import TileLayer

_MOVED_M = 0.02
_MOVED_RAD = 0.002


@dataclass(slots=True)
class _Footprint:
    """Cells in `map` as they lay when the keyframe was at `pose`; log_odds: evidence of being seen once."""

    pose: Planar
    spec: GridSpec
    seen: NDArray[np.bool_]
    log_odds: float


class FootprintStore:
    """The footprints of all keyframes, and the coverage layer that they sum up to."""

    def __init__(self, coverage: TileLayer) -> None:
        self._coverage = coverage
        self._footprints: dict[int, _Footprint] = {}
        self._changed: set[int] = set()

    def add(
        self,
        scan: CoverageScan,
        keyframe: Planar,
        state: NDArray[np.uint8],
        spec: GridSpec,
        odom_to_map: Planar,
    ) -> int:
        """Add one look. state: (h, w) risk map states over `spec` in odom. Returns how many cells were new.

        Only known free cells are covered; unknown cells block the view like obstacles.
        """
        patch, seen = _look(scan, state, spec)
        if patch is None:
            return 0
        if not odom_to_map.is_identity:
            patch, seen = _moved(patch, seen, odom_to_map)
        held = self._footprints.get(scan.keyframe_id)
        if held is None:
            empty = np.zeros(patch.shape, dtype=np.bool_)
            held = _Footprint(keyframe, patch, empty, look_log_odds(scan.detection_probability))
            self._footprints[scan.keyframe_id] = held
        self._grow(held, patch)
        common = overlap(held.spec, patch)
        assert common is not None  # the footprint has just grown over the patch
        new = np.zeros(held.spec.shape, dtype=np.bool_)
        new[common[0]] = seen[common[1]] & ~held.seen[common[0]]
        held.seen |= new
        if new.any():
            self._changed.add(scan.keyframe_id)
        self._add_evidence(held.spec, new, held.log_odds)
        return int(new.sum())

    @staticmethod
    def _grow(held: _Footprint, patch: GridSpec) -> None:
        a = held.spec
        ix0, iy0 = min(a.ix0, patch.ix0), min(a.iy0, patch.iy0)
        width = max(a.ix0 + a.width, patch.ix0 + patch.width) - ix0
        height = max(a.iy0 + a.height, patch.iy0 + patch.height) - iy0
        grown = GridSpec(a.resolution_m, ix0, iy0, width, height)
        if grown == a:
            return
        seen = np.zeros(grown.shape, dtype=np.bool_)
        seen[a.iy0 - iy0 : a.iy0 - iy0 + a.height, a.ix0 - ix0 : a.ix0 - ix0 + a.width] = held.seen
        held.spec, held.seen = grown, seen

    def _add_evidence(self, spec: GridSpec, cells: NDArray[np.bool_], log_odds: float) -> None:
        window = self._coverage.read(spec)
        window[cells] += np.float32(log_odds)
        self._coverage.write(spec, window)

    def follow(self, keyframes: dict[int, Planar]) -> int:
        """Move the footprints of keyframes that SLAM has moved. Returns how many moved."""
        moved = 0
        for keyframe_id in sorted(self._footprints):
            held, pose = self._footprints[keyframe_id], keyframes.get(keyframe_id)
            if pose is None or not _has_moved(held.pose, pose):
                continue
            self._add_evidence(held.spec, held.seen, -held.log_odds)
            change = pose.compose(held.pose.inverse())
            spec, seen = _moved(held.spec, held.seen, change)
            self._footprints[keyframe_id] = _Footprint(pose, spec, seen, held.log_odds)
            self._changed.add(keyframe_id)
            self._add_evidence(spec, seen, held.log_odds)
            moved += 1
        return moved

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {str(k): _pack(f) for k, f in sorted(self._footprints.items())}

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot, with the coverage layer as it was then."""
        self._footprints = {int(key): _unpack(packed) for key, packed in state.items()}

    def take_changes(self) -> dict[str, Any]:
        """The footprints that have changed since the last call: for the journal."""
        changed, self._changed = self._changed, set()
        return {str(k): _pack(self._footprints[k]) for k in sorted(changed)}

    def apply_changes(self, changes: dict[str, Any]) -> None:
        """Take in changes from the journal: footprints and what they add to the coverage."""
        for key, packed in changes.items():
            self._footprints[int(key)] = self._replace(self._footprints.get(int(key)), _unpack(packed))

    def _replace(self, old: _Footprint | None, new: _Footprint) -> _Footprint:
        """Only the difference is counted when the keyframe has not moved: sums of evidence stay exact."""
        fresh = new.seen.copy()
        if old is not None and old.pose == new.pose:
            common = overlap(new.spec, old.spec)
            assert common is not None  # footprints only grow
            fresh[common[0]] &= ~old.seen[common[1]]
        elif old is not None:
            self._add_evidence(old.spec, old.seen, -old.log_odds)
        self._add_evidence(new.spec, fresh, new.log_odds)
        return new


def _pack(footprint: _Footprint) -> list[Any]:
    f = footprint
    return [list(f.pose), list(f.spec), np.packbits(f.seen), f.log_odds]


def _unpack(packed: list[Any]) -> _Footprint:
    pose, spec_fields, bits, log_odds = packed
    spec = GridSpec(*spec_fields)
    seen = np.unpackbits(bits, count=spec.width * spec.height).astype(np.bool_).reshape(spec.shape)
    return _Footprint(Planar(*pose), spec, seen, float(log_odds))


def _look(
    scan: CoverageScan, state: NDArray[np.uint8], spec: GridSpec
) -> tuple[GridSpec | None, NDArray[np.bool_]]:
    """The cells that one look sees, in odom, on a patch just large enough."""
    pose, resolution = scan.pose_in_odom, spec.resolution_m
    reach = math.ceil(scan.range_m / resolution) + 1
    row, column = spec.cell_of(pose.x_m, pose.y_m)
    r0, r1 = max(0, row - reach), min(spec.height, row + reach + 1)
    c0, c1 = max(0, column - reach), min(spec.width, column + reach + 1)
    if r0 >= r1 or c0 >= c1 or not spec.contains(row, column):
        return None, np.zeros((0, 0), dtype=np.bool_)
    piece = state[r0:r1, c0:c1]
    patch = GridSpec(resolution, spec.ix0 + c0, spec.iy0 + r0, c1 - c0, r1 - r0)
    out = np.zeros(patch.shape, dtype=np.uint8)
    x_cells = pose.x_m / resolution - patch.ix0
    y_cells = pose.y_m / resolution - patch.iy0
    visible_cells(piece != FREE, x_cells, y_cells, scan.range_m / resolution, pose.yaw_rad, scan.fov_rad, out)
    return patch, (out != 0) & (piece == FREE)


def _has_moved(a: Planar, b: Planar) -> bool:
    turned = abs(math.remainder(a.yaw_rad - b.yaw_rad, 2.0 * math.pi))
    return math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) > _MOVED_M or turned > _MOVED_RAD


def _moved(spec: GridSpec, cells: NDArray[np.bool_], by: Planar) -> tuple[GridSpec, NDArray[np.bool_]]:
    """The cells after a rigid motion: every cell of the new place asks where it came from, so no holes appear."""
    res = spec.resolution_m
    corners = [
        by.apply((spec.ix0 + cx) * res, (spec.iy0 + cy) * res)
        for cx in (0, spec.width)
        for cy in (0, spec.height)
    ]
    ix0 = math.floor(min(c[0] for c in corners) / res)
    iy0 = math.floor(min(c[1] for c in corners) / res)
    width = math.floor(max(c[0] for c in corners) / res) - ix0 + 1
    height = math.floor(max(c[1] for c in corners) / res) - iy0 + 1
    target = GridSpec(res, ix0, iy0, width, height)
    return target, resample(cells, spec, target, by, False)


def resample(
    values: NDArray[Any], spec: GridSpec, target: GridSpec, target_from_source: Planar, fill: Any
) -> NDArray[Any]:
    """Nearest-cell values of a layer over another grid in another frame.

    target_from_source: pose of the source's frame in the target's. Cells that come from outside get `fill`.
    """
    back = target_from_source.inverse()
    c, s = math.cos(back.yaw_rad), math.sin(back.yaw_rad)
    x, y = np.meshgrid(target.centres_x(), target.centres_y())
    column = np.floor((back.x_m + c * x - s * y) / spec.resolution_m).astype(np.int64) - spec.ix0
    row = np.floor((back.y_m + s * x + c * y) / spec.resolution_m).astype(np.int64) - spec.iy0
    inside = (row >= 0) & (row < spec.height) & (column >= 0) & (column < spec.width)
    out = np.full(target.shape, fill, dtype=values.dtype)
    out[inside] = values[row[inside], column[inside]]
    return out
