"""A lava tube like the paper's Valentine Cave: "a main tube, which branches into smaller, auxiliary tubes", its floor
"ropy masses of cooled lava", with "large boulders, from ceiling breakdown ... scattered throughout" (section V)."""

from __future__ import annotations

import math

import numpy as np

from planning.grid import GridSpec
from services.sim.cave import RESOLUTION_M, rough_walls, underground, vault
from services.sim.hazards import Ground
from services.sim.noise import Field, line_noise, octave
from services.sim.passages import Passage, curve, grid_around, hollow, passage
from services.sim.world import World

_SECTIONS, _SHORT_SECTIONS = 9, 4
_SECTION_M = 26.0


def lava_tube(seed: int) -> World:
    """One broad winding tube, 6 to 15 m wide and some 236 m long, with pockets at its sides."""
    return _lava_tube("lava_tube", seed, _SECTIONS)


def short_lava_tube(seed: int) -> World:
    """The same but 105 m long, with 4 pockets."""
    return _lava_tube("short_lava_tube", seed, _SHORT_SECTIONS)


def _lava_tube(name: str, seed: int, sections: int) -> World:
    """What is scattered along the tube goes by its length; a pocket a section."""
    rng = np.random.default_rng([seed, 104])
    passages = tube_plan(rng, sections)
    share = sections / _SECTIONS
    spec = grid_around(passages, RESOLUTION_M, margin_m=2.0)
    start = tuple(passages[0].line_m[16].tolist())
    space = rough_walls(spec, hollow(spec, passages), rng)
    ground = Ground(spec, space, start, rng)
    ground.undulate(((40.0, 2.0), (12.0, 0.3)))
    ground.roughen(1.2, 0.02)
    smooth = ground.floor_m.copy()
    _ropes(spec, ground, rng)
    ground.talus(0.9, 0.8, -0.7)
    ground.mounds(round(11 * share), (1.0, 3.0), (0.4, 1.2))
    ground.drop_offs(round(3 * share), (1.5, 3.0), (0.4, 1.2))
    ground.pits(round(12 * share), (0.5, 1.2), (0.6, 2.0))
    ground.rubble(round(16 * share), (0.8, 2.0), 0.16)
    ground.boulders(round(75 * share), (0.25, 0.9), (0.25, 1.2))
    ceiling = vault(spec, smooth, space, ground.aside, rng, height_m=3.4)
    _skylights(spec, ceiling, passages[0], rng)
    return underground(name, spec, space, ground.floor_m, ceiling, start)


def tube_plan(rng: np.random.Generator, sections: int = _SECTIONS) -> list[Passage]:
    """The main tube first, then its pockets, as many as sections."""
    heading, at, points = 0.0, np.zeros(2), [np.zeros(2)]
    for _ in range(sections):
        # Winding about one direction: a tube follows the slope of its flow and does not cross itself.
        heading = float(np.clip(0.35 * heading + rng.uniform(-1.0, 1.0), -1.1, 1.1))
        at = at + _SECTION_M * np.array([math.cos(heading), math.sin(heading)])
        points.append(at)
    line = curve(np.array(points))
    count = len(line)
    half = 4.6 + 2.0 * line_noise(count, 16, rng) + 0.5 * line_noise(count, 50, rng)
    half = np.clip(half, 3.2, 7.2)
    half[:28] = np.maximum(half[:28], 5.0)
    tube = passage(line, half, rng)
    return [tube, *(_pocket(tube, k, sections, rng) for k in range(sections))]


def _pocket(tube: Passage, index: int, pockets: int, rng: np.random.Generator) -> Passage:
    """A short auxiliary tube off the main one."""
    count = len(tube.line_m)
    at = int((index + 0.6 + rng.uniform(-0.3, 0.3)) * count / (pockets + 0.5))
    along = tube.line_m[min(at + 2, count - 1)] - tube.line_m[at - 2]
    along /= math.hypot(*along)
    side = np.array([-along[1], along[0]]) * (1.0 if rng.random() < 0.5 else -1.0)
    way = side + along * rng.uniform(-0.6, 0.6)
    way /= math.hypot(*way)
    length_m = float(tube.half_width_m[at]) + rng.uniform(4.0, 9.0)
    bend = np.array([-way[1], way[0]]) * rng.uniform(-0.2, 0.2) * length_m
    centre = tube.line_m[at]
    line = curve(np.stack([centre, centre + way * length_m * 0.55 + bend, centre + way * length_m]))
    half = np.linspace(rng.uniform(1.6, 2.4), rng.uniform(1.1, 1.8), len(line))
    return passage(line, half, rng)


def _ropes(spec: GridSpec, ground: Ground, rng: np.random.Generator) -> None:
    """Ropy lava: ridges a few centimetres high across the flow."""
    phase = spec.centres_x() + 1.2 * octave(spec, 5.0, rng)
    strength = np.clip(0.5 + 0.5 * octave(spec, 8.0, rng), 0.0, 1.0) * ground.calm
    ground.floor_m += 0.02 * np.sin(2.0 * np.pi * phase / 0.8) * strength


def _skylights(spec: GridSpec, ceiling_m: Field, tube: Passage, rng: np.random.Generator) -> None:
    """Two holes in the roof, in place."""
    for share in (0.4, 0.75):
        x_m, y_m = tube.line_m[int((share + rng.uniform(-0.08, 0.08)) * len(tube.line_m))]
        away = np.hypot(spec.centres_x() - x_m, spec.centres_y()[:, None] - y_m)
        ceiling_m[away < rng.uniform(1.2, 2.2)] = np.inf
