"""What was given up comes back wherever the robot is, with a way to it, and not for ever."""

from __future__ import annotations

import math

import networkx as nx
import numpy as np
import pytest

from planning.frames import Planar
from planning.grid import UNKNOWN
from schemas.base import Pose
from schemas.world import BREADCRUMB
from services.irm.config import Config
from services.irm.frontiers import BESIDE, CUT_OFF, ISOLATED, Frontier, FrontierManager, GivenUp
from services.irm.keyframes import Anchor
from services.irm.roadmap import ROBOT, Roadmap
from services.irm.window import Window
from tests.irm.worlds import Belief, Flat, room

SECOND = 10**9
RES = 0.5
IN_VAIN = "pursued in vain: the robot got no nearer"
RETRY_S = 50.0
NEAR, FAR, PLACE = (3.75, 1.75), (33.25, 1.75), (1.75, 1.75)
GAIN = 5.0


def look(
    flat: Flat, robot: tuple[float, float], covered_from_m: float = -99.0, window_m: float = 8.0
) -> Window:
    """So much of a world seen from a place, covered but for its beginning."""
    belief = Belief.new(Config(), RES)
    x, _ = np.meshgrid(flat.spec.centres_x(), flat.spec.centres_y())
    belief.cover(flat.spec, x > covered_from_m)
    return belief.window(flat.risk_map(*robot, window_m), *robot)


def corridor() -> Flat:
    return room(0.0, 0.0, 35.0, 3.0, RES, RES)


class Left:
    """A corridor of 34 m, breadcrumbs 1 to 18 every 2 m; near its beginning something was given up.

    The robot is at its end, where everything is covered, and sees 8 m around it.
    """

    def __init__(self, reason: str = IN_VAIN, **changes: float) -> None:
        changes = {"retry_after_s": RETRY_S, "second_chance_gain": 99.0, **changes}
        self.roadmap = Roadmap(Config.model_validate(changes), next_id=100, last_breadcrumb=18)
        for k in range(1, 19):
            self.roadmap.road.set_node(k, 2.0 * (k - 1), 1.75, 0.0, BREADCRUMB, 0.0, 1.0)
        for k in range(1, 18):
            self.roadmap.road.set_edge(k, k + 1, 2.0, 0.0, 1)
        self.manager, self.now_s = self.roadmap.manager, 0.0
        self.there = look(corridor(), FAR)
        entry = GivenUp(*PLACE, GAIN, reason, int(RETRY_S) * SECOND, False, 3, *PLACE)
        self.manager.given_up.append(entry)

    def wait(self, seconds: float, rounds: int = 1, window: Window | None = None) -> None:
        """So much later, the robot where it was or, with a window of its own, near the beginning."""
        robot = FAR if window is None else NEAR
        for _ in range(rounds):
            self.now_s += seconds
            self.roadmap.update(window or self.there, *robot, int(self.now_s * SECOND), 1.0)
            self.roadmap.message(Pose(), Pose(), 1, False)

    def only(self) -> Frontier:
        (frontier,) = self.manager.frontiers.values()
        return frontier

    def give_up(self, reason: str = IN_VAIN) -> None:
        self.manager.give_up(self.only(), reason, int(self.now_s * SECOND))

    def way_m(self) -> float:
        """Length of the way over the graph to the only frontier."""
        graph, to = self.roadmap.graph, self.only().node_id
        return float(nx.dijkstra_path_length(graph, ROBOT, to, weight="distance"))


def test_a_frontier_out_of_the_window_comes_back_with_a_way_when_its_time_is_over() -> None:
    left = Left()
    left.wait(RETRY_S - 1.0)
    assert left.manager.frontiers == {} and len(left.manager.given_up) == 1
    left.wait(1.0)
    back = left.only()
    assert (back.x_m, back.y_m, back.gain, back.again) == (*PLACE, GAIN, True)
    assert left.manager.given_up == []
    assert left.way_m() == pytest.approx(FAR[0] - PLACE[0], abs=3.0)
    left.wait(1.0, rounds=30)
    assert left.only() is back and left.way_m() < 35.0, "a way leads to it"


def test_a_second_chance_has_a_way_from_afar() -> None:
    left = Left(second_chance_gain=1.0)
    left.wait(1.0, rounds=30)
    assert left.only().again and left.manager.given_up == []
    assert left.way_m() == pytest.approx(FAR[0] - PLACE[0], abs=3.0)


def test_what_was_given_up_twice_stays_told_and_does_not_come_back_for_ever() -> None:
    left = Left(second_chance_gain=1.0)
    left.wait(RETRY_S)
    left.give_up()
    for _ in range(5):
        left.wait(RETRY_S)
        assert left.manager.frontiers == {}
        assert [(g.x_m, g.y_m, g.again) for g in left.manager.given_up] == [(*PLACE, True)]


@pytest.mark.parametrize("covered", [False, True])
def test_what_was_given_up_twice_is_judged_where_it_is_seen(covered: bool) -> None:
    left = Left()
    left.wait(RETRY_S)
    left.give_up()
    left.wait(RETRY_S)
    left.wait(1.0, window=look(corridor(), NEAR, -99.0 if covered else 2.5))
    assert left.manager.given_up == []
    assert [f.again for f in left.manager.frontiers.values()] == ([] if covered else [True])


@pytest.mark.parametrize("reason", [CUT_OFF, ISOLATED])
def test_a_closure_brings_back_once_what_no_way_led_to(reason: str) -> None:
    left = Left(reason)
    left.roadmap.follow({3: Planar(0.2, 0.0, 0.0)})
    left.wait(1.0)
    assert left.manager.frontiers == {} and len(left.manager.given_up) == 1, "no news"
    left.roadmap.follow({3: Planar(0.7, 0.0, 0.0)})
    left.wait(1.0)
    assert math.dist((left.only().x_m, left.only().y_m), (PLACE[0] + 0.7, PLACE[1])) < 1e-6
    assert left.manager.given_up == [] and left.way_m() < 35.0
    left.give_up(reason)
    left.roadmap.follow({3: Planar(1.4, 0.0, 0.0)})
    left.wait(1.0)
    assert left.manager.frontiers == {} and len(left.manager.given_up) == 1


@pytest.mark.parametrize(("gain", "comes"), [(0.9, False), (1.1, True)])
def test_little_that_the_robot_saw_nothing_new_of_is_told_and_waits_to_be_found(
    gain: float, comes: bool
) -> None:
    left = Left(BESIDE, second_chance_gain=1.0)
    left.manager.given_up[0].gain = gain
    left.manager._put(Frontier(50, 900.0, 0.0, 9.0), Anchor())  # something else is left: no second chances
    left.wait(RETRY_S)
    assert (len(left.manager.frontiers), len(left.manager.given_up)) == ((2, 0) if comes else (1, 1))


@pytest.mark.parametrize("opening", [False, True])
def test_an_opening_that_comes_back_is_waited_for_until_it_is_seen_from_near(opening: bool) -> None:
    """Openings are looked for near the robot only: that none was found farther off is no news."""
    flat = room(0.0, 0.0, 12.0, 3.0, RES, RES).fill(-1.0, -1.0, 1.0, 4.0, UNKNOWN)
    robot = (10.25, 1.75)
    manager = FrontierManager(Config())
    manager.given_up.append(GivenUp(*PLACE, GAIN, IN_VAIN, 0, opening=opening))
    manager.update(look(flat, robot, window_m=24.0), robot, SECOND, 1.0, 7)
    assert [f.opening for f in manager.frontiers.values()] == [True] * opening
