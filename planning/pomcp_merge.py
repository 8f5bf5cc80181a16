"""Root parallelism: trees that were grown apart from the same belief, added up history by history.

Each worker searches on its own, without locks; what they found is one tree of all their simulations (Chaslot, Winands
and van den Herik 2008, root parallelisation, here for the whole tree and not for the root alone).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.pomcp_tree import (
    BRANCHES,
    DEEPEST,
    NONE,
    REFUSED,
    ROOT,
    SIMULATIONS,
    STEPS,
    Tree,
    find_child,
    new_child,
)


@njit
def merge_tree(into: Tree, source: Tree) -> None:
    """Add the histories of `source` to `into`: visits add up, values are means by visits.

    The virtual visits of a prior count once for each tree. What finds no room in `into` is left out, with all below it.
    """
    stack = np.empty((source.node_visits.size, 2), np.int32)
    stack[0, 0], stack[0, 1] = ROOT, ROOT
    size = 1
    while size > 0:
        size -= 1
        size = _merge_node(into, source, stack[size, 0], stack[size, 1], stack, size)
    for counter in (SIMULATIONS, REFUSED, STEPS):
        into.counters[counter] += source.counters[counter]
    into.counters[DEEPEST] = max(into.counters[DEEPEST], source.counters[DEEPEST])
    for depth in range(into.return_low.size):
        into.return_low[depth] = min(into.return_low[depth], source.return_low[depth])
        into.return_high[depth] = max(into.return_high[depth], source.return_high[depth])


@njit
def _merge_node(into: Tree, source: Tree, node: int, other: int, stack: NDArray[np.int32], size: int) -> int:
    """Add node `other` of `source` to `node`, and its children to the stack. Returns the stack's new size."""
    visits = into.node_visits[node] + source.node_visits[other]
    if visits > 0:
        gap = source.node_value[other] - into.node_value[node]
        into.node_value[node] += gap * (source.node_visits[other] / visits)
    into.node_visits[node] = visits
    theirs, count = source.node_first_branch[other], source.node_branches[other]
    if theirs == NONE:
        return size
    if into.node_first_branch[node] == NONE and not _copy_branches(into, source, node, theirs, count):
        return size
    for i in range(count):
        branch, other_branch = into.node_first_branch[node] + i, theirs + i
        visits = into.branch_visits[branch] + source.branch_visits[other_branch]
        if visits > 0:
            gap = source.branch_value[other_branch] - into.branch_value[branch]
            into.branch_value[branch] += gap * (source.branch_visits[other_branch] / visits)
        into.branch_visits[branch] = visits
        child = source.branch_first_child[other_branch]
        while child != NONE:
            observation = source.node_observation[child]
            mine = find_child(into, branch, observation)
            if mine == NONE:
                mine = new_child(into, branch, observation)
            if mine != NONE:
                stack[size, 0], stack[size, 1] = mine, child
                size += 1
            child = source.node_next_sibling[child]
    return size


@njit
def _copy_branches(into: Tree, source: Tree, node: int, theirs: int, count: int) -> bool:
    """Give `node` the same actions, not visited yet. The actions of a history are the same in every tree."""
    first = into.counters[BRANCHES]
    if first + count > into.branch_visits.size:
        return False
    into.counters[BRANCHES] = first + count
    for i in range(count):
        into.branch_action[first + i] = source.branch_action[theirs + i]
        into.branch_visits[first + i] = 0
        into.branch_value[first + i] = 0.0
        into.branch_first_child[first + i] = NONE
    into.node_first_branch[node] = first
    into.node_branches[node] = count
    return True
