"""The POMCP solver against exact solutions, and the promises of its interface one by one."""

from __future__ import annotations

import subprocess
import sys
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from planning.kernels import njit
from planning.pomcp import NONE, PolicyTree, Pomcp, SearchSettings, Tree, register_model
from planning.pomcp_tree import find_child, select_branch
from tests.planning.exact_pomdp import LatticeWorld, tiger_value
from tests.planning.pomdp_models import (
    LATTICE,
    Table,
    Tiger,
    lattice_model,
    search_lattice,
    search_table,
    search_tiger,
    table_model,
)

SEEDS = (0, 1, 2)
BUDGETS = (2**12, 2**16, 2**20)
LATTICE_RULES = (LATTICE, 0.5, 0.2, 0.95)
LATTICE_HORIZON = 8


def lattice_world() -> LatticeWorld:
    return LatticeWorld(*LATTICE_RULES, LATTICE_HORIZON)


def lattice_solver() -> Pomcp:
    return Pomcp(
        state_size=3,
        max_actions=4,
        max_nodes=2**17,
        max_depth=LATTICE_HORIZON,
        exploration=0.5,
        return_range=10.0,
    )


def tiger_solver(horizon: int = 6, max_nodes: int = 2**17) -> Pomcp:
    return Pomcp(
        state_size=1,
        max_actions=3,
        max_nodes=max_nodes,
        max_depth=horizon,
        exploration=0.25,
        return_range=110.0,
    )


def table_solver(actions: int, max_depth: int, max_nodes: int = 4096) -> Pomcp:
    return Pomcp(state_size=1, max_actions=actions, max_nodes=max_nodes, max_depth=max_depth)


# --- convergence ---------------------------------------------------------------------------------------------


def test_tiger_exact_value_of_short_horizons() -> None:
    """The yardstick itself: one step is best spent listening; with three, opening pays after two equal sounds."""
    assert tiger_value(1) == -1.0
    assert tiger_value(2) == pytest.approx(-1.95)
    agree = 0.85**2 + 0.15**2
    after_agreement = 10.0 - 110.0 * 0.15**2 / agree
    by_hand = -1.0 - 0.95 + 0.95**2 * (agree * after_agreement + (1.0 - agree) * -1.0)
    assert tiger_value(3) == pytest.approx(by_hand)


def test_tiger_root_value_converges() -> None:
    """max_a Q at the root approaches the exact value; each budget 16 times the last shrinks the error."""
    exact, solver = tiger_value(6), tiger_solver()
    errors = []
    for simulations in BUDGETS:
        values = []
        for seed in SEEDS:
            solver.search(search_tiger, Tiger(), seed=seed, simulations=simulations)
            values.append(solver.root().max_value)
        errors.append(float(np.mean(np.abs(np.array(values) - exact))))
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.6 * errors[1]
    assert errors[2] < 1.5  # of returns that range over more than 110


def test_lattice_yardsticks() -> None:
    """Nothing hidden: both planners of the yardstick agree. Hidden: looking before choosing is worth a lot."""
    for blocked_probability in (0.0, 1.0):
        world = LatticeWorld(LATTICE, blocked_probability, *LATTICE_RULES[2:], LATTICE_HORIZON)
        assert world.closed_loop_value() == pytest.approx(world.open_loop_value())
    assert lattice_world().closed_loop_value() > lattice_world().open_loop_value() + 2.0


def test_lattice_root_value_converges_and_beats_every_open_loop_plan() -> None:
    world, model, solver = lattice_world(), lattice_model(*LATTICE_RULES), lattice_solver()
    exact, open_loop = world.closed_loop_value(), world.open_loop_value()
    errors: list[float] = []
    last: list[float] = []
    for simulations in BUDGETS:
        last = []
        for seed in SEEDS:
            solver.search(search_lattice, model, seed=seed, simulations=simulations)
            last.append(solver.root().max_value)
        errors.append(float(np.mean(np.abs(np.array(last) - exact))))
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.5 * errors[1]
    assert errors[2] < 0.03 * exact
    assert min(last) > open_loop + 1.5


def follow_policy(policy: PolicyTree, world: LatticeWorld, blocked: bool) -> float:
    """Discounted return of the policy in one world of the yardstick, to the policy's end."""
    node, cell, covered, weight, total = 0, world.start, frozenset[tuple[int, int]](), 1.0, 0.0
    while policy.node_action[node] != NONE:
        cell, covered, reward = world.move(cell, covered, int(policy.node_action[node]), blocked)
        total += weight * reward
        weight *= world.discount
        seen = 1 + int(blocked) if world.sees_door(cell) else 0
        branches = range(policy.child_start[node], policy.child_start[node + 1])
        node = next(int(policy.child_node[k]) for k in branches if policy.child_observation[k] == seen)
    return total


