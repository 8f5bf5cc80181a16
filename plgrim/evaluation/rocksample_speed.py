"""How fast POMCP plays RockSample here and in pomdp-py, interleaved in one run."""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plgrim.evaluation.rocksample import MAX_DEPTH, Layout, solver_for
from plgrim.evaluation.rocksample_model import DISCOUNT, LEGAL, rock_sample, search_rocks

PEER = "pomdp_py.problems.rocksample.cythonize.rocksample_problem"


class Speed(NamedTuple):
    """Simulations a second of processor time, each round: ours, the peer's (empty where it is not installed)."""

    ours: NDArray[np.float64]
    peer: NDArray[np.float64]


def measure(
    layout: Layout, rounds: int, our_simulations: int = 16_384, peer_simulations: int = 3_000
) -> Speed:
    """Both search the first move again and again: uniformly random rollouts to depth 90, one thread.

    Their rollouts go on to depth 90 after the exit, without effect; ours end there, which few reach. Their sampling
    where no rock lies is allowed and free, here it is refused as in the published program.
    """
    ours, peer = our_search(layout, our_simulations), peer_search(layout, peer_simulations)
    rates: tuple[list[float], list[float]] = ([], [])
    for k in range(-1, rounds):  # the first round compiles and warms up
        for search, simulations, found in (
            (ours, our_simulations, rates[0]),
            (peer, peer_simulations, rates[1]),
        ):
            if search is None:
                continue
            began = time.process_time()
            search(k + 1)
            if k >= 0:
                found.append(simulations / (time.process_time() - began))
    return Speed(np.array(rates[0]), np.array(rates[1]))


def report(speed: Speed) -> str:
    """One line: medians over the rounds, and the median of the ratios round by round with its range."""
    ours = float(np.median(speed.ours))
    if not len(speed.peer):
        return f"{ours / 1e3:.0f} k simulations/s; pomdp-py is not installed (pip install pomdp-py)"
    ratio = speed.ours / speed.peer
    return (
        f"simulations/s of CPU, depth {MAX_DEPTH}, {len(ratio)} interleaved rounds: {ours / 1e3:.0f} k here, "
        f"{np.median(speed.peer) / 1e3:.1f} k pomdp-py (Cython); "
        f"ratio {np.median(ratio):.0f} ({ratio.min():.0f} to {ratio.max():.0f})"
    )


def our_search(layout: Layout, simulations: int) -> Callable[[int], None]:
    """A search of the first move, by seed."""
    solver = solver_for(len(layout.rocks), simulations, exploration=1.0)
    model = rock_sample(layout.size, layout.rocks, layout.start, LEGAL)

    def search(seed: int) -> None:
        solver.search(search_rocks, model, seed=seed, simulations=simulations)

    return search


def peer_search(layout: Layout, simulations: int) -> Callable[[int], None] | None:
    """The same with pomdp-py's compiled models, or None where it is not installed (`pip install pomdp-py`)."""
    if importlib.util.find_spec("pomdp_py") is None:
        return None
    pomdp_py: Any = importlib.import_module("pomdp_py")
    models: Any = importlib.import_module(PEER)
    k = len(layout.rocks)
    # Their y grows to the south: mirrored, it is the same problem.
    rocks = {(x, layout.size - 1 - y): i for i, (x, y) in enumerate(layout.rocks)}
    start = (layout.start[0], layout.size - 1 - layout.start[1])
    state = models.RSState(start, ("good",) * k, False)
    belief = models.init_particles_belief(k, 200, state, belief="uniform")
    problem = models.RockSampleProblem(layout.size, k, state, rocks, belief)

    def search(seed: int) -> None:
        planner = pomdp_py.POMCP(
            max_depth=MAX_DEPTH,
            discount_factor=DISCOUNT,
            num_sims=simulations,
            exploration_const=20.0,
            rollout_policy=problem.agent.policy_model,
        )
        problem.agent.tree = None
        planner.plan(problem.agent)

    return search
