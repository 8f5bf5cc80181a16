"""The Local IRM: a rolling lattice around the robot, snapped to multiples of its spacing (Algorithm 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from planning.grid import FREE, UNKNOWN
from planning.kernels import njit
from planning.rays import visible_mass
from planning.sight import visible_mass_over
from schemas.base import Pose
from schemas.world import LocalIrm
from services.irm.config import Config
from services.irm.glimpses import add_glimpses
from services.irm.lattice import choose_anchors, connect_neighbours, halve, halve_heights, sum_patches
from services.irm.window import Window

_SEEN_SHARE = 0.5
_MAX_BENT = 4096
_MAX_BENT_POINTS = 1 << 17
_NO_HEIGHTS = np.zeros((0, 0), np.float32)


@dataclass(slots=True)
class LocalIrmBuilder:
    """Builds Local IRMs; keeps the anchors by lattice index, so that nodes keep their place as the window rolls."""

    config: Config
    footprint_radius_m: float
    version: int = 0
    _anchors: dict[tuple[int, int], tuple[float, float]] = field(default_factory=dict)

    def build(self, window: Window, pose: Pose, map_to_odom: Pose, stamp_ns: int) -> LocalIrm:
        """The Local IRM of this window, centred on the robot's patch."""
        c, n = self.config, self.config.size * self.config.size
        ix0 = math.floor(pose.x_m / c.spacing_m) - c.size // 2
        iy0 = math.floor(pose.y_m / c.spacing_m) - c.size // 2
        s = window.spec
        anchor, state = self._anchor(window, ix0, iy0)
        distance, risk = np.zeros((n, 8), np.float32), np.zeros((n, 8), np.float32)
        bent_edge, bent_start = np.zeros(_MAX_BENT, np.int32), np.zeros(_MAX_BENT + 1, np.int32)
        bent_xy = np.zeros((_MAX_BENT_POINTS, 2), np.float32)
        needed = self.footprint_radius_m + c.clearance_margin_m - c.clearance_hysteresis_m
        bent = connect_neighbours(
            window.free_space, window.clearance_m, window.hazard, window.step_cost, needed, s.resolution_m,
            c.spacing_m, s.ix0, s.iy0, c.size, c.edge_detour, state, anchor, distance, risk,
            bent_edge, bent_start, bent_xy,
        )  # fmt: skip
        counted = window.entropy if window.weight is None else window.entropy * window.weight
        entropy = self._patch_sum(window, counted, ix0, iy0, window.uncovered)[0].astype(np.float32)
        entropy[entropy < c.min_node_entropy] = 0.0
        reach = math.ceil(c.sensor_range_m / c.spacing_m)
        visible = self._visible(window, anchor, state, entropy, ix0, iy0, reach)
        self.version += 1
        return LocalIrm(
            stamp_ns=stamp_ns,
            irm_version=self.version,
            risk_stamp_ns=stamp_ns,
            spacing_m=c.spacing_m,
            ix0=ix0,
            iy0=iy0,
            size=c.size,
            robot_pose=pose,
            map_to_odom=map_to_odom,
            sensor_range_m=c.sensor_range_m,
            sensor_fov_rad=math.radians(c.sensor_fov_deg),
            reach=reach,
            state=state,
            anchor_m=anchor,
            node_risk=self._mean(window, window.hazard, ix0, iy0, window.state != UNKNOWN),
            coverage=self._mean(window, window.probability, ix0, iy0, window.ground),
            entropy=entropy,
            edge_distance_m=distance,
            edge_risk=risk,
            bent_edge=bent_edge[:bent],
            bent_start=bent_start[: bent + 1],
            bent_xy=bent_xy[: bent_start[bent]],
            visible=visible,
        )

    def state(self) -> list[list[float]]:
        """For a snapshot: lattice index and place of each anchor."""
        return [[*index, *place] for index, place in sorted(self._anchors.items())]

    def set_state(self, state: list[list[float]]) -> None:
        """From a snapshot."""
        self._anchors = {(int(ix), int(iy)): (x, y) for ix, iy, x, y in state}

    def _anchor(self, window: Window, ix0: int, iy0: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        c, s = self.config, window.spec
        n = c.size * c.size
        previous = np.full((n, 2), np.nan)
        for node in range(n):
            held = self._anchors.get((ix0 + node % c.size, iy0 + node // c.size))
            if held is not None:
                previous[node] = held
        anchor, state = np.zeros((n, 2)), np.zeros(n, np.uint8)
        choose_anchors(
            window.free_space, window.state != UNKNOWN, window.clearance_m, s.resolution_m, c.spacing_m,
            s.ix0, s.iy0, ix0, iy0, c.size, previous, anchor, state,
        )  # fmt: skip
        self._anchors = {
            (ix0 + int(i) % c.size, iy0 + int(i) // c.size): (float(anchor[i, 0]), float(anchor[i, 1]))
            for i in np.flatnonzero(state == 1)
        }
        return anchor, state

    def _patch_sum(
        self,
        window: Window,
        values: NDArray[np.float32],
        ix0: int,
        iy0: int,
        counted: NDArray[np.bool_] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        c, s = self.config, window.spec
        total, count = np.zeros(c.size * c.size), np.zeros(c.size * c.size, np.int64)
        mask = window.ground if counted is None else counted
        sum_patches(values, mask, s.resolution_m, c.spacing_m, s.ix0, s.iy0, ix0, iy0, c.size, total, count)
        return total, count

    def _mean(
        self, window: Window, values: NDArray[np.float32], ix0: int, iy0: int, counted: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        total, count = self._patch_sum(window, values, ix0, iy0, counted)
        return (total / np.maximum(count, 1)).astype(np.float32)

    def _visible(
        self,
        window: Window,
        anchor: NDArray[np.float64],
        state: NDArray[np.uint8],
        entropy: NDArray[np.float32],
        ix0: int,
        iy0: int,
        reach: int,
    ) -> NDArray[np.uint32]:
        """What each node sees; with `coverage: known` entropy is changed to what can be seen at all."""
        c, s = self.config, window.spec
        # Halves of even global index, so that what a node sees does not change as the window rolls.
        skip_x, skip_y = s.ix0 % 2, s.iy0 % 2
        ix, iy = s.ix0 + skip_x, s.iy0 + skip_y
        half = ((s.height - skip_y) // 2, (s.width - skip_x) // 2)
        opaque, mass = np.zeros(half, np.bool_), np.zeros(half, np.float32)
        part = (slice(skip_y, None), slice(skip_x, None))
        hides = window.state != FREE
        if c.coverage == "known":
            hides &= ~window.hopeful  # the sensor will look into what turns out to be free
        halve(hides[part], window.entropy[part] * window.uncovered[part], opaque, mass)
        ground, top = _NO_HEIGHTS, _NO_HEIGHTS
        if window.top_m is not None:
            ground, top = np.zeros(half, np.float32), np.zeros(half, np.float32)
            halve_heights(window.elevation_m[part], window.top_m[part], ground, top)
        rows = np.zeros((c.size * c.size, 2 * reach + 1), np.uint32)
        res = 2.0 * s.resolution_m
        patch = self._patches(*half, ix // 2, iy // 2, res, ix0, iy0)
        visible_rows(
            opaque, ground, top, mass, patch, ix * s.resolution_m, iy * s.resolution_m, res,
            c.sensor_range_m, c.sensor_height_m, c.size, reach, state, anchor, entropy > 0.0, rows,
        )  # fmt: skip
        if c.coverage == "known" and window.top_m is None:
            patch = self._patches(s.height, s.width, s.ix0, s.iy0, s.resolution_m, ix0, iy0)
            add_glimpses(
                hides, window.entropy * window.uncovered, patch, s.ix0 * s.resolution_m, s.iy0 * s.resolution_m,
                s.resolution_m, c.sensor_range_m, c.size, reach, state, anchor, entropy, rows,
            )  # fmt: skip
        return rows

    def _patches(
        self, height: int, width: int, first_x: int, first_y: int, resolution_m: float, ix0: int, iy0: int
    ) -> NDArray[np.int32]:
        """The node whose patch holds the centre of each cell of a grid, (h, w); -1 outside the lattice."""
        size, spacing_m = self.config.size, self.config.spacing_m
        column = np.floor((first_x + np.arange(width) + 0.5) * resolution_m / spacing_m) - ix0
        row = np.floor((first_y + np.arange(height) + 0.5) * resolution_m / spacing_m) - iy0
        patch = row[:, None] * size + column[None, :]
        outside = ((row < 0) | (row >= size))[:, None] | ((column < 0) | (column >= size))[None, :]
        patch[outside] = -1
        return np.asarray(patch, np.int32)


@njit
def visible_rows(
    opaque: NDArray[np.bool_],
    ground_m: NDArray[np.float32],
    top_m: NDArray[np.float32],
    mass: NDArray[np.float32],
    patch_of: NDArray[np.int32],
    x0_m: float,
    y0_m: float,
    resolution_m: float,
    range_m: float,
    height_m: float,
    size: int,
    reach: int,
    state: NDArray[np.uint8],
    anchor_m: NDArray[np.float64],
    wanted: NDArray[np.bool_],
    rows: NDArray[np.uint32],
) -> None:
    """Set the bits of the nodes that each traversable node sees: at least half of their uncovered mass in sight.

    ground_m, top_m: heights, over which a sensor height_m above the anchor's ground looks; (0, 0) on flat ground.
    """
    rough = top_m.size > 0
    whole = np.zeros(size * size, np.float32)
    for row in range(opaque.shape[0]):
        for column in range(opaque.shape[1]):
            if patch_of[row, column] >= 0:
                whole[patch_of[row, column]] += mass[row, column]
    seen = np.zeros(size * size, np.float32)
    for node in range(size * size):
        if state[node] != 1:
            continue
        own_row, own_column = node // size, node % size
        near = 0
        for r in range(max(0, own_row - reach), min(size, own_row + reach + 1)):
            for c in range(max(0, own_column - reach), min(size, own_column + reach + 1)):
                seen[r * size + c] = 0.0
                near += 1 if wanted[r * size + c] else 0
        if near == 0:
            continue
        # Anchors are centres of cells, quarters of these: exact, since rays that graze a corner hang on the last bit.
        x = round(4.0 * (anchor_m[node, 0] - x0_m) / resolution_m) / 4.0
        y = round(4.0 * (anchor_m[node, 1] - y0_m) / resolution_m) / 4.0
        if rough:
            z_m = ground_m[min(int(y), ground_m.shape[0] - 1), min(int(x), ground_m.shape[1] - 1)] + height_m
            visible_mass_over(top_m, ground_m, mass, (x, y, z_m), range_m / resolution_m, patch_of, seen)
        else:
            visible_mass(opaque, mass, x, y, range_m / resolution_m, patch_of, seen)
        for r in range(max(0, own_row - reach), min(size, own_row + reach + 1)):
            for c in range(max(0, own_column - reach), min(size, own_column + reach + 1)):
                other = r * size + c
                if wanted[other] and whole[other] > 0.0 and seen[other] >= _SEEN_SHARE * whole[other]:
                    rows[node, r - own_row + reach] |= np.uint32(1) << np.uint32(c - own_column + reach)