def test_lattice_policy_earns_the_exact_value_when_it_is_followed() -> None:
    """The extracted policy, walked in the yardstick's worlds: it looks at the door, then branches, optimally."""
    world, solver = lattice_world(), lattice_solver()
    solver.search(search_lattice, lattice_model(*LATTICE_RULES), seed=0, simulations=2**18)
    policy = solver.policy(min_visits=64)
    earned = np.mean([follow_policy(policy, world, blocked) for blocked in (False, True)])
    assert earned == pytest.approx(world.closed_loop_value(), rel=0.01)
    assert earned > world.open_loop_value() + 2.0


def test_lattice_with_the_logarithmic_bonus_also_learns() -> None:
    """UCB1 is there as well: on a short horizon, where the logarithm is quick enough, it finds the exact value."""
    world = LatticeWorld(*LATTICE_RULES, 3)
    solver = Pomcp(
        state_size=3,
        max_actions=4,
        max_nodes=2**12,
        max_depth=3,
        exploration=1.0,
        return_range=4.0,
        logarithmic=True,
    )
    solver.search(search_lattice, lattice_model(*LATTICE_RULES), seed=0, simulations=2**17)
    assert solver.root().max_value == pytest.approx(world.closed_loop_value(), rel=0.03)


# --- belief, observations, discount, leaves ------------------------------------------------------------------


def test_root_belief_is_the_particles() -> None:
    """Surely left: open right, never a mistake. The same search with both particles listens."""
    solver = tiger_solver(horizon=1)
    solver.search(search_tiger, Tiger(particles=np.array([0])), seed=0, simulations=4096)
    assert solver.best_action() == 2
    assert solver.root().values.tolist() == [-1.0, -100.0, 10.0]
    solver.search(search_tiger, Tiger(), seed=0, simulations=4096)
    assert solver.best_action() == 0


def signal_model(observations: NDArray[np.int64]) -> Table:
    """K hidden states, equally likely: action 0 shows which (for nothing), action 1 + k pays 1 in state k, ends."""
    kinds = observations.size
    model = table_model(states=kinds, actions=1 + kinds)
    model.observation[:, 0] = observations
    model.reward[np.arange(kinds), 1 + np.arange(kinds)] = 1.0
    model.terminal[:, 1:] = True
    return model._replace(particles=np.arange(kinds))


def test_observations_branch_and_the_policy_answers_each() -> None:
    observations = np.array([7, 2**31 - 1, 0, 1000], dtype=np.int64)
    solver = table_solver(actions=5, max_depth=2)
    solver.search(search_table, signal_model(observations), seed=3, simulations=20000)
    assert solver.best_action() == 0
    assert solver.root().max_value == pytest.approx(1.0, abs=0.05)  # blind, the best is 1 / 4

    policy = solver.policy(min_visits=100)
    branches = slice(policy.child_start[0], policy.child_start[1])
    assert policy.child_observation[branches].tolist() == [0, 7, 1000, 2**31 - 1]
    assert policy.node_action[policy.child_node[branches]].tolist() == [3, 1, 4, 2]
    probability = policy.node_visits[policy.child_node[branches]] / policy.node_action_visits[0]
    np.testing.assert_allclose(probability, 0.25, atol=0.02)


def chain_model(rewards: list[float], discounts: list[float], leaf_value: float, *, terminal: bool) -> Table:
    """One action; step k pays rewards[k] and discounts the rest by discounts[k]; then a leaf, or the end."""
    steps = len(rewards)
    model = table_model(states=steps + 1, actions=1)
    model.next_state[:, 0] = np.minimum(np.arange(steps + 1) + 1, steps)
    model.reward[:steps, 0], model.discount[:steps, 0] = rewards, discounts
    model.leaf_value[steps] = leaf_value
    model.terminal[steps - 1, 0] = terminal
    return model


CHAIN_REWARDS, CHAIN_DISCOUNTS = [1.0, -2.0, 5.0, 3.0], [0.9, 0.5, 0.25, 0.8]
CHAIN_VALUE = 1.0 + 0.9 * (-2.0 + 0.5 * (5.0 + 0.25 * 3.0))
CHAIN_WEIGHT = 0.9 * 0.5 * 0.25 * 0.8


