"""The coverage problem without coverage and without risk: what the tree and the moves alone cost.

The measure of the coverage model's speed: the same lattice, tree, actions (moves, macro moves, a sweep of the same
length) and horizon. The reward is the travel, the rollout and the sweep walk at random, the observation is always the
same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.coverage_model import HEADING, MACRO_STEPS, MOVES, NODE, SWEEP, SWEEP_STEPS, CoverageModel
from planning.kernels import njit, njit_borrowing
from planning.pomcp import SearchSettings, Tree, random_below, register_model, simulate


class BareWalk(NamedTuple):
    """The lattice of a `CoverageModel`: step_to (n, 8) neighbours, distance_m, discount (n, 8), start, horizon."""

    step_to: NDArray[np.int32]
    distance_m: NDArray[np.float32]
    discount: NDArray[np.float64]
    start: int
    heading: int
    horizon: int


def bare_walk(model: CoverageModel) -> BareWalk:
    """The bare walk of a coverage problem."""
    return BareWalk(
        model.step_to, model.edge_distance_m, model.edge_discount,
        int(model.particle_node[0]), int(model.particle_heading[0]), model.horizon,
    )  # fmt: skip


@njit_borrowing
def _sample(model: BareWalk, rng: NDArray[np.uint64], state: NDArray[np.int64]) -> None:
    state[NODE], state[HEADING], state[MOVES] = model.start, model.heading, 0


@njit_borrowing
def _random_direction(distance_m: NDArray[np.float32], node: int, rng: NDArray[np.uint64]) -> int:
    """A uniformly random edge of a node that has one."""
    k = np.int64(random_below(rng, 8))
    while distance_m[node, k] <= 0.0:
        k = np.int64(random_below(rng, 8))
    return int(k)


@njit_borrowing
def _step(
    model: BareWalk, state: NDArray[np.int64], action: int, rng: NDArray[np.uint64]
) -> tuple[int, float, float, bool]:
    steps = 1 if action < 8 else (MACRO_STEPS if action < SWEEP else SWEEP_STEPS)
    total, discount = 0.0, 1.0
    for _ in range(min(steps, model.horizon - state[MOVES])):
        node, k = state[NODE], action % 8
        if action == SWEEP:
            k = _random_direction(model.distance_m, node, rng)
        if model.distance_m[node, k] <= 0.0:
            break
        state[NODE], state[HEADING] = model.step_to[node, k], k
        state[MOVES] += 1
        total -= discount * model.distance_m[node, k]
        discount *= model.discount[node, k]
    return 1, total, discount, state[MOVES] >= model.horizon


@njit_borrowing
def _actions(model: BareWalk, state: NDArray[np.int64], actions_out: NDArray[np.int64]) -> int:
    node, heading, count = state[NODE], state[HEADING], 1
    actions_out[0] = SWEEP
    for turn in (0, 1, 7, 2, 6, 3, 5, 4):
        k = (heading + turn) % 8
        if model.distance_m[node, k] <= 0.0:
            continue
        actions_out[count] = k
        count += 1
        if model.distance_m[model.step_to[node, k], k] > 0.0:
            actions_out[count] = 8 + k
            count += 1
    return count if count > 1 else 0


@njit_borrowing
def _rollout(model: BareWalk, state: NDArray[np.int64], depth_left: int, rng: NDArray[np.uint64]) -> float:
    step_to, distance_m, edge_discount = model.step_to, model.distance_m, model.discount
    value, discount, node = 0.0, 1.0, state[NODE]
    for _ in range(model.horizon - state[MOVES]):
        k = _random_direction(distance_m, node, rng)
        value -= discount * distance_m[node, k]
        discount *= edge_discount[node, k]
        node = step_to[node, k]
    return value


register_model(BareWalk, sample=_sample, step=_step, actions=_actions, rollout=_rollout)


@njit
def search_bare_walk(
    tree: Tree, model: BareWalk, settings: SearchSettings, rng: NDArray[np.uint64], simulations: int
) -> None:
    """Entry point of POMCP for the bare walk."""
    simulate(tree, model, settings, rng, simulations)
