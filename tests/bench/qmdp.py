"""How fast and how exact QMDP is: `python -m tests.bench.qmdp`.

Random graphs of average degree 6 with terminal frontiers, discounted travel and edges that fail with probability rho.
Milliseconds of our solver over `scipy.sparse.csgraph.dijkstra` on the same graph, and quantecon's methods over ours,
interleaved in one run; the values against a sparse linear solve of the policy found, and its Bellman residual.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from services.gcp import qmdp

GAMMA_PER_M = 0.995
QUANTECON_METHODS = ("value_iteration", "policy_iteration", "modified_policy_iteration")


class Problem(NamedTuple):
    """A graph for our solver, the same for scipy (lengths), and one attempt of each edge for the linear solve."""

    graph: qmdp.GlobalGraph
    lengths: csr_array
    frontiers: NDArray[np.int32]
    distance_m: NDArray[np.float64]
    risk: NDArray[np.float64]
    cost: NDArray[np.float64]


def random_problem(nodes: int, seed: int) -> Problem:
    """Nodes in the plane at one for each 4 m2, edges to the nearest (degree 6 on average), a frontier to 500 nodes."""
    rng = np.random.default_rng([seed, nodes])
    xy = rng.uniform(0.0, 2.0 * np.sqrt(nodes), (nodes, 2))
    near = np.asarray(cKDTree(xy).query(xy, k=6)[1])[:, 1:]
    pairs = np.sort(np.stack([np.repeat(np.arange(nodes), 5), near.ravel()], axis=1), axis=1)
    pairs = np.unique(pairs, axis=0)
    source, target = np.concatenate([pairs, pairs[:, ::-1]]).T
    length = np.linalg.norm(xy[source] - xy[target], axis=1)
    lengths = csr_array(coo_array((length, (source, target)), shape=(nodes, nodes)))
    distance = lengths.data
    risk = np.where(rng.random(distance.size) < 0.3, rng.uniform(0.0, 0.5, distance.size), 0.0)
    cost = 0.01 * distance + 0.2 * risk
    frontiers = np.sort(rng.choice(nodes, max(1, nodes // 500), replace=False)).astype(np.int32)
    terms = qmdp.edge_terms(distance, risk, cost, GAMMA_PER_M)
    graph = qmdp.global_graph(
        lengths.indptr.astype(np.int32), lengths.indices.astype(np.int32), terms, frontiers,
        rng.uniform(20.0, 60.0, frontiers.size),
    )  # fmt: skip
    return Problem(graph, lengths, frontiers, distance, risk, cost)


def worst_error(problem: Problem, found: qmdp.QmdpSolution) -> float:
    """Largest difference to the exact value: the policy's by a sparse linear solve with the self-loops of failures left
    in, and the gain of its best improvement, which bounds what any other policy is worth (both must be about 0)."""
    graph, n = problem.graph, len(found.value)
    acting = np.flatnonzero(found.action >= 0)
    edge = found.action[acting]
    gamma = GAMMA_PER_M ** problem.distance_m[edge]
    rows = np.concatenate([acting, acting])
    columns = np.concatenate([graph.indices[edge], acting])
    weights = np.concatenate([gamma * (1.0 - problem.risk[edge]), gamma * problem.risk[edge]])
    reward = np.where(graph.terminal, graph.gain, 0.0)
    reward[acting] = -problem.cost[edge]
    transition = csr_array(coo_array((weights, (rows, columns)), shape=(n, n)))
    value = spsolve((eye_array(n) - transition).tocsc(), reward)
    source = np.repeat(np.arange(n), np.diff(graph.indptr))
    full = GAMMA_PER_M**problem.distance_m
    q = full * ((1.0 - problem.risk) * value[graph.indices] + problem.risk * value[source]) - problem.cost
    free = ~graph.terminal[source]
    gain = float(np.max(q[free] - value[source[free]], initial=0.0))
    return max(float(np.abs(value - found.value).max()), gain)


def quantecon_solver(problem: Problem, method: str) -> Callable[[], object] | None:
    """The same problem for quantecon (state-action pairs, self-loops eliminated, one discount), or None without it.

    Its discount is one number, so the edges' own go into the transition matrix: what is missing to 1 leads to a state
    of value 0, as the end of the mission does.
    """
    if importlib.util.find_spec("quantecon") is None:
        return None
    markov: Any = importlib.import_module("quantecon.markov")
    graph, n = problem.graph, len(problem.graph.terminal)
    source = np.repeat(np.arange(n), np.diff(graph.indptr))
    keep = ~graph.terminal[source]
    beta = float(graph.discount[keep].max())
    states = np.concatenate([source[keep], np.arange(n + 1)])
    targets = np.concatenate([graph.indices[keep], np.full(n + 1, n)])
    inside = np.concatenate([graph.discount[keep] / beta, np.ones(n + 1)])
    rewards = np.concatenate([-graph.cost[keep], np.where(graph.terminal, graph.gain, 0.0), [0.0]])
    order = np.lexsort((targets, states))
    states, targets, inside, rewards = states[order], targets[order], inside[order], rewards[order]
    pairs = np.arange(len(states))
    rows, columns = np.concatenate([pairs, pairs]), np.concatenate([targets, np.full(len(pairs), n)])
    matrix = csr_array(
        coo_array((np.concatenate([inside, 1.0 - inside]), (rows, columns)), (len(pairs), n + 1))
    )
    actions = pairs - np.searchsorted(states, states)
    from scipy.sparse import csr_matrix

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ddp = markov.DiscreteDP(rewards, csr_matrix(matrix), beta, states, actions)
    return lambda: ddp.solve(method=method, epsilon=1e-6, max_iter=100_000)


def best_of(rounds: int, runs: dict[str, Callable[[], object]]) -> dict[str, NDArray[np.float64]]:
    """Milliseconds of processor time of each, interleaved, (rounds,); one round before to warm up."""
    found: dict[str, list[float]] = {name: [] for name in runs}
    for k in range(rounds + 1):
        for name, run in runs.items():
            began = time.process_time()
            run()
            if k:
                found[name].append(1e3 * (time.process_time() - began))
    return {name: np.array(times) for name, times in found.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=[10_000, 100_000])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--peer-rounds", type=int, default=2, help="of quantecon, which is slower; 0: none")
    options = parser.parse_args()
    for nodes in options.nodes:
        problem = random_problem(nodes, 1)
        found = qmdp.solve(problem.graph)
        times = best_of(
            options.rounds,
            {
                "qmdp": lambda problem=problem: qmdp.solve(problem.graph),  # type: ignore[misc]
                "dijkstra": lambda problem=problem: dijkstra(
                    problem.lengths, indices=problem.frontiers, min_only=True
                ),  # type: ignore[misc]
            },
        )
        ratio = times["qmdp"] / times["dijkstra"]
        ours = float(np.median(times["qmdp"]))
        print(
            f"{nodes} nodes, {problem.lengths.nnz / nodes:.1f} edges a node, {len(problem.frontiers)} frontiers: "
            f"QMDP {ours:.2f} ms, scipy dijkstra {np.median(times['dijkstra']):.2f} ms, ratio {np.median(ratio):.2f} "
            f"({ratio.min():.2f} to {ratio.max():.2f}); policy improvements {found.iterations}, "
            f"worst error {worst_error(problem, found):.1e}"
        )
        if options.peer_rounds:
            _peer(problem, found, ours, options.peer_rounds)


def _peer(problem: Problem, found: qmdp.QmdpSolution, ours_ms: float, rounds: int) -> None:
    for method in QUANTECON_METHODS:
        solver = quantecon_solver(problem, method)
        if solver is None:
            print("  quantecon is not installed (pip install quantecon)")
            return
        times = best_of(rounds, {method: solver, "qmdp": lambda: qmdp.solve(problem.graph)})
        result: Any = solver()
        error = float(np.abs(result.v[:-1] - found.value).max())
        ratio = float(np.median(times[method]) / np.median(times["qmdp"]))
        print(
            f"  quantecon {method}: {np.median(times[method]):.0f} ms, {ratio:.0f} times ours; differs by {error:.1e}"
        )


if __name__ == "__main__":
    main()
