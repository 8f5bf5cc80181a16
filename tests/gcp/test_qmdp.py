"""QMDP against an independent exact solver: policy iteration with a linear solve, failures kept as self-loops."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.gcp import qmdp
from tests.gcp import frontier_values as alternatives


class Case(NamedTuple):
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    source: NDArray[np.int32]
    distance_m: NDArray[np.float64]
    risk: NDArray[np.float64]
    cost: NDArray[np.float64]
    gamma_per_m: float
    frontiers: NDArray[np.int32]
    gains: NDArray[np.float64]

    @property
    def nodes(self) -> int:
        return len(self.indptr) - 1

    def graph(self) -> qmdp.GlobalGraph:
        terms = qmdp.edge_terms(self.distance_m, self.risk, self.cost, self.gamma_per_m)
        return qmdp.global_graph(self.indptr, self.indices, terms, self.frontiers, self.gains)


def _case(
    edges: list[tuple[int, int, float, float, float]],
    nodes: int,
    gamma_per_m: float,
    frontiers: dict[int, float],
) -> Case:
    """Edges (from, to, distance, risk, cost) in any order."""
    edges = sorted(edges)
    source = np.array([e[0] for e in edges], np.int32)
    indptr = np.searchsorted(source, np.arange(nodes + 1)).astype(np.int32)
    columns = [np.array([e[k] for e in edges], np.float64) for k in (2, 3, 4)]
    indices = np.array([e[1] for e in edges], np.int32)
    gains = np.array(list(frontiers.values()), np.float64)
    ids = np.array(list(frontiers), np.int32)
    return Case(indptr, indices, source, columns[0], columns[1], columns[2], gamma_per_m, ids, gains)


def _random_case(seed: int) -> Case:
    """Random graphs: sparse ones fall apart, costs from nothing to far above the gains, risks up to nearly 1."""
    rng = np.random.default_rng(seed)
    nodes = int(rng.integers(2, 28))
    density = rng.choice([0.06, 0.15, 0.4])
    cost_scale = rng.choice([0.05, 1.0, 8.0])
    risk_kind = rng.choice(["none", "some", "high"])
    two_way = rng.random() < 0.6
    edges = []
    for a, b in itertools.permutations(range(nodes), 2):
        if rng.random() >= density or (two_way and a > b):
            continue
        distance = float(rng.uniform(0.2, 6.0))
        low, high = {"none": (0.0, 0.0), "some": (0.0, 0.6), "high": (0.9, 0.9999)}[str(risk_kind)]
        risk = float(rng.uniform(low, high))
        cost = float(cost_scale * distance * rng.uniform(0.1, 1.0))
        edges.append((a, b, distance, risk, cost))
        if two_way:
            edges.append((b, a, distance, risk, cost))
    count = int(rng.integers(0, max(2, nodes // 4)))
    ids = rng.choice(nodes, count, replace=False)
    gains = {int(k): float(rng.uniform(0.0, 30.0)) for k in ids}
    return _case(edges, nodes, float(rng.choice([0.8, 0.97, 0.999, 1.0])), gains)


def _exact(case: Case, allow_stay: bool) -> NDArray[np.float64]:
    """Howard's policy iteration on the original process: V(i) = -c + gamma ((1 - rho) V(j) + rho V(i))."""
    gain = dict(zip(case.frontiers.tolist(), case.gains.tolist(), strict=True))
    leads = set(gain)
    policy: dict[int, int] = {}
    for _ in range(case.nodes):  # a first policy that reaches a frontier wherever there is a way
        for edge, (a, b) in enumerate(zip(case.source.tolist(), case.indices.tolist(), strict=True)):
            if b in leads and a not in leads:
                leads.add(a)
                policy[a] = edge
    if allow_stay:
        policy = {}
    gamma = case.gamma_per_m**case.distance_m
    for _ in range(200):
        matrix, right = np.eye(case.nodes), np.zeros(case.nodes)
        for node, value in gain.items():
            right[node] = value
        for node, edge in policy.items():
            matrix[node, node] = 1.0 - gamma[edge] * case.risk[edge]
            matrix[node, case.indices[edge]] -= gamma[edge] * (1.0 - case.risk[edge])
            right[node] = -case.cost[edge]
        value = np.linalg.solve(matrix, right)
        better = dict(policy)
        best = value.copy()
        for edge, (a, b) in enumerate(zip(case.source.tolist(), case.indices.tolist(), strict=True)):
            if a in gain or (not allow_stay and b not in leads):
                continue
            retry = 1.0 - gamma[edge] * case.risk[edge]
            q = (gamma[edge] * (1.0 - case.risk[edge]) * value[b] - case.cost[edge]) / retry
            if q > best[a] + 1e-11 * (1.0 + abs(best[a])):
                best[a], better[a] = q, edge
        if better == policy:
            return np.asarray(value)
        policy = better
    raise AssertionError("the reference did not converge")


