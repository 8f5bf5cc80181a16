"""How fast POMCP on the Local IRM is: `python -m tests.bench.lcp_speed`.

Simulations a second of processor time with everything on (entropies, occlusion, sampled risk, informed rollouts,
horizon 40), as a share of the bare walk (same tree and moves, no coverage, no risk) and with two threads, interleaved.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from planning.coverage_model import ACTIONS, BITS, look, search_coverage
from planning.coverage_tiles import nodes_of_tiles, tile_count
from planning.pomcp import Pomcp
from plgrim.evaluation.bare_walk import bare_walk, search_bare_walk
from services.lcp.config import Config
from tests.bench.coverage_worlds import SIZE, World, model_at, random_world

HORIZON = 40


def solver(config: Config, workers: int = 1) -> Pomcp:
    """A solver as lcp has it."""
    return Pomcp(
        state_size=BITS + tile_count(SIZE),
        max_actions=ACTIONS,
        max_nodes=config.max_nodes,
        max_depth=config.max_depth,
        max_branches=12 * config.max_nodes,
        exploration=config.exploration,
        workers=workers,
    )


def after_a_look(world: World, fov_deg: float) -> NDArray[np.float64]:
    """The entropies when the robot has looked from its start, as it always has. (n,)"""
    tiles = np.zeros(tile_count(world.size), np.uint64)
    look(model_at(world, world.start, 0, fov_deg=fov_deg), world.start, 0, tiles)
    return np.where(nodes_of_tiles(tiles, world.size), 0.0, world.entropy)


def measure(
    rounds: int, simulations: int, fov_deg: float, reach: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(processor seconds, wall seconds), each (rounds, 3): coverage, bare walk, coverage by two threads."""
    config = Config(horizon=HORIZON)
    alone, walk, pair = solver(config), solver(config), solver(config, workers=2)
    cpu, wall = np.zeros((rounds, 3)), np.zeros((rounds, 3))
    for k in range(-1, rounds):
        world = random_world(1000 + k, reach=reach, risky_share=0.1, seen=True)
        model = model_at(
            world, world.start, 0, entropy=after_a_look(world, fov_deg), fov_deg=fov_deg, config=config
        )
        bare = bare_walk(model)
        searches: tuple[Callable[[], object], ...] = (
            lambda model=model, k=k: alone.search(search_coverage, model, seed=k, simulations=simulations),  # type: ignore[misc]
            lambda bare=bare, k=k: walk.search(search_bare_walk, bare, seed=k, simulations=simulations),  # type: ignore[misc]
            lambda model=model, k=k: pair.search(search_coverage, model, seed=k, simulations=2 * simulations),  # type: ignore[misc]
        )
        for i, search in enumerate(searches):
            began_cpu, began = time.process_time(), time.perf_counter()
            search()
            if k >= 0:
                cpu[k, i] = time.process_time() - began_cpu
                wall[k, i] = time.perf_counter() - began
    return cpu, wall


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20, help="different worlds")
    parser.add_argument("--simulations", type=int, default=8192)
    parser.add_argument("--fov-deg", type=float, default=360.0)
    parser.add_argument("--reach", type=int, default=5, help="radius of the footprint, nodes")
    options = parser.parse_args()
    cpu, wall = measure(options.rounds, options.simulations, options.fov_deg, options.reach)
    rate = options.simulations / cpu[:, :2] / 1e3
    share = cpu[:, 1] / cpu[:, 0]
    print(
        f"POMCP on the Local IRM, horizon {HORIZON}, footprint radius {options.reach}, {options.fov_deg:.0f} deg, "
        f"{options.simulations} simulations a search, {options.rounds} worlds (medians):"
    )
    print(
        f"  everything on {np.median(rate[:, 0]):.0f} k simulations/s, bare walk {np.median(rate[:, 1]):.0f} k"
    )
    print(f"  share of the bare walk {np.median(share):.2f} ({share.min():.2f} to {share.max():.2f})")
    by_cpu, by_wall = 2.0 * 2.0 * cpu[:, 0] / cpu[:, 2], 2.0 * wall[:, 0] / wall[:, 2]
    print(
        f"  two threads, trees added up: {np.median(by_cpu):.2f} times one by processor time "
        f"(both threads kept busy), {np.median(by_wall):.2f} by wall time on this machine as it was"
    )


if __name__ == "__main__":
    main()
