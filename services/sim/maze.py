"""The paper's maze, on flat ground: "narrow passages, sharp bends, dead-ends" (section V)."""

from __future__ import annotations

import numpy as np

from services.sim.polygons import Polygon, band, draw, spanning_links
from services.sim.world import World, with_start

_CELLS = 12
_PITCH_M = 5.0
_RESOLUTION_M = 0.1
_LOOP_FRACTION = 0.08


def maze(seed: int) -> World:
    """A maze of about 60 x 60 m: a spanning tree of corridors 3 to 3.8 m wide, and a few loops."""
    rng = np.random.default_rng([seed, 102])
    lattice = np.stack(np.meshgrid(np.arange(_CELLS), np.arange(_CELLS)), axis=-1) * _PITCH_M
    nodes = lattice + rng.uniform(-0.3, 0.3, lattice.shape)
    polygons: list[Polygon] = [_square(nodes[r, c], 3.0) for r in range(_CELLS) for c in range(_CELLS)]
    for a, b in spanning_links(_CELLS, _CELLS, _LOOP_FRACTION, rng):
        polygons.append(band(nodes[a], nodes[b], float(rng.uniform(3.0, 3.8))))
    spec, occupied = draw(polygons, _RESOLUTION_M, margin_m=1.0)
    start = nodes[0, 0]
    return with_start(World("maze", spec, occupied, (0.0, 0.0, 0.0)), float(start[0]), float(start[1]))


def _square(centre: Polygon, side_m: float) -> Polygon:
    return np.asarray(centre + side_m / 2.0 * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]))