@given(seed=st.integers(0, 1_000_000), allow_stay=st.booleans())
def test_value_equals_policy_iteration_with_a_linear_solve(seed: int, allow_stay: bool) -> None:
    case = _random_case(seed)
    expected = _exact(case, allow_stay)
    solution = qmdp.solve(case.graph(), allow_stay)
    np.testing.assert_allclose(solution.value, expected, rtol=1e-6, atol=1e-6)
    assert solution.residual <= 1e-9 * (1 + np.abs(expected).max())


def test_the_random_graphs_hold_what_the_proof_must_cover() -> None:
    """Negative values, improvements beyond label-setting, unreachable nodes, no discount: all among the cases."""
    cases = [_random_case(seed) for seed in range(150)]
    solutions = [qmdp.solve(case.graph(), allow_stay=False) for case in cases]
    assert sum(bool((s.value < -1e-3).any()) for s in solutions) > 20
    assert sum(s.iterations > 0 for s in solutions) > 10
    assert sum(bool((~s.reaches_frontier).any()) for s in solutions) > 10
    assert sum(case.gamma_per_m == 1.0 for case in cases) > 10
    for case, solution in zip(cases, solutions, strict=True):
        np.testing.assert_allclose(solution.value, _exact(case, False), rtol=1e-6, atol=1e-6)


@given(seed=st.integers(0, 1_000_000))
def test_policy_earns_its_value(seed: int) -> None:
    case = _random_case(seed)
    graph = case.graph()
    solution = qmdp.solve(graph)
    for node in range(case.nodes):
        nodes, edges = qmdp.follow_policy(graph, solution.action, node)
        value = graph.gain[nodes[-1]] if graph.terminal[nodes[-1]] else 0.0
        for edge in edges[::-1]:
            value = graph.discount[edge] * value - graph.cost[edge]
        assert value == pytest.approx(solution.value[node], abs=1e-9)
        q = qmdp.edge_q(graph, solution.value, node)
        if not graph.terminal[node]:
            assert max(0.0, q.max(initial=0.0)) == pytest.approx(solution.value[node], abs=1e-9)


def test_failures_by_hand() -> None:
    case = _case([(0, 1, 1.0, 0.5, 1.0)], 2, 0.9, {1: 10.0})
    # V = -1 + 0.9 (0.5 * 10 + 0.5 V)
    assert qmdp.solve(case.graph()).value[0] == pytest.approx(3.5 / 0.55)


def test_without_staying_a_cheap_loop_for_ever_can_beat_a_dear_way() -> None:
    loop = [(0, 1, 1.0, 0.0, 0.1), (1, 0, 1.0, 0.0, 0.1), (1, 2, 1.0, 0.0, 50.0)]
    solution = qmdp.solve(_case(loop, 3, 0.9, {2: 1.0}).graph(), allow_stay=False)
    assert solution.value[:2] == pytest.approx([-1.0, -1.0])
    undiscounted = qmdp.solve(_case(loop, 3, 1.0, {2: 1.0}).graph(), allow_stay=False)
    assert undiscounted.value[:2] == pytest.approx([-49.1, -49.0])


