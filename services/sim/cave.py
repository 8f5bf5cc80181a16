"""The paper's simulated cave: "complex terrain (rocks, steep slopes, etc.) and topology (narrow passages, sharp
bends, dead-ends, open-spaces, etc.)" (section V)."""

from __future__ import annotations

import math

import numpy as np

from planning.grid import GridSpec
from services.sim.hazards import Ground, connected
from services.sim.noise import Field, octave, smooth_step
from services.sim.passages import Hollow, Passage, curve, grid_around, hollow, passage
from services.sim.polygons import spanning_links
from services.sim.world import World, with_start

RESOLUTION_M = 0.1
_ROWS, _COLUMNS, _PITCH_M = 4, 6, 18.0
_LOOP_FRACTION = 0.3
_ENTRANCE_M = 5.0
LOWEST_CEILING_M = 0.4
"""Over the floor; below it a cell is solid."""


def cave(seed: int) -> World:
    """A branching cave with loops: some 550 to 600 m of passage, 2 to 6 m wide, pinches, chambers, rough ground."""
    rng = np.random.default_rng([seed, 103])
    nodes, passages = cave_plan(rng)
    spec = grid_around(passages, RESOLUTION_M, margin_m=2.0)
    start = (float(nodes[0, 0, 0]), float(nodes[0, 0, 1]))
    space = rough_walls(spec, hollow(spec, passages), rng)
    ground = Ground(spec, space, start, rng)
    ground.undulate(((32.0, 2.2), (9.0, 0.25)))
    ground.roughen(0.9, 0.015)
    smooth = ground.floor_m.copy()
    ground.talus(0.6, 0.9, -0.7)
    ground.mounds(50, (0.8, 2.5), (0.4, 1.2))
    ground.drop_offs(9, (1.5, 3.0), (0.5, 1.5))
    ground.pits(45, (0.4, 1.1), (0.6, 2.5))
    ground.rubble(45, (0.6, 1.6), 0.14)
    ground.boulders(110, (0.2, 0.7), (0.25, 1.1))
    ground.stalagmites(60)
    ceiling = vault(spec, smooth, space, ground.aside, rng)
    return underground("cave", spec, space, ground.floor_m, ceiling, start)


def cave_plan(rng: np.random.Generator) -> tuple[Field, list[Passage]]:
    """Junctions (rows, columns, 2), and passages between them; some of the loops are too narrow for any robot."""
    lattice = np.stack(np.meshgrid(np.arange(_COLUMNS), np.arange(_ROWS)), axis=-1) * _PITCH_M
    nodes = lattice + rng.uniform(-3.0, 3.0, lattice.shape)
    half_m = np.where(rng.random((_ROWS, _COLUMNS)) < 0.35, rng.uniform(3.2, 5.5, (_ROWS, _COLUMNS)), 1.8)
    half_m[0, 0] = _ENTRANCE_M
    links = spanning_links(_ROWS, _COLUMNS, _LOOP_FRACTION, rng)
    loops = len(links) - (_ROWS * _COLUMNS - 1)
    passages = [_chamber(nodes[r, c], half_m[r, c], rng) for r in range(_ROWS) for c in range(_COLUMNS)]
    for k, (a, b) in enumerate(links):
        slit = k >= len(links) - loops // 3
        pinch_m = 0.2 if slit else float(rng.uniform(0.6, 0.75)) if rng.random() < 0.25 else math.inf
        passages.append(_gallery(nodes[a], nodes[b], pinch_m, rng))
    return nodes, passages


def _chamber(centre: Field, half_m: float, rng: np.random.Generator) -> Passage:
    """A short passage: an oval."""
    angle = rng.uniform(0.0, math.pi)
    axis = 0.25 * half_m * np.array([math.cos(angle), math.sin(angle)])
    line = curve(np.stack([centre - axis, centre, centre + axis]))
    return passage(line, np.full(len(line), half_m), rng)


def _gallery(a: Field, b: Field, pinch_m: float, rng: np.random.Generator) -> Passage:
    """A bent passage of changing width, as narrow as `pinch_m` (half) at one place."""
    along = b - a
    side = np.array([-along[1], along[0]])
    bends = rng.uniform(-0.3, 0.3, 2)
    line = curve(np.stack([a, a + along * 0.33 + side * bends[0], a + along * 0.67 + side * bends[1], b]))
    at = np.linspace(0.0, 1.0, len(line))
    half = rng.uniform(1.4, 2.4) + 0.45 * np.sin(2 * np.pi * (at * rng.uniform(0.5, 1.5) + rng.random()))
    if math.isfinite(pinch_m):
        length_m = float(np.hypot(*np.diff(line, axis=0).T).sum())
        distance_m = np.abs(at - rng.uniform(0.4, 0.6)) * length_m
        half = np.minimum(half, pinch_m + np.maximum(distance_m - 0.8, 0.0) * 0.6)
    return passage(line, half, rng)


def rough_walls(spec: GridSpec, space: Hollow, rng: np.random.Generator) -> Hollow:
    """The hollow with uneven walls; calm where it is narrow, so that pinches keep their width."""
    calm = np.clip((space.half_width_m - 0.6) / 1.0, 0.0, 1.0)
    walls = 0.35 * octave(spec, 4.0, rng) + 0.12 * octave(spec, 1.2, rng)
    return space._replace(depth_m=space.depth_m + np.clip(walls, -0.7, 0.7) * calm)


def vault(
    spec: GridSpec,
    floor_m: Field,
    space: Hollow,
    aside: Field,
    rng: np.random.Generator,
    height_m: float = 2.6,
) -> Field:
    """The ceiling over smooth ground: an arch, higher where it is wide, hanging low in nooks off the lanes."""
    depth = np.maximum(space.depth_m, 0.0)
    crown = np.clip(height_m + 0.7 * octave(spec, 9.0, rng), 1.8, 6.0) + 0.35 * depth
    arch = floor_m + np.minimum(crown, 1.35 + 1.6 * depth)
    nook = smooth_step(octave(spec, 5.0, rng), 1.3, 1.5) * smooth_step(aside, 0.5, 1.0)
    return np.asarray(arch * (1.0 - nook) + np.minimum(arch, floor_m + 0.65) * nook)


def underground(
    name: str, spec: GridSpec, space: Hollow, floor_m: Field, ceiling_m: Field, start_m: tuple[float, float]
) -> World:
    """The world of a hollow: what is open and connected with the start; all else is rock."""
    free = (space.depth_m > 0.0) & (ceiling_m - floor_m >= LOWEST_CEILING_M)
    free[[0, -1], :] = free[:, [0, -1]] = False
    free = connected(free, *spec.cell_of(*start_m))
    world = World(
        name,
        spec,
        ~free,
        (0.0, 0.0, 0.0),
        floor_m=np.where(free, floor_m, 0.0).astype(np.float32),
        ceiling_m=np.where(free, ceiling_m, 0.0).astype(np.float32),
    )
    return with_start(world, *start_m)
