"""Which breadcrumbs are joined by edges, kept as edges come and go."""

from __future__ import annotations

from collections.abc import Callable, Iterable

Neighbours = Callable[[int], Iterable[int]]


class Components:
    """Connected components of a growing graph.

    An edge that comes joins two components: the smaller takes the label of the larger. An edge that goes splits one
    only if no other way is left; that is looked for from both ends by turns, so that it costs no more than the smaller
    side, or than the way round (mostly a few nodes).
    """

    def __init__(self) -> None:
        self._label: dict[int, int] = {}
        self._members: dict[int, set[int]] = {}
        self._next = 0

    def add(self, node: int) -> None:
        """A node without edges."""
        if node not in self._label:
            self._give([node])

    def _give(self, nodes: Iterable[int]) -> None:
        self._next += 1
        self._members[self._next] = set(nodes)
        for node in self._members[self._next]:
            self._label[node] = self._next

    def join(self, a: int, b: int) -> None:
        """An edge has come."""
        small, large = self._label[a], self._label[b]
        if small == large:
            return
        if len(self._members[small]) > len(self._members[large]):
            small, large = large, small
        moving = self._members.pop(small)
        self._members[large] |= moving
        for node in moving:
            self._label[node] = large

    def part(self, a: int, b: int, neighbours: Neighbours) -> None:
        """The edge a-b has gone. neighbours: of a node over the edges that are left."""
        cut = _smaller_side(a, b, neighbours)
        if cut:
            self._members[self._label[a]] -= cut
            self._give(cut)

    def largest(self) -> int:
        """The number of the component with the most nodes (the lowest number of several); -1 when there is none."""
        return min(self._members, key=lambda k: (-len(self._members[k]), k), default=-1)

    def label(self, node: int) -> int:
        """The same number for all nodes of a component; -1 for a node that is not there."""
        return self._label.get(node, -1)


def _smaller_side(a: int, b: int, neighbours: Neighbours) -> set[int]:
    """The nodes of the side that is exhausted first; empty when a way leads from a to b."""
    reached: tuple[set[int], set[int]] = ({a}, {b})
    fronts = ([a], [b])
    turn = 0
    while True:
        following = []
        for node in fronts[turn]:
            for other in neighbours(node):
                if other in reached[1 - turn]:
                    return set()
                if other not in reached[turn]:
                    reached[turn].add(other)
                    following.append(other)
        if not following:
            return reached[turn]
        fronts[turn][:] = following
        turn = 1 - turn
