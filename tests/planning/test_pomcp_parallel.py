"""Root parallelism: the sum of trees is the tree of all their simulations, and threads change nothing but the time."""

from __future__ import annotations

import numpy as np
import pytest

from planning.pomcp import NONE, Pomcp, Tree, clear_tree
from planning.pomcp_merge import merge_tree
from planning.pomcp_tree import NODES, SIMULATIONS
from tests.planning.exact_pomdp import tiger_value
from tests.planning.pomdp_models import Tiger, search_tiger


def solver(workers: int, max_nodes: int = 1 << 14) -> Pomcp:
    return Pomcp(
        state_size=1, max_actions=3, max_nodes=max_nodes, max_depth=6, exploration=0.25, return_range=110.0,
        workers=workers,
    )  # fmt: skip


def histories(tree: Tree) -> dict[tuple[int, ...], tuple[int, float]]:
    """Visits and mean of every node (by its actions and observations) and of every branch (ending in an action)."""
    found: dict[tuple[int, ...], tuple[int, float]] = {}
    stack: list[tuple[int, tuple[int, ...]]] = [(0, ())]
    while stack:
        node, history = stack.pop()
        found[history] = (int(tree.node_visits[node]), float(tree.node_value[node]))
        first = int(tree.node_first_branch[node])
        for branch in range(first, first + int(tree.node_branches[node])) if first != NONE else ():
            longer = (*history, int(tree.branch_action[branch]))
            found[longer] = (int(tree.branch_visits[branch]), float(tree.branch_value[branch]))
            child = int(tree.branch_first_child[branch])
            while child != NONE:
                stack.append((child, (*longer, int(tree.node_observation[child]))))
                child = int(tree.node_next_sibling[child])
    return found


def test_a_merged_tree_holds_every_history_with_all_visits_and_the_mean_of_all_returns() -> None:
    apart = []
    for seed in (1, 2, 3):
        one = solver(1)
        one.search(search_tiger, Tiger(), seed=seed, simulations=700 * seed)
        apart.append(histories(one.tree))
        if seed == 1:
            total = solver(1, 1 << 16)
            clear_tree(total.tree)
        merge_tree(total.tree, one.tree)
    merged = histories(total.tree)
    assert set(merged) == set().union(*apart)
    for history, (visits, value) in merged.items():
        parts = [tree[history] for tree in apart if history in tree]
        assert visits == sum(n for n, _ in parts)
        if visits:
            assert value == pytest.approx(sum(n * v for n, v in parts) / visits)
    assert total.tree.counters[SIMULATIONS] == 700 * 6
    assert total.root().simulations == total.tree.node_visits[0] == 700 * 6


@pytest.mark.parametrize("workers", [2, 3])
def test_threads_give_the_sum_of_searches_one_after_another(workers: int) -> None:
    """Each worker's tree is what a lone search with its stream and its share finds; the batches do not matter."""
    whole = solver(workers)
    report = whole.search(search_tiger, Tiger(), seed=9, simulations=2001)
    other = solver(workers)
    other.search(search_tiger, Tiger(), seed=9, simulations=2001, should_stop=lambda: False, batch=250)
    assert histories(whole.tree) == histories(other.tree)
    assert report.simulations == 2001
    assert whole.root().simulations == 2001
    assert sum(int(tree.counters[SIMULATIONS]) for tree in whole._trees) == 2001
    alone = solver(1)
    alone.search(search_tiger, Tiger(), seed=9, simulations=2001 // workers)
    assert histories(whole._trees[0]) == histories(alone.tree)
    firsts = [float(tree.branch_value[0]) for tree in whole._trees]
    assert len(set(firsts)) == workers, "each worker draws from a stream of its own"


def test_more_workers_find_the_same_value_and_resuming_goes_on() -> None:
    pair = solver(2, 1 << 16)
    pair.search(search_tiger, Tiger(), seed=3, simulations=1 << 14)
    pair.search(search_tiger, Tiger(), seed=3, simulations=1 << 16, resume=True)
    assert pair.root().simulations == (1 << 14) + (1 << 16)
    assert pair.root().max_value == pytest.approx(tiger_value(6), abs=4.0)  # of returns that range over 110
    assert pair.best_action() == 0
    policy = pair.policy(64)
    assert len(policy.node_action) > 3
    assert policy.node_visits[0] == pair.root().simulations


def test_what_finds_no_room_is_left_out() -> None:
    big, small = solver(1), solver(1, 40)
    big.search(search_tiger, Tiger(), seed=1, simulations=2000)
    clear_tree(small.tree)
    merge_tree(small.tree, big.tree)
    held = histories(small.tree)
    assert small.tree.counters[NODES] == 40
    whole = histories(big.tree)
    assert all(whole[history] == pytest.approx(found) for history, found in held.items())
    assert np.all(small.tree.branch_visits[: len(held)] >= 0)


def test_no_workers_are_refused() -> None:
    with pytest.raises(ValueError, match="workers"):
        solver(0)
