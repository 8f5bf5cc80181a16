"""Exact answers for small coverage problems: all move sequences, and all policies where edges may be blocked."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from tests.planning.coverage_lattices import Reference

BITS = NDArray[np.int64]
VALUES = NDArray[np.float64]


@njit
def _search(
    to: BITS,
    distance: VALUES,
    sees: BITS,
    entropy: VALUES,
    k_information: float,
    k_distance: float,
    k_turn: float,
    gamma: float,
    node: int,
    heading: int,
    steps: int,
    turns_show: bool,
    best: VALUES,
) -> None:
    """Depth first over all sequences of up to `steps` moves; a branch that cannot reach the best so far is cut."""
    at, facing = np.zeros(steps + 1, np.int64), np.zeros(steps + 1, np.int64)
    covered, next_k = np.zeros(steps + 1, np.int64), np.zeros(steps + 1, np.int64)
    value, discount = np.zeros(steps + 1), np.ones(steps + 1)
    at[0], facing[0] = node, heading
    best[0] = 0.0
    depth = 0
    while depth >= 0:
        k = next_k[depth]
        if depth == steps or k == 8:
            depth -= 1
            continue
        next_k[depth] = k + 1
        other = to[at[depth], k]
        if other < 0:
            continue
        new = sees[other, k] | covered[depth]
        if turns_show and k != facing[depth]:
            new |= sees[at[depth], k]
        gained, left = 0.0, 0.0
        for i in range(entropy.shape[0]):
            if not (new >> i) & 1:
                left += entropy[i]
            elif not (covered[depth] >> i) & 1:
                gained += entropy[i]
        off = abs(facing[depth] - k)
        turn = min(off, 8 - off) / 4.0
        length = distance[at[depth], k]
        total = value[depth] + discount[depth] * (
            k_information * gained - k_distance * length - k_turn * turn
        )
        factor = discount[depth] * gamma**length
        best[0] = max(best[0], total)
        if total + factor * k_information * left <= best[0]:
            continue
        depth += 1
        at[depth], facing[depth], covered[depth] = other, k, new
        value[depth], discount[depth], next_k[depth] = total, factor, 0


def best_value(lattice: Reference, node: int, heading: int, steps: int) -> float:
    """The largest discounted reward of any sequence of up to `steps` moves; edges must be without risk."""
    n = lattice.size**2
    to, distance = np.full((n, 8), -1, np.int64), np.zeros((n, 8))
    sees = np.zeros((n, 8), np.int64)
    for (a, k), edge in lattice.edges.items():
        assert edge.risk == 0.0
        to[a, k], distance[a, k] = lattice.neighbour(a, k), edge.distance_m
    for a in range(n):
        for k in range(8):
            sees[a, k] = sum(1 << other for other in lattice.footprint(a, k))
    w, best = lattice.weights, np.zeros(1)
    _search(
        to, distance, sees, lattice.entropy, w.k_information, w.k_cost * w.k_distance_per_m, w.k_cost * w.k_turn,
        w.gamma_per_m, node, heading, steps, lattice.fov_rad < 2.0 * math.pi - 1e-6, best,
    )  # fmt: skip
    return float(best[0])


def best_policy_value(lattice: Reference, node: int, heading: int, steps: int) -> float:
    """The value of the best closed-loop policy of up to `steps` moves: exact expectimax over what is known of edges."""
    seen_before: dict[tuple[int, int, frozenset[int], frozenset[tuple[int, int, bool]], int], float] = {}

    def value(
        at: int, facing: int, covered: frozenset[int], known: frozenset[tuple[int, int, bool]], left: int
    ) -> float:
        key = (at, facing, covered, known, left)
        if left == 0 or key in seen_before:
            return seen_before.get(key, 0.0)
        best = 0.0
        for k in lattice.directions(at):
            best = max(
                best,
                sum(p * outcome(at, facing, covered, known, left, k, b) for b, p in chances(at, k, known)),
            )
        seen_before[key] = best
        return best

    def chances(at: int, k: int, known: frozenset[tuple[int, int, bool]]) -> list[tuple[bool, float]]:
        other, risk = lattice.neighbour(at, k), lattice.edges[at, k].risk
        low, high = min(at, other), max(at, other)
        for blocked in (False, True):
            if (low, high, blocked) in known:
                return [(blocked, 1.0)]
        return [(False, 1.0 - risk), (True, risk)] if risk > 0.0 else [(False, 1.0)]

    def outcome(
        at: int,
        facing: int,
        covered: frozenset[int],
        known: frozenset[tuple[int, int, bool]],
        left: int,
        k: int,
        blocked: bool,
    ) -> float:
        if lattice.edges[at, k].risk > 0.0:
            other = lattice.neighbour(at, k)
            known |= {(min(at, other), max(at, other), blocked)}
        after, covered, gained, discount = lattice.move(at, facing, covered, k, blocked)
        return gained + discount * value(after, k, covered, known, left - 1)

    return value(node, heading, frozenset(), frozenset(), steps)


class _World(NamedTuple):
    """One outcome of the risky edge: where the robot is in it, what it has covered, and its discount so far."""

    blocked: bool
    node: int
    heading: int
    covered: frozenset[int]
    discount: float


def best_open_loop_value(
    lattice: Reference, node: int, heading: int, risky: tuple[int, int], steps: int
) -> float:
    """The best expected reward of up to `steps` moves that are chosen beforehand and carried out whatever happens.

    risky: (node, direction) of the one edge that may be blocked. A move without an edge is left out, at no cost.
    """
    other_end = (lattice.neighbour(*risky), (risky[1] + 4) % 8)
    rho = lattice.edges[risky].risk
    seen_before: dict[tuple[_World, _World, int], float] = {}

    def moved(world: _World, k: int) -> tuple[_World, float]:
        if (world.node, k) not in lattice.edges:
            return world, 0.0
        stops = world.blocked and (world.node, k) in (risky, other_end)
        at, covered, gained, factor = lattice.move(world.node, world.heading, world.covered, k, stops)
        after = _World(world.blocked, at, k, covered, round(world.discount * factor, 12))
        return after, world.discount * gained

    def value(free: _World, stuck: _World, left: int) -> float:
        key = (free, stuck, left)
        if left == 0 or key in seen_before:
            return seen_before.get(key, 0.0)
        best = 0.0
        for k in {*lattice.directions(free.node), *lattice.directions(stuck.node)}:
            (a, gained_a), (b, gained_b) = moved(free, k), moved(stuck, k)
            best = max(best, (1.0 - rho) * gained_a + rho * gained_b + value(a, b, left - 1))
        seen_before[key] = best
        return best

    nothing = frozenset[int]()
    return value(_World(False, node, heading, nothing, 1.0), _World(True, node, heading, nothing, 1.0), steps)