def test_no_discount_and_no_cost_still_lead_to_the_frontier() -> None:
    edges = [(0, 1, 0.0, 0.0, 0.0), (1, 0, 0.0, 0.0, 0.0), (1, 2, 1.0, 0.0, 0.0)]
    graph = _case(edges, 3, 1.0, {2: 4.0}).graph()
    for allow_stay in (True, False):
        solution = qmdp.solve(graph, allow_stay)
        assert solution.value.tolist() == [4.0, 4.0, 4.0]
        assert qmdp.follow_policy(graph, solution.action, 0)[0].tolist() == [0, 1, 2]


def test_nodes_without_a_frontier_stay_and_are_worth_nothing() -> None:
    edges = [(0, 1, 1.0, 0.0, 0.5), (1, 0, 1.0, 0.0, 0.5), (2, 3, 1.0, 1.0, 0.1), (2, 0, 1.0, 0.0, 0.1)]
    for allow_stay in (True, False):
        solution = qmdp.solve(_case(edges, 4, 0.95, {3: 9.0}).graph(), allow_stay)
        assert solution.value[:3].tolist() == [0.0, 0.0, 0.0]
        assert solution.action.tolist() == [qmdp.STAY] * 4
        assert solution.reaches_frontier.tolist() == [False, False, False, True]


def test_empty_graph() -> None:
    solution = qmdp.solve(_case([], 0, 0.9, {}).graph())
    assert len(solution.value) == 0 and solution.residual == 0.0


@pytest.mark.parametrize(
    ("distance_m", "risk", "cost", "gamma"),
    [(-1.0, 0.1, 1.0, 0.9), (1.0, 1.1, 1.0, 0.9), (1.0, 0.1, -1.0, 0.9), (1.0, np.nan, 1.0, 0.9),
     (1.0, 0.1, 1.0, 0.0), (1.0, 0.1, 1.0, 1.01)],
)  # fmt: skip
def test_bad_edges_are_refused(distance_m: float, risk: float, cost: float, gamma: float) -> None:
    with pytest.raises(ValueError, match="must lie in"):
        qmdp.edge_terms([distance_m], [risk], [cost], gamma)


def test_bad_graphs_are_refused() -> None:
    terms = qmdp.edge_terms([1.0], [0.0], [1.0], 0.9)
    indptr, indices = np.array([0, 1, 1], np.int32), np.array([1], np.int32)
    frontier, gain = np.array([1], np.int32), np.array([1.0])
    with pytest.raises(ValueError, match="row pointer"):
        qmdp.global_graph(np.array([0, 2, 1], np.int32), indices, terms, frontier, gain)
    with pytest.raises(ValueError, match="indices name a node"):
        qmdp.global_graph(indptr, np.array([2], np.int32), terms, frontier, gain)
    with pytest.raises(ValueError, match="frontiers name a node"):
        qmdp.global_graph(indptr, indices, terms, np.array([2], np.int32), gain)
    with pytest.raises(ValueError, match="finite"):
        qmdp.global_graph(indptr, indices, terms, frontier, np.array([np.inf]))
    with pytest.raises(ValueError, match="length"):
        qmdp.global_graph(indptr, indices, terms, frontier, np.array([1.0, 2.0]))


def test_relocation_averages_over_the_pose_belief() -> None:
    nodes = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 3.0], [50.0, 0.0, 0.0]])
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    distance = qmdp.straight_distances_m(poses, nodes)
    assert distance[:, 1] == pytest.approx([5.0, np.sqrt(16 + 9 + 9)])
    distance[1, 2] = np.inf
    terms = qmdp.edge_terms(distance, 0.1 * np.ones((2, 3)), 0.2 * distance, 0.95)
    value = np.array([2.0, 5.0, 90.0])
    q = qmdp.relocation_q(value, np.array([3.0, 1.0]), terms, blocked_value=-1.0)
    for j in range(3):
        expected = 0.0
        for weight, p in ((0.75, 0), (0.25, 1)):
            if np.isinf(distance[p, j]):
                expected -= weight
                continue
            gamma = 0.95 ** distance[p, j]
            # Solve Q = -c + gamma (0.9 V + 0.1 Q) for the pose that may have to try again.
            expected += weight * (-0.2 * distance[p, j] + gamma * 0.9 * value[j]) / (1 - gamma * 0.1)
        assert q[j] == pytest.approx(expected)
    with pytest.raises(ValueError, match="weights"):
        qmdp.relocation_q(value, np.zeros(2), terms)


