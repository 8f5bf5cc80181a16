"""tau*: the terms against plain Python, the choice against trying every prefix, and what half-open intervals mean."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.coverage_model import MAX_EDGE_RISK, follow_rule, rollout_value
from planning.pomcp import random_stream
from planning.reward import RewardWeights
from services.reconciler.tau import TauTerms, choose_tau, tau_terms
from tests.planning.coverage_lattices import Edge, Reference, random_lattice

SEEDS = st.integers(0, 2**32 - 1)
WEIGHTS = RewardWeights(k_risk=1.5, k_turn=0.2, k_distance_per_m=0.1, gamma_per_m=0.94)


def walk(lattice: Reference, rng: np.random.Generator, node: int, length: int) -> list[int]:
    moves: list[int] = []
    for _ in range(length):
        moves.append(int(rng.choice(list(lattice.directions(node)))))
        node = lattice.neighbour(node, moves[-1])
    return moves


def plain_terms(
    lattice: Reference,
    node: int,
    heading: int,
    before: frozenset[int],
    moves: list[int],
    ratio: float,
    seed: int,
) -> tuple[list[float], list[float], list[float]]:
    """kept, replanned and mismatch for 0 to k steps.

    The value of replanning is the shared rollout from each junction, in order, with one random stream; all else is
    done again here. Interval i is half-open: it holds the steps 0 to i - 1, step i belongs to the new policy.
    """
    model = lattice.model(node, heading, before, rollout_random=0.2)
    rng = random_stream(seed)
    kept, replanned, mismatch = [0.0], [], []
    discount = alive = 1.0
    covered = before
    for i in range(len(moves) + 1):
        words = lattice.tiles(covered)
        replanned.append(discount * alive * ratio * rollout_value(model, node, heading, words, rng, 4))
        first = np.zeros(1, np.int64)
        found = follow_rule(model, node, heading, words.copy(), first)
        off = abs(math.remainder((int(first[0]) - heading) * math.pi / 4.0, 2.0 * math.pi))
        mismatch.append(off / math.pi if found else 0.0)
        if i == len(moves):
            break
        k = moves[i]
        edge = lattice.edges[node, k]
        stays, _, if_blocked, _ = lattice.move(node, heading, covered, k, True)
        goes, covered, if_free, factor = lattice.move(node, heading, covered, k, False)
        assert stays == node
        expected = (1.0 - edge.risk) * if_free + edge.risk * if_blocked
        kept.append(kept[-1] + discount * alive * expected)
        node, heading = goes, k
        discount *= factor
        alive *= 1.0 - edge.risk
    return kept, replanned, mismatch


@settings(max_examples=40)
@given(SEEDS, st.floats(1.0, 2.0))
def test_the_terms_of_every_prefix(seed: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, 6, 2, risky_share=0.4, weights=WEIGHTS)
    node, heading = int(rng.integers(36)), int(rng.integers(8))
    before = frozenset(int(i) for i in np.flatnonzero(rng.random(36) < 0.2))
    moves = walk(lattice, rng, node, 7)
    model = lattice.model(node, heading, before, rollout_random=0.2)
    terms = tau_terms(model, node, heading, np.array(moves, np.int64), 4, ratio, seed)
    kept, replanned, mismatch = plain_terms(lattice, node, heading, before, moves, ratio, seed)
    assert terms.possible == 7
    np.testing.assert_allclose(terms.kept, kept, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(terms.replanned, replanned, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(terms.mismatch, mismatch, atol=1e-12)
    assert lattice.in_tiles(model.covered) == before, "the model's own coverage is not touched"


@settings(max_examples=60)
@given(SEEDS, st.integers(0, 9), st.integers(0, 9), st.floats(0.0, 3.0), st.booleans())
def test_tau_is_the_best_of_all_prefixes(seed: int, low: int, high: int, weight: float, paper: bool) -> None:
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, 6, 2, risky_share=0.4, weights=WEIGHTS)
    node, heading = int(rng.integers(36)), int(rng.integers(8))
    moves = walk(lattice, rng, node, 7)
    terms = tau_terms(lattice.model(node, heading), node, heading, np.array(moves, np.int64), 2, 1.2, seed)
    chosen = choose_tau(terms, low, high, weight, "paper" if paper else "default")
    candidates = [i for i in range(8) if low <= i <= high] or [min(low, high, 7)]
    score = {
        i: terms.kept[i] if paper else terms.kept[i] + terms.replanned[i] - weight * terms.mismatch[i]
        for i in candidates
    }
    assert chosen in candidates
    assert score[chosen] == max(score.values())
    assert all(score[i] < score[chosen] for i in candidates if i < chosen), "of equal ones the shorter"


@pytest.mark.parametrize("risk", [None, 0.95])
def test_a_prefix_is_cut_before_the_first_impassable_edge(risk: float | None) -> None:
    lattice = random_lattice(3, 6, 1, weights=WEIGHTS)
    for node, k in ((14, 0), (15, 4)):
        if risk is None:
            del lattice.edges[node, k]
        else:
            assert risk > MAX_EDGE_RISK
            lattice.edges[node, k] = Edge(1.0, risk)
    terms = tau_terms(lattice.model(12, 0), 12, 0, np.zeros(5, np.int64), 2, 1.0, 1)
    assert terms.possible == 2
    assert len(terms.kept) == len(terms.replanned) == len(terms.mismatch) == 3
    for at_least in (0, 2, 4):
        assert choose_tau(terms, at_least, 5, 0.0, "paper") <= 2


@given(SEEDS)
def test_each_step_belongs_to_one_side_only(seed: int) -> None:
    """If the old policy is what would be planned anew, every tau is worth the same: nothing is counted twice."""
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, 6, 2, 360.0, weights=WEIGHTS)
    node, heading = int(rng.integers(36)), int(rng.integers(8))
    model = lattice.model(node, heading, horizon=200)
    moves = np.zeros(200, np.int64)
    count = follow_rule(model, node, heading, model.covered.copy(), moves)
    assert count < 200
    terms = tau_terms(model, node, heading, moves[:count], 1, 1.0, seed)
    np.testing.assert_allclose(terms.kept + terms.replanned, terms.replanned[0], rtol=1e-6)


def test_the_literal_rule_keeps_everything_that_pays_and_the_default_does_not() -> None:
    """The paper's rule has no term for what replanning would gain (DESIGN: reconciler)."""
    terms = TauTerms(
        kept=np.array([0.0, 0.1, 0.2, 0.3]),
        replanned=np.array([5.0, 4.0, 3.0, 2.0]),
        mismatch=np.zeros(4),
        possible=3,
    )
    assert choose_tau(terms, 0, 3, 0.3, "paper") == 3
    assert choose_tau(terms, 0, 3, 0.3, "default") == 0
    assert choose_tau(terms, 1, 3, 0.3, "default") == 1, "never less than latency and braking need"


def test_the_regulariser_moves_the_junction_to_where_the_robot_need_not_turn() -> None:
    terms = TauTerms(
        kept=np.array([0.0, 0.5, 1.0]),
        replanned=np.array([2.0, 1.45, 0.9]),
        mismatch=np.array([1.0, 0.0, 0.5]),
        possible=2,
    )
    assert choose_tau(terms, 0, 2, 0.0, "default") == 0
    assert choose_tau(terms, 0, 2, 0.3, "default") == 1


def test_the_ablations_keep_as_little_and_as_much_as_can_be_whatever_it_is_worth() -> None:
    terms = TauTerms(
        kept=np.array([0.0, 3.0, 4.0, 3.5]),
        replanned=np.array([1.0, 9.0, 1.0, 0.0]),
        mismatch=np.zeros(4),
        possible=3,
    )
    assert [choose_tau(terms, 1, 9, 0.3, "always_new"), choose_tau(terms, 0, 9, 0.3, "always_new")] == [1, 0]
    assert [choose_tau(terms, 1, 9, 0.3, "always_old"), choose_tau(terms, 1, 2, 0.3, "always_old")] == [3, 2]
