"""The coverage model against plain Python: what is seen, what is blocked, what a step pays, what a path is worth."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.coverage_build import reachable_entropy
from planning.coverage_groups import best_viewpoint
from planning.coverage_model import (
    ACTIONS,
    BITS,
    HEADING,
    KEY,
    MACRO_STEPS,
    MAX_EDGE_RISK,
    MOVES,
    NODE,
    SWEEP,
    SWEEP_STEPS,
    _actions,
    _rollout,
    _sample,
    _step,
    best_gain_direction,
    edge_blocked,
    evaluate_moves,
    follow_rule,
    look,
    new_nodes,
    rollout_value,
    turn_share,
)
from planning.coverage_tiles import cover, tile_count
from planning.pomcp import random_bits, random_stream
from planning.reward import RewardWeights
from tests.planning.coverage_lattices import Edge, Reference, random_lattice, reachable

SEEDS = st.integers(0, 2**32 - 1)
WEIGHTS = RewardWeights(
    k_information=1.3, k_cost=0.7, k_distance_per_m=0.11, k_risk=2.0, k_turn=0.23, gamma_per_m=0.93
)


def start_of(lattice: Reference, rng: np.random.Generator) -> int:
    """A node with at least one edge."""
    return int(rng.choice(sorted({node for node, _ in lattice.edges})))


def state_at(
    lattice: Reference, node: int, heading: int, key: int, covered: frozenset[int], moves: int = 0
) -> NDArray[np.int64]:
    state = np.zeros(BITS + tile_count(lattice.size), np.int64)
    state[NODE], state[HEADING], state[KEY], state[MOVES] = node, heading, key, moves
    state[BITS:] = lattice.tiles(covered).view(np.int64)
    return state


# --- what is seen -------------------------------------------------------------------------------------------------


@given(SEEDS, st.integers(1, 9), st.integers(0, 4), st.sampled_from([60.0, 90.0, 120.0, 200.0, 360.0]))
def test_a_look_covers_the_footprint_and_pays_its_entropies(
    seed: int, size: int, reach: int, fov_deg: float
) -> None:
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, size, reach, fov_deg, wall_share=0.1, hidden_share=0.3, covered_share=0.2)
    model = lattice.model()
    before = frozenset(int(i) for i in np.flatnonzero(rng.random(size * size) < 0.3))
    covered = lattice.tiles(before)
    node, heading = int(rng.integers(size * size)), int(rng.integers(8))
    fresh = lattice.footprint(node, heading) - before
    assert new_nodes(model, node, heading, covered) == len(fresh)
    information = look(model, node, heading, covered)
    assert math.isclose(information, lattice.information(fresh), rel_tol=1e-12, abs_tol=1e-12)
    assert lattice.in_tiles(covered) == before | fresh
    assert look(model, node, heading, covered) == 0.0


def test_the_widest_lattice_fits_into_its_words() -> None:
    """61 nodes a side and reach 15: bits are shifted to the ends of the words."""
    size, reach, rng = 61, 15, np.random.default_rng(3)
    sees: dict[int, frozenset[int]] = {}
    for row, column in ((0, 0), (0, 60), (60, 0), (60, 60), (30, 30), (7, 55), (7, 3), (52, 46), (20, 14)):
        rows = range(max(0, row - reach), min(size, row + reach + 1))
        columns = range(max(0, column - reach), min(size, column + reach + 1))
        near = [r * size + c for r in rows for c in columns]
        sees[row * size + column] = frozenset(node for node in near if rng.random() < 0.5)
    lattice = Reference(size, reach, 2.0 * math.pi, WEIGHTS, np.ones(size * size), {}, sees)
    model = lattice.model()
    for node, seen in sees.items():
        covered = lattice.tiles(())
        assert look(model, node, 0, covered) == len(seen)
        assert lattice.in_tiles(covered) == seen


@given(SEEDS)
def test_only_what_a_connected_node_sees_has_entropy(seed: int) -> None:
    lattice = random_lattice(seed, 6, 2, wall_share=0.5, hidden_share=0.5)
    model = lattice.model()
    connected = {node for node, _ in lattice.edges}
    seen = set().union(*(lattice.sees[node] for node in connected)) if connected else set()
    entropy = np.random.default_rng(seed).uniform(0.1, 1.0, 36).astype(np.float32)
    found = reachable_entropy(entropy, lattice.visible(), model.edge_distance_m, 6, 2)
    np.testing.assert_array_equal(found, [entropy[i] if i in seen else 0.0 for i in range(36)])


# --- what is blocked ----------------------------------------------------------------------------------------------


def test_an_edge_is_blocked_from_both_ends_and_again_and_again() -> None:
    lattice = random_lattice(5, 6, 1, risky_share=1.0)
    model, rng = lattice.model(), random_stream(1)
    answers = set()
    for _ in range(50):
        key = int(random_bits(rng) >> np.uint64(1))
        for node, k in lattice.edges:
            blocked = edge_blocked(model, key, node, k)
            assert blocked == edge_blocked(model, key, lattice.neighbour(node, k), (k + 4) % 8)
            assert blocked == edge_blocked(model, key, node, k)
            answers.add(blocked)
    assert answers == {True, False}


def test_edges_are_blocked_as_often_as_rho_says_and_independently() -> None:
    """Six standard deviations of the binomial: one false alarm in 10^9, and the keys are fixed anyway."""
    lattice = random_lattice(5, 4, 1, risky_share=1.0)
    model, rng = lattice.model(), random_stream(2)
    edges = [(node, k) for node, k in lattice.edges if k < 4]
    keys = [int(random_bits(rng) >> np.uint64(1)) for _ in range(2000)]
    blocked = np.array([[edge_blocked(model, key, node, k) for node, k in edges] for key in keys])
    rho = np.array([lattice.edges[edge].risk for edge in edges])
    deviation = np.sqrt(rho * (1.0 - rho) / len(keys))
    assert np.all(np.abs(blocked.mean(axis=0) - rho) < 6.0 * deviation)
    together = blocked.T.astype(float) @ blocked / len(keys)
    expected = np.outer(rho, rho)
    off = np.abs(together - expected) / np.sqrt(expected * (1.0 - expected) / len(keys))
    assert off[~np.eye(len(edges), dtype=bool)].max() < 6.0


def test_an_edge_without_risk_is_never_blocked() -> None:
    lattice = random_lattice(5, 4, 1)
    model, rng = lattice.model(), random_stream(3)
    for _ in range(200):
        key = int(random_bits(rng) >> np.uint64(1))
        assert not any(edge_blocked(model, key, node, k) for node, k in lattice.edges)


# --- what a step pays ---------------------------------------------------------------------------------------------


def reference_action(
    lattice: Reference, state: NDArray[np.int64], directions: list[int], horizon: int
) -> tuple[NDArray[np.int64], float, float, float, bool, bool]:
    """Moves until one is impossible or blocked, or the horizon is reached, where the value of the leaf is paid.

    Returns (state, reward, discount, information, blocked, terminal). Standing still would go on for ever: it is the
    end of the simulation too.
    """
    model = lattice.model()
    node, heading, key, moves = (int(state[i]) for i in (NODE, HEADING, KEY, MOVES))
    covered = lattice.in_tiles(state[BITS:].view(np.uint64))
    value, discount, blocked, before, first = 0.0, 1.0, False, covered, moves
    for k in directions:
        edge = lattice.edges.get((node, k))
        if edge is None or edge.risk > MAX_EDGE_RISK or blocked or moves == horizon:
            break
        blocked = edge_blocked(model, key, node, k)
        node, covered, gained, factor = lattice.move(node, heading, covered, k, blocked)
        heading, moves = k, moves + 1
        value += discount * gained
        discount *= factor
    information = lattice.information(covered - before)
    terminal = moves in (first, horizon)
    if terminal:
        value, moves = value + discount * float(lattice.leaf_value[node]), horizon
    after = state_at(lattice, node, heading, key, covered, moves)
    return after, value, discount, information, blocked, terminal


def check_step(
    lattice: Reference, state: NDArray[np.int64], action: int, directions: list[int], horizon: int
) -> None:
    """One step of the model against the reference."""
    model = lattice.model(int(state[NODE]), int(state[HEADING]), horizon=horizon)
    after, value, factor, information, blocked, ends = reference_action(lattice, state, directions, horizon)
    observation, reward, discount, terminal = _step(model, state, action, random_stream(0))
    np.testing.assert_array_equal(state, after)
    assert math.isclose(reward, value, rel_tol=1e-6, abs_tol=1e-9)
    assert math.isclose(discount, factor, rel_tol=1e-6)
    assert terminal == ends
    assert (observation >= 8) == blocked
    assert observation % 8 == sum(information > bound for bound in (0.02, 0.5, 1.5, 3.0))


@settings(max_examples=150)
@given(SEEDS, st.integers(0, 15), st.integers(0, 5), st.sampled_from([0.93, 1.0]))
def test_a_step_pays_the_formula_and_discounts_by_travel(
    seed: int, action: int, moves_left: int, gamma: float
) -> None:
    rng = np.random.default_rng(seed)
    lattice = random_lattice(
        seed, 6, 2, wall_share=0.1, risky_share=0.5, hidden_share=0.2,
        weights=WEIGHTS.model_copy(update={"gamma_per_m": gamma}),
    )  # fmt: skip
    lattice = replace(lattice, leaf_value=rng.uniform(0.0, 5.0, 36))
    covered = frozenset(int(i) for i in np.flatnonzero(rng.random(36) < 0.2))
    start, heading, key = start_of(lattice, rng), int(rng.integers(8)), int(rng.integers(2**62))
    state = state_at(lattice, start, heading, key, covered, 9 - moves_left)
    directions = [action % 8] * (1 if action < 8 else MACRO_STEPS)
    check_step(lattice, state, action, directions, 9)


@given(SEEDS)
def test_a_sweep_is_the_informed_rule(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, 6, 2, wall_share=0.1, covered_share=0.6, weights=WEIGHTS)
    lattice = replace(lattice, leaf_value=rng.uniform(0.0, 5.0, 36))
    node, heading = start_of(lattice, rng), int(rng.integers(8))
    model = lattice.model(node, heading)
    moves = np.zeros(SWEEP_STEPS, np.int64)
    count = follow_rule(model, node, heading, model.covered.copy(), moves)
    state = state_at(lattice, node, heading, 7, frozenset())
    check_step(lattice, state, SWEEP, [int(k) for k in moves[:count]], 40)


def test_mu_is_the_turn_as_a_share_of_half_a_turn() -> None:
    for heading, k in itertools.product(range(8), range(8)):
        off = abs(math.remainder((heading - k) * math.pi / 4.0, 2.0 * math.pi))
        assert math.isclose(turn_share(heading, k), off / math.pi, abs_tol=1e-12)


@given(SEEDS)
def test_the_actions_are_the_edges_that_may_be_taken(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, 5, 1, wall_share=0.3, risky_share=0.5)
    for key, edge in list(lattice.edges.items()):
        if edge.risk > 0.7:
            lattice.edges[key] = Edge(edge.distance_m, 0.95)
    node, out = int(rng.integers(25)), np.zeros(17, np.int64)
    state = state_at(lattice, node, int(rng.integers(8)), 1, frozenset())
    count = _actions(lattice.model(), state, out)
    singles = {k for k in lattice.directions(node) if lattice.edges[node, k].risk <= MAX_EDGE_RISK}
    macros = {8 + k for k in singles if (lattice.neighbour(node, k), k) in lattice.edges}
    assert set(out[:count].tolist()) == (singles | macros | {SWEEP} if singles else set())
    assert len(set(out[:count].tolist())) == count


def test_particles_are_drawn_as_often_as_they_weigh() -> None:
    lattice = random_lattice(1, 4, 1)
    weights = np.array([0.5, 0.3, 0.15, 0.05])
    model = lattice.model(covered=[3, 9])._replace(
        particle_node=np.array([0, 5, 10, 15], np.int32),
        particle_heading=np.array([1, 3, 5, 7], np.uint8),
        particle_weight=weights,
    )
    rng, state = random_stream(4), np.zeros(BITS + 1, np.int64)
    tally, keys = np.zeros(4), set()
    for _ in range(4000):
        state[:] = -1
        _sample(model, rng, state)
        assert state[HEADING] == 1 + 2 * (state[NODE] // 5)
        assert lattice.in_tiles(state[BITS:].view(np.uint64)) == {3, 9}
        tally[state[NODE] // 5] += 1
        keys.add(int(state[KEY]))
    assert np.all(np.abs(tally / 4000 - weights) < 6.0 * np.sqrt(weights * (1.0 - weights) / 4000))
    assert len(keys) == 4000


# --- what a path is worth -----------------------------------------------------------------------------------------


def random_path(lattice: Reference, rng: np.random.Generator, node: int, length: int) -> list[int]:
    """Moves over edges, none of them twice: a second try of the same edge would have the same outcome."""
    moves: list[int] = []
    used: set[frozenset[int]] = set()
    for _ in range(length):
        free = [
            k
            for k in lattice.directions(node)
            if frozenset((node, lattice.neighbour(node, k))) not in used
            and lattice.edges[node, k].risk <= MAX_EDGE_RISK
        ]
        if not free:
            break
        k = int(rng.choice(free))
        used.add(frozenset((node, lattice.neighbour(node, k))))
        moves.append(k)
        node = lattice.neighbour(node, k)
    return moves


def exhaustive_rewards(
    lattice: Reference, node: int, heading: int, covered: frozenset[int], moves: list[int]
) -> tuple[list[float], list[float]]:
    """Expected reward of each step and the probability of being past it, over all outcomes of all edges.

    The semantics that is exact: steps are attempted in order; a blocked one turns the robot, pays turn and risk but no
    distance, and nothing follows it.
    """
    rewards, alive = [0.0] * len(moves), [0.0] * len(moves)
    nodes = [node]
    for k in moves:
        nodes.append(lattice.neighbour(nodes[-1], k))
    risks = [lattice.edges[a, k].risk for a, k in zip(nodes, moves, strict=False)]
    for outcome in itertools.product((False, True), repeat=len(moves)):
        weight = math.prod(r if blocked else 1.0 - r for r, blocked in zip(risks, outcome, strict=True))
        at, facing, seen = node, heading, covered
        for i, (k, blocked) in enumerate(zip(moves, outcome, strict=True)):
            at, seen, gained, _ = lattice.move(at, facing, seen, k, blocked)
            facing = k
            rewards[i] += weight * gained
            if blocked:
                break
            alive[i] += weight
    return rewards, alive


@given(SEEDS)
def test_a_path_is_worth_the_expectation_over_all_outcomes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, 5, 2, risky_share=0.6, hidden_share=0.2, weights=WEIGHTS)
    node, heading = start_of(lattice, rng), int(rng.integers(8))
    before = frozenset(int(i) for i in np.flatnonzero(rng.random(25) < 0.2))
    moves = random_path(lattice, rng, node, 6)
    expected, alive = exhaustive_rewards(lattice, node, heading, before, moves)
    covered = lattice.tiles(before)
    out = np.zeros(6), np.zeros(6), np.zeros(6)
    count = evaluate_moves(lattice.model(), node, heading, np.array(moves, np.int64), covered, *out)
    assert count == len(moves)
    np.testing.assert_allclose(out[0][:count], expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(out[2][:count], alive, rtol=1e-6)
    at, seen = node, before
    for i, k in enumerate(moves):
        assert math.isclose(out[1][i], lattice.edges[at, k].distance_m, rel_tol=1e-9)
        at, seen, _, _ = lattice.move(at, heading, seen, k, False)
        heading = k
    assert lattice.in_tiles(covered) == seen


@pytest.mark.parametrize("risk", [None, 0.95])
def test_a_path_ends_at_an_edge_that_is_gone_or_impassable(risk: float | None) -> None:
    lattice = random_lattice(1, 5, 1, weights=WEIGHTS)
    for node, k in ((2, 0), (3, 4)):
        if risk is None:
            del lattice.edges[node, k]
        else:
            lattice.edges[node, k] = Edge(1.0, risk)
    out = np.zeros(4), np.zeros(4), np.zeros(4)
    assert evaluate_moves(lattice.model(), 0, 0, np.zeros(4, np.int64), lattice.tiles(()), *out) == 2


# --- the informed rule --------------------------------------------------------------------------------------------


@given(SEEDS)
def test_the_rule_stays_on_edges_and_covers_all_that_can_be_covered(seed: int) -> None:
    """With sight all around it ends by itself, and only when nothing is left that some reachable node sees."""
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, 7, 2, 360.0, wall_share=0.35, hidden_share=0.4, covered_share=0.3)
    node = start_of(lattice, rng)
    model = lattice.model(node, 0)
    moves, covered = np.zeros(300, np.int64), model.covered.copy()
    count = follow_rule(model, node, 0, covered, moves)
    assert count < 300
    at, heading, seen = node, 0, frozenset[int]()
    for k in moves[:count]:
        assert (at, int(k)) in lattice.edges
        at, seen, _, _ = lattice.move(at, heading, seen, int(k), False)
        heading = int(k)
    assert lattice.in_tiles(covered) == seen
    within = reachable(lattice, node)
    coverable = set().union(*(lattice.sees[i] for i in within)) - lattice.sees[node]
    assert coverable <= seen


@given(SEEDS)
def test_every_node_that_can_be_covered_has_a_group_and_a_way_to_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, 8, 2, wall_share=0.35, hidden_share=0.4, covered_share=0.3)
    node = start_of(lattice, rng)
    model = lattice.model(node, 0)
    within = reachable(lattice, node)
    coverable = set().union(*(lattice.sees[i] for i in within))
    with_way: set[int] = set()
    for c in range(len(model.cluster_tile)):
        if not math.isfinite(model.cluster_cost[node, c]):
            continue
        at, steps = node, 0
        while model.cluster_move[at, c] >= 0 and steps < 64:
            assert (at, int(model.cluster_move[at, c])) in lattice.edges
            at, steps = lattice.neighbour(at, int(model.cluster_move[at, c])), steps + 1
        words = np.zeros_like(model.covered)
        np.bitwise_or.at(words, model.cluster_tile[c].astype(int), model.cluster_word[c])
        members = lattice.in_tiles(words)
        assert members & lattice.sees[at], "the way ends where nothing of the group is seen"
        with_way |= members
    assert coverable <= with_way


def test_a_viewpoint_sees_most_of_its_block() -> None:
    lattice = random_lattice(11, 7, 2, 360.0, hidden_share=0.5)
    block = {r * 7 + c for r in range(3, 6) for c in range(3, 6)}
    words = lattice.bits(block)[3:6].copy()
    cost = np.zeros(49)
    best = best_viewpoint(lattice.visible(), cost, 7, 2, 3, words, 4.0, 4.0)
    scores = {
        node: len(lattice.sees[node] & block) - 0.3 * math.hypot(node // 7 - 4, node % 7 - 4)
        for node in range(49)
        if lattice.sees[node] & block
    }
    assert math.isclose(scores[best], max(scores.values()))


# --- rollouts -----------------------------------------------------------------------------------------------------


@given(SEEDS, st.integers(1, 30))
def test_a_rollout_without_chance_is_the_rule_and_the_leaf(seed: int, horizon: int) -> None:
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, 6, 2, wall_share=0.1, covered_share=0.5, weights=WEIGHTS)
    leaf = rng.uniform(0.0, 5.0, 36)
    node, heading = start_of(lattice, rng), int(rng.integers(8))
    model = replace(lattice, leaf_value=leaf).model(node, heading, horizon=horizon)
    moves = np.zeros(horizon, np.int64)
    count = follow_rule(model, node, heading, model.covered.copy(), moves)
    value, discount, at, facing, seen = 0.0, 1.0, node, heading, frozenset[int]()
    for k in moves[:count].tolist():
        at, seen, gained, factor = lattice.move(at, facing, seen, k, False)
        value, discount, facing = value + discount * gained, discount * factor, k
    value += discount * leaf[at]
    found = rollout_value(model, node, heading, model.covered, random_stream(1), 3)
    assert math.isclose(found, value, rel_tol=1e-6, abs_tol=1e-9)
    at_the_horizon = state_at(lattice, node, heading, 5, frozenset(), horizon)
    assert _rollout(model, at_the_horizon, 3, random_stream(1)) == leaf[node]


def test_rollouts_with_chance_stay_on_edges() -> None:
    """Random moves too: `look` would raise on a node outside, and the state must end on a node that exists."""
    lattice = random_lattice(9, 6, 1, wall_share=0.3, risky_share=0.5)
    rng = random_stream(8)
    nodes = {node for node, _ in lattice.edges}
    start = min(nodes)
    model = lattice.model(start, horizon=30, rollout_random=0.7)
    within, ends = reachable(lattice, start), set()
    for key in range(300):
        state = state_at(lattice, start, 0, key, frozenset())
        _rollout(model, state, 1, rng)
        ends.add(int(state[NODE]))
    assert ends <= within
    assert len(ends) > 5


def test_uniform_rollouts_take_every_edge_equally_often() -> None:
    """`rollout_random=1`, the paper's plain rollouts: the ends of one move, against equal shares."""
    lattice = random_lattice(9, 6, 1, wall_share=0.2, risky_share=0.0)
    start = max({node for node, _ in lattice.edges}, key=lambda node: len(list(lattice.directions(node))))
    ways = list(lattice.directions(start))
    model = lattice.model(start, horizon=1, rollout_random=1.0)
    rng, ends = random_stream(4), dict.fromkeys((lattice.neighbour(start, k) for k in ways), 0)
    draws = 4000
    for _ in range(draws):
        state = state_at(lattice, start, 0, 1, frozenset())
        _rollout(model, state, 1, rng)
        ends[int(state[NODE])] += 1
    deviation = math.sqrt(draws / len(ways))
    assert len(ways) >= 4
    assert all(abs(n - draws / len(ways)) < 5 * deviation for n in ends.values())


