"""The paper's subway station: "large interconnected, polygonal rooms with smooth floors, devoid of obstacles"
(section V, simulated subway station), at the scales 1x, 2x and 3x."""

from __future__ import annotations

import math

import numpy as np

from services.sim.polygons import Polygon, band, draw, regular, spanning_links
from services.sim.world import World, WorldError, with_start

GROUND_PER_SCALE_M2 = 2350.0
"""Free ground at scale 1x; the ground within a robot's reach is some 2 % less (corners)."""
_LAYOUTS = {1: (2, 4), 2: (4, 4), 3: (4, 6)}
_SLOT_X_M, _SLOT_Y_M = 24.0, 20.0
_RESOLUTION_M = 0.1


def subway(seed: int, scale: int = 1) -> World:
    """The station for a seed; `scale` 1, 2 or 3 times `GROUND_PER_SCALE_M2` of free ground.

    Raises WorldError for another scale.
    """
    if scale not in _LAYOUTS:
        raise WorldError(f"subway scale {scale} is not one of 1, 2, 3")
    rng = np.random.default_rng([seed, 101, scale])
    rows, columns = _LAYOUTS[scale]
    centres, polygons = _plan(rows, columns, rng)
    zoom = _zoom_to_area(polygons, GROUND_PER_SCALE_M2 * scale)
    spec, occupied = draw([zoom * p for p in polygons], _RESOLUTION_M, margin_m=1.0)
    start = zoom * centres[int(rng.integers(rows)), 0]
    world = World(f"subway_{scale}x", spec, occupied, (0.0, 0.0, 0.0))
    return with_start(world, float(start[0]), float(start[1]))


def _plan(rows: int, columns: int, rng: np.random.Generator) -> tuple[Polygon, list[Polygon]]:
    """Room centres (rows, columns, 2) and all free polygons, before the zoom."""
    slots = np.stack(np.meshgrid(np.arange(columns) * _SLOT_X_M, np.arange(rows) * _SLOT_Y_M), axis=-1)
    centres = slots + rng.uniform(-1.0, 1.0, slots.shape)
    polygons = [_room(centres[r, c], rng) for r in range(rows) for c in range(columns)]
    for a, b in spanning_links(rows, columns, 0.45, rng):
        # Mostly corridors; now and then a wide opening that joins two rooms into a hall.
        width_m = float(rng.uniform(2.6, 4.2) if rng.random() < 0.75 else rng.uniform(6.0, 8.0))
        polygons.append(band(centres[a], centres[b], width_m))
    return centres, polygons


def _room(centre: Polygon, rng: np.random.Generator) -> Polygon:
    """A chamfered, slightly turned rectangle, or a regular hall of six to eight corners."""
    turn = float(rng.uniform(-0.15, 0.15))
    if rng.random() < 0.25:
        shape = regular(np.zeros(2), float(rng.uniform(8.5, 9.6)), int(rng.integers(6, 9)))
    else:
        shape = _chamfered(rng.uniform([8.0, 6.0], [10.5, 8.5]), rng)
    rotation = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    return np.asarray(centre + shape @ rotation)


def _chamfered(half: Polygon, rng: np.random.Generator) -> Polygon:
    """A rectangle of half size (x, y) with two to four of its corners cut."""
    corners: list[Polygon] = []
    cut_corners = set(rng.permutation(4)[: int(rng.integers(2, 5))].tolist())
    for k, (sx, sy) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        cut = rng.uniform(2.0, 6.0, 2)
        corner = half * np.array([sx, sy])
        if k not in cut_corners:
            corners.append(corner)
            continue
        on_x_edge, on_y_edge = corner - [sx * cut[0], 0.0], corner - [0.0, sy * cut[1]]
        corners += [on_y_edge, on_x_edge] if k in (0, 2) else [on_x_edge, on_y_edge]
    return np.array(corners)


def _zoom_to_area(polygons: list[Polygon], area_m2: float) -> float:
    """Factor on all lengths that gives the union of the polygons this area."""
    _, occupied = draw(polygons, 0.2, margin_m=0.2)
    return math.sqrt(area_m2 / (np.count_nonzero(~occupied) * 0.2**2))
