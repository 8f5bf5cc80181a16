"""Ways over known ground: the cheapest there are, over ground alone, and distances that fit them."""

from __future__ import annotations

import itertools
import math

import networkx as nx
import numpy as np
import pytest

from planning.grid import GridSpec
from plgrim.evaluation.known_ground import KnownGround, Mask, Points, distances_between
from plgrim.evaluation.tour import tour_judge
from tests.evaluation.worlds import CONFIG, rooms


def ground_of(mask: Mask) -> KnownGround:
    return KnownGround(GridSpec(0.1, -20, 30, mask.shape[1], mask.shape[0]), mask)


def hook() -> Mask:
    """Two chambers side by side whose only link is a long way round."""
    mask = np.zeros((120, 60), np.bool_)
    mask[5:115, 5:25] = mask[5:115, 35:55] = mask[105:115, 5:55] = True
    return mask


def cheapest(ground: KnownGround, begin: tuple[int, int], end: tuple[int, int]) -> float:
    """By another library, from the definition of the cost."""
    rough = 1.0 + 1.5 * np.maximum(0.0, 0.4 / np.maximum(ground.margin_m.astype(np.float64), 0.1) - 1.0)
    graph: nx.Graph[tuple[int, int]] = nx.Graph()
    mask = ground.roamed
    for r, c in np.argwhere(mask).tolist():
        for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
            r1, c1 = r + dr, c + dc
            if mask[r1, c1] and mask[r, c1] and mask[r1, c]:
                graph.add_edge(
                    (r, c), (r1, c1), weight=0.1 * math.hypot(dr, dc) * 0.5 * (rough[r, c] + rough[r1, c1])
                )
    return float(nx.dijkstra_path_length(graph, begin, end))


def on_ground(ground: KnownGround, points: Points) -> bool:
    """Whether a polyline keeps to the ground."""
    for a, b in itertools.pairwise(points):
        count = max(2, math.ceil(float(np.hypot(*(b - a))) / 0.02))
        along = a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)
        if (ground.margin_at(along) <= 0.0).any():
            return False
    return True


def test_the_way_round_is_found_although_its_end_lies_behind_the_wall() -> None:
    ground = ground_of(hook())
    begin, end = (10, 20), (10, 40)
    points, cost = ground.way(ground.spec.centre_of(*begin), end)
    assert cost == pytest.approx(cheapest(ground, begin, end), rel=1e-5)
    assert points[-1] == pytest.approx(ground.spec.centre_of(*end))
    assert float(np.hypot(*np.diff(points, axis=0).T).sum()) > 19.0
    assert on_ground(ground, points)


def test_where_there_is_room_ways_keep_off_the_rim() -> None:
    mask = np.zeros((60, 100), np.bool_)
    mask[5:55, 5:95] = True
    mask[5:40, 48:52] = False
    ground = ground_of(mask)
    points, _ = ground.way(ground.spec.centre_of(8, 20), (8, 80))
    inner = points[1:-1]
    assert len(inner) >= 1
    assert (ground.margin_at(inner) >= 0.3).all()


def test_there_is_no_way_to_another_part() -> None:
    mask = hook()
    mask[105:115, 28:32] = False
    ground = ground_of(mask)
    points, cost = ground.way(ground.spec.centre_of(10, 20), (10, 40))
    assert math.isinf(cost)
    assert len(points) == 1
    part = ground.part_with(*ground.spec.centre_of(10, 20))
    assert part.roamed[:, :28].sum() == mask[:, :28].sum()
    assert not part.roamed[:, 30:].any()


def test_places_lie_on_the_ground_one_in_each_square() -> None:
    ground = ground_of(hook())
    cells = ground.places(1.5)
    assert ground.roamed[cells[:, 0], cells[:, 1]].all()
    squares = {(r // 15, c // 15) for r, c in cells.tolist()}
    assert len(squares) == len(cells)
    assert squares == {(r // 15, c // 15) for r, c in np.argwhere(ground.roamed).tolist()}


def test_distances_are_those_of_ways() -> None:
    """Along the roadmap a way is never shorter than the cheapest, and not much longer."""
    ground = ground_of(hook())
    cells = ground.places(1.5)
    distance = distances_between(ground.roadmap(cells, 1.5), np.arange(len(cells)))
    exact = ground.from_point(*ground.spec.centre_of(*cells[0].tolist()), cells)
    assert np.isfinite(distance).all()
    assert (distance == distance.T).all()
    assert (distance[0] >= exact - 1e-4).all()
    assert (distance[0] <= 1.1 * exact + 1e-4).all()


def test_a_roadmap_joins_places_whose_neighbours_are_behind_walls() -> None:
    ground = ground_of(hook())
    cells = np.array([[10, 10], [10, 50]])
    distance = distances_between(ground.roadmap(cells, 1.5), np.arange(2))
    assert distance[0, 1] == pytest.approx(cheapest(ground, (10, 10), (10, 50)), rel=1e-5)


def test_the_judge_roams_what_it_then_sweeps() -> None:
    world = rooms(6.0, 4.0, walls=((3.0, 0.0, 3.2, 3.0),))
    judge = tour_judge(world, CONFIG)
    assert judge.roamed.any()
    assert (judge.reachable | ~judge.roamed).all()
    assert not (judge.roamed & world.occupied).any()
    assert judge.reachable.sum() > judge.roamed.sum()


def test_a_disc_can_be_left_out() -> None:
    ground = ground_of(hook())
    x_m, y_m = ground.spec.centre_of(50, 15)
    smaller = ground.without(x_m, y_m, 0.35)
    assert not smaller.roamed[48:53, 13:18].any()
    assert smaller.roamed.sum() == ground.roamed.sum() - 37
    row, column = smaller.nearest_cell(x_m, y_m)
    away = np.hypot(*(np.argwhere(smaller.roamed) - (50, 15)).T)
    assert smaller.roamed[row, column]
    assert math.hypot(row - 50, column - 15) == away.min()
