"""What irm makes of fences: no ground, no frontiers, no edges; what was behind one comes back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from planning.fences import Placed, place, polygon
from planning.frames import Planar
from planning.grid import FREE
from schemas.base import Pose
from services.irm.config import Config
from services.irm.frontiers import FrontierManager
from services.irm.keyframes import Anchor
from services.irm.out_of_reach import FENCED, OutOfReach
from services.irm.roadmap import ROBOT, Roadmap
from services.irm.window import Window, build_window, grid_of
from tests.irm.worlds import RADIUS_M, Belief, two_rooms

HERE = Planar(0.0, 0.0, 0.0)
EAST = [(1.0, -4.0), (6.0, -4.0), (6.0, 4.0), (1.0, 4.0), (1.0, -4.0)]
CONFIG = Config()


def fences(*rings: list[tuple[float, float]], kind: str = "no_go") -> Placed:
    return place([polygon(kind, "map", 4.0, [ring]) for ring in rings], HERE, True)


def window(placed: Placed, x_m: float = -2.5) -> Window:
    """Two rooms seen whole by a robot in the west one, of which nothing is covered."""
    risk = two_rooms().risk_map(x_m, 0.0)
    spec = grid_of(risk)
    belief = Belief.new(CONFIG, spec.resolution_m)
    return build_window(
        risk, x_m, 0.0, CONFIG, belief.ground.read(spec), belief.coverage.read(spec), [],
        shut=placed.over(spec), weight=placed.weights(spec),
    )  # fmt: skip


def test_shut_ground_is_no_ground_and_the_body_keeps_off() -> None:
    fenced, open_ = window(fences(EAST)), window(Placed())
    x = fenced.spec.centres_x()
    assert not fenced.ground[:, x > 1.0].any()
    assert not fenced.free_space[:, x > 1.0 - RADIUS_M + 0.06].any()
    assert open_.ground[:, x > 2.0].any()
    west = x < 0.0
    assert np.array_equal(fenced.ground[:, west], open_.ground[:, west])
    assert np.array_equal(fenced.state, open_.state)  # the eye looks over a fence


def test_free_ground_that_only_a_fence_closes_off_is_told() -> None:
    places = OutOfReach(1.0)
    places.update(window(fences(EAST)), RADIUS_M, RADIUS_M, Anchor())
    assert [place.reason for place in places.places] == [FENCED]
    assert places.reopened(fences(EAST)) == []
    (back,) = places.reopened(Placed())
    assert back.gain > 5.0
    assert places.places == []


def test_frontiers_behind_a_fence_are_put_aside_and_come_back() -> None:
    manager = FrontierManager(CONFIG)
    next_id = manager.update(window(Placed()), (-2.5, 0.0), 0, 0.0, 1)
    before = {(f.x_m, f.y_m) for f in manager.frontiers.values() if f.x_m > 1.0}
    next_id, back = manager.fence(fences(EAST), True, [], next_id)
    assert not any(f.x_m > 1.0 for f in manager.frontiers.values())
    assert len(manager.aside) == len(before)
    twin = FrontierManager(CONFIG)
    twin.set_state(manager.state())
    next_id, back = twin.fence(Placed(), True, [], next_id)
    assert {(twin.frontiers[n].x_m, twin.frontiers[n].y_m) for n in back} == before
    assert twin.aside == []


def corridor() -> Roadmap:
    """Breadcrumbs 1 to 5 at x = 0, 2, ... 8 m, driven, told."""
    roadmap = Roadmap(CONFIG)
    roadmap.road.set_node(ROBOT, 0.0, 0.0, 0.0, 0, 0.0, 1.0)
    for k in range(1, 6):
        roadmap.road.set_node(k, 2.0 * (k - 1), 0.0, 0.0, 0, 0.0, 1.0)
    for k in range(1, 5):
        roadmap.road.set_edge(k, k + 1, 2.0, 0.0, 1)
    roadmap.road.set_edge(ROBOT, 1, 0.1, 0.0, 0)
    told(roadmap, True)
    return roadmap


def told(roadmap: Roadmap, whole: bool = False) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """(edges told, edges taken away) by the next message."""
    message = roadmap.message(Pose(), Pose(), 0, whole)
    edges = list(zip(message.edge_a.tolist(), message.edge_b.tolist(), strict=True))
    return edges, [(a, b) for a, b in message.removed_edge.tolist()]


def test_edges_through_a_fence_are_kept_and_not_told() -> None:
    roadmap = corridor()
    across = [(2.5, -1.0), (3.5, -1.0), (3.5, 1.0), (2.5, 1.0), (2.5, -1.0)]
    roadmap.fence(fences(across), True, [])
    assert told(roadmap) == ([], [(2, 3)])
    assert roadmap.graph.has_edge(2, 3)
    assert len(roadmap.road.components_of(ROBOT)) == 1
    assert roadmap.road.components_of(4).isdisjoint(roadmap.road.components_of(1))
    twin = Roadmap(CONFIG)
    twin.set_state(roadmap.state())
    for one in (roadmap, twin):
        one.fence(Placed(), True, [])
        assert told(one) == ([(2, 3)], [])
        assert one.road.components_of(4) == one.road.components_of(1)


def test_a_journal_keeps_edges_that_are_shut() -> None:
    roadmap, twin = corridor(), corridor()
    across = [(2.5, -1.0), (3.5, -1.0), (3.5, 1.0), (2.5, 1.0), (2.5, -1.0)]
    roadmap.fence(fences(across), True, [])
    record = roadmap.difference(roadmap.message(Pose(), Pose(), 0, False))
    twin.apply_difference(record)
    assert twin.graph.has_edge(2, 3)
    assert twin.road.shut == {(2, 3)}
    assert (2, 3) not in told(twin, True)[0]


@pytest.mark.parametrize("whole", [False, True])
def test_a_journal_tells_of_shut_edges_that_change_or_go(whole: bool) -> None:
    """No message tells of them, as they have been taken away from the readers before."""
    roadmap, twin = corridor(), corridor()
    across = [(2.5, -1.0), (5.5, -1.0), (5.5, 1.0), (2.5, 1.0), (2.5, -1.0)]
    roadmap.fence(fences(across), True, [])
    twin.apply_difference(roadmap.difference(roadmap.message(Pose(), Pose(), 0, whole)))
    roadmap.road.drop_edge(2, 3)  # as a closure does that tears it
    roadmap.road.set_edge(3, 4, 2.5, 0.1, 0)
    twin.apply_difference(roadmap.difference(roadmap.message(Pose(), Pose(), 0, False)))
    assert not twin.graph.has_edge(2, 3)
    assert twin.graph.edges[3, 4] == roadmap.graph.edges[3, 4]
    assert twin.road.shut == roadmap.road.shut == {(3, 4)}
    twin.fence(Placed(), True, [])
    assert (3, 4) in told(twin, True)[0]


def test_a_priority_counts_more() -> None:
    weighted = window(fences(EAST, kind="priority"))
    assert weighted.weight is not None
    x = weighted.spec.centres_x()
    assert set(np.unique(weighted.weight[:, x < 0.9])) == {1.0}
    row, column = weighted.spec.cell_of(3.0, 0.0)
    assert weighted.weight[row, column] == 4.0
    assert weighted.state[row, column] == FREE
    assert math.isclose(fences(EAST, kind="priority").boost(3.0, 0.0), 4.0)
