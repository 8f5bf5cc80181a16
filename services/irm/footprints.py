"""Coverage footprints, computed when the scan is taken and kept with their keyframe (paper, Algorithm 1; DESIGN).

A footprint is a set of cells. All scans that are joined to a keyframe make one footprint, which is one Bayes update
of the cells in it. When SLAM moves the keyframe, its footprint moves along: what it added to the coverage is taken
back and added where it now lies. The cells are kept as they were seen, so that moving them often does not wear them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.coverage import look_log_odds
from planning.frames import Planar
from planning.grid import FREE, LETHAL, GridSpec, overlap
from planning.rays import visible_cells
from planning.sight import visible_over
from schemas.sensing import CoverageScan
from services.irm.keyframes import IDENTITY, has_moved
from services.irm.resample import moved
from services.irm.tiles import TileLayer
from services.irm.window import Relief

BLUR_LEVELS = 5
"""Steps of the blur, by a factor of the square root of 2 each."""


@dataclass(slots=True)
class _Footprint:
    """Cells in `map` as they lay when the keyframe was at `pose`; placed: where it is now.

    log_odds: evidence of being seen once; blur: level by which it is weakened.
    """

    pose: Planar
    spec: GridSpec
    seen: NDArray[np.bool_]
    log_odds: float
    placed: Planar
    blur: int = 0

    @property
    def motion(self) -> Planar:
        """What SLAM has moved it by."""
        return IDENTITY if self.placed == self.pose else self.placed.compose(self.pose.inverse())

    @property
    def evidence(self) -> float:
        """Log-odds that it adds to the coverage of its cells."""
        return self.log_odds if self.blur == 0 else self.log_odds * 2.0 ** (-0.5 * self.blur)


class FootprintStore:
    """The footprints of all keyframes, and the coverage layer that they sum up to."""

    def __init__(self, coverage: TileLayer) -> None:
        self._coverage = coverage
        self._footprints: dict[int, _Footprint] = {}
        self._blurred: set[int] = set()
        self._changed: set[int] = set()

    def add(
        self,
        scan: CoverageScan,
        keyframe: Planar,
        state: NDArray[np.uint8],
        spec: GridSpec,
        odom_to_map: Planar,
        relief: Relief | None = None,
    ) -> int:
        """Add one look. state: (h, w) risk map states over `spec` in odom. Returns how many cells were new.

        Only known free cells are covered. relief: heights, over which the sensor looks; on flat ground (None) unknown
        cells block the view like obstacles.
        """
        patch, seen = _look(scan, state, spec, relief)
        if patch is None:
            return 0
        held = self._footprints.get(scan.keyframe_id)
        back = IDENTITY if held is None else held.motion.inverse()
        place = odom_to_map if back.is_identity else back.compose(odom_to_map)
        patch, seen = moved(patch, seen, place)
        if held is None:
            empty = np.zeros(patch.shape, dtype=np.bool_)
            odds = look_log_odds(scan.detection_probability)
            held = _Footprint(keyframe, patch, empty, odds, keyframe)
            self._footprints[scan.keyframe_id] = held
        self._grow(held, patch)
        common = overlap(held.spec, patch)
        assert common is not None  # the footprint has just grown over the patch
        new = np.zeros(held.spec.shape, dtype=np.bool_)
        new[common[0]] = seen[common[1]] & ~held.seen[common[0]]
        held.seen |= new
        if new.any():
            self._changed.add(scan.keyframe_id)
        self._add_evidence(*moved(held.spec, new, held.motion), held.evidence)
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
        count = 0
        for keyframe_id in sorted(keyframes.keys() & self._footprints.keys()):
            held, pose = self._footprints[keyframe_id], keyframes[keyframe_id]
            if not has_moved(held.placed, pose):
                continue
            self._add_evidence(*moved(held.spec, held.seen, held.motion), -held.evidence)
            held.placed = pose
            self._changed.add(keyframe_id)
            self._add_evidence(*moved(held.spec, held.seen, held.motion), held.evidence)
            count += 1
        return count

    def blur(self, deviations_m: dict[int, float], from_m: float) -> int:
        """Weaken what was seen from keyframes whose place relative to the robot's is uncertain (DESIGN 3, irm).

        deviations_m: standard deviation by keyframe, of those around the robot; the others keep their level.
        Returns how many changed.
        """
        if not deviations_m:  # nothing is uncertain any more
            deviations_m = dict.fromkeys(self._blurred, 0.0)
        levels = {
            k: blur_level(d, from_m) for k, d in deviations_m.items() if d > from_m or k in self._blurred
        }
        changed = 0
        for keyframe_id in sorted(levels.keys() & self._footprints.keys()):
            held, level = self._footprints[keyframe_id], levels[keyframe_id]
            if level == held.blur:
                continue
            spec, cells = moved(held.spec, held.seen, held.motion)
            before = held.evidence
            held.blur = level
            self._add_evidence(spec, cells, held.evidence - before)
            (self._blurred.add if level else self._blurred.discard)(keyframe_id)
            self._changed.add(keyframe_id)
            changed += 1
        return changed

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {str(k): _pack(f) for k, f in sorted(self._footprints.items())}

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot, with the coverage layer as it was then."""
        self._footprints = {int(key): _unpack(packed) for key, packed in state.items()}
        self._blurred = {k for k, f in self._footprints.items() if f.blur}

    def take_changes(self) -> dict[str, Any]:
        """The footprints that have changed since the last call: for the journal."""
        changed, self._changed = self._changed, set()
        return {str(k): _pack(self._footprints[k]) for k in sorted(changed)}

    def apply_changes(self, changes: dict[str, Any]) -> None:
        """Take in changes from the journal: footprints and what they add to the coverage."""
        for key, packed in changes.items():
            new = _unpack(packed)
            self._replace(self._footprints.get(int(key)), new)
            self._footprints[int(key)] = new
            (self._blurred.add if new.blur else self._blurred.discard)(int(key))

    def _replace(self, old: _Footprint | None, new: _Footprint) -> None:
        """Only the difference is counted when the keyframe has not moved: sums of evidence stay exact."""
        fresh = new.seen.copy()
        if old is not None and (old.placed, old.blur) == (new.placed, new.blur):
            common = overlap(new.spec, old.spec)
            assert common is not None  # footprints only grow
            fresh[common[0]] &= ~old.seen[common[1]]
        elif old is not None:
            self._add_evidence(*moved(old.spec, old.seen, old.motion), -old.evidence)
        self._add_evidence(*moved(new.spec, fresh, new.motion), new.evidence)


