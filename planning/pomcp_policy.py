"""What a search has found: statistics of the root, the best action, and the policy tree as flat arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.pomcp_tree import NODES, NONE, ROOT, SIMULATIONS, Tree

MIN_VISIT_SHARE = 0.1
"""An action is trusted with this share of the visits of the most visited one: a mean of few returns is luck."""


class RootStatistics(NamedTuple):
    """The root after a search. Per action, in the model's order: `actions`, `visits` int32, `values` float64.

    `max_value` is the largest mean return of any tried action, max_a Q(root, a). `best_value` is that of
    `best_action`, which takes enough visits as well. `mean_value` is the mean return of all simulations,
    that is Q weighted by visits: it lags behind, as it contains the exploration. nan without a simulation.
    """

    actions: NDArray[np.int32]
    visits: NDArray[np.int32]
    values: NDArray[np.float64]
    max_value: float
    best_action: int
    best_value: float
    mean_value: float
    simulations: int


class PolicyTree(NamedTuple):
    """A belief policy of M histories in breadth-first order, the root first.

    `node_action` int32[M]: action to take, NONE (-1) at a leaf. `node_value` float64[M]: mean return of that
    action; at a leaf the mean of the rollouts. `node_visits` int32[M]: simulations through the history.
    `node_action_visits` int32[M]: visits of the chosen action, 0 at a leaf. `node_source` int32[M]: index in the
    search tree. The successors of node i after its action are `child_node[k]` (int32, index in this policy) on
    `child_observation[k]` (int32, ascending) for k from `child_start[i]` to `child_start[i + 1]` (int32[M + 1]).
    `node_visits[child] / node_action_visits[i]` estimates the probability of the observation; what is missing
    to 1 ended the episode, or was seen too rarely to be kept.
    """

    node_action: NDArray[np.int32]
    node_value: NDArray[np.float64]
    node_visits: NDArray[np.int32]
    node_action_visits: NDArray[np.int32]
    node_source: NDArray[np.int32]
    child_start: NDArray[np.int32]
    child_node: NDArray[np.int32]
    child_observation: NDArray[np.int32]


@njit
def best_branch(tree: Tree, node: int, min_visit_share: float) -> int:
    """The branch of largest mean among those with enough visits, or NONE if no branch was tried.

    Enough is `min_visit_share` (0 to 1) of the visits of the most visited one; equal means go to the first.
    """
    first = tree.node_first_branch[node]
    if first == NONE:
        return NONE
    last = first + tree.node_branches[node]
    needed = max(1.0, min_visit_share * tree.branch_visits[first:last].max())
    best = NONE
    for branch in range(first, last):
        if tree.branch_visits[branch] >= needed and (
            best == NONE or tree.branch_value[branch] > tree.branch_value[best]
        ):
            best = branch
    return best


def root_statistics(tree: Tree, min_visit_share: float = MIN_VISIT_SHARE) -> RootStatistics:
    """Copy the statistics of the root. `best_action` is NONE (-1) before the first simulation."""
    first, count = int(tree.node_first_branch[ROOT]), int(tree.node_branches[ROOT])
    span = slice(max(first, 0), max(first, 0) + count)
    visits, values = tree.branch_visits[span].copy(), tree.branch_value[span].copy()
    simulations = int(tree.counters[SIMULATIONS])
    best = int(best_branch(tree, ROOT, min_visit_share))
    return RootStatistics(
        actions=tree.branch_action[span].copy(),
        visits=visits,
        values=values,
        max_value=float(values[visits > 0].max()) if np.any(visits > 0) else float("nan"),
        best_action=int(tree.branch_action[best]) if best != NONE else NONE,
        best_value=float(tree.branch_value[best]) if best != NONE else float("nan"),
        mean_value=float(tree.node_value[ROOT]) if simulations else float("nan"),
        simulations=simulations,
    )


def best_action(tree: Tree, min_visit_share: float = MIN_VISIT_SHARE) -> int:
    """The action of largest mean return at the root among those with enough visits, or NONE (-1)."""
    return root_statistics(tree, min_visit_share).best_action


@njit
def _append_children(
    tree: Tree,
    branch: int,
    min_visits: int,
    source: NDArray[np.int32],
    observation: NDArray[np.int32],
    end: int,
) -> int:
    """Queue the kept children of `branch` from `end` on, ascending in observation. Returns the new end."""
    start = end
    child = tree.branch_first_child[branch]
    while child != NONE:
        if tree.node_visits[child] >= min_visits:
            seen = tree.node_observation[child]
            place = end
            while place > start and observation[place - 1] > seen:
                source[place], observation[place] = source[place - 1], observation[place - 1]
                place -= 1
            source[place], observation[place] = child, seen
            end += 1
        child = tree.node_next_sibling[child]
    return end


@njit
def _walk_policy(
    tree: Tree,
    min_visits: int,
    min_visit_share: float,
    source: NDArray[np.int32],
    observation: NDArray[np.int32],
    chosen: NDArray[np.int32],
    child_start: NDArray[np.int32],
) -> int:
    """Breadth first from the root along the best branches. Returns the number of histories kept."""
    source[0] = ROOT
    end, i = 1, 0
    while i < end:
        chosen[i] = best_branch(tree, source[i], min_visit_share)
        child_start[i] = end - 1  # children follow one another in the queue, and the root is nobody's child
        if chosen[i] != NONE:
            end = _append_children(tree, chosen[i], min_visits, source, observation, end)
        i += 1
    child_start[end] = end - 1
    return end


def extract_policy(tree: Tree, min_visits: int, min_visit_share: float = MIN_VISIT_SHARE) -> PolicyTree:
    """The greedy policy of the tree, down to histories with at least `min_visits` simulations.

    The root is always kept. `ValueError` if `min_visits` is below 1 or the share is not from 0 to 1.
    """
    if min_visits < 1 or not 0.0 <= min_visit_share <= 1.0:
        raise ValueError(
            f"min_visits {min_visits} must be at least 1, min_visit_share {min_visit_share} in [0, 1]"
        )
    visits = tree.node_visits[: int(tree.counters[NODES])]
    room = 1 + int(np.count_nonzero(visits >= min_visits))
    source, observation, chosen = (np.zeros(room, dtype=np.int32) for _ in range(3))
    child_start = np.zeros(room + 1, dtype=np.int32)
    size = int(_walk_policy(tree, min_visits, min_visit_share, source, observation, chosen, child_start))
    source, chosen = source[:size], chosen[:size]
    acts = chosen != NONE
    return PolicyTree(
        node_action=np.where(acts, tree.branch_action[chosen], np.int32(NONE)),
        node_value=np.where(acts, tree.branch_value[chosen], tree.node_value[source]),
        node_visits=tree.node_visits[source],
        node_action_visits=np.where(acts, tree.branch_visits[chosen], np.int32(0)),
        node_source=source.copy(),
        child_start=child_start[: size + 1].copy(),
        child_node=np.arange(1, size, dtype=np.int32),
        child_observation=observation[1:size].copy(),
    )