@settings(max_examples=50)
@given(SEEDS)
def test_without_macros_the_actions_are_the_moves_there_are(seed: int) -> None:
    lattice = random_lattice(seed, 6, 1, wall_share=0.4, risky_share=0.3)
    model, out = lattice.model(macros=False), np.zeros(ACTIONS, np.int64)
    for node in {node for node, _ in lattice.edges}:
        count = _actions(model, state_at(lattice, node, 3, 1, frozenset()), out)
        open_ways = [k for k in lattice.directions(node) if lattice.edges[node, k].risk <= MAX_EDGE_RISK]
        assert sorted(out[:count].tolist()) == sorted(open_ways)


def best_by_sets(
    lattice: Reference, node: int, heading: int, covered: frozenset[int], tried: int, k_risk: float
) -> int:
    """The informed rule's move by counting sets: of equal scores the first direction, -1 when nothing scores."""
    best, best_score = -1, 0.0
    for k in lattice.directions(node):
        edge = lattice.edges[node, k]
        if tried >> k & 1 or edge.risk > MAX_EDGE_RISK:
            continue
        gain = len(lattice.footprint(lattice.neighbour(node, k), k) - covered)
        turn = min((heading - k) % 8, (k - heading) % 8) / 4.0
        score = 0.5 * gain / (edge.distance_m + 0.7 * turn) - k_risk * edge.risk
        if score > best_score:
            best, best_score = k, score
    return best