def _best_simple_path(case: Case, graph: qmdp.GlobalGraph, start: int, goal: int) -> float:
    """Best value over all simple paths that pass no other frontier, by exhaustive search."""

    def visit(node: int, seen: frozenset[int]) -> float:
        if node == goal:
            return float(graph.gain[goal])
        if graph.terminal[node] and node != start:
            return -np.inf
        best = -np.inf
        for edge in range(graph.indptr[node], graph.indptr[node + 1]):
            other = int(graph.indices[edge])
            if other not in seen:
                rest = visit(other, seen | {other})
                best = max(best, float(graph.discount[edge] * rest - graph.cost[edge]))
        return best

    return visit(start, frozenset({start}))


@given(seed=st.integers(0, 1_000_000))
def test_frontier_values_equal_the_best_of_all_paths(seed: int) -> None:
    rng = np.random.default_rng(seed)
    nodes = 8
    edges = []
    for a, b in itertools.combinations(range(nodes), 2):
        if rng.random() < 0.4:
            d, risk = float(rng.uniform(0.2, 6)), float(rng.uniform(0, 0.5))
            edges += [(a, b, d, risk, 0.2 * d), (b, a, d, risk, 0.2 * d)]
    gains = {5: float(rng.uniform(0, 20)), 6: float(rng.uniform(0, 20)), 7: 3.0}
    case = _case(edges, nodes, float(rng.choice([0.9, 1.0])), gains)
    graph = case.graph()
    result = alternatives.frontier_values(graph, case.distance_m, case.risk, 0, top=3)
    solution = qmdp.solve(graph)
    assert sorted(result.node.tolist()) == [5, 6, 7]
    assert (np.diff(result.value[np.isfinite(result.value)]) <= 0).all()
    assert max(0.0, result.value[0]) == pytest.approx(solution.value[0], abs=1e-9)
    for node, value, exact, distance, risk in zip(
        result.node, result.value, result.exact, result.distance_m, result.risk, strict=True
    ):
        best = _best_simple_path(case, graph, 0, int(node))
        if exact:
            assert value == pytest.approx(best, abs=1e-9)
        else:
            assert value <= best + 1e-9 and best <= 1e-9
        assert np.isfinite(value) == np.isfinite(best) == np.isfinite(distance)
        assert 0.0 <= risk <= 1.0


def test_frontier_values_give_the_reasons_along_the_path() -> None:
    edges = [(0, 1, 2.0, 0.1, 0.5), (1, 2, 3.0, 0.2, 0.5), (0, 3, 1.0, 0.0, 0.1)]
    case = _case(edges, 5, 0.99, {2: 10.0, 3: 1.0, 4: 99.0})
    result = alternatives.frontier_values(case.graph(), case.distance_m, case.risk, 0)
    assert result.node.tolist() == [2, 3, 4]
    assert result.distance_m.tolist() == [5.0, 1.0, np.inf]
    assert result.risk == pytest.approx([1 - 0.9 * 0.8, 0.0, 1.0])
    assert result.gain.tolist() == [10.0, 1.0, 99.0]
    assert result.value[2] == -np.inf
    at_frontier = alternatives.frontier_values(case.graph(), case.distance_m, case.risk, 3)
    assert at_frontier.node[0] == 3 and at_frontier.value[0] == 1.0 and at_frontier.distance_m[0] == 0.0