@pytest.mark.parametrize("simulations", [1, 2, 5, 100])
def test_every_step_has_its_own_discount(simulations: int) -> None:
    solver = table_solver(actions=1, max_depth=4)
    model = chain_model(CHAIN_REWARDS, CHAIN_DISCOUNTS, 0.0, terminal=True)
    solver.search(search_table, model, seed=0, simulations=simulations)
    assert solver.root().max_value == pytest.approx(CHAIN_VALUE)
    assert solver.root().mean_value == pytest.approx(CHAIN_VALUE)


@pytest.mark.parametrize("simulations", [1, 2, 5, 100])
def test_leaf_value_is_paid_at_the_horizon_and_not_after_a_terminal_step(simulations: int) -> None:
    solver = table_solver(actions=1, max_depth=4)
    for terminal, expected in ((False, CHAIN_VALUE + CHAIN_WEIGHT * 40.0), (True, CHAIN_VALUE)):
        model = chain_model(CHAIN_REWARDS, CHAIN_DISCOUNTS, 40.0, terminal=terminal)
        report = solver.search(search_table, model, seed=0, simulations=simulations)
        assert solver.root().max_value == pytest.approx(expected)
        assert report.deepest == min(simulations, 4)


def test_history_without_actions_is_a_leaf() -> None:
    model = chain_model(CHAIN_REWARDS, CHAIN_DISCOUNTS, 40.0, terminal=False)
    model.action_count[2] = 0
    model.leaf_value[2] = -6.0
    solver = table_solver(actions=1, max_depth=4)
    report = solver.search(search_table, model, seed=0, simulations=200)
    # The first visits still roll out beyond it: the rollout is the model's own.
    assert solver.tree.node_value[2] == pytest.approx(
        (5.75 + CHAIN_WEIGHT / 0.45 * 40.0 - 6.0 * 198) / 199, rel=0.02
    )
    assert report.deepest == 2 and report.refused == 0


def test_root_without_actions_gives_its_leaf_value_and_no_action() -> None:
    model = table_model(states=1, actions=1)
    model.action_count[0] = 0
    model.leaf_value[0] = 2.5
    solver = table_solver(actions=1, max_depth=4)
    solver.search(search_table, model, seed=0, simulations=10)
    root, policy = solver.root(), solver.policy(min_visits=1)
    assert (root.best_action, root.mean_value, root.actions.size) == (NONE, 2.5, 0)
    assert policy.node_action.tolist() == [NONE] and policy.node_value.tolist() == [2.5]


# --- selection, prior ------------------------------------------------------------------------------------------


def bandit_model(means: list[float]) -> Table:
    model = table_model(states=1, actions=len(means))
    model.reward[0] = means
    model.terminal[:] = True
    return model


def test_untried_actions_come_first_in_the_order_of_the_model() -> None:
    solver = table_solver(actions=4, max_depth=1)
    for simulations in range(1, 5):
        solver.search(search_table, bandit_model([0.0, 5.0, 1.0, 2.0]), seed=0, simulations=simulations)
        assert solver.root().visits.tolist() == [1] * simulations + [0] * (4 - simulations)
    solver.search(search_table, bandit_model([0.0, 5.0, 1.0, 2.0]), seed=0, simulations=1000)
    assert solver.best_action() == 1
    assert solver.root().values.tolist() == [0.0, 5.0, 1.0, 2.0]
    assert solver.root().visits.sum() == 1000


def test_selection_is_mean_plus_bonus() -> None:
    solver = table_solver(actions=3, max_depth=1)
    solver.search(search_table, bandit_model([0.0, 0.0, 0.0]), seed=0, simulations=3)
    tree = solver.tree
    tree.branch_visits[:3], tree.branch_value[:3] = (100, 4, 12), (1.0, 0.3, 0.5)
    for logarithmic, growth in ((True, np.log(116.0) ** 0.5), (False, 116.0**0.25)):
        for constant in (0.0, 0.1, 0.5, 1.0, 5.0):
            scores = np.array([1.0, 0.3, 0.5]) + constant * growth / np.sqrt([100, 4, 12])
            assert select_branch(tree, 0, constant, logarithmic) == int(scores.argmax())


