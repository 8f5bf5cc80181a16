"""What the local planner has promised to cover soon, and what it has promised too often.

The model of what a look covers is never quite the world: a patch may be seen from a place and a heading that the robot
does not take up exactly, or not at all. A planner that believes its model alone goes on trying for ever. So the patches
that the near part of each answer is to cover are counted, and one that stays uncovered all the same is left alone for a
while.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from schemas.contract import SECOND_NS

Index = tuple[int, int]
"""Global lattice index (x, y) of a patch."""


@dataclass(slots=True)
class Promises:
    """Counts answers by patch. most: answers that may promise one in vain. rest_s: how long it is left alone then."""

    most: float
    rest_s: float
    _made: dict[Index, tuple[float, float]] = field(default_factory=dict)
    _resting: dict[Index, tuple[int, float]] = field(default_factory=dict)

    def left_alone(self, now_ns: int, entropy: dict[Index, float]) -> set[Index]:
        """The patches to leave alone now. One that has changed since is as good as new. entropy: of patches in view."""
        for index, (until_ns, was) in list(self._resting.items()):
            if now_ns >= until_ns or abs(entropy.get(index, was) - was) > 0.3 * was:
                del self._resting[index]
        return set(self._resting)

    def note(self, now_ns: int, promised: Iterable[Index], entropy: dict[Index, float]) -> None:
        """An answer is given that is to cover these patches soon; what it does not promise is slowly forgotten."""
        wanted = set(promised)
        for index, (count, was) in list(self._made.items()):
            left = entropy.get(index, was)
            if left < 0.7 * was or (index not in wanted and count <= 0.1):
                del self._made[index]
            elif index not in wanted:
                self._made[index] = (count - 0.1, was)
        for index in sorted(wanted):
            count, was = self._made.get(index, (0.0, entropy.get(index, 0.0)))
            self._made[index] = (count + 1.0, was)
            if count + 1.0 > self.most:
                del self._made[index]
                self._resting[index] = (now_ns + int(self.rest_s * SECOND_NS), entropy.get(index, was))

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {
            "made": [[*k, *v] for k, v in sorted(self._made.items())],
            "resting": [[*k, *v] for k, v in sorted(self._resting.items())],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self._made = {(x, y): (count, was) for x, y, count, was in state["made"]}
        self._resting = {(x, y): (until, was) for x, y, until, was in state["resting"]}
