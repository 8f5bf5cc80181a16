"""Small lattices for the tests of the coverage model, and a plain Python model of the same problem.

`Reference` knows nothing of bits, words and kernels: sets of nodes, `math`, and the formulas of the paper.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.coverage_build import RootBelief, build_model
from planning.coverage_model import ACTIONS, BITS, CoverageModel
from planning.coverage_tiles import tile_count
from planning.pomcp import Pomcp
from planning.reward import RewardWeights, parameters

STEPS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
"""(dx, dy) of the eight directions, E first and counter-clockwise."""


class Edge(NamedTuple):
    """An edge's length and its probability of failing."""

    distance_m: float
    risk: float


@dataclass(frozen=True)
class Reference:
    """A coverage problem in plain Python. Nodes are (column, row) pairs numbered row by row.

    edges: (node, direction) -> Edge, both ways. sees: node -> nodes in line of sight and range, whatever the heading.
    """

    size: int
    reach: int
    fov_rad: float
    weights: RewardWeights
    entropy: NDArray[np.float64]
    edges: dict[tuple[int, int], Edge]
    sees: dict[int, frozenset[int]]
    leaf_value: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def neighbour(self, node: int, k: int) -> int:
        """The node in direction k; -1 outside."""
        row, column = node // self.size + STEPS[k][1], node % self.size + STEPS[k][0]
        inside = 0 <= row < self.size and 0 <= column < self.size
        return row * self.size + column if inside else -1

    def footprint(self, node: int, heading: int) -> frozenset[int]:
        """What the sensor covers: in sight, and no more than half the field of view off the heading."""
        return self._footprints[node, heading]

    @cached_property
    def _footprints(self) -> dict[tuple[int, int], frozenset[int]]:
        return {
            (node, k): frozenset(other for other in self.sees.get(node, ()) if self._in_wedge(node, other, k))
            for node in range(self.size**2)
            for k in range(8)
        }

    def _in_wedge(self, node: int, other: int, k: int) -> bool:
        dx, dy = other % self.size - node % self.size, other // self.size - node // self.size
        if dx == 0 and dy == 0:
            return True
        hx, hy = STEPS[k]
        cosine = (dx * hx + dy * hy) / math.hypot(dx, dy) / math.hypot(hx, hy)
        return math.acos(max(-1.0, min(1.0, cosine))) <= self.fov_rad / 2.0 + 1e-6

    def information(self, seen: Iterable[int]) -> float:
        """I: the sum of entropies."""
        return sum(float(self.entropy[node]) for node in seen)

    def cost(self, distance_m: float, risk: float, heading: int, k: int) -> float:
        """k_C (k_d d + k_rho rho + k_mu mu)."""
        w = self.weights
        turn = min((heading - k) % 8, (k - heading) % 8) / 4.0
        return w.k_cost * (w.k_distance_per_m * distance_m + w.k_risk * risk + w.k_turn * turn)

    def move(
        self, node: int, heading: int, covered: frozenset[int], k: int, blocked: bool
    ) -> tuple[int, frozenset[int], float, float]:
        """One move. Returns (node, covered, reward, discount): the robot turns, looks, goes, and looks again.

        A sensor that sees all round has looked before it turns.
        """
        edge = self.edges[node, k]
        before = covered
        if k != heading and self.fov_rad < 2.0 * math.pi - 1e-6:
            covered |= self.footprint(node, k)
        if not blocked:
            node = self.neighbour(node, k)
            covered |= self.footprint(node, k)
        gain = self.weights.k_information * self.information(covered - before)
        length = 0.0 if blocked else edge.distance_m
        discount = self.weights.gamma_per_m ** (0.5 * edge.distance_m if blocked else edge.distance_m)
        return node, covered, gain - self.cost(length, edge.risk, heading, k), discount

    def value_of(self, node: int, heading: int, covered: frozenset[int], moves: Iterable[int]) -> float:
        """Discounted reward of moves that all succeed."""
        value, discount = 0.0, 1.0
        for k in moves:
            node, covered, gained, factor = self.move(node, heading, covered, k, False)
            heading = k
            value += discount * gained
            discount *= factor
        return value

    def directions(self, node: int) -> Iterator[int]:
        """Directions in which there is an edge."""
        return (k for k in range(8) if (node, k) in self.edges)

    def model(
        self,
        node: int = 0,
        heading: int = 0,
        covered: Iterable[int] = (),
        horizon: int = 40,
        rollout_random: float = 0.0,
        macros: bool = True,
    ) -> CoverageModel:
        """The compiled model of this problem."""
        n = self.size**2
        distance, risk = np.zeros((n, 8), np.float32), np.zeros((n, 8), np.float32)
        for (a, k), edge in self.edges.items():
            distance[a, k], risk[a, k] = edge
        return build_model(
            size=self.size,
            reach=self.reach,
            fov_rad=self.fov_rad,
            edge_distance_m=distance,
            edge_risk=risk,
            entropy=self.entropy,
            visible=self.visible(),
            leaf_value=self.leaf_value if len(self.leaf_value) else np.zeros(n),
            root=RootBelief(
                np.array([node], np.int32), np.array([heading], np.uint8), np.ones(1), self.bits(covered)
            ),
            weights=parameters(self.weights),
            horizon=horizon,
            rollout_random=rollout_random,
            macros=macros,
        )

    def visible(self) -> NDArray[np.uint32]:
        """What each node sees as rows of bits around it, (n, 2 reach + 1)."""
        rows = np.zeros((self.size**2, 2 * self.reach + 1), np.uint32)
        for a, seen in self.sees.items():
            for other in seen:
                row = other // self.size - a // self.size + self.reach
                rows[a, row] |= np.uint32(1 << (other % self.size - a % self.size + self.reach))
        return rows

    def bits(self, nodes: Iterable[int]) -> NDArray[np.uint64]:
        """A set of nodes as coverage words."""
        words = [0] * self.size
        for node in nodes:
            words[node // self.size] |= 1 << node % self.size
        return np.array(words, np.uint64)

    def tiles(self, nodes: Iterable[int]) -> NDArray[np.uint64]:
        """A set of nodes as the words of a model's tiles."""
        side = (self.size + 7) // 8
        words = [0] * side**2
        for node in nodes:
            row, column = divmod(node, self.size)
            words[row // 8 * side + column // 8] |= 1 << row % 8 * 8 + column % 8
        return np.array(words, np.uint64)

    def in_tiles(self, tiles: NDArray[np.uint64]) -> frozenset[int]:
        """The words of tiles as a set of nodes; bits beyond the lattice make it a node that does not exist."""
        side, found = (self.size + 7) // 8, set()
        for tile, word in enumerate(tiles.tolist()):
            for bit in range(64):
                if word >> bit & 1:
                    row, column = tile // side * 8 + bit // 8, tile % side * 8 + bit % 8
                    found.add(row * self.size + column if max(row, column) < self.size else -1)
        return frozenset(found)

    def nodes(self, words: NDArray[np.uint64]) -> frozenset[int]:
        """Coverage words as a set of nodes; bits beyond the lattice make it a node that does not exist."""
        return frozenset(
            row * self.size + column if column < self.size else -1
            for row in range(self.size)
            for column in range(64)
            if int(words[row]) >> column & 1
        )


def random_lattice(
    seed: int,
    size: int,
    reach: int,
    fov_deg: float = 120.0,
    *,
    wall_share: float = 0.0,
    risky_share: float = 0.0,
    hidden_share: float = 0.0,
    covered_share: float = 0.0,
    weights: RewardWeights | None = None,
) -> Reference:
    """A lattice of random entropies.

    wall_share: nodes that are not there. risky_share: edges with rho from 0.05 to 0.85. hidden_share: nodes in range
    that are not in sight after all. covered_share: nodes of entropy 0.
    """
    rng = np.random.default_rng(seed)
    n = size * size
    there = rng.random(n) >= wall_share
    entropy = np.where(there & (rng.random(n) >= covered_share), rng.uniform(0.1, 0.69, n), 0.0)
    shape = Reference(size, reach, math.radians(fov_deg), weights or RewardWeights(), entropy, {}, {})
    edges: dict[tuple[int, int], Edge] = {}
    for node in range(n):
        for k in range(4):
            other = shape.neighbour(node, k)
            if other < 0 or not (there[node] and there[other]):
                continue
            risk = float(np.float32(rng.uniform(0.05, 0.85))) if rng.random() < risky_share else 0.0
            length = float(np.float32(math.hypot(*STEPS[k]) * rng.uniform(1.0, 1.2)))
            edges[node, k] = edges[other, k + 4] = Edge(length, risk)
    sees: dict[int, frozenset[int]] = {}
    for node in range(n):
        near = [
            row * size + column
            for row in range(max(0, node // size - reach), min(size, node // size + reach + 1))
            for column in range(max(0, node % size - reach), min(size, node % size + reach + 1))
        ]
        seen = [o for o in near if entropy[o] > 0.0 and (o == node or rng.random() >= hidden_share)]
        sees[node] = frozenset(seen if there[node] else [])
    return Reference(size, reach, shape.fov_rad, shape.weights, entropy, edges, sees)


def reachable(lattice: Reference, start: int, max_risk: float = 0.9) -> set[int]:
    """Nodes that can be driven to."""
    found, open_nodes = {start}, [start]
    while open_nodes:
        node = open_nodes.pop()
        for k in lattice.directions(node):
            other = lattice.neighbour(node, k)
            if other not in found and lattice.edges[node, k].risk <= max_risk:
                found.add(other)
                open_nodes.append(other)
    return found


def coverage_solver(size: int, max_depth: int, max_nodes: int = 1 << 16, exploration: float = 0.1) -> Pomcp:
    """A solver for lattices of this size."""
    return Pomcp(
        state_size=BITS + tile_count(size),
        max_actions=ACTIONS,
        max_nodes=max_nodes,
        max_depth=max_depth,
        max_branches=12 * max_nodes,
        exploration=exploration,
    )