@settings(max_examples=200)
@given(SEEDS, st.sampled_from([60.0, 120.0, 360.0]), st.booleans(), st.booleans(), st.integers(0, 255))
def test_the_best_move_is_that_of_counting_all_of_them(
    seed: int, fov_deg: float, at_root: bool, even: bool, tried: int
) -> None:
    """Where the sensor has looked from the node, and at the root, from which it has not. even: many ties."""
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, 9, 2, fov_deg, wall_share=0.2, risky_share=0.0 if even else 0.3)
    if even:
        for node, k in lattice.edges:
            lattice.edges[node, k] = Edge(1.0, 0.0)
    root, node, heading = start_of(lattice, rng), start_of(lattice, rng), int(rng.integers(8))
    node = root if at_root else node
    before = frozenset(int(i) for i in np.flatnonzero(rng.random(81) < rng.choice([0.0, 0.3, 0.9, 1.0])))
    model = lattice.model(root, heading, before if seed % 2 else ())
    if not at_root:
        before |= lattice.footprint(node, heading)
    found = best_gain_direction(model, node, heading, lattice.tiles(before), tried & 0x55)
    assert found == best_by_sets(lattice, node, heading, before, tried & 0x55, model.weights.k_risk)


@pytest.mark.parametrize("fov_deg", [360.0, 120.0])
def test_only_a_root_that_something_is_to_be_seen_from_is_unlooked(fov_deg: float) -> None:
    """There a step shows all that its end does; elsewhere what its start did not."""
    lattice = random_lattice(5, 9, 2, fov_deg, wall_share=0.15)
    start, heading = start_of(lattice, np.random.default_rng(5)), 3
    for looked in (lattice.footprint(start, heading), frozenset[int]()):
        model = lattice.model(start, heading, looked)
        for node, k in lattice.edges:
            tiles = np.zeros(tile_count(9), np.uint64)
            cover(model.sight, 8 * node + k, model.entropy, tiles)
            own = frozenset[int]() if node == start and not looked else lattice.footprint(node, k)
            expected = lattice.footprint(lattice.neighbour(node, k), k) - looked - own
            assert lattice.in_tiles(tiles) == expected
