"""Exact values of the textbook POMDPs, in plain Python and from their definitions: no code of the solver."""

from __future__ import annotations

from functools import cache


def tiger_value(
    horizon: int, discount: float = 0.95, hear_correctly: float = 0.85, belief: float = 0.5
) -> float:
    """Optimal value of Tiger over the reachable beliefs; `belief` is the probability that the tiger is left."""

    @cache
    def value(left: float, steps: int) -> float:
        if steps == 0:
            return 0.0
        hear_left = left * hear_correctly + (1 - left) * (1 - hear_correctly)
        after_left = round(left * hear_correctly / hear_left, 12)
        after_right = round(left * (1 - hear_correctly) / (1 - hear_left), 12)
        future = hear_left * value(after_left, steps - 1) + (1 - hear_left) * value(after_right, steps - 1)
        anew = discount * value(0.5, steps - 1)
        open_left = left * -100.0 + (1 - left) * 10.0 + anew
        open_right = left * 10.0 + (1 - left) * -100.0 + anew
        return max(-1.0 + discount * future, open_left, open_right)

    return value(belief, horizon)


class LatticeWorld:
    """A picture of cells (digits pay once, S start, # wall, D door), walked exactly.

    The door is blocked with `blocked_probability`; a walker beside it or in it sees whether. A bump costs the move.
    """

    def __init__(
        self,
        rows: tuple[str, ...],
        blocked_probability: float,
        move_cost: float,
        discount: float,
        horizon: int,
    ) -> None:
        self.marks = {
            (x, -y): mark for y, row in enumerate(rows) for x, mark in enumerate(row) if mark != "#"
        }
        self.start = next(cell for cell, mark in self.marks.items() if mark == "S")
        self.blocked_probability, self.move_cost = blocked_probability, move_cost
        self.discount, self.horizon = discount, horizon

    MOVES = ((1, 0), (0, 1), (-1, 0), (0, -1))

    def move(
        self, cell: tuple[int, int], covered: frozenset[tuple[int, int]], action: int, blocked: bool
    ) -> tuple[tuple[int, int], frozenset[tuple[int, int]], float]:
        """Cell, covered cells and reward after one action."""
        target = (cell[0] + self.MOVES[action][0], cell[1] + self.MOVES[action][1])
        if target in self.marks and not (self.marks[target] == "D" and blocked):
            cell = target
        mark = self.marks[cell]
        gain = float(mark) if mark.isdigit() and cell not in covered else 0.0
        return cell, covered | {cell}, gain - self.move_cost

    def sees_door(self, cell: tuple[int, int]) -> bool:
        """Whether the cell is the door's or next to it."""
        return self.marks[cell] == "D" or any(
            self.marks.get((cell[0] + dx, cell[1] + dy)) == "D" for dx, dy in self.MOVES
        )

    def closed_loop_value(self) -> float:
        """Expectimax over beliefs: `known` is None while the door was not seen, else whether it is blocked."""

        @cache
        def value(
            cell: tuple[int, int], covered: frozenset[tuple[int, int]], known: bool | None, steps: int
        ) -> float:
            if steps == 0:
                return 0.0
            best = float("-inf")
            for action in range(4):
                worlds = (
                    ((known, 1.0),)
                    if known is not None
                    else (
                        (True, self.blocked_probability),
                        (False, 1.0 - self.blocked_probability),
                    )
                )
                total = 0.0
                for blocked, probability in worlds:
                    after, then, reward = self.move(cell, covered, action, blocked)
                    learnt = blocked if known is not None or self.sees_door(after) else None
                    total += probability * (reward + self.discount * value(after, then, learnt, steps - 1))
                best = max(best, total)
            return best

        return value(self.start, frozenset(), None, self.horizon)

    def open_loop_value(self) -> float:
        """The best fixed sequence of actions: all 4^horizon of them, walked in both worlds."""
        probabilities = (self.blocked_probability, 1.0 - self.blocked_probability)

        @cache
        def value(
            walkers: tuple[tuple[tuple[int, int], frozenset[tuple[int, int]]], ...], steps: int
        ) -> float:
            if steps == 0:
                return 0.0
            best = float("-inf")
            for action in range(4):
                moved = [
                    self.move(*walker, action, blocked)
                    for walker, blocked in zip(walkers, (True, False), strict=True)
                ]
                reward = sum(p * after[2] for p, after in zip(probabilities, moved, strict=True))
                best = max(best, reward + self.discount * value(tuple(m[:2] for m in moved), steps - 1))
            return best

        return value(((self.start, frozenset()),) * 2, self.horizon)
