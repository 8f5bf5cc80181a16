"""Textbook POMDPs for the tests of the solver: Tiger, a lattice with a door, and small ones with one point each.

The exact values are computed elsewhere (`tests/planning/exact_pomdp.py`), without any of this code.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.pomcp import SearchSettings, Tree, random_below, random_uniform, register_model, simulate

State = NDArray[np.int64]
Stream = NDArray[np.uint64]
Outcome = tuple[int, float, float, bool]


class Tiger(NamedTuple):
    """Kaelbling, Littman and Cassandra 1998. State: the door with the tiger. Opening puts the tiger anew."""

    discount: float = 0.95
    hear_correctly: float = 0.85
    particles: NDArray[np.int64] = np.array([0, 1])


@njit
def _tiger_sample(model: Tiger, rng: Stream, state: State) -> None:
    state[0] = model.particles[random_below(rng, model.particles.size)]


@njit
def _tiger_step(model: Tiger, state: State, action: int, rng: Stream) -> Outcome:
    if action == 0:
        correct = random_uniform(rng) < model.hear_correctly
        return (state[0] if correct else 1 - state[0]), -1.0, model.discount, False
    reward = -100.0 if action - 1 == state[0] else 10.0
    state[0] = random_below(rng, 2)
    return random_below(rng, 2), reward, model.discount, False


@njit
def _tiger_actions(model: Tiger, state: State, actions: State) -> int:
    actions[0], actions[1], actions[2] = 0, 1, 2
    return 3


@njit
def _tiger_rollout(model: Tiger, state: State, depth_left: int, rng: Stream) -> float:
    value = 0.0
    for _ in range(depth_left):  # listens to the end
        value = -1.0 + model.discount * value
    return value


register_model(Tiger, sample=_tiger_sample, step=_tiger_step, actions=_tiger_actions, rollout=_tiger_rollout)


@njit
def search_tiger(tree: Tree, model: Tiger, settings: SearchSettings, rng: Stream, simulations: int) -> None:
    """Entry point of `Tiger`: 3 actions (listen, open left, open right), observations heard left or right."""
    simulate(tree, model, settings, rng, simulations)


LATTICE = ("2.2#44", "2S.D.4", "2.2#44")
"""Digits pay once, S is the start, # a wall, D the door. East of the door lies most of what can be covered."""


class Lattice(NamedTuple):
    """Coverage of a lattice whose door is blocked with some probability. State: cell, blocked or not, covered bits.

    Actions E, N, W, S. `neighbour[cell, action]` is the cell itself at a wall. The door shows whether it is blocked
    (observation 2, open: 1) to whom stands beside or in it; elsewhere nothing is observed (0).
    """

    start: int
    door: int
    neighbour: NDArray[np.int64]
    beside_door: NDArray[np.bool_]
    reward: NDArray[np.float64]
    blocked_probability: float
    move_cost: float
    discount: float


def lattice_model(
    rows: tuple[str, ...], blocked_probability: float, move_cost: float, discount: float
) -> Lattice:
    """Build the model's tables from a picture; the first row is the most northern one."""
    width, cells = len(rows[0]), "".join(rows)
    neighbour = np.zeros((len(cells), 4), dtype=np.int64)
    for cell in range(len(cells)):
        row, column = divmod(cell, width)
        for action, (d_row, d_column) in enumerate(((0, 1), (-1, 0), (0, -1), (1, 0))):
            r, c = row + d_row, column + d_column
            free = 0 <= r < len(rows) and 0 <= c < width and rows[r][c] != "#"
            neighbour[cell, action] = r * width + c if free else cell
    door = cells.index("D")
    return Lattice(
        start=cells.index("S"),
        door=door,
        neighbour=neighbour,
        beside_door=(neighbour == door).any(axis=1) | (np.arange(len(cells)) == door),
        reward=np.array([float(mark) if mark.isdigit() else 0.0 for mark in cells]),
        blocked_probability=blocked_probability,
        move_cost=move_cost,
        discount=discount,
    )


@njit
def _lattice_sample(model: Lattice, rng: Stream, state: State) -> None:
    state[0] = model.start
    state[1] = 1 if random_uniform(rng) < model.blocked_probability else 0
    state[2] = 0


