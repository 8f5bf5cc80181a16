"""Random worlds for the benches of the local planner: 41 x 41 nodes at 1 m, walls, risky edges, ground half seen."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from planning.coverage_build import RootBelief, build_model
from planning.coverage_model import CoverageModel
from planning.grid import DIRECTION_DX, DIRECTION_DY
from planning.reward import parameters
from services.lcp.config import Config

SIZE = 41


class World(NamedTuple):
    """free (size, size). distance_m, risk (n, 8), 0 where there is no edge. visible (n, 2 reach + 1). entropy (n,).

    start: a free node of the largest connected part; what is not connected to it is not free.
    """

    size: int
    reach: int
    free: NDArray[np.bool_]
    distance_m: NDArray[np.float32]
    risk: NDArray[np.float32]
    visible: NDArray[np.uint32]
    entropy: NDArray[np.float64]
    start: int


def random_world(
    seed: int, *, reach: int = 5, wall_share: float = 0.15, risky_share: float = 0.0, seen: bool = False
) -> World:
    """A world of rectangular walls. seen: with entropies as partial looks leave them, else log 2 everywhere."""
    rng = np.random.default_rng([seed, 41])
    free = np.ones((SIZE, SIZE), np.bool_)
    while free.mean() > 1.0 - wall_share:
        high, wide = rng.integers(1, 6, 2)
        row, column = rng.integers(0, SIZE - high + 1), rng.integers(0, SIZE - wide + 1)
        free[row : row + high, column : column + wide] = False
    parts, _ = label(free)
    free = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    distance = _edges(free)
    risk = np.zeros_like(distance)
    for node, k in zip(*np.nonzero(distance[:, :4]), strict=True):
        if rng.random() < risky_share:
            other = node + DIRECTION_DY[k] * SIZE + DIRECTION_DX[k]
            risk[node, k] = risk[other, k + 4] = rng.uniform(0.02, 0.4)
    shade = rng.uniform(0.1, 1.0, free.size) if seen else np.ones(free.size)
    entropy = np.where(free.ravel(), math.log(2.0) * shade, 0.0)
    start = int(rng.choice(np.flatnonzero(free.ravel())))
    return World(SIZE, reach, free, distance, risk, _visible(free, reach), entropy, start)


def _edges(free: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Edge lengths (n, 8); diagonals do not cut corners."""
    padded = np.pad(free, 1)

    def shifted(dx: int, dy: int) -> NDArray[np.bool_]:
        return padded[1 + dy : 1 + dy + SIZE, 1 + dx : 1 + dx + SIZE]

    columns = []
    for dx, dy in zip(DIRECTION_DX.tolist(), DIRECTION_DY.tolist(), strict=True):
        there = free & shifted(dx, dy) & shifted(dx, 0) & shifted(0, dy)
        columns.append(np.where(there, math.hypot(dx, dy), 0.0).ravel())
    return np.stack(columns, axis=1).astype(np.float32)


def _visible(free: NDArray[np.bool_], reach: int) -> NDArray[np.uint32]:
    """Free nodes in range with free nodes all along the straight line."""
    rows = np.zeros((SIZE * SIZE, 2 * reach + 1), np.uint32)
    padded = np.pad(free, reach)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if dx * dx + dy * dy > reach * reach:
                continue
            seen, far = free.copy(), max(abs(dx), abs(dy))
            for t in range(1, far + 1):
                y, x = reach + round(dy * t / far), reach + round(dx * t / far)
                seen &= padded[y : y + SIZE, x : x + SIZE]
            rows[:, dy + reach] |= np.where(seen.ravel(), np.uint32(1 << (dx + reach)), np.uint32(0))
    return rows


def model_at(
    world: World,
    node: int,
    heading: int,
    *,
    entropy: NDArray[np.float64] | None = None,
    fov_deg: float = 360.0,
    config: Config | None = None,
) -> CoverageModel:
    """The local planner's problem at a node, as lcp would set it up there. entropy: (n,), by default the world's."""
    config = config or Config()
    entropy = world.entropy if entropy is None else entropy
    columns = np.uint64(1) << np.arange(world.size, dtype=np.uint64)
    covered = np.where(entropy.reshape(world.size, world.size) > 0.0, np.uint64(0), columns[None, :]).sum(
        axis=1
    )
    return build_model(
        size=world.size,
        reach=world.reach,
        fov_rad=math.radians(fov_deg),
        edge_distance_m=world.distance_m,
        edge_risk=world.risk,
        entropy=entropy,
        visible=world.visible,
        leaf_value=np.zeros(world.size**2),
        root=RootBelief(
            np.array([node], np.int32),
            np.array([heading], np.uint8),
            np.ones(1),
            covered.astype(np.uint64),
        ),
        weights=parameters(config.weights),
        horizon=config.horizon,
        rollout_random=config.rollout_random,
        macros=config.macros,
    )
