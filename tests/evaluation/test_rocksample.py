"""RockSample against a plain Python version of the published rules, and what the solver makes of it."""

from __future__ import annotations

import itertools
import math
from collections import Counter

import numpy as np
import pytest

from planning.pomcp import random_stream
from planning.randomness import stream
from plgrim.evaluation import rocksample_model as rs
from plgrim.evaluation.rocksample import (
    LAYOUTS,
    MAX_MOVES,
    Layout,
    evaluate,
    layout_of,
    play,
    solver_for,
    world_step,
)

SMALL = Layout(3, (0, 1), ((0, 0), (2, 2), (1, 1)))
MOVES = {rs.NORTH: (0, 1), rs.EAST: (1, 0), rs.SOUTH: (0, -1), rs.WEST: (-1, 0)}


class Plain:
    """The rules with tuples and sets. `left`: rocks that were not sampled yet."""

    def __init__(self, layout: Layout, at: tuple[int, int], good: set[int], left: set[int]) -> None:
        self.layout, self.at, self.good, self.left = layout, at, good, left

    def here(self) -> set[int]:
        return {i for i in self.left if self.layout.rocks[i] == self.at}

    def legal(self) -> set[int]:
        n, (x, y) = self.layout.size, self.at
        inside = {a for a, (dx, dy) in MOVES.items() if 0 <= x + dx < n and 0 <= y + dy < n}
        return (
            inside | {rs.EAST} | ({rs.SAMPLE} if self.here() else set()) | {rs.CHECK + i for i in self.left}
        )

    def outcomes(self, action: int) -> dict[int, float]:
        """Probability of each observation."""
        if action < rs.CHECK:
            return {rs.NOTHING: 1.0}
        rock = action - rs.CHECK
        right = 0.5 + 0.5 * math.pow(2.0, -math.dist(self.at, self.layout.rocks[rock]) / 20.0)
        truth, lie = (rs.GOOD, rs.BAD) if rock in self.good else (rs.BAD, rs.GOOD)
        return {truth: right, lie: 1.0 - right}

    def take(self, action: int) -> tuple[float, bool]:
        """(reward, end)."""
        if action in MOVES:
            self.at = (self.at[0] + MOVES[action][0], self.at[1] + MOVES[action][1])
            return (10.0, True) if self.at[0] == self.layout.size else (0.0, False)
        if action == rs.SAMPLE:
            (rock,) = self.here()
            self.left = self.left - {rock}
            return (10.0 if rock in self.good else -10.0), False
        return 0.0, False


def state_of(plain: Plain) -> np.ndarray:
    n, k = plain.layout.size, len(plain.layout.rocks)
    state = np.zeros(rs.state_size(k), np.int64)
    state[rs.AT] = plain.at[1] * n + plain.at[0]
    state[rs.TREASURE] = sum(1 << i for i in plain.good)
    state[rs.SPENT] = sum(1 << i for i in range(k) if i not in plain.left)
    return state


def every_state() -> list[Plain]:
    rocks = range(len(SMALL.rocks))
    subsets = [set(c) for r in range(4) for c in itertools.combinations(rocks, r)]
    cells = itertools.product(range(3), range(3))
    return [Plain(SMALL, at, good, left) for at in cells for good in subsets for left in subsets]


def test_actions_rewards_and_moves_are_those_of_the_rules_in_every_state() -> None:
    model, rng = rs.rock_sample(3, SMALL.rocks, SMALL.start, rs.LEGAL), random_stream(1)
    actions = np.zeros(8, np.int64)
    for plain in every_state():
        count = rs._actions(model, state_of(plain), actions)
        assert set(actions[:count].tolist()) == plain.legal()
        for action in plain.legal():
            state, copy = state_of(plain), Plain(SMALL, plain.at, plain.good, plain.left)
            observation, reward, discount, terminal = rs._step(model, state, action, rng)
            assert (reward, terminal) == copy.take(action)
            assert discount == 0.95
            assert plain.outcomes(action)[observation] > 0.0
            if not terminal:
                assert state[: rs.ODDS].tolist() == state_of(copy)[: rs.ODDS].tolist()


