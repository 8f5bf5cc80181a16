"""FrontierManager: the border of covered and uncovered traversable ground (Algorithm 1; Keidar and Kaminka 2012).

Incremental: only what lies in the window around the robot is looked at again; frontiers outside keep what they had,
as no cell there can have changed.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field
from typing import Any

from planning.fences import Placed
from planning.frames import Planar
from planning.grid import FREE, LETHAL, UNKNOWN
from services.irm.borders import Found, find_frontiers, least_gain
from services.irm.config import Config
from services.irm.keyframes import NOBODY, Anchor
from services.irm.out_of_reach import FENCED, Place
from services.irm.spatial import SpatialHash
from services.irm.window import Window

CUT_OFF = "cut off: no way for the robot was found"
ISOLATED = "no way over the graph"
BESIDE = "stood beside it and saw nothing new"
_NO_WAY = (CUT_OFF, ISOLATED)
_NEWS_M = 0.3
"""A place that a closure moves by more may have a way now."""
_MANY_ROUNDS = 100
"""What was a frontier before is no noise of one round."""


@dataclass(slots=True)
class Frontier:
    """A frontier node. x_m, y_m: a place in `map` that the robot's centre can reach. gain: nats of whole patches.

    keyframe: what it belongs to since it was last seen; local_*: its place in that keyframe's frame.
    """

    node_id: int
    x_m: float
    y_m: float
    gain: float
    beside_s: float = 0.0
    best_gain: float = math.inf
    seen: bool = True
    missed: int = 0
    isolated: int = 0
    pursued_s: float = 0.0
    nearest_m: float = math.inf
    again: bool = False
    opening: bool = False
    rounds: int = 0
    keyframe: int = NOBODY
    local_x_m: float = 0.0
    local_y_m: float = 0.0


@dataclass(slots=True)
class GivenUp:
    """A frontier that was given up, why, when it may come back, and whether it has come back before.

    One that does not come back then is still told, until it is found again or seen to be covered. Place and keyframe as
    there.
    """

    x_m: float
    y_m: float
    gain: float
    reason: str
    until_ns: int
    again: bool = False
    keyframe: int = NOBODY
    local_x_m: float = 0.0
    local_y_m: float = 0.0
    opening: bool = False


@dataclass(slots=True)
class FrontierManager:
    """Finds, names, prunes and gives up frontiers.

    aside: those behind the operator's fences, until these change. dropped, dropped_gain: too little in a world that
    has grown.
    """

    config: Config
    frontiers: dict[int, Frontier] = field(default_factory=dict)
    given_up: list[GivenUp] = field(default_factory=list)
    aside: list[GivenUp] = field(default_factory=list)
    dropped: int = 0
    dropped_gain: float = 0.0
    _places: SpatialHash = field(default_factory=SpatialHash)
    _changed: set[int] = field(default_factory=set)
    _back: list[int] = field(default_factory=list)
    _pursued: set[int] = field(default_factory=set)
    _least: float = 0.0
    _doubtful: frozenset[int] = frozenset()

    def update(
        self,
        window: Window,
        robot: tuple[float, float],
        now_ns: int,
        elapsed_s: float,
        next_id: int,
        ground_m2: float = 0.0,
        anchor: Anchor = Anchor(),  # noqa: B008
        doubtful: frozenset[int] = frozenset(),
    ) -> int:
        """Look at the window again. Returns the next id.

        robot: its place in `map`. elapsed_s: since the last call; ground_m2: known so far; anchor: the keyframe that
        the robot is at; doubtful: keyframes whose place relative to it is not known well. What belongs to them is not
        in the window for certain, and is left as it is until the robot gets there.
        """
        self._doubtful = doubtful
        least = least_gain(self.config, ground_m2)
        next_id = self._second_chances(next_id)
        next_id = self._come_back(now_ns, least, next_id)
        found = find_frontiers(window, self.config, least)
        found = [f for f in found if not self._is_given_up(f.x_m, f.y_m, now_ns)]
        self._drop_small(window, least)
        inside = [self.frontiers[k] for k in sorted(self.near(window))]
        for frontier in inside:
            frontier.seen = False
        taken: set[int] = set()
        for distance, index, node_id in self._pairs(found, inside):
            if index in taken or self.frontiers[node_id].seen or distance > self.config.frontier_same_m:
                continue
            taken.add(index)
            self._see_again(self.frontiers[node_id], found[index], anchor)
        for frontier in inside:
            if not frontier.seen:
                self._miss(frontier, window, robot, now_ns)
        for index, (x, y, gain, opening) in enumerate(found):
            again = self._drop_expired(x, y, now_ns)
            if index not in taken:
                self._put(Frontier(next_id, x, y, gain, opening=opening, again=again), anchor)
                next_id += 1
        self._drop_covered(window, now_ns)
        self._watch(window, robot, now_ns, elapsed_s)
        return next_id

    def fence(
        self, placed: Placed, changed: bool, reopened: list[Place], next_id: int
    ) -> tuple[int, list[int]]:
        """Put frontiers where the robot may not be aside. When other fences hold now (`changed`), what they let free
        comes back: what was aside, what no way led to, and places behind a fence that is gone.

        Returns the next id, and the ids of those that came back.
        """
        for f in [f for f in self.frontiers.values() if placed.forbids(f.x_m, f.y_m)] if placed.shuts else []:
            self.aside.append(_given_up(f, FENCED, 0))
            self._forget(f.node_id)
        if not changed:
            return next_id, []
        free = [g for g in self.aside if not placed.forbids(g.x_m, g.y_m)]
        free += [g for g in self.given_up if g.reason in _NO_WAY and not placed.forbids(g.x_m, g.y_m)]
        self.aside = [g for g in self.aside if g not in free]
        self.given_up = [g for g in self.given_up if g not in free]
        free += [_place_given_up(p) for p in reopened]
        back = list(range(next_id, next_id + len(free)))
        for node_id, g in zip(back, free, strict=True):
            self._keep(_frontier_again(node_id, g, g.again))
        self._changed |= set(self.frontiers)  # priorities may have changed what they are told to be worth
        return next_id + len(free), back

    def near(self, window: Window) -> list[int]:
        """The frontiers that lie in the window, those of doubtful place only when the robot is beside them.

        There it sees what is open, wherever exactly; else it would wait for ever beside what is not there.
        """
        s = window.spec
        x, y = window.to_map(*s.centre_of(s.height // 2, s.width // 2))
        radius = 0.5 * math.hypot(s.height + 2, s.width + 2) * s.resolution_m
        around = (k for k in self._places.around(x, y, radius) if k in self.frontiers)
        inside = [k for k in around if _in_window(window, self.frontiers[k])]
        if not self._doubtful:
            return inside
        robot = window.to_map(*s.centre_of(*window.robot_cell))
        return [k for k in inside if self._can_judge(self.frontiers[k], robot)]

    def _can_judge(self, frontier: Frontier | GivenUp, robot: tuple[float, float]) -> bool:
        away_m = math.hypot(frontier.x_m - robot[0], frontier.y_m - robot[1])
        return frontier.keyframe not in self._doubtful or away_m <= self.config.opening_range_m

    def take_changes(self) -> set[int]:
        """Ids of the frontiers that are new, other than before or gone since the last call."""
        changed, self._changed = self._changed, set()
        return changed

    def take_back(self) -> list[int]:
        """Ids of the frontiers that came back since the last call: wherever they are, they have no edges yet."""
        back, self._back = self._back, []
        return back

    def follow(self, keyframes: dict[int, Planar]) -> list[int]:
        """Move what belongs to keyframes that SLAM has moved. Returns the ids of the frontiers that moved."""
        for g in self.given_up:
            if g.keyframe in keyframes:
                before = g.x_m, g.y_m
                g.x_m, g.y_m = keyframes[g.keyframe].apply(g.local_x_m, g.local_y_m)
                # A closure is news: what no way led to may have been a ghost of drift, or have a way now.
                if g.reason in _NO_WAY and math.dist(before, (g.x_m, g.y_m)) > _NEWS_M:
                    g.until_ns = 0
        for g in self.aside:
            if g.keyframe in keyframes:
                g.x_m, g.y_m = keyframes[g.keyframe].apply(g.local_x_m, g.local_y_m)
        moved = [k for k in sorted(self.frontiers) if self.frontiers[k].keyframe in keyframes]
        for node_id in moved:
            f = self.frontiers[node_id]
            f.x_m, f.y_m = keyframes[f.keyframe].apply(f.local_x_m, f.local_y_m)
            self._places.put(node_id, f.x_m, f.y_m)
            self._changed.add(node_id)
        return moved

    def _put(self, frontier: Frontier, anchor: Anchor) -> None:
        """A frontier is there, or elsewhere than before, as seen from this keyframe."""
        frontier.keyframe = anchor.keyframe
        frontier.local_x_m, frontier.local_y_m = anchor.local(frontier.x_m, frontier.y_m)
        self._keep(frontier)

    def _keep(self, frontier: Frontier) -> None:
        self.frontiers[frontier.node_id] = frontier
        self._places.put(frontier.node_id, frontier.x_m, frontier.y_m)
        self._changed.add(frontier.node_id)

    def _second_chances(self, next_id: int) -> int:
        """With nothing else left, frontiers with much to gain that were given up come back, once."""
        if self.frontiers:
            return next_id
        return self._bring_back([g for g in self.given_up if self._is_much(g) and not g.again], next_id)

    def _come_back(self, now_ns: int, least: float, next_id: int) -> int:
        """What was given up comes back when its time is over, wherever the robot is, once: else the robot might go to
        and fro for ever. Little that it saw nothing new of, right beside it, waits to be found again."""
        expired = [g for g in self.given_up if g.until_ns <= now_ns and g.gain >= least and not g.again]
        return self._bring_back([g for g in expired if g.reason != BESIDE or self._is_much(g)], next_id)

    def _is_much(self, g: GivenUp) -> bool:
        return g.gain >= self.config.second_chance_gain

    def _bring_back(self, entries: list[GivenUp], next_id: int) -> int:
        for node_id, g in enumerate(entries, next_id):
            self.given_up.remove(g)
            self._keep(_frontier_again(node_id, g, True))
            self._back.append(node_id)
        return next_id + len(entries)

    def _drop_expired(self, x_m: float, y_m: float, now_ns: int) -> bool:
        """A frontier was found here: what was given up here is that one. Returns whether there was any."""
        expired, same_m = [g for g in self.given_up if g.until_ns <= now_ns], self.config.frontier_same_m
        here = [g for g in expired if math.hypot(g.x_m - x_m, g.y_m - y_m) <= same_m]
        self.given_up = [g for g in self.given_up if g not in here]
        return bool(here)

    def _drop_covered(self, window: Window, now_ns: int) -> None:
        """What may come back and is seen to be covered is not left any more."""
        robot = window.to_map(*window.spec.centre_of(*window.robot_cell))
        for g in [g for g in self.given_up if g.until_ns <= now_ns]:
            cell = window.cell(g.x_m, g.y_m)
            if not window.spec.contains(*cell) or window.state[cell] == UNKNOWN:
                continue
            near = _around(window, cell)
            left = self._open_near(window, near) or window.hopeful[near].any()
            if not left and self._can_judge(g, robot):
                self.given_up.remove(g)

    def _see_again(self, frontier: Frontier, found: Found, anchor: Anchor) -> None:
        if math.hypot(found.x_m - frontier.x_m, found.y_m - frontier.y_m) > 0.5:
            frontier.beside_s, frontier.pursued_s, frontier.nearest_m = 0.0, 0.0, math.inf
        frontier.x_m, frontier.y_m, frontier.gain, frontier.opening = found
        frontier.seen, frontier.missed = True, 0
        frontier.rounds += 1
        self._put(frontier, anchor)

    def _forget(self, node_id: int) -> None:
        self.frontiers.pop(node_id, None)
        self._places.drop(node_id)
        self._pursued.discard(node_id)
        self._changed.add(node_id)

    def _drop_small(self, window: Window, least: float) -> None:
        """What was worth a trip in a smaller world may be no more; those in the window may yet be found again."""
        if least <= self._least:
            return
        self._least = least
        for f in [f for f in self.frontiers.values() if f.gain < least]:
            self._forget(f.node_id)
            if not _in_window(window, f):
                self.dropped += 1
                self.dropped_gain += f.gain

    def _miss(self, frontier: Frontier, window: Window, robot: tuple[float, float], now_ns: int) -> None:
        """A frontier in the window that was not found again: covered, forgotten by the risk map, or cut off."""
        row, column = window.cell(frontier.x_m, frontier.y_m)
        if window.state[row, column] == UNKNOWN:
            return
        near = _around(window, (row, column))
        if frontier.opening and window.hopeful[near].any():
            away_m = math.hypot(frontier.x_m - robot[0], frontier.y_m - robot[1])
            if away_m > self.config.opening_range_m - 1.0:
                return  # openings are looked for near the robot only
        if frontier.opening and frontier.rounds < self.config.opening_rounds:
            self._forget(frontier.node_id)
            return
        if not self._open_near(window, near):
            self._forget(frontier.node_id)
            return
        frontier.missed += 1
        if frontier.missed > self.config.missed_rounds:
            if window.reachable[near].any():
                self._forget(frontier.node_id)
            else:
                self.give_up(frontier, CUT_OFF, now_ns)

    def _open_near(self, window: Window, near: tuple[slice, slice]) -> bool:
        """Whether something in this part of the window is left to be covered."""
        looked = window.probability[near] >= self.config.covered_probability
        ground = window.ground[near] | (window.state[near] == FREE)
        return bool(((window.state[near] != LETHAL) & ~looked & ground).any())

    @staticmethod
    def _pairs(found: list[Found], old: list[Frontier]) -> list[tuple[float, int, int]]:
        pairs = [
            (math.hypot(x.x_m - f.x_m, x.y_m - f.y_m), i, f.node_id) for i, x in enumerate(found) for f in old
        ]
        return sorted(pairs)

    def _is_given_up(self, x_m: float, y_m: float, now_ns: int) -> bool:
        held, near = [g for g in self.given_up if g.until_ns > now_ns], 0.7 * self.config.give_up_radius_m
        return any(math.hypot(g.x_m - x_m, g.y_m - y_m) < near for g in held)

    def _watch(self, window: Window, robot: tuple[float, float], now_ns: int, elapsed_s: float) -> None:
        """Give up frontiers beside which the robot has been for long and that yield nothing."""
        for node_id in sorted(self.near(window)):
            f = self.frontiers[node_id]
            if f.gain < 0.9 * f.best_gain:
                f.best_gain, f.beside_s, f.pursued_s = f.gain, 0.0, 0.0
            if math.hypot(f.x_m - robot[0], f.y_m - robot[1]) <= self.config.give_up_radius_m:
                f.beside_s += elapsed_s
            if f.beside_s > self.config.give_up_s:
                self.give_up(f, BESIDE, now_ns)

    def progressed(self) -> None:
        """Ground was covered somewhere: the robot has better to do than to go to its target, which loses no time."""
        for node_id in self._pursued:
            self.frontiers[node_id].pursued_s = 0.0
        self._pursued.clear()

    def pursue(self, node_id: int, distance_m: float, now_ns: int, elapsed_s: float) -> None:
        """The global planner's target is this frontier, so far away: give it up when the robot gets no nearer."""
        f = self.frontiers.get(node_id)
        if f is None:
            return
        if distance_m < f.nearest_m - 0.5:
            f.nearest_m, f.pursued_s = distance_m, 0.0
            return
        f.pursued_s += elapsed_s
        self._pursued.add(node_id)
        if f.pursued_s > self.config.pursue_s:
            self.give_up(f, "pursued in vain: the robot got no nearer", now_ns)

    def give_up(self, frontier: Frontier, reason: str, now_ns: int) -> None:
        """Take a frontier off the list for a while."""
        until = now_ns + int(self.config.retry_after_s * 1e9)
        self.given_up.append(_given_up(frontier, reason, until))
        self._forget(frontier.node_id)

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {
            "frontiers": [list(astuple(f)) for _, f in sorted(self.frontiers.items())],
            "given_up": [list(astuple(g)) for g in self.given_up],
            "aside": [list(astuple(g)) for g in self.aside],
            "dropped": [self.dropped, self.dropped_gain, self._least],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self.frontiers, self._places = {}, SpatialHash()
        for values in state["frontiers"]:
            f = Frontier(int(values[0]), *values[1:])
            self.frontiers[f.node_id] = f
            self._places.put(f.node_id, f.x_m, f.y_m)
        self.given_up = [GivenUp(*g) for g in state["given_up"]]
        self.aside = [GivenUp(*g) for g in state.get("aside", ())]  # older journals have none
        self.dropped, self.dropped_gain, self._least = state["dropped"]
        self._pursued = {k for k, f in self.frontiers.items() if f.pursued_s > 0.0}
        self._changed = set(self.frontiers)


def _given_up(f: Frontier, reason: str, until_ns: int) -> GivenUp:
    local = f.local_x_m, f.local_y_m
    return GivenUp(f.x_m, f.y_m, f.gain, reason, until_ns, f.again, f.keyframe, *local, f.opening)


def _place_given_up(p: Place) -> GivenUp:
    return GivenUp(p.x_m, p.y_m, p.gain, FENCED, 0, False, p.keyframe, p.local_x_m, p.local_y_m)


def _frontier_again(node_id: int, g: GivenUp, again: bool) -> Frontier:
    """What was given up as a frontier once more, under a new id."""
    back = Frontier(node_id, g.x_m, g.y_m, g.gain, again=again, keyframe=g.keyframe)
    back.local_x_m, back.local_y_m = g.local_x_m, g.local_y_m
    back.opening, back.rounds = g.opening, _MANY_ROUNDS
    return back


def _around(window: Window, cell: tuple[int, int]) -> tuple[slice, slice]:
    """The part of the window within a metre of a cell in it."""
    reach = round(1.0 / window.spec.resolution_m)
    row, column = cell
    return slice(max(0, row - reach), row + reach + 1), slice(max(0, column - reach), column + reach + 1)


def _in_window(window: Window, frontier: Frontier) -> bool:
    return window.spec.contains(*window.cell(frontier.x_m, frontier.y_m))
