"""The search tree of POMCP as flat arrays, and the compiled search over it.

A *node* is a history (the root, or action and observation after its parent). A *branch* is an action at a node; the
branches of a node are consecutive. A node gets its branches at its second visit: most nodes are seen once, and
then cost no branches. The nodes below a branch (one per observation seen) are a linked list.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit, njit_borrowing
from planning.pomcp_model import model_actions, model_prior, model_rollout, model_sample, model_step

# What depends on the model is compiled into the model's own entry point and cached there, next to the model's file.
# Cached here, one index would name every model ever used (tests included) and each process would have to import
# them all; and a change in a model's file would leave a stale kernel behind.
# Both kinds borrow their arguments (see `planning.kernels.njit_borrowing`): counting references of the two dozen arrays
# of a tree at every call was more than half of the time of a search.
_njit_inside_entry_point: Callable[[Any], Any] = numba.njit(nogil=True, error_model="numpy", _nrt=False)

NONE = -1
"""Where an index is stored: there is no such node or branch."""
ROOT = 0
"""Index of the root node."""

NODES, BRANCHES, SIMULATIONS, REFUSED, DEEPEST, STEPS = range(6)
"""Index into `Tree.counters`: nodes and branches in use, simulations run, simulations that a full tree kept from
growing it, deepest history reached (steps), steps taken inside the tree."""


class SearchSettings(NamedTuple):
    """Constants of a search.

    `max_depth`: horizon in steps, at least 1. `exploration`: the constant c of the bonus, in units of the range of
    returns. `return_range`: that range in units of reward; 0 takes, at every depth, the largest minus the smallest
    return from that depth seen so far in this search. `logarithmic`: the bonus of UCB1, c sqrt(ln N / n), with c
    about 1; otherwise c N^(1/4) / n^(1/2), with c about 0.25 (Shah, Xie and Xu 2020). The returns below an action
    drift while its subtree learns, and the logarithm is then too slow to try again what began badly.
    """

    max_depth: int
    exploration: float
    return_range: float
    logarithmic: bool


class Tree(NamedTuple):
    """Preallocated search tree, N nodes and B branches at most, and the scratch of one simulation.

    `node_visits` counts simulations through the node, `node_value` is their mean return from there.
    `node_first_branch` is NONE until the node is expanded. `branch_visits` and `branch_value` (mean return)
    include the virtual visits of the prior.
    """

    node_first_branch: NDArray[np.int32]
    node_branches: NDArray[np.int32]
    node_visits: NDArray[np.int32]
    node_value: NDArray[np.float64]
    node_observation: NDArray[np.int32]
    node_next_sibling: NDArray[np.int32]
    branch_action: NDArray[np.int32]
    branch_visits: NDArray[np.int32]
    branch_value: NDArray[np.float64]
    branch_first_child: NDArray[np.int32]
    return_low: NDArray[np.float64]
    return_high: NDArray[np.float64]
    counters: NDArray[np.int64]
    state: NDArray[np.int64]
    actions: NDArray[np.int64]
    prior_visits: NDArray[np.int64]
    prior_values: NDArray[np.float64]
    path_node: NDArray[np.int32]
    path_branch: NDArray[np.int32]
    path_reward: NDArray[np.float64]
    path_discount: NDArray[np.float64]


def new_tree(*, state_size: int, max_actions: int, max_nodes: int, max_branches: int, max_depth: int) -> Tree:
    """Allocate a tree with an unvisited root. `ValueError` if a size is below 1 or does not fit in int32."""
    sizes = {
        "state_size": state_size,
        "max_actions": max_actions,
        "max_nodes": max_nodes,
        "max_branches": max_branches,
        "max_depth": max_depth,
    }
    for name, size in sizes.items():
        if not 1 <= size < 2**31:
            raise ValueError(f"{name} must be from 1 to 2^31 - 1, got {size}")
    tree = Tree(
        node_first_branch=np.zeros(max_nodes, dtype=np.int32),
        node_branches=np.zeros(max_nodes, dtype=np.int32),
        node_visits=np.zeros(max_nodes, dtype=np.int32),
        node_value=np.zeros(max_nodes),
        node_observation=np.zeros(max_nodes, dtype=np.int32),
        node_next_sibling=np.zeros(max_nodes, dtype=np.int32),
        branch_action=np.zeros(max_branches, dtype=np.int32),
        branch_visits=np.zeros(max_branches, dtype=np.int32),
        branch_value=np.zeros(max_branches),
        branch_first_child=np.zeros(max_branches, dtype=np.int32),
        return_low=np.zeros(max_depth + 1),
        return_high=np.zeros(max_depth + 1),
        counters=np.zeros(6, dtype=np.int64),
        state=np.zeros(state_size, dtype=np.int64),
        actions=np.zeros(max_actions, dtype=np.int64),
        prior_visits=np.zeros(max_actions, dtype=np.int64),
        prior_values=np.zeros(max_actions),
        path_node=np.zeros(max_depth + 1, dtype=np.int32),
        path_branch=np.zeros(max_depth + 1, dtype=np.int32),
        path_reward=np.zeros(max_depth + 1),
        path_discount=np.zeros(max_depth + 1),
    )
    clear_tree(tree)
    return tree


@njit
def clear_tree(tree: Tree) -> None:
    """Forget everything but an unvisited root. Costs the depth, not the size: nodes are initialised when taken."""
    tree.counters[:] = 0
    tree.return_low[:] = np.inf
    tree.return_high[:] = -np.inf
    new_node(tree, 0)


@njit_borrowing
def new_node(tree: Tree, observation: int) -> int:
    """Take the next free node, or NONE if the tree is full."""
    node = tree.counters[NODES]
    if node >= tree.node_visits.size:
        return NONE
    tree.counters[NODES] = node + 1
    tree.node_first_branch[node] = NONE
    tree.node_branches[node] = 0
    tree.node_visits[node] = 0
    tree.node_value[node] = 0.0
    tree.node_observation[node] = observation
    tree.node_next_sibling[node] = NONE
    return node


@njit_borrowing
def find_child(tree: Tree, branch: int, observation: int) -> int:
    """The node below `branch` for `observation`, or NONE."""
    child = tree.branch_first_child[branch]
    while child != NONE and tree.node_observation[child] != observation:
        child = tree.node_next_sibling[child]
    return child


@njit_borrowing
def new_child(tree: Tree, branch: int, observation: int) -> int:
    """Take a node for `observation` below `branch`, or NONE if the tree is full."""
    child = new_node(tree, observation)
    if child != NONE:
        tree.node_next_sibling[child] = tree.branch_first_child[branch]
        tree.branch_first_child[branch] = child
    return child


@njit_borrowing
def _add_branches(tree: Tree, node: int, count: int) -> None:
    """Give `node` the `count` actions and priors that lie in the scratch arrays; room was checked."""
    first = tree.counters[BRANCHES]
    tree.counters[BRANCHES] = first + count
    for i in range(count):
        tree.branch_action[first + i] = tree.actions[i]
        tree.branch_visits[first + i] = tree.prior_visits[i]
        tree.branch_value[first + i] = tree.prior_values[i]
        tree.branch_first_child[first + i] = NONE
    tree.node_first_branch[node] = first
    tree.node_branches[node] = count


@njit_borrowing
def select_branch(tree: Tree, node: int, exploration: float, logarithmic: bool) -> int:
    """UCB at an expanded node: the first untried branch, else the largest sum of mean and bonus."""
    first = tree.node_first_branch[node]
    last = first + tree.node_branches[node]
    total = 0
    for branch in range(first, last):
        visits = tree.branch_visits[branch]
        if visits == 0:
            return branch
        total += visits
    scale = exploration * math.sqrt(math.log(total) if logarithmic else math.sqrt(total))
    best, best_score = first, -np.inf
    for branch in range(first, last):
        score = tree.branch_value[branch] + scale / math.sqrt(tree.branch_visits[branch])
        if score > best_score:
            best, best_score = branch, score
    return best


@njit_borrowing
def _exploration_at(tree: Tree, depth: int, settings: SearchSettings) -> float:
    """The constant of the bonus in units of reward at `depth`."""
    if settings.return_range > 0.0:
        return settings.exploration * settings.return_range
    spread = tree.return_high[depth] - tree.return_low[depth]
    return settings.exploration * spread if spread > 0.0 else 0.0


@njit_borrowing
def _record_return(tree: Tree, node: int, depth: int, value: float) -> None:
    """Count a return from `node` and widen the range of returns at its depth."""
    tree.node_visits[node] += 1
    tree.node_value[node] += (value - tree.node_value[node]) / tree.node_visits[node]
    tree.return_low[depth] = min(tree.return_low[depth], value)
    tree.return_high[depth] = max(tree.return_high[depth], value)


@njit_borrowing
def _back_up(tree: Tree, leaf: int, depth: int, value: float) -> None:
    """Return `value`, seen at `leaf` (NONE: outside the tree) after `depth` steps, to the histories on the path."""
    if leaf != NONE:
        _record_return(tree, leaf, depth, value)
    for step in range(depth - 1, -1, -1):
        value = tree.path_reward[step] + tree.path_discount[step] * value
        branch = tree.path_branch[step]
        tree.branch_visits[branch] += 1
        tree.branch_value[branch] += (value - tree.branch_value[branch]) / tree.branch_visits[branch]
        _record_return(tree, tree.path_node[step], step, value)


@_njit_inside_entry_point
def _expand(tree: Tree, node: int, model: Any) -> int:
    """Give `node` its branches. Returns their number, 0 if it has no action, NONE if the tree is full."""
    count = model_actions(model, tree.state, tree.actions)
    if count == 0:
        return 0
    if tree.counters[BRANCHES] + count > tree.branch_visits.size:
        return NONE
    for i in range(count):
        tree.prior_visits[i] = 0
        tree.prior_values[i] = 0.0
    model_prior(model, tree.state, tree.actions, count, tree.prior_visits, tree.prior_values)
    _add_branches(tree, node, count)
    return count


@_njit_inside_entry_point
def _simulate_once(tree: Tree, model: Any, settings: SearchSettings, rng: NDArray[np.uint64]) -> None:
    """One simulation: down the tree by UCB, one node more, a rollout, and the return back up (Algorithm 1)."""
    model_sample(model, rng, tree.state)
    node, depth = ROOT, 0
    terminal, actionless = False, False
    while node != NONE and depth < settings.max_depth and (depth == 0 or tree.node_visits[node] > 0):
        if tree.node_first_branch[node] == NONE:
            count = _expand(tree, node, model)
            if count <= 0:
                actionless = count == 0
                tree.counters[REFUSED] += count == NONE
                break
        branch = select_branch(tree, node, _exploration_at(tree, depth, settings), settings.logarithmic)
        observation, reward, discount, terminal = model_step(
            model, tree.state, tree.branch_action[branch], rng
        )
        tree.path_node[depth], tree.path_branch[depth] = node, branch
        tree.path_reward[depth], tree.path_discount[depth] = reward, discount
        depth += 1
        node = NONE
        if terminal:
            break
        node = find_child(tree, branch, observation)
        if node == NONE:
            node = new_child(tree, branch, observation)
            tree.counters[REFUSED] += node == NONE
    value = 0.0
    if not terminal:
        value = model_rollout(model, tree.state, 0 if actionless else settings.max_depth - depth, rng)
    tree.counters[SIMULATIONS] += 1
    tree.counters[STEPS] += depth
    tree.counters[DEEPEST] = max(tree.counters[DEEPEST], depth)
    _back_up(tree, node, depth, value)


@_njit_inside_entry_point
def simulate(
    tree: Tree, model: Any, settings: SearchSettings, rng: NDArray[np.uint64], simulations: int
) -> None:
    """Run `simulations` simulations from the root. Call it from a model's entry point, see `planning.pomcp`.

    `max_depth` of the settings must not exceed that of the tree. Running twice n simulations gives the same tree
    as running 2 n at once.
    """
    for _ in range(simulations):
        _simulate_once(tree, model, settings, rng)