def test_answers_come_with_the_published_probability_and_move_the_belief_by_bayes() -> None:
    layout = LAYOUTS[11, 11]
    model, rng = rs.rock_sample(11, layout.rocks, layout.start, rs.LEGAL), random_stream(3)
    for at, rock in (((0, 5), 10), ((9, 3), 9), ((6, 6), 4)):
        plain = Plain(layout, at, {rock}, set(range(11)))
        seen: Counter[int] = Counter()
        for _ in range(20_000):
            state = state_of(plain)
            observation = rs._step(model, state, rs.CHECK + rock, rng)[0]
            seen[observation] += 1
            right = plain.outcomes(rs.CHECK + rock)[rs.GOOD]
            if right < 1.0:
                odds = math.log(right / (1.0 - right)) * (1 if observation == rs.GOOD else -1)
                assert abs(state[rs.ODDS + rock] / 2**20 - odds) < 1e-5
        assert abs(seen[rs.GOOD] / 20_000 - right) < 4.0 * math.sqrt(right * (1.0 - right) / 20_000) + 1e-9


def test_the_belief_after_answers_is_bayes_rule_and_particles_are_drawn_from_it() -> None:
    layout = LAYOUTS[7, 8]
    model = rs.rock_sample(7, layout.rocks, layout.start, rs.INFORMED)
    likelihood = {True: 1.0, False: 1.0}
    for action, observation in ((rs.CHECK + 2, rs.GOOD), (rs.EAST, rs.NOTHING), (rs.CHECK + 2, rs.BAD),
                                (rs.NORTH, rs.NOTHING), (rs.CHECK + 2, rs.BAD)):  # fmt: skip
        if action >= rs.CHECK:
            at = (model.at % 7, model.at // 7)
            for truth in (True, False):
                plain = Plain(layout, at, {2} if truth else set(), set(range(8)))
                likelihood[truth] *= plain.outcomes(action)[observation]
        model = rs.after(model, action, observation)
    exact = likelihood[True] / sum(likelihood.values())
    assert model.good[2] == pytest.approx(exact, abs=1e-5)
    rng, state, count = random_stream(5), np.zeros(rs.state_size(8), np.int64), 0
    for _ in range(20_000):
        rs._sample(model, rng, state)
        count += int(state[rs.TREASURE] >> 2) & 1
    assert abs(count / 20_000 - exact) < 4.0 * math.sqrt(exact * (1.0 - exact) / 20_000)


def test_the_random_rollout_earns_what_the_rules_pay() -> None:
    """Against a plain simulation of uniformly random legal actions, within four standard errors."""
    model, rng = rs.rock_sample(3, SMALL.rocks, SMALL.start, rs.LEGAL), random_stream(7)
    python = np.random.default_rng(7)
    ours, plain_returns = [], []
    for _ in range(4000):
        state = np.zeros(rs.state_size(3), np.int64)
        rs._sample(model, rng, state)
        ours.append(rs._rollout(model, state, 12, rng))
        plain = Plain(SMALL, SMALL.start, {i for i in range(3) if python.random() < 0.5}, {0, 1, 2})
        total, end = 0.0, False
        for step in range(12):
            reward, end = plain.take(int(python.choice(sorted(plain.legal()))))
            total += 0.95**step * reward
            if end:
                break
        plain_returns.append(total)
    error = math.hypot(np.std(ours), np.std(plain_returns)) / math.sqrt(4000)
    assert abs(np.mean(ours) - np.mean(plain_returns)) < 4.0 * error


@pytest.mark.parametrize("depth", [0, 1, 3, 7, 90])
def test_the_informed_rollout_never_knows_more_than_the_history(depth: int) -> None:
    """One rock, two cells off: a check there, 10 if it is good, and out. The truth changes the pay, not the way."""
    model, rng = rs.rock_sample(4, [(2, 0)], (0, 0), rs.INFORMED), random_stream(1)
    for good in (0, 1):
        state = np.zeros(rs.state_size(1), np.int64)
        state[rs.TREASURE] = good
        found = rs._rollout(model, state, depth, rng)
        pays = [
            (3, 10.0 * good),
            (3 + good + 1, 10.0),
        ]  # two moves, a check, (a sample,) one move and the exit
        assert found == pytest.approx(sum(0.95**t * pay for t, pay in pays if t < depth))


def test_preferred_actions_are_legal_and_never_none() -> None:
    model = rs.rock_sample(3, SMALL.rocks, SMALL.start, rs.INFORMED)
    rng, actions = np.random.default_rng(2), np.zeros(8, np.int64)
    for plain in every_state():
        state = state_of(plain)
        state[rs.ODDS : rs.ODDS + 3] = (rng.normal(0.0, 2.0, 3) * 2**20).astype(np.int64)
        count = rs._actions(model, state, actions)
        assert count > 0
        assert set(actions[:count].tolist()) <= plain.legal()
        for rock in plain.here():
            if state[rs.ODDS + rock] > 0:
                assert actions[:count].tolist() == [rs.SAMPLE]


def test_a_certain_world_is_played_for_all_it_holds() -> None:
    """All rocks known to be good: sampling them on the way out is the best there is on this small grid."""
    rng = stream(0, "test")
    model = rs.rock_sample(3, ((0, 1), (1, 1)), (0, 1), rs.INFORMED)
    model = model._replace(odds=np.full(2, 2**24), good=np.array([1.0, 1.0]))
    solver, total, weight = solver_for(2, 512), 0.0, 1.0
    for k in range(10):
        solver.search(rs.search_rocks, model, seed=k, simulations=512)
        action = solver.best_action()
        observation, reward, end = world_step(model, np.array([True, True]), action, rng)
        total, weight = total + weight * reward, weight * 0.95
        if end:
            break
        model = rs.after(model, action, observation)
    assert total == pytest.approx(10.0 * (1.0 + 0.95**2 + 0.95**4))


def test_episodes_are_reproducible_and_knowledge_pays() -> None:
    layout = LAYOUTS[7, 8]
    informed = evaluate(layout, simulations=128, episodes=25, seed=3)
    again = evaluate(layout, simulations=128, episodes=25, seed=3)
    legal = evaluate(layout, simulations=128, episodes=25, seed=3, knowledge=rs.LEGAL)
    assert informed.discounted.tolist() == again.discounted.tolist()
    assert informed.mean() > legal.mean() + 2.0
    assert informed.mean() > 15.0
    assert 0.0 < informed.standard_error() < 3.0


def test_an_episode_ends() -> None:
    total, moves = play(SMALL, solver_for(3, 16), 16, stream(1, "short"), rs.LEGAL)
    assert 1 <= moves <= MAX_MOVES
    assert -30.0 <= total <= 40.0


@pytest.mark.parametrize("size", sorted(LAYOUTS))
def test_layouts_fit_and_random_ones_are_of_their_seed(size: tuple[int, int]) -> None:
    layout = layout_of(*size)
    assert (layout.size, len(layout.rocks)) == size
    assert layout.start == (0, size[0] // 2)
    assert len(set(layout.rocks)) == size[1]
    drawn = layout_of(*size, 4)
    assert drawn == layout_of(*size, 4) != layout_of(*size, 5)
    assert len(set(drawn.rocks)) == size[1]


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="published"):
        layout_of(6, 6)
    for rocks in ([(0, 0), (0, 0)], [(3, 0)], []):
        with pytest.raises(ValueError, match="fit"):
            rs.rock_sample(3, rocks, (0, 0), rs.LEGAL)
