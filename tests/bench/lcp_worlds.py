"""How well the local planner covers: `python -m tests.bench.lcp_worlds`.

On fresh random worlds (41 x 41 nodes, walls), POMCP with so many milliseconds a decision against the greedy rule
"largest one-step gain, else the nearest uncovered node": nodes covered after 80 and 160 steps, as a share of what can
be covered.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from planning.coverage_build import reachable_entropy
from planning.coverage_model import (
    MAX_EDGE_RISK,
    SWEEP,
    CoverageModel,
    follow_rule,
    look,
    new_nodes,
    search_coverage,
)
from planning.coverage_tiles import nodes_of_tiles, tile_count
from planning.lattice_graph import travel_costs
from planning.pomcp import Pomcp
from planning.reward import leftover_entropy
from services.lcp.config import Config
from tests.bench.coverage_worlds import World, model_at, random_world
from tests.bench.lcp_speed import solver

Words = NDArray[np.uint64]
Choose = Callable[[int, int, Words], int]


def greedy(world: World, model: CoverageModel) -> Choose:
    """The move that newly covers most; where none does, the first move to the nearest uncovered node."""
    n = world.size**2
    goal = reachable_entropy(
        world.entropy.astype(np.float32), world.visible, world.distance_m, world.size, world.reach
    )

    def choose(node: int, heading: int, words: Words) -> int:
        gains = [
            new_nodes(model, int(other), k, words) if world.distance_m[node, k] > 0.0 else -1
            for k, other in enumerate(model.step_to[node])
        ]
        if max(gains) > 0:
            return int(np.argmax(gains))
        cost, move = np.empty(n), np.empty(n, np.int8)
        left = (goal > 0.0) & ~nodes_of_tiles(words, world.size)
        travel_costs(node, world.size, world.distance_m, world.risk, 0.0, MAX_EDGE_RISK, cost, move)
        cost[~left] = np.inf
        if not np.isfinite(cost).any():
            return -1
        return first_move(world, model, node, int(np.argmin(cost)))

    return choose


def first_move(world: World, model: CoverageModel, node: int, target: int) -> int:
    """The first move of a shortest path."""
    n = world.size**2
    cost, move = np.empty(n), np.empty(n, np.int8)
    travel_costs(target, world.size, world.distance_m, world.risk, 0.0, MAX_EDGE_RISK, cost, move)
    return int(move[node])


def pomcp(
    world: World, fov_deg: float, config: Config, search: Pomcp, milliseconds: float, seed: int
) -> Choose:
    """POMCP as lcp runs it, from a fresh model and a fresh tree at every step."""
    done = [0]

    def choose(node: int, heading: int, words: Words) -> int:
        entropy = np.where(nodes_of_tiles(words, world.size), 0.0, world.entropy)
        entropy = reachable_entropy(
            entropy.astype(np.float32), world.visible, world.distance_m, world.size, world.reach
        )
        if not entropy.any():
            return -1
        counted = leftover_entropy(entropy, world.free.ravel(), world.size, config.weights)
        model = model_at(world, node, heading, entropy=counted, fov_deg=fov_deg, config=config)
        ends = time.thread_time() + milliseconds / 1e3
        done[0] += 1
        search.search(
            search_coverage, model, seed=seed * 1000 + done[0], simulations=10_000_000, batch=64,
            should_stop=lambda: time.thread_time() > ends,
        )  # fmt: skip
        action = search.best_action()
        if action == SWEEP:
            moves = np.zeros(1, np.int64)
            return int(moves[0]) if follow_rule(model, node, heading, model.covered.copy(), moves) else -1
        return action % 8 if action >= 0 else -1

    return choose


def drive(world: World, model: CoverageModel, choose: Choose, steps: int) -> NDArray[np.float64]:
    """Share covered after each step, (steps,). Every step turns, looks, moves and looks again."""
    words = np.zeros(tile_count(world.size), np.uint64)
    node, heading = world.start, 0
    look(model, node, heading, words)
    goal = reachable_entropy(
        world.entropy.astype(np.float32), world.visible, world.distance_m, world.size, world.reach
    ) > 0.0  # fmt: skip
    share = np.zeros(steps)
    for step in range(steps):
        k = choose(node, heading, words)
        if k >= 0:
            if k != heading:
                look(model, node, k, words)
            node, heading = int(model.step_to[node, k]), k
            look(model, node, heading, words)
        share[step] = float((nodes_of_tiles(words, world.size) & goal).sum() / goal.sum())
    return share


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=5000)
    parser.add_argument("--ms", type=float, default=10.0, help="search time a decision, processor time")
    parser.add_argument("--steps", type=int, default=160)
    parser.add_argument("--fov-deg", type=float, default=360.0)
    parser.add_argument("--reach", type=int, default=5)
    options = parser.parse_args()
    config = Config()
    search = solver(config)
    found = np.zeros((options.worlds, 2, options.steps))
    for i in range(options.worlds):
        world = random_world(options.first_seed + i, reach=options.reach)
        model = model_at(world, world.start, 0, fov_deg=options.fov_deg)
        found[i, 0] = drive(world, model, greedy(world, model), options.steps)
        planner = pomcp(world, options.fov_deg, config, search, options.ms, i)
        found[i, 1] = drive(world, model, planner, options.steps)
    _print(options, 100.0 * found)


def _print(options: argparse.Namespace, percent: NDArray[np.float64]) -> None:
    print(
        f"coverage of {options.worlds} random worlds (seeds from {options.first_seed}), footprint radius "
        f"{options.reach}, {options.fov_deg:.0f} deg, {options.ms:.0f} ms of search a decision (mean, standard error):"
    )
    for step in (options.steps // 2, options.steps):
        at = percent[:, :, step - 1]
        error = at.std(axis=0, ddof=1) / np.sqrt(len(at))
        gap = at[:, 1] - at[:, 0]
        print(
            f"  after {step:3d} steps: greedy {at[:, 0].mean():.1f} +- {error[0]:.1f} %, "
            f"POMCP {at[:, 1].mean():.1f} +- {error[1]:.1f} %, "
            f"difference {gap.mean():+.1f} +- {gap.std(ddof=1) / np.sqrt(len(gap)):.1f} points"
        )


if __name__ == "__main__":
    main()
