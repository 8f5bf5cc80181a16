"""RockSample(n, k) as a generative model for `planning.pomcp` (Smith and Simmons 2004; Silver and Veness 2010).

A robot on an n x n grid knows its place and where the k rocks lie, not which are good. Actions: 0 to 3 move north,
east, south, west; 4 samples the rock here (+10 if it is good, -10 if not; then it is spent); 5 + i checks rock i from
afar: the answer is right with probability (1 + 2^(-distance / 20)) / 2. Leaving over the east edge pays 10 and ends the
episode. Discount 0.95. What is refused or worthless is no action, as in the published POMCP program: moves into the
other edges, sampling where no rock is left, checking a spent rock.

Two levels of knowledge, both of the history only, never of what is hidden. `LEGAL`: uniformly random legal rollouts, no
preference. `INFORMED`: preferred actions in the tree, and a greedy rule over the rocks' beliefs in the rollouts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit, njit_borrowing
from planning.pomcp import (
    SearchSettings,
    Tree,
    random_bits,
    random_uniform,
    register_model,
    simulate,
)

NORTH, EAST, SOUTH, WEST, SAMPLE, CHECK = range(6)
"""Actions; CHECK + i checks rock i."""
NOTHING, GOOD, BAD = range(3)
"""Observations."""
LEGAL, INFORMED = range(2)
"""Levels of knowledge."""
AT, TREASURE, SPENT, ODDS = range(4)
"""State: cell (y * n + x), bits of good rocks, bits of sampled ones, then the log-odds that each rock is good as the
history has it, in units of 2^-20, then how often each was checked."""

HALF_EFFICIENCY_DISTANCE = 20.0
ROCK_REWARD = EXIT_REWARD = 10.0
DISCOUNT = 0.95
_UNIT = float(1 << 20)
_CERTAIN = 1000.0
_SURE = int(3.0 * _UNIT)
_POOR = int(-2.0 * _UNIT)
_CHECK_BELOW = int(math.log(20.0) * _UNIT)
_MAX_CHECKS = 5
_HALF, _LOWER, _TO_UNIT = np.uint64(32), np.uint64(0xFFFFFFFF), 1.0 / 4294967296.0
_POWERS = DISCOUNT ** np.arange(1024)


class RockSample(NamedTuple):
    """The problem and the belief that a search starts from.

    size: n. rock_cell: (k,) cells. rock_at: (n * n,) rock in a cell or -1. right: (n * n, k) probability that a check
    is right. evidence: (n * n, k) log-odds of one answer, in units of 2^-20. at, spent: as in the state. odds, checks:
    (k,) as in the state. good: (k,) probability that a rock is good. knowledge: `LEGAL` or `INFORMED`.
    """

    size: int
    rock_cell: NDArray[np.int64]
    rock_at: NDArray[np.int64]
    right: NDArray[np.float64]
    evidence: NDArray[np.int64]
    at: int
    spent: int
    odds: NDArray[np.int64]
    checks: NDArray[np.int64]
    good: NDArray[np.float64]
    knowledge: int


def state_size(rocks: int) -> int:
    """Words of a state."""
    return ODDS + 2 * rocks


def rock_sample(
    size: int, rocks: Sequence[tuple[int, int]], start: tuple[int, int], knowledge: int
) -> RockSample:
    """The problem before the first action. rocks, start: (x, y), x grows to the east, y to the north.

    `ValueError` if a rock or the start lies outside, or two rocks in one cell.
    """
    inside = all(0 <= x < size and 0 <= y < size for x, y in [*rocks, start])
    if not inside or len(set(rocks)) != len(rocks) or not 1 <= len(rocks) <= 62:
        raise ValueError(f"the rocks {rocks} and the start {start} do not fit on {size} x {size} cells")
    cells = np.array([y * size + x for x, y in rocks], np.int64)
    rock_at = np.full(size * size, -1, np.int64)
    rock_at[cells] = np.arange(len(rocks))
    y, x = np.divmod(np.arange(size * size), size)
    distance = np.hypot(x[:, None] - x[cells][None, :], y[:, None] - y[cells][None, :])
    right = 0.5 * (1.0 + 2.0 ** (-distance / HALF_EFFICIENCY_DISTANCE))
    with np.errstate(divide="ignore"):
        evidence = np.minimum(np.log(right / (1.0 - right)), _CERTAIN)
    return RockSample(
        size, cells, rock_at, right, np.rint(evidence * _UNIT).astype(np.int64), start[1] * size + start[0], 0,
        np.zeros(len(rocks), np.int64), np.zeros(len(rocks), np.int64), np.full(len(rocks), 0.5), knowledge,
    )  # fmt: skip


def after(model: RockSample, action: int, observation: int) -> RockSample:
    """The problem after an action and its observation: the exact belief, which is one of independent rocks."""
    at, spent, odds, checks = model.at, model.spent, model.odds.copy(), model.checks.copy()
    if action < SAMPLE:
        at += (model.size, 1, -model.size, -1)[action]
    elif action == SAMPLE:
        spent |= 1 << int(model.rock_at[at])
    else:
        rock = action - CHECK
        odds[rock] += model.evidence[at, rock] * (1 if observation == GOOD else -1)
        checks[rock] += 1
    good = 1.0 / (1.0 + np.exp(-np.clip(odds / _UNIT, -500.0, 500.0)))
    return model._replace(at=at, spent=spent, odds=odds, checks=checks, good=good)


@njit_borrowing
def _sample(model: RockSample, rng: NDArray[np.uint64], state: NDArray[np.int64]) -> None:
    rocks = model.rock_cell.size
    treasure = 0
    for i in range(rocks):
        treasure |= int(random_uniform(rng) < model.good[i]) << i
        state[ODDS + i] = model.odds[i]
        state[ODDS + rocks + i] = model.checks[i]
    state[AT], state[TREASURE], state[SPENT] = model.at, treasure, model.spent


@njit_borrowing
def _check(model: RockSample, state: NDArray[np.int64], rock: int, rng: NDArray[np.uint64]) -> int:
    """Draw the answer and record it. Returns the observation."""
    at = state[AT]
    is_good = (state[TREASURE] >> rock) & 1 == 1
    says_good = (random_uniform(rng) < model.right[at, rock]) == is_good
    state[ODDS + rock] += model.evidence[at, rock] if says_good else -model.evidence[at, rock]
    state[ODDS + model.rock_cell.size + rock] += 1
    return GOOD if says_good else BAD


@njit_borrowing
def _step(
    model: RockSample, state: NDArray[np.int64], action: int, rng: NDArray[np.uint64]
) -> tuple[int, float, float, bool]:
    if action >= CHECK:
        return _check(model, state, action - CHECK, rng), 0.0, DISCOUNT, False
    at = state[AT]
    if action == SAMPLE:
        rock = model.rock_at[at]
        state[SPENT] |= 1 << rock
        reward = ROCK_REWARD if (state[TREASURE] >> rock) & 1 else -ROCK_REWARD
        return NOTHING, reward, DISCOUNT, False
    if action == EAST:
        state[AT] = at + 1
        if (at + 1) % model.size == 0:
            return NOTHING, EXIT_REWARD, DISCOUNT, True
    elif action == WEST:
        state[AT] = at - 1
    else:
        state[AT] = at + (model.size if action == NORTH else -model.size)
    return NOTHING, 0.0, DISCOUNT, False


@njit_borrowing
def _is_legal(model: RockSample, state: NDArray[np.int64], action: int) -> bool:
    if action >= CHECK:
        return bool((state[SPENT] >> (action - CHECK)) & 1 == 0)
    at = state[AT]
    if action == EAST:
        return True
    if action == NORTH:
        return bool(at < model.size * (model.size - 1))
    if action == SOUTH:
        return bool(at >= model.size)
    if action == WEST:
        return bool(at % model.size > 0)
    return bool(model.rock_at[at] >= 0 and (state[SPENT] >> model.rock_at[at]) & 1 == 0)


@njit_borrowing
def _is_preferred(model: RockSample, state: NDArray[np.int64], action: int) -> bool:
    """Whether a legal action is preferred (Silver and Veness 2010, section 5.2, as their program has it).

    Sample a rock that is rather good; else move towards a rock that may be good, or check a rock of which little is
    known. With nothing left that may be good: east. A perfect answer (from the rock's own cell) settles it.
    """
    size, rocks = model.size, model.rock_cell.size
    at, spent = state[AT], state[SPENT]
    here = model.rock_at[at]
    if here >= 0 and (spent >> here) & 1 == 0 and state[ODDS + here] > 0:
        return action == SAMPLE
    if action >= CHECK:
        rock = action - CHECK
        few = state[ODDS + rocks + rock] < _MAX_CHECKS
        return bool(few and abs(state[ODDS + rock]) < _SURE)
    promising, towards = False, False
    for i in range(rocks):
        if (spent >> i) & 1 or state[ODDS + i] < 0:
            continue
        promising = True
        dx, dy = model.rock_cell[i] % size - at % size, model.rock_cell[i] // size - at // size
        towards |= (action == NORTH and dy > 0) or (action == SOUTH and dy < 0)
        towards |= (action == EAST and dx > 0) or (action == WEST and dx < 0)
    return towards or (action == EAST and not promising)


@njit_borrowing
def _actions(model: RockSample, state: NDArray[np.int64], actions_out: NDArray[np.int64]) -> int:
    count = 0
    if model.knowledge == INFORMED:
        for action in range(CHECK + model.rock_cell.size):
            if _is_legal(model, state, action) and _is_preferred(model, state, action):
                actions_out[count] = action
                count += 1
    if count == 0:
        for action in range(CHECK + model.rock_cell.size):
            if _is_legal(model, state, action):
                actions_out[count] = action
                count += 1
    return count


@njit_borrowing
def _legal_rollout(
    size: int,
    rock_at: NDArray[np.int64],
    right: NDArray[np.float64],
    evidence: NDArray[np.int64],
    state: NDArray[np.int64],
    depth_left: int,
    rng: NDArray[np.uint64],
) -> float:
    """Uniformly random legal actions; answers are drawn and recorded as in the tree."""
    rocks, last = right.shape[1], size - 1
    at, treasure, spent = state[AT], state[TREASURE], state[SPENT]
    y, x = at // size, at % size
    value, weight, left = 0.0, 1.0, depth_left
    while left > 0:
        bits = random_bits(rng)  # the upper half picks the action, the lower half the answer
        action = np.int64(((bits >> _HALF) * np.uint64(CHECK + rocks)) >> _HALF)
        if action >= CHECK:
            rock = action - CHECK
            if (spent >> rock) & 1:
                continue
            at = y * size + x
            is_right = float(bits & _LOWER) * _TO_UNIT < right[at, rock]
            sign = 1 if is_right == ((treasure >> rock) & 1 == 1) else -1
            state[ODDS + rock] += sign * evidence[at, rock]
            state[ODDS + rocks + rock] += 1
        elif action == EAST:
            if x == last:
                return value + weight * EXIT_REWARD
            x += 1
        elif action == WEST:
            if x == 0:
                continue
            x -= 1
        elif action == NORTH:
            if y == last:
                continue
            y += 1
        elif action == SOUTH:
            if y == 0:
                continue
            y -= 1
        else:
            rock = rock_at[y * size + x]
            if rock < 0 or (spent >> rock) & 1:
                continue
            spent |= 1 << rock
            value += weight * (ROCK_REWARD if (treasure >> rock) & 1 else -ROCK_REWARD)
        weight *= DISCOUNT
        left -= 1
    return value


@njit_borrowing
def _checks_first(odds: int) -> bool:
    """Whether a check in the rock's own cell pays before sampling: 0.95 * 10 p > 10 (2 p - 1), so p < 1 / 1.05."""
    return odds < _CHECK_BELOW


@njit_borrowing
def _next_rock(model: RockSample, state: NDArray[np.int64]) -> tuple[int, int]:
    """The rock that is worth most on the way out, with its distance in moves; -1: out at once is better."""
    size = model.size
    x, y = state[AT] % size, state[AT] // size
    best, best_distance, best_value = -1, 0, EXIT_REWARD * _POWERS[size - 1 - x]
    for i in range(model.rock_cell.size):
        if (state[SPENT] >> i) & 1 or state[ODDS + i] < _POOR:
            continue
        rx, ry = model.rock_cell[i] % size, model.rock_cell[i] // size
        p = 1.0 / (1.0 + math.exp(-state[ODDS + i] / _UNIT))
        worth = (
            DISCOUNT * ROCK_REWARD * p if _checks_first(state[ODDS + i]) else ROCK_REWARD * (2.0 * p - 1.0)
        )
        moves = abs(rx - x) + abs(ry - y)
        value = _POWERS[moves] * (worth + EXIT_REWARD * _POWERS[size - rx])
        if value > best_value:
            best, best_distance, best_value = i, moves, value
    return best, best_distance


@njit_borrowing
def _informed_rollout(
    model: RockSample, state: NDArray[np.int64], depth_left: int, rng: NDArray[np.uint64]
) -> float:
    """Greedy: from rock to rock as `_next_rock` has it, sampling the good ones, then out; in legs, not in moves.

    At an uncertain rock one check settles it, as an answer from its own cell is never wrong.
    """
    size, value, steps = model.size, 0.0, 0
    while True:
        rock, moves = _next_rock(model, state)
        if rock < 0:
            break
        steps += moves
        state[AT] = model.rock_cell[rock]
        state[SPENT] |= 1 << rock
        good = (state[TREASURE] >> rock) & 1 == 1
        if _checks_first(state[ODDS + rock]):
            steps += 1
            if steps < depth_left and good:
                value += _POWERS[steps] * ROCK_REWARD
                steps += 1
        else:
            if steps < depth_left:
                value += _POWERS[steps] * (ROCK_REWARD if good else -ROCK_REWARD)
            steps += 1
        if steps >= depth_left:
            return value
    steps += size - 1 - state[AT] % size
    return value + EXIT_REWARD * _POWERS[steps] if steps < depth_left else value


@njit_borrowing
def _rollout(model: RockSample, state: NDArray[np.int64], depth_left: int, rng: NDArray[np.uint64]) -> float:
    if model.knowledge == INFORMED:
        return _informed_rollout(model, state, depth_left, rng)
    return _legal_rollout(model.size, model.rock_at, model.right, model.evidence, state, depth_left, rng)


register_model(RockSample, sample=_sample, step=_step, actions=_actions, rollout=_rollout)


@njit
def search_rocks(
    tree: Tree, model: RockSample, settings: SearchSettings, rng: NDArray[np.uint64], simulations: int
) -> None:
    """Entry point of POMCP for this model (see `planning.pomcp`)."""
    simulate(tree, model, settings, rng, simulations)