def test_prior_counts_as_visits_and_fades() -> None:
    model = bandit_model([0.0, 1.0])
    model.prior_visits[0], model.prior_values[0] = (50, 0), (2.0, 9.0)
    solver = table_solver(actions=2, max_depth=1)
    solver.search(search_table, model, seed=0, simulations=1)
    assert solver.root().visits.tolist() == [
        50,
        1,
    ]  # tried first is what has no prior; its value counts for nothing
    assert solver.root().values.tolist() == [2.0, 1.0]
    assert solver.best_action() == 0
    solver.search(search_table, model, seed=0, simulations=5000)
    assert solver.root().visits.sum() == 5050
    assert solver.best_action() == 1


def test_an_action_seen_too_rarely_is_not_best() -> None:
    solver = table_solver(actions=2, max_depth=1)
    solver.search(search_table, bandit_model([1.0, 0.0]), seed=0, simulations=2)
    solver.tree.branch_visits[:2], solver.tree.branch_value[:2] = (100, 9), (1.0, 50.0)
    assert solver.best_action() == 0 and solver.root().max_value == 50.0
    assert solver.best_action(min_visit_share=0.05) == 1


# --- budget, determinism, capacity -----------------------------------------------------------------------------


def tree_bytes(solver: Pomcp) -> list[bytes]:
    return [array.tobytes() for array in solver.tree]


def test_same_seed_and_simulations_give_the_same_tree_whatever_the_batches() -> None:
    trees = []
    for batch, seed in ((256, 5), (1000, 5), (7, 5), (256, 6)):
        solver = tiger_solver()
        solver.search(
            search_tiger, Tiger(), seed=seed, simulations=3000, batch=batch, should_stop=lambda: False
        )
        trees.append(tree_bytes(solver))
    assert trees[0] == trees[1] == trees[2]
    assert trees[0] != trees[3]


