"""The local coverage problem as a generative model: motion and observation model and reward (paper, LCP and Eq. 5).

Shared by lcp, reconciler and baselines. State (int64): node, heading, key of the simulation's risk outcomes, moves
made, then one word a tile of 8 x 8 nodes with the bits of those that this simulation has covered. Actions: 0..7 one
move in that direction, 8..15 up to MACRO_STEPS moves in a row, SWEEP a few steps of the informed rule (the last two
are left out on demand: the paper's plain configuration). Observation:
blocked or not, and how much was newly covered, binned. Whether an edge is blocked is drawn once a simulation (a hash
of its key), so that a blocked edge stays blocked and is worth finding out about.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.coverage_tiles import TileLists, count_fresh, cover
from planning.kernels import njit, njit_borrowing
from planning.pomcp import (
    SearchSettings,
    Tree,
    random_below,
    random_bits,
    random_uniform,
    register_model,
    simulate,
)
from planning.reward import RewardParameters, action_cost, reward, travel_discount

NODE, HEADING, KEY, MOVES, BITS = 0, 1, 2, 3, 4
MACRO_STEPS = 4
SWEEP = 16
ACTIONS = 17
SWEEP_STEPS = 6
MAX_EDGE_RISK = 0.9
_BINS = (0.02, 0.5, 1.5, 3.0)
_BLOCKED = 8
_TURN = np.array([[min((a - b) % 8, (b - a) % 8) / 4.0 for b in range(8)] for a in range(8)])


class CoverageModel(NamedTuple):
    """The Local IRM and what the simulations need of it; n nodes, size * size. Sets of nodes are words of tiles.

    headings: 8, or 1 for a sensor that looks all around. step_to: (n, 8), the neighbour in each direction, -1 outside.
    edge_distance_m, edge_risk, edge_discount: (n, 8). entropy: (64 tiles,), nats of whole patches, in the order of
    `coverage_tiles.by_tile`. sight: of the nodes not covered at the root, set 8 node + k is what the sensor sees from
    the end of a step k and not, under the same heading, from its start (from a node of `unlooked` ones: all); set
    8 n + node headings + heading is all that it sees from a node under a heading (0 for one that looks all around).
    leaf_value: (n,). particle_*: (p,), the root belief. covered: (tiles,) bits that count as covered already: whatever
    is asked of the model is asked with these covered, or more. cluster_*: groups of uncovered nodes for the informed
    rule: cluster_move (n, c) first moves, cluster_cost (n, c), cluster_tile, cluster_word (c, 4), empty ones last.
    horizon: moves of every simulation, in the tree and the rollout together, so that values of short and of long
    actions compare. looks_on_turn: whether turning shows something new: not to a sensor that looks all around. It has
    looked from where the robot stands; what the model still promises there would be seen from the node's anchor.
    move_order: (n, 8), the moves from a node under a heading by falling `most_score`, 3 bits each. most_score:
    (n, 8, 8), by node, heading and place in that order, the most that such a move can score, 0 when nothing or less.
    Both the sets of steps and the scores hold where the sensor has looked from the node under that heading. That is so
    after every move; of the nodes of the root belief, those from which it has not are `unlooked`, and there the model
    takes it that nothing has been seen. macros: whether macro actions are offered. rollout_random: share of random
    moves in rollouts; 1: none by the informed rule.
    """

    size: int
    headings: int
    weights: RewardParameters
    step_to: NDArray[np.int32]
    edge_distance_m: NDArray[np.float32]
    edge_risk: NDArray[np.float32]
    edge_discount: NDArray[np.float64]
    entropy: NDArray[np.float64]
    sight: TileLists
    leaf_value: NDArray[np.float64]
    particle_node: NDArray[np.int32]
    particle_heading: NDArray[np.uint8]
    particle_weight: NDArray[np.float64]
    covered: NDArray[np.uint64]
    cluster_move: NDArray[np.int8]
    cluster_cost: NDArray[np.float32]
    cluster_tile: NDArray[np.uint8]
    cluster_word: NDArray[np.uint64]
    horizon: int
    rollout_random: float
    looks_on_turn: bool
    move_order: NDArray[np.int32]
    most_score: NDArray[np.float32]
    macros: bool


@njit_borrowing
def footprint_set(model: CoverageModel, node: int, heading: int) -> int:
    """Which set of `model.sight` is what the sensor sees from a node under a heading."""
    return model.headings * node + 8 * model.step_to.shape[0] + (heading if model.headings > 1 else 0)


@njit_borrowing
def new_nodes(model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64]) -> int:
    """How many nodes one look from (node, heading) would newly cover; covered: (tiles,)."""
    return count_fresh(model.sight, footprint_set(model, node, heading), covered)


@njit_borrowing
def look(model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64]) -> float:
    """Cover what is seen from (node, heading); covered: (tiles,), changed.

    Returns I, the sum of the entropies of the newly covered nodes.
    """
    return cover(model.sight, footprint_set(model, node, heading), model.entropy, covered)


@njit_borrowing
def look_on_turn(
    model: CoverageModel, node: int, heading: int, turned: int, covered: NDArray[np.uint64]
) -> float:
    """What the turn from a heading to another newly covers at a node; covered: (tiles,), changed."""
    if turned == heading or not model.looks_on_turn:
        return 0.0
    return look(model, node, turned, covered)


@njit_borrowing
def edge_blocked(model: CoverageModel, key: int, node: int, k: int) -> bool:
    """Whether the edge is blocked in the simulation with this key: the same answer each time and from both ends."""
    rho = model.edge_risk[node, k]
    if rho <= 0.0:
        return False
    other = model.step_to[node, k]
    low, high = min(node, other), max(node, other)
    x = np.uint64(key) ^ (np.uint64(low * 8192 + high) * np.uint64(0x9E3779B97F4A7C15))
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x = x ^ (x >> np.uint64(31))
    return float(x >> np.uint64(11)) * (1.0 / 9007199254740992.0) < rho


@njit_borrowing
def turn_share(heading: int, k: int) -> float:
    """mu(q): the turn to direction k as a share of half a turn, 0 to 1."""
    return _TURN[heading, k]


@njit_borrowing
def move_cost(distance_m: float, heading: int, k: int) -> float:
    """What the informed rule divides a gain by: the way, and the turn to direction k (0.7 m for half a turn)."""
    return distance_m + 0.7 * _TURN[heading, k]


@njit_borrowing
def _move(
    model: CoverageModel, node: int, heading: int, key: int, covered: NDArray[np.uint64], k: int
) -> tuple[float, float, float, bool]:
    """One move. Returns (information, cost, distance, blocked); a blocked robot has turned to k and stays."""
    turn = turn_share(heading, k)
    distance, risk = float(model.edge_distance_m[node, k]), float(model.edge_risk[node, k])
    information = look_on_turn(model, node, heading, k, covered)
    if edge_blocked(model, key, node, k):
        return information, action_cost(model.weights, 0.0, risk, turn), 0.5 * distance, True
    information += cover(model.sight, 8 * node + k, model.entropy, covered)
    return information, action_cost(model.weights, distance, risk, turn), distance, False


@njit_borrowing
def best_gain_direction(
    model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64], tried: int
) -> int:
    """The move with the best one-step gain for its travel and risk, or -1 when no move covers anything.

    Of equal ones the first direction. tried: bits of directions not to take.
    """
    order, k_risk = model.move_order[node, heading], model.weights.k_risk
    best, best_score = -1, 0.0
    for i in range(8):
        if model.most_score[node, heading, i] <= best_score:
            break
        k: int = np.int64((order >> (3 * i)) & 7)  # type: ignore[assignment]  # the compiler's int
        if (tried >> k) & 1:
            continue
        if k == heading or not model.looks_on_turn:
            gain = count_fresh(model.sight, 8 * node + k, covered)
        else:
            gain = new_nodes(model, model.step_to[node, k], k, covered)
        if gain == 0:
            continue
        cost = move_cost(model.edge_distance_m[node, k], heading, k)
        score = 0.5 * gain / cost - k_risk * model.edge_risk[node, k]
        if score > best_score or (score == best_score and k < best):
            best, best_score = k, score
    return best


@njit_borrowing
def cluster_left(model: CoverageModel, c: int, covered: NDArray[np.uint64]) -> bool:
    """Whether a node of the group is still uncovered."""
    for i in range(4):
        word = model.cluster_word[c, i]
        if word == np.uint64(0):
            return False
        if (word & ~covered[np.int64(model.cluster_tile[c, i])]) != np.uint64(0):
            return True
    return False


@njit_borrowing
def nearest_cluster(model: CoverageModel, node: int, covered: NDArray[np.uint64]) -> int:
    """The uncovered group that is the shortest way off (not one whose viewpoint this is), or -1."""
    nearest, nearest_cost = -1, np.float32(np.inf)
    for c in range(model.cluster_tile.shape[0]):
        if model.cluster_cost[node, c] >= nearest_cost or model.cluster_move[node, c] < 0:
            continue
        if cluster_left(model, c, covered):
            nearest, nearest_cost = c, model.cluster_cost[node, c]
    return nearest


@njit_borrowing
def informed_move(
    model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64], tried: int, group: int
) -> tuple[int, int]:
    """The informed rule: the next move (-1: nothing left to cover) and the group that it goes to (-1: none).

    The move with the best one-step gain for its cost, else towards the nearest uncovered group; tried: bits of
    directions not to take. On the way to a group it does not waver: it looks again only when the group is covered or
    reached.
    """
    if (
        group >= 0
        and model.cluster_move[node, group] >= 0
        and tried == 0
        and cluster_left(model, group, covered)
    ):
        return np.int64(model.cluster_move[node, group]), group  # type: ignore[return-value]
    k = best_gain_direction(model, node, heading, covered, tried)
    if k >= 0:
        return k, -1
    group = nearest_cluster(model, node, covered)
    if group < 0:
        return -1, -1
    k = np.int64(model.cluster_move[node, group])  # type: ignore[assignment]  # the compiler's int
    return (-1, -1) if (tried >> k) & 1 else (k, group)


@njit_borrowing
def _discount(model: CoverageModel, node: int, k: int, distance: float) -> float:
    """Discount of a move: of the whole edge, or (blocked) of what was driven of it."""
    if distance == model.edge_distance_m[node, k]:
        return model.edge_discount[node, k]
    return travel_discount(model.weights, distance)


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
    state[MOVES] = 0
    for tile in range(model.covered.shape[0]):
        state[BITS + tile] = np.int64(model.covered[tile])


@njit
def _step(
    model: CoverageModel, state: NDArray[np.int64], action: int, rng: NDArray[np.uint64]
) -> tuple[int, float, float, bool]:
    covered = state[BITS:].view(np.uint64)
    steps = 1 if action < 8 else (MACRO_STEPS if action < SWEEP else SWEEP_STEPS)
    node, heading, key, before = state[NODE], state[HEADING], state[KEY], state[MOVES]
    total, seen, discount, blocked, group, moves = 0.0, 0.0, 1.0, False, -1, before
    for _ in range(min(steps, model.horizon - before)):
        k = action % 8
        if action == SWEEP:
            k, group = informed_move(model, node, heading, covered, 0, group)
        if k < 0 or model.edge_distance_m[node, k] <= 0.0 or model.edge_risk[node, k] > MAX_EDGE_RISK:
            break
        moves += 1
        information, cost, distance, blocked = _move(model, node, heading, key, covered, k)
        group = -1 if information > 0.0 else group
        total += discount * (model.weights.k_information * information - cost)
        seen += information
        discount *= _discount(model, node, k, distance)
        heading = k
        if blocked:
            break
        node = np.int64(model.step_to[node, k])
    state[NODE], state[HEADING], state[MOVES] = node, heading, moves
    if state[MOVES] >= model.horizon:
        total += discount * model.leaf_value[state[NODE]]
    elif state[MOVES] == before:  # nothing was left to do: the simulation would stand still for ever
        state[MOVES] = model.horizon
        total += model.leaf_value[state[NODE]]
    observation = 0
    for bound in _BINS:
        observation += 1 if seen > bound else 0
    return observation + (_BLOCKED if blocked else 0), total, discount, state[MOVES] >= model.horizon


@njit
def _actions(model: CoverageModel, state: NDArray[np.int64], actions_out: NDArray[np.int64]) -> int:
    node, heading, count = state[NODE], state[HEADING], 1 if model.macros else 0
    actions_out[0] = SWEEP
    for turn in (0, 1, 7, 2, 6, 3, 5, 4):
        k = (heading + turn) % 8
        if model.edge_distance_m[node, k] <= 0.0 or model.edge_risk[node, k] > MAX_EDGE_RISK:
            continue
        actions_out[count] = k
        count += 1
        beyond = model.step_to[node, k]
        if model.macros and model.edge_distance_m[beyond, k] > 0.0:
            actions_out[count] = 8 + k
            count += 1
    return count if count > (1 if model.macros else 0) else 0


@njit_borrowing
def _random_move(model: CoverageModel, node: int, rng: NDArray[np.uint64]) -> int:
    """A move from a node, all that it has equally likely; -1: it has none."""
    k, count = -1, 0
    for direction in range(8):
        if model.edge_distance_m[node, direction] > 0.0 and model.edge_risk[node, direction] <= MAX_EDGE_RISK:
            count += 1
            if random_below(rng, count) == 0:
                k = direction
    return k


@njit
def _rollout(
    model: CoverageModel, state: NDArray[np.int64], depth_left: int, rng: NDArray[np.uint64]
) -> float:
    covered = state[BITS:].view(np.uint64)
    node, heading, key = state[NODE], state[HEADING], state[KEY]
    value, discount, tried, group = 0.0, 1.0, 0, -1
    for _ in range(model.horizon - state[MOVES]):
        k = -1
        if model.rollout_random >= 1.0:
            k = _random_move(model, node, rng)
        elif random_uniform(rng) < model.rollout_random:
            k, group = np.int64(random_below(rng, 8)), -1  # type: ignore[assignment]
            if model.edge_distance_m[node, k] <= 0.0 or model.edge_risk[node, k] > 0.1:
                k = -1
        if k < 0 and model.rollout_random < 1.0:
            k, group = informed_move(model, node, heading, covered, tried, group)
        if k < 0:
            break
        information, cost, distance, blocked = _move(model, node, heading, key, covered, k)
        if information > 0.0:
            group = -1
        tried = tried | (1 << k) if blocked else 0
        value += discount * (model.weights.k_information * information - cost)
        discount *= _discount(model, node, k, distance)
        node, heading = node if blocked else np.int64(model.step_to[node, k]), k
    state[NODE], state[HEADING] = node, heading
    return value + discount * model.leaf_value[node]


register_model(CoverageModel, sample=_sample, step=_step, actions=_actions, rollout=_rollout)


@njit
def search_coverage(
    tree: Tree, model: CoverageModel, settings: SearchSettings, rng: NDArray[np.uint64], simulations: int
) -> None:
    """Entry point of POMCP for this model (see `planning.pomcp`)."""
    simulate(tree, model, settings, rng, simulations)


@njit
def rollout_value(model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64], rng: NDArray[np.uint64], count: int) -> float:  # fmt: skip  # noqa: E501
    """Mean value of the informed rollout from (node, heading) with these nodes covered; covered: (tiles,), kept."""
    state = np.empty(BITS + covered.shape[0], np.int64)
    total = 0.0
    for _ in range(count):
        state[NODE], state[HEADING], state[MOVES] = node, heading, 0
        state[KEY] = np.int64(random_bits(rng) >> np.uint64(1))
        for tile in range(covered.shape[0]):
            state[BITS + tile] = np.int64(covered[tile])
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
    """Expected reward of each step of a path under the current belief (paper, Eq. 17).

    moves: (k,) directions. covered: (tiles,), changed: what the path covers. A step that fails (probability rho) turns
    the robot, drives nowhere and ends the path; alive_out: probability of getting past the step. Exact when no edge
    comes twice. Returns how many steps can be made (an edge that is gone or impassable ends the path).
    """
    alive = 1.0
    for i in range(moves.shape[0]):
        k = moves[i]
        distance, risk = float(model.edge_distance_m[node, k]), float(model.edge_risk[node, k])
        if distance <= 0.0 or risk > MAX_EDGE_RISK:
            return i
        information = look_on_turn(model, node, heading, k, covered)
        other = model.step_to[node, k]
        information += (1.0 - risk) * look(model, other, k, covered)
        driven = (1.0 - risk) * distance
        reward_out[i] = alive * reward(model.weights, information, driven, risk, turn_share(heading, k))
        distance_out[i] = distance
        alive *= 1.0 - risk
        alive_out[i] = alive
        node, heading = other, k
    return moves.shape[0]


@njit
def follow_rule(
    model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64], moves_out: NDArray[np.int64]
) -> int:
    """The moves of the informed rule from (node, heading) when nothing is blocked; covered: (tiles,), changed."""
    group = -1
    for i in range(moves_out.shape[0]):
        k, group = informed_move(model, node, heading, covered, 0, group)
        if k < 0:
            return i
        information = look_on_turn(model, node, heading, k, covered)
        node, heading = model.step_to[node, k], k
        information += look(model, node, k, covered)
        group = -1 if information > 0.0 else group
        moves_out[i] = k
    return moves_out.shape[0]