@njit
def _lattice_step(model: Lattice, state: State, action: int, rng: Stream) -> Outcome:
    target = model.neighbour[state[0], action]
    if target != model.door or state[1] == 0:
        state[0] = target
    cell = state[0]
    reward = -model.move_cost
    if state[2] >> cell & 1 == 0:
        reward += model.reward[cell]
        state[2] |= 1 << cell
    return (1 + state[1] if model.beside_door[cell] else 0), reward, model.discount, False


@njit
def _lattice_actions(model: Lattice, state: State, actions: State) -> int:
    for action in range(4):
        actions[action] = action
    return 4


@njit
def _lattice_rollout(model: Lattice, state: State, depth_left: int, rng: Stream) -> float:
    value, weight = 0.0, 1.0
    for _ in range(depth_left):  # a random walk
        _, reward, discount, _ = _lattice_step(model, state, random_below(rng, 4), rng)
        value += weight * reward
        weight *= discount
    return value


register_model(
    Lattice, sample=_lattice_sample, step=_lattice_step, actions=_lattice_actions, rollout=_lattice_rollout
)


@njit
def search_lattice(
    tree: Tree, model: Lattice, settings: SearchSettings, rng: Stream, simulations: int
) -> None:
    """Entry point of `Lattice`: 4 actions, state of 3."""
    simulate(tree, model, settings, rng, simulations)


class Table(NamedTuple):
    """Any POMDP of S hidden states and A actions with given outcomes; only the start is drawn, from `particles`.

    Arrays are (S, A); `action_count` and `leaf_value` (S,). The rollout takes action 0 to a terminal step or to
    the horizon, and adds the leaf's value there.
    """

    particles: NDArray[np.int64]
    next_state: NDArray[np.int64]
    observation: NDArray[np.int64]
    reward: NDArray[np.float64]
    discount: NDArray[np.float64]
    terminal: NDArray[np.bool_]
    action_count: NDArray[np.int64]
    leaf_value: NDArray[np.float64]
    prior_visits: NDArray[np.int64]
    prior_values: NDArray[np.float64]


def table_model(states: int, actions: int) -> Table:
    """One particle (state 0), every action available everywhere, staying, rewards 0, discounts 1, no prior."""
    return Table(
        particles=np.zeros(1, dtype=np.int64),
        next_state=np.repeat(np.arange(states)[:, None], actions, axis=1),
        observation=np.zeros((states, actions), dtype=np.int64),
        reward=np.zeros((states, actions)),
        discount=np.ones((states, actions)),
        terminal=np.zeros((states, actions), dtype=np.bool_),
        action_count=np.full(states, actions),
        leaf_value=np.zeros(states),
        prior_visits=np.zeros((states, actions), dtype=np.int64),
        prior_values=np.zeros((states, actions)),
    )


@njit
def _table_sample(model: Table, rng: Stream, state: State) -> None:
    state[0] = model.particles[random_below(rng, model.particles.size)]


@njit
def _table_step(model: Table, state: State, action: int, rng: Stream) -> Outcome:
    s = state[0]
    state[0] = model.next_state[s, action]
    return (
        model.observation[s, action],
        model.reward[s, action],
        model.discount[s, action],
        model.terminal[s, action],
    )


@njit
def _table_actions(model: Table, state: State, actions: State) -> int:
    count = int(model.action_count[state[0]])
    for action in range(count):
        actions[action] = action
    return count


@njit
def _table_rollout(model: Table, state: State, depth_left: int, rng: Stream) -> float:
    value, weight = 0.0, 1.0
    for _ in range(depth_left):
        _, reward, discount, terminal = _table_step(model, state, 0, rng)
        value += weight * reward
        weight *= discount
        if terminal:
            return value
    return value + weight * float(model.leaf_value[state[0]])


@njit
def _table_prior(
    model: Table, state: State, actions: State, count: int, visits_out: State, values_out: NDArray[np.float64]
) -> None:
    for i in range(count):
        visits_out[i] = model.prior_visits[state[0], actions[i]]
        values_out[i] = model.prior_values[state[0], actions[i]]


register_model(
    Table,
    sample=_table_sample,
    step=_table_step,
    actions=_table_actions,
    rollout=_table_rollout,
    prior=_table_prior,
)


@njit
def search_table(tree: Tree, model: Table, settings: SearchSettings, rng: Stream, simulations: int) -> None:
    """Entry point of `Table`: state of 1."""
    simulate(tree, model, settings, rng, simulations)