def test_a_used_solver_searches_as_a_new_one_does() -> None:
    used, new = tiger_solver(), tiger_solver()
    used.search(search_tiger, Tiger(), seed=1, simulations=5000)
    for solver in (used, new):
        solver.search(search_tiger, Tiger(), seed=2, simulations=500)
    for ours, theirs in zip(used.root(), new.root(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for ours, theirs in zip(used.policy(1), new.policy(1), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_resume_goes_on_where_the_search_ended() -> None:
    whole, halves = tiger_solver(), tiger_solver()
    whole.search(search_tiger, Tiger(), seed=5, simulations=2000)
    halves.search(search_tiger, Tiger(), seed=5, simulations=1200)
    report = halves.search(search_tiger, Tiger(), seed=99, simulations=800, resume=True)
    assert report.simulations == 800 and halves.root().simulations == 2000
    assert tree_bytes(whole) == tree_bytes(halves)


@pytest.mark.parametrize(
    ("calls", "simulations", "done", "stopped_by"),
    [(3, 10000, 300, "caller"), (1, 10000, 100, "caller"), (99, 250, 250, "simulations")],
)
def test_search_stops_when_the_caller_says_so(
    calls: int, simulations: int, done: int, stopped_by: str
) -> None:
    asked = count(1)
    solver = tiger_solver()
    report = solver.search(
        search_tiger,
        Tiger(),
        seed=0,
        simulations=simulations,
        batch=100,
        should_stop=lambda: next(asked) >= calls,
    )
    assert (report.simulations, report.stopped_by) == (done, stopped_by)
    assert solver.root().simulations == done == solver.tree.node_visits[0]


@pytest.mark.parametrize(("max_nodes", "max_branches"), [(1, 300), (50, 3000), (5000, 30), (5000, 1)])
def test_a_full_tree_stops_growing_and_goes_on(max_nodes: int, max_branches: int) -> None:
    solver = Pomcp(state_size=1, max_actions=3, max_nodes=max_nodes, max_branches=max_branches, max_depth=6)
    report = solver.search(search_tiger, Tiger(), seed=0, simulations=20000)
    assert report.simulations == 20000 == solver.tree.node_visits[0]
    assert report.nodes <= max_nodes and report.branches <= max_branches
    assert report.nodes == max_nodes or report.branches > max_branches - 3
    assert report.refused > 10000
    assert np.isfinite(solver.root().mean_value)
    if max_branches >= 3:
        assert solver.root().visits.sum() == 20000 and solver.best_action() == 0


def test_tree_is_consistent() -> None:
    """Counts add up: an action's visits are those of its observations, a node's those of its actions and one more."""
    solver = tiger_solver()
    report = solver.search(search_tiger, Tiger(), seed=4, simulations=30000)
    tree = solver.tree
    assert report.refused == 0 and report.branches % 3 == 0
    for node in range(report.nodes):
        first = tree.node_first_branch[node]
        if first == NONE:
            continue
        branches = range(first, first + tree.node_branches[node])
        assert sum(tree.branch_visits[branches]) + (node != 0) == tree.node_visits[node]
        for branch in branches:
            children = [find_child(tree, branch, observation) for observation in (0, 1)]
            assert sum(int(tree.node_visits[c]) for c in children if c != NONE) == tree.branch_visits[branch]


def test_policy_keeps_histories_with_enough_visits() -> None:
    solver = tiger_solver()
    solver.search(search_tiger, Tiger(), seed=4, simulations=30000)
    sizes = []
    for min_visits in (1, 50, 1000, 10**6):
        policy = solver.policy(min_visits)
        size = policy.node_action.size
        sizes.append(size)
        assert np.all(policy.node_visits[1:] >= min_visits)
        assert policy.child_start[0] == 0 and policy.child_start[-1] == size - 1 == policy.child_node.size
        np.testing.assert_array_equal(policy.child_node, np.arange(1, size))
        for node in range(size):
            seen = policy.child_observation[policy.child_start[node] : policy.child_start[node + 1]]
            assert np.all(np.diff(seen) > 0)
        assert policy.node_value[0] == solver.root().best_value
    assert sizes == sorted(sizes, reverse=True) and sizes[0] > sizes[1] > sizes[2] > sizes[3] == 1


# --- refusals ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("state_size", 0),
        ("max_actions", 0),
        ("max_nodes", 0),
        ("max_nodes", 2**31),
        ("max_depth", 0),
        ("max_branches", -1),
        ("exploration", -1.0),
        ("exploration", float("nan")),
        ("return_range", float("inf")),
    ],
)
def test_bad_sizes_are_refused_by_name(name: str, bad: float) -> None:
    good = {"state_size": 1, "max_actions": 3, "max_nodes": 10, "max_depth": 2}
    with pytest.raises(ValueError, match=name):
        Pomcp(**{**good, name: bad})  # type: ignore[arg-type]


def test_bad_budgets_are_refused() -> None:
    solver = tiger_solver()
    for simulations, batch in ((0, 1), (1, 0)):
        with pytest.raises(ValueError, match="at least 1"):
            solver.search(search_tiger, Tiger(), seed=0, simulations=simulations, batch=batch)
    solver.search(search_tiger, Tiger(), seed=0, simulations=10)
    with pytest.raises(ValueError, match="min_visits"):
        solver.policy(min_visits=0)


def test_bad_models_are_refused() -> None:
    def plain(*_: object) -> None: ...

    @njit
    def compiled(*_: object) -> None: ...

    with pytest.raises(TypeError, match="NamedTuple"):
        register_model(int, sample=compiled, step=compiled, actions=compiled, rollout=compiled)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="step of SearchSettings is not compiled"):
        register_model(SearchSettings, sample=compiled, step=plain, actions=compiled, rollout=compiled)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Tiger is registered already"):
        register_model(Tiger, sample=compiled, step=compiled, actions=compiled, rollout=compiled)  # type: ignore[arg-type]


# --- kernels on disk ---------------------------------------------------------------------------------------------

_IN_A_NEW_PROCESS = """
from planning.pomcp import Pomcp
from tests.planning.pomdp_models import Tiger, search_tiger
solver = Pomcp(state_size=1, max_actions=3, max_nodes=64, max_depth=6)
solver.search(search_tiger, Tiger(), seed=0, simulations=8)
stats = search_tiger.stats
print(sum(stats.cache_hits.values()), sum(stats.cache_misses.values()))
"""


def test_a_new_process_finds_the_compiled_search_on_disk() -> None:
    """The first process may compile; the second must not."""
    root = Path(__file__).resolve().parent.parent.parent
    for _ in range(2):
        printed = subprocess.run(
            [sys.executable, "-W", "error", "-c", _IN_A_NEW_PROCESS],
            cwd=root,
            check=True,
            capture_output=True,
            text=True,
        ).stdout
    assert printed.split() == ["1", "0"]


def test_entry_points_are_typed_alike() -> None:
    """One specialisation per model: an argument of another type would compile a second one at run time."""
    entry_points: tuple[Any, ...] = (search_tiger, search_table, search_lattice)
    for entry_point in entry_points:
        signatures = entry_point.signatures
        assert len(signatures) <= 1, f"{entry_point} was compiled for {signatures}"
    assert isinstance(tiger_solver().tree, Tree)
