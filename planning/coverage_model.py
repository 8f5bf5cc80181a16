"""The local coverage problem as a generative model: motion and observation model and reward (paper, LCP and Eq. 5).

Shared by lcp, reconciler and baselines. State (int64): node, heading, key of the simulation's risk outcomes, then one
word a lattice row with the bits of the nodes that this simulation has covered. Actions: 0..7 one move in that
direction, 8..15 up to MACRO_STEPS moves in a row, SWEEP a few steps of the informed rule. Observation: blocked or not,
and how much was newly covered, binned. Whether an edge is blocked is drawn once a simulation (a hash of its key), so
that a blocked edge stays blocked and is worth finding out about.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.bits import count_bits, lowest_bit
from planning.grid import DIRECTION_DX, DIRECTION_DY
from planning.kernels import njit
from planning.lattice_graph import neighbour, travel_costs
from planning.pomcp import random_below, random_bits, random_uniform, register_model, simulate
from planning.reward import RewardParameters, action_cost, reward, travel_discount

NODE, HEADING, KEY, BITS = 0, 1, 2, 3
MACRO_STEPS = 4
SWEEP = 16
ACTIONS = 17
SWEEP_STEPS = 6
MAX_EDGE_RISK = 0.9
_BINS = (0.02, 0.5, 1.5, 3.0)
_BLOCKED = 8
_DX, _DY = DIRECTION_DX, DIRECTION_DY
_ONE = np.uint64(1)


class CoverageModel(NamedTuple):
    """The Local IRM and what the simulations need of it; n nodes, size * size.

    edge_distance_m, edge_risk: (n, 8). entropy: (n,), nats of whole patches. visible: (n, rows). wedge: (8, rows), the
    field of view by heading. leaf_value: (n,). particle_*: (p,), the root belief. covered: (size,) bits that count as
    covered already. cluster_*: groups of uncovered nodes for the informed rule: cluster_move (c, n) first moves,
    cluster_cost (c, n), cluster_rows (c, 3) words, cluster_top (c,) first row. cost_order: (n, few) nearest clusters.
    """

    size: int
    reach: int
    weights: RewardParameters
    edge_distance_m: NDArray[np.float32]
    edge_risk: NDArray[np.float32]
    entropy: NDArray[np.float64]
    visible: NDArray[np.uint32]
    wedge: NDArray[np.uint32]
    leaf_value: NDArray[np.float64]
    particle_node: NDArray[np.int32]
    particle_heading: NDArray[np.uint8]
    particle_weight: NDArray[np.float64]
    covered: NDArray[np.uint64]
    cluster_move: NDArray[np.int8]
    cluster_cost: NDArray[np.float32]
    cluster_rows: NDArray[np.uint64]
    cluster_top: NDArray[np.int32]
    rollout_steps: int
    rollout_random: float


def wedge_rows(reach: int, fov_rad: float) -> NDArray[np.uint32]:
    """(8, 2 reach + 1) words: offsets inside the field of view for each heading; the own node always."""
    rows = np.zeros((8, 2 * reach + 1), np.uint32)
    for k in range(8):
        heading = k * math.pi / 4.0
        for r in range(2 * reach + 1):
            for c in range(2 * reach + 1):
                dx, dy = c - reach, r - reach
                off = abs(math.remainder(math.atan2(dy, dx) - heading, 2.0 * math.pi))
                if (dx == 0 and dy == 0) or off <= fov_rad / 2.0 + 1e-9:
                    rows[k, r] |= np.uint32(1 << c)
    return rows


@njit
def footprint_row(model: CoverageModel, node: int, heading: int, r: int) -> np.uint64:
    """Row r of the nodes that the sensor covers from (node, heading), shifted to lattice columns."""
    word = np.uint64(model.visible[node, r] & model.wedge[heading, r])
    shift = node % model.size - model.reach
    if shift >= 0:
        return word << np.uint64(shift)
    return word >> np.uint64(-shift)


@njit
def new_nodes(model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64]) -> int:
    """How many nodes one look from (node, heading) would newly cover."""
    total = 0
    top = node // model.size - model.reach
    for r in range(2 * model.reach + 1):
        row = top + r
        if 0 <= row < model.size and model.visible[node, r] != 0:
            total += count_bits(footprint_row(model, node, heading, r) & ~covered[row])
    return total


@njit
def look(model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64]) -> float:
    """Cover what is seen from (node, heading). Returns I, the sum of the entropies of the newly covered nodes."""
    information = 0.0
    top = node // model.size - model.reach
    for r in range(2 * model.reach + 1):
        row = top + r
        if row < 0 or row >= model.size or model.visible[node, r] == 0:
            continue
        fresh = footprint_row(model, node, heading, r) & ~covered[row]
        covered[row] |= fresh
        while fresh != np.uint64(0):
            information += model.entropy[row * model.size + lowest_bit(fresh)]
            fresh &= fresh - _ONE
    return information


@njit
def edge_blocked(model: CoverageModel, key: int, node: int, k: int) -> bool:
    """Whether the edge is blocked in the simulation with this key: the same answer each time and from both ends."""
    rho = model.edge_risk[node, k]
    if rho <= 0.0:
        return False
    other = neighbour(node, k, model.size)
    low, high = min(node, other), max(node, other)
    x = np.uint64(key) ^ (np.uint64(low * 8192 + high) * np.uint64(0x9E3779B97F4A7C15))
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x = x ^ (x >> np.uint64(31))
    return float(x >> np.uint64(11)) * (1.0 / 9007199254740992.0) < rho


@njit
def turn_share(heading: int, k: int) -> float:
    """mu(q): the turn to direction k as a share of half a turn, 0 to 1."""
    off = abs(heading - k) % 8
    return min(off, 8 - off) / 4.0


@njit
def _move(
    model: CoverageModel, state: NDArray[np.int64], covered: NDArray[np.uint64], k: int
) -> tuple[float, float, float, bool]:
    """One move. Returns (information, cost, distance, blocked); a blocked robot has turned and stays."""
    node, heading = state[NODE], state[HEADING]
    turn = turn_share(heading, k)
    distance, risk = float(model.edge_distance_m[node, k]), float(model.edge_risk[node, k])
    state[HEADING] = k
    information = look(model, node, k, covered) if k != heading else 0.0
    if edge_blocked(model, state[KEY], node, k):
        return information, action_cost(model.weights, 0.0, risk, turn), 0.5 * distance, True
    state[NODE] = neighbour(node, k, model.size)
    information += look(model, state[NODE], k, covered)
    return information, action_cost(model.weights, distance, risk, turn), distance, False


@njit
def greedy_direction(
    model: CoverageModel, state: NDArray[np.int64], covered: NDArray[np.uint64], tried: int
) -> int:
    """The informed rule: the move with the best one-step gain less cost, else towards the nearest uncovered group.

    tried: bits of directions not to take. Returns -1 when nothing is left to cover.
    """
    node, heading = state[NODE], state[HEADING]
    best, best_score = -1, 0.0
    for k in range(8):
        distance = model.edge_distance_m[node, k]
        if distance <= 0.0 or (tried >> k) & 1 or model.edge_risk[node, k] > MAX_EDGE_RISK:
            continue
        gain = new_nodes(model, neighbour(node, k, model.size), k, covered)
        if gain == 0:
            continue
        score = 0.5 * gain / (distance + 0.7 * turn_share(heading, k)) - model.weights.k_risk * float(
            model.edge_risk[node, k]
        )
        if score > best_score:
            best, best_score = k, score
    if best >= 0:
        return best
    return _towards_nearest(model, node, covered, tried)


@njit
def _towards_nearest(model: CoverageModel, node: int, covered: NDArray[np.uint64], tried: int) -> int:
    nearest, nearest_cost = -1, np.float32(np.inf)
    for c in range(model.cluster_top.shape[0]):
        if model.cluster_cost[c, node] >= nearest_cost or model.cluster_move[c, node] < 0:
            continue
        left = np.uint64(0)
        for r in range(3):
            row = model.cluster_top[c] + r
            if row < model.size:
                left |= model.cluster_rows[c, r] & ~covered[row]
        if left != np.uint64(0):
            nearest, nearest_cost = c, model.cluster_cost[c, node]
    if nearest < 0:
        return -1
    k = int(model.cluster_move[nearest, node])
    return -1 if k < 0 or (tried >> k) & 1 else k


@njit
def _sample(model: CoverageModel, rng: NDArray[np.uint64], state: NDArray[np.int64]) -> None:
    pick, particle = random_uniform(rng), 0
    total = model.particle_weight[0]
    while total < pick and particle < model.particle_weight.shape[0] - 1:
        particle += 1
        total += model.particle_weight[particle]
    state[NODE] = model.particle_node[particle]
    state[HEADING] = model.particle_heading[particle]
    state[KEY] = np.int64(random_bits(rng) >> np.uint64(1))
    for row in range(model.size):
        state[BITS + row] = np.int64(model.covered[row])


@njit
def _step(
    model: CoverageModel, state: NDArray[np.int64], action: int, rng: NDArray[np.uint64]
) -> tuple[int, float, float, bool]:
    covered = state[BITS:].view(np.uint64)
    steps = 1 if action < 8 else (MACRO_STEPS if action < SWEEP else SWEEP_STEPS)
    total, seen, discount, blocked = 0.0, 0.0, 1.0, False
    for _ in range(steps):
        k = greedy_direction(model, state, covered, 0) if action == SWEEP else action % 8
        if k < 0 or model.edge_distance_m[state[NODE], k] <= 0.0 or model.edge_risk[state[NODE], k] > MAX_EDGE_RISK:
            break
        information, cost, distance, blocked = _move(model, state, covered, k)
        total += discount * (model.weights.k_information * information - cost)
        seen += information
        discount *= travel_discount(model.weights, distance)
        if blocked:
            break
    observation = 0
    for bound in _BINS:
        observation += 1 if seen > bound else 0
    return observation + (_BLOCKED if blocked else 0), total, discount, False


@njit
def _actions(model: CoverageModel, state: NDArray[np.int64], actions_out: NDArray[np.int64]) -> int:
    node, heading, count = state[NODE], state[HEADING], 1
    actions_out[0] = SWEEP
    for turn in (0, 1, 7, 2, 6, 3, 5, 4):
        k = (heading + turn) % 8
        if model.edge_distance_m[node, k] <= 0.0 or model.edge_risk[node, k] > MAX_EDGE_RISK:
            continue
        actions_out[count] = k
        count += 1
        beyond = neighbour(node, k, model.size)
        if model.edge_distance_m[beyond, k] > 0.0:
            actions_out[count] = 8 + k
            count += 1
    return count if count > 1 else 0


@njit
def _rollout(model: CoverageModel, state: NDArray[np.int64], depth_left: int, rng: NDArray[np.uint64]) -> float:
    covered = state[BITS:].view(np.uint64)
    value, discount, tried = 0.0, 1.0, 0
    for _ in range(model.rollout_steps if depth_left > 0 else 0):
        k = -1
        if random_uniform(rng) < model.rollout_random:
            k = np.int64(random_below(rng, 8))
            if model.edge_distance_m[state[NODE], k] <= 0.0 or model.edge_risk[state[NODE], k] > 0.1:
                k = -1
        if k < 0:
            k = greedy_direction(model, state, covered, tried)
        if k < 0:
            break
        information, cost, distance, blocked = _move(model, state, covered, k)
        tried = tried | (1 << k) if blocked else 0
        value += discount * (model.weights.k_information * information - cost)
        discount *= travel_discount(model.weights, distance)
    return value + discount * model.leaf_value[state[NODE]]


register_model(CoverageModel, sample=_sample, step=_step, actions=_actions, rollout=_rollout)


@njit
def search_coverage(tree, model, settings, rng, simulations):  # type: ignore[no-untyped-def]
    """Entry point of POMCP for this model (see `planning.pomcp`)."""
    simulate(tree, model, settings, rng, simulations)


@njit
def rollout_value(model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64], rng: NDArray[np.uint64], count: int) -> float:  # fmt: skip  # noqa: E501
    """Mean value of the informed rollout from (node, heading) with these nodes covered; covered: (size,), kept."""
    state = np.empty(BITS + model.size, np.int64)
    total = 0.0
    for _ in range(count):
        state[NODE], state[HEADING] = node, heading
        state[KEY] = np.int64(random_bits(rng) >> np.uint64(1))
        for row in range(model.size):
            state[BITS + row] = np.int64(covered[row])
        total += _rollout(model, state, 1, rng)
    return total / max(count, 1)


@njit
def evaluate_moves(
    model: CoverageModel,
    node: int,
    heading: int,
    moves: NDArray[np.int64],
    covered: NDArray[np.uint64],
    reward_out: NDArray[np.float64],
    distance_out: NDArray[np.float64],
    alive_out: NDArray[np.float64],
) -> int:
    """Expected reward of each step of a path under the current belief (paper, Eq. 13).

    moves: (k,) directions. covered: (size,), changed: what the path covers. A step that fails (probability rho) ends
    the path; alive_out: probability of getting that far. Returns how many steps can be made (an edge that is gone or
    impassable ends the path).
    """
    state = np.empty(BITS + model.size, np.int64)
    alive = 1.0
    for i in range(moves.shape[0]):
        k = moves[i]
        distance, risk = float(model.edge_distance_m[node, k]), float(model.edge_risk[node, k])
        if distance <= 0.0 or risk > MAX_EDGE_RISK:
            return i
        information = look(model, node, k, covered) if k != heading else 0.0
        other = neighbour(node, k, model.size)
        information += (1.0 - risk) * look(model, other, k, covered)
        reward_out[i] = alive * reward(model.weights, information, distance, risk, turn_share(heading, k))
        distance_out[i] = distance
        alive *= 1.0 - risk
        alive_out[i] = alive
        node, heading = other, k
    state[0] = node
    return moves.shape[0]


@njit
def follow_rule(
    model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64], moves_out: NDArray[np.int64]
) -> int:
    """The moves of the informed rule from (node, heading) when nothing is blocked; covered: (size,), changed."""
    state = np.zeros(BITS + model.size, np.int64)
    state[NODE], state[HEADING] = node, heading
    for i in range(moves_out.shape[0]):
        k = greedy_direction(model, state, covered, 0)
        if k < 0:
            return i
        if k != state[HEADING]:
            look(model, state[NODE], k, covered)
        state[NODE], state[HEADING] = neighbour(state[NODE], k, model.size), k
        look(model, state[NODE], k, covered)
        moves_out[i] = k
    return moves_out.shape[0]


@njit
def seen_by_any(
    visible: NDArray[np.uint32], connected: NDArray[np.bool_], size: int, reach: int, seen: NDArray[np.bool_]
) -> None:
    """Mark the nodes that some connected node sees; seen: (n,) out. Others cannot be covered from here."""
    for node in range(size * size):
        if not connected[node]:
            continue
        for r in range(2 * reach + 1):
            word = np.uint64(visible[node, r])
            while word != np.uint64(0):
                row, column = node // size + r - reach, node % size + lowest_bit(word) - reach
                word &= word - _ONE
                if 0 <= row < size and 0 <= column < size:
                    seen[row * size + column] = True


@njit
def best_viewpoint(
    visible: NDArray[np.uint32],
    cost: NDArray[np.float64],
    size: int,
    reach: int,
    top: int,
    words: NDArray[np.uint64],
    middle_row: float,
    middle_column: float,
) -> int:
    """The reachable node near a block that sees most of it, then the nearest to its middle; -1 if none sees any.

    cost: (n,) travel from the root, inf where the robot cannot go. words: (3,) the block's nodes, from row `top`.
    """
    best, best_score = -1, 0.0
    for row in range(max(0, top - reach), min(size, top + 3 + reach)):
        for column in range(max(0, int(middle_column) - reach), min(size, int(middle_column) + reach + 1)):
            node = row * size + column
            if not math.isfinite(cost[node]):
                continue
            count = 0
            for r in range(3):
                offset = top + r - row + reach
                if offset < 0 or offset > 2 * reach or top + r >= size:
                    continue
                shift = column - reach
                word = np.uint64(visible[node, offset])
                word = word << np.uint64(shift) if shift >= 0 else word >> np.uint64(-shift)
                count += count_bits(word & words[r])
            if count == 0:
                continue
            score = count - 0.3 * math.hypot(row - middle_row, column - middle_column) + 100.0
            if score > best_score:
                best, best_score = node, score
    return best


def clusters(
    entropy: NDArray[np.float64],
    size: int,
    reach: int,
    visible: NDArray[np.uint32],
    edge_distance_m: NDArray[np.float32],
    edge_risk: NDArray[np.float32],
    risk_weight_m: float,
    root: int,
) -> tuple[NDArray[np.int8], NDArray[np.float32], NDArray[np.uint64], NDArray[np.int32]]:
    """Groups of uncovered nodes (blocks of 3 x 3) and the way to each from every node, for the informed rule."""
    n = size * size
    grid = entropy.reshape(size, size) > 0.0
    root_cost, move = np.empty(n), np.empty(n, np.int8)
    travel_costs(root, size, edge_distance_m, edge_risk, risk_weight_m, MAX_EDGE_RISK, root_cost, move)
    moves, costs, rows, tops = [], [], [], []
    for top in range(0, size, 3):
        for left in range(0, size, 3):
            block = grid[top : top + 3, left : left + 3]
            if not block.any():
                continue
            words = np.zeros(3, np.uint64)
            for r, c in np.argwhere(block):
                words[r] |= np.uint64(1) << np.uint64(left + c)
            middle = np.argwhere(block).mean(axis=0) + np.array([top, left])
            source = best_viewpoint(visible, root_cost, size, reach, top, words, middle[0], middle[1])
            if source < 0:
                continue
            cost = np.empty(n)
            travel_costs(
                source, size, edge_distance_m, edge_risk, risk_weight_m, MAX_EDGE_RISK, cost, move
            )
            moves.append(move.copy())
            costs.append(cost.astype(np.float32))
            rows.append(words)
            tops.append(top)
    return (
        np.array(moves, np.int8).reshape(-1, n),
        np.array(costs, np.float32).reshape(-1, n),
        np.array(rows, np.uint64).reshape(-1, 3),
        np.array(tops, np.int32),
    )


def reachable_entropy(
    entropy: NDArray[np.float32],
    visible: NDArray[np.uint32],
    edge_distance_m: NDArray[np.float32],
    size: int,
    reach: int,
) -> NDArray[np.float64]:
    """Entropy of each node that can be covered from some connected node; 0 for the others. (n,)"""
    connected = (edge_distance_m > 0.0).any(axis=1)
    seen = np.zeros(size * size, np.bool_)
    seen_by_any(visible, connected, size, reach, seen)
    return np.where(seen, entropy, 0.0).astype(np.float64)


class RootBelief(NamedTuple):
    """The belief that a search starts from: particles (p,), and the nodes that count as covered, (size,) words."""

    node: NDArray[np.int32]
    heading: NDArray[np.uint8]
    weight: NDArray[np.float64]
    covered: NDArray[np.uint64]


def build_model(
    *,
    size: int,
    reach: int,
    fov_rad: float,
    edge_distance_m: NDArray[np.float32],
    edge_risk: NDArray[np.float32],
    entropy: NDArray[np.float64],
    visible: NDArray[np.uint32],
    leaf_value: NDArray[np.float64],
    root: RootBelief,
    weights: RewardParameters,
    rollout_steps: int,
    rollout_random: float,
) -> CoverageModel:
    """The model of an episode from the columns of a Local IRM (shapes as in `CoverageModel`)."""
    start = int(root.node[int(np.argmax(root.weight))])
    risk_weight_m = weights.k_risk / max(weights.k_distance_per_m, 1e-3)
    move, cost, rows, top = clusters(
        entropy, size, reach, visible, edge_distance_m, edge_risk, risk_weight_m, start
    )
    return CoverageModel(
        size, reach, weights, edge_distance_m, edge_risk, entropy, visible, wedge_rows(reach, fov_rad), leaf_value,
        root.node, root.heading, root.weight, root.covered, move, cost, rows, top, rollout_steps, rollout_random,
    )  # fmt: skip