def _pack(footprint: _Footprint) -> list[Any]:
    f = footprint
    return [list(f.pose), list(f.spec), np.packbits(f.seen), f.log_odds, list(f.placed), f.blur]


def _unpack(packed: list[Any]) -> _Footprint:
    pose, spec_fields, bits, log_odds, placed, blur = packed
    spec = GridSpec(*spec_fields)
    seen = np.unpackbits(bits, count=spec.width * spec.height).astype(np.bool_).reshape(spec.shape)
    return _Footprint(Planar(*pose), spec, seen, float(log_odds), Planar(*placed), blur)


def blur_level(deviation_m: float, from_m: float) -> int:
    """0 up to `from_m`; the evidence falls as from_m / deviation from there on, in steps, to a quarter at most."""
    if deviation_m <= from_m or from_m <= 0.0:
        return 0
    return min(BLUR_LEVELS - 1, round(2.0 * math.log2(deviation_m / from_m)))


def _look(
    scan: CoverageScan, state: NDArray[np.uint8], spec: GridSpec, relief: Relief | None = None
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
    x_cells = pose.x_m / resolution - patch.ix0
    y_cells = pose.y_m / resolution - patch.iy0
    reach_cells, free = scan.range_m / resolution, piece == FREE
    if relief is not None:
        over = np.zeros(patch.shape, dtype=np.bool_)
        visible_over(
            relief.top_m[r0:r1, c0:c1], relief.ground_m[r0:r1, c0:c1], free, (x_cells, y_cells, pose.z_m), reach_cells,
            pose.yaw_rad, scan.fov_rad, over,
        )  # fmt: skip
        return patch, over | _behind(over, piece)
    out = np.zeros(patch.shape, dtype=np.uint8)
    visible_cells(piece != FREE, x_cells, y_cells, reach_cells, pose.yaw_rad, scan.fov_rad, out)
    seen = (out != 0) & free
    return patch, seen | _behind(seen, piece)


def _behind(seen: NDArray[np.bool_], state: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The obstacles that the sight ends at, and what is not free right behind their surface.

    A wall was looked at to its foot. Where it stands is known to a cell or two only, and less where odometry drifts:
    should it turn out to stand farther back, the ground before it is not unseen.
    """
    surface = _grown(seen) & (state == LETHAL)
    return surface | (_grown(surface) & (state != FREE))


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The cells of a mask and the eight around each."""
    padded = np.pad(mask, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    grown: NDArray[np.bool_] = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return grown
