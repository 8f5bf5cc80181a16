"""How near the local planner comes to the best of all paths: `python -m tests.bench.lcp_gap`.

Random small lattices (walls, hidden nodes, random entropies), each solved by depth-first search over all sequences of
moves; the gap is what the planned path lacks of that, as a share. Mean with a bootstrap interval.
"""

from __future__ import annotations

import argparse

import numpy as np

from planning.coverage_model import search_coverage
from plgrim.evaluation.statistics import bootstrap_mean
from services.lcp.config import Config
from services.lcp.policy_path import likely_moves
from tests.lcp.exhaustive import best_value
from tests.planning.coverage_lattices import coverage_solver, random_lattice

SHAPES = ((4, 1, 120.0), (5, 1, 120.0), (5, 1, 360.0), (5, 2, 120.0))
"""(size, reach, field of view in degrees), in turn."""


def gap(seed: int, steps: int, simulations: int, config: Config) -> float:
    """The gap on one lattice: (best - planned) / best."""
    size, reach, fov_deg = SHAPES[seed % len(SHAPES)]
    lattice = random_lattice(seed, size, reach, fov_deg, wall_share=0.1, hidden_share=0.1)
    rng = np.random.default_rng(seed)
    node = int(rng.choice(sorted({node for node, _ in lattice.edges})))
    heading = int(rng.integers(8))
    best = best_value(lattice, node, heading, steps)
    model = lattice.model(node, heading, horizon=steps, rollout_random=config.rollout_random)
    solver = coverage_solver(size, config.max_depth, exploration=config.exploration)
    solver.search(search_coverage, model, seed=seed, simulations=simulations)
    moves, _ = likely_moves(model, solver.policy(config.min_visits), node, heading, steps)
    return (best - lattice.value_of(node, heading, frozenset(), moves)) / best


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lattices", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=9)
    parser.add_argument("--simulations", type=int, default=4096)
    options = parser.parse_args()
    config = Config()
    seeds = range(options.first_seed, options.first_seed + options.lattices)
    gaps = [gap(seed, options.steps, options.simulations, config) for seed in seeds]
    found = bootstrap_mean(gaps, "lcp-gap")
    print(
        f"optimality gap of lcp, {len(gaps)} random lattices of 4 x 4 and 5 x 5 nodes, {options.steps} moves, "
        f"{options.simulations} simulations, seeds from {options.first_seed}: mean {100 * found.mean:.2f} % "
        f"(95 % interval {100 * found.low:.2f} to {100 * found.high:.2f}), worst {100 * max(gaps):.1f} %, "
        f"optimal in {100 * np.mean(np.array(gaps) < 1e-6):.0f} %"
    )


if __name__ == "__main__":
    main()
