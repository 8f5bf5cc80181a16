"""Polygons: what is refused and how it is named; cells, points and lines agree."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planning.fences import FenceView, Polygon, place, polygon
from planning.frames import Planar
from planning.grid import GridSpec
from planning.polygons import (
    PolygonError,
    cells_inside,
    cells_on_border,
    check_rings,
    crosses,
    distance_m,
    inside,
)

SQUARE = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (0.0, 0.0)]
HOLE = [(1.0, 1.0), (2.0, 1.0), (2.0, 2.0), (1.0, 2.0), (1.0, 1.0)]
SPEC = GridSpec(0.1, -20, -20, 90, 80)


def ring(points: list[tuple[float, float]]) -> np.ndarray:
    return np.array(points, dtype=np.float64)


@pytest.mark.parametrize("points", [SQUARE, SQUARE[::-1], [(0, 0), (5, 0), (0, 5), (0, 0)]])
def test_what_is_fit_passes(points: list[tuple[float, float]]) -> None:
    check_rings([points], 100)
    check_rings([SQUARE, HOLE], 100)


@pytest.mark.parametrize(
    ("rings", "index", "says"),
    [
        ([], 0, "missing"),
        ([SQUARE[:3]], 0, "at least 4"),
        ([[*SQUARE[:-1], (0.0, 0.1)]], 0, "not closed"),
        ([[(0, 0), (4, 4), (4, 0), (0, 4), (0, 0)]], 0, r"sides 0 and 2 at \(2, 2\)"),
        ([[(0, 0), (4, 0), (2, 0), (2, 4), (0, 0)]], 0, "crosses itself"),
        ([[(0, 0), (4, 0), (4, 4), (2, 0), (0, 4), (0, 0)]], 0, "crosses itself"),
        ([[(0, 0), (0, 0), (4, 0), (4, 4), (0, 0)]], 0, "twice in a row"),
        ([[(0, 0), (1e-3, 0), (1e-3, 1e-3), (0, 0)]], 0, "encloses"),
        ([[(0, 0), (math.nan, 0), (4, 4), (0, 0)]], 0, "not finite"),
        ([[(11.0, 48.0), (200000.0, 48.0), (11.5, 48.5), (11.0, 48.0)]], 0, "beyond"),
        ([[(0, 0), (30000, 0), (0, 30000), (0, 0)]], 0, "wide"),
        ([SQUARE, [(3, 3), (5, 3), (5, 5), (3, 5), (3, 3)]], 1, "leaves the outer ring"),
        ([SQUARE, HOLE, [(1.5, 1.5), (3, 1.5), (3, 3), (1.5, 3), (1.5, 1.5)]], 2, "crosses ring 1"),
    ],
)
def test_what_is_wrong_is_named(rings: list[list[tuple[float, float]]], index: int, says: str) -> None:
    with pytest.raises(PolygonError, match=says) as caught:
        check_rings(rings, 100)
    assert caught.value.ring == index
    assert caught.value.mend


def test_too_many_points_are_refused() -> None:
    circle = [(math.cos(a), math.sin(a)) for a in np.linspace(0, 2 * math.pi, 200, endpoint=False)]
    with pytest.raises(PolygonError, match="over 100"):
        check_rings([[*circle, circle[0]]], 100)


def star(radii: list[float]) -> np.ndarray:
    """A polygon without knots: corners around a point, at these distances."""
    angles = np.linspace(0.0, 2.0 * math.pi, len(radii), endpoint=False)
    points = np.stack(
        [2.0 + np.array(radii) * np.cos(angles), 1.5 + np.array(radii) * np.sin(angles)], axis=1
    )
    return np.concatenate([points, points[:1]])


@given(st.lists(st.floats(0.5, 3.0), min_size=3, max_size=12))
def test_cells_points_and_distances_agree(radii: list[float]) -> None:
    rings = [star(radii)]
    check_rings([[(float(x), float(y)) for x, y in rings[0]]], 100)
    x, y = np.meshgrid(SPEC.centres_x(), SPEC.centres_y())
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    within = inside(rings, points).reshape(SPEC.shape)
    assert np.array_equal(cells_inside(SPEC, rings), within)
    border = cells_on_border(SPEC, rings)
    edge = within[:, 1:] != within[:, :-1]
    near = border[:, 1:] | border[:, :-1]
    assert (near | ~edge).all()  # between a cell inside and one outside runs the border
    row, column = np.argwhere(border)[0]
    assert distance_m(rings, *SPEC.centre_of(int(row), int(column))) <= 0.0708


def test_lines_meet_the_border() -> None:
    begin = np.array([[-1.0, 2.0], [-1.0, 5.0], [1.0, 1.0], [-1.0, -1.0]])
    end = np.array([[5.0, 2.0], [5.0, 5.0], [2.0, 2.0], [2.0, 2.0]])
    assert crosses([ring(SQUARE)], begin, end).tolist() == [True, False, False, True]


def no_go(*rings: list[tuple[float, float]]) -> Polygon:
    return polygon("no_go", "map", 1.0, rings)


def test_a_polygon_thinner_than_a_cell_shuts_all_the_same() -> None:
    thin = [(1.0, -1.0), (1.01, -1.0), (1.01, 4.0), (1.0, 4.0), (1.0, -1.0)]
    shut = place([no_go(thin)], Planar(0.0, 0.0, 0.0), True).over(SPEC)
    assert shut is not None
    rows = (SPEC.centres_y() > -1.0) & (SPEC.centres_y() < 4.0)
    assert shut.mask[rows].any(axis=1).all()


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_a_fence_in_map_lies_in_odom_where_the_frames_say(x_m: float, y_m: float, yaw_rad: float) -> None:
    frame = Planar(round(x_m, 2), round(y_m, 2), round(yaw_rad, 3))
    placed = place([no_go(SQUARE)], frame, True)
    for point in ((2.0, 2.0), (-0.5, 2.0), (3.9, 0.1), (4.1, 0.1)):
        held = bool(inside([ring(SQUARE)], np.array([point]))[0])
        assert placed.forbids(*frame.inverse().apply(*point)) == held
    assert not place([polygon("no_go", "odom", 1.0, [SQUARE])], frame, True).forbids(-0.5, 2.0)


def test_outside_the_geofence_and_inside_no_go_is_shut() -> None:
    fences = [polygon("geofence", "map", 1.0, [SQUARE]), no_go(HOLE)]
    placed = place(fences, Planar(0.0, 0.0, 0.0), False)
    assert placed.forbids(5.0, 2.0)
    assert placed.forbids(1.5, 1.5)
    assert not placed.forbids(3.0, 3.0)
    assert placed.forbids_lines(np.array([[0.5, 1.5]]), np.array([[3.0, 1.5]])).tolist() == [True]
    shut = placed.over(SPEC)
    assert shut is not None
    row, column = SPEC.cell_of(3.0, 3.0)
    assert not shut.mask[row, column]
    assert shut.distance_m[row, column] == pytest.approx(0.95, abs=0.15)


def test_two_geofences_are_one_ground() -> None:
    right = [(4.0, 0.0), (8.0, 0.0), (8.0, 4.0), (4.0, 4.0), (4.0, 0.0)]
    placed = place(
        [polygon("geofence", "map", 1.0, [r]) for r in (SQUARE, right)], Planar(0.0, 0.0, 0.0), False
    )
    assert not placed.forbids_lines(np.array([[3.0, 2.0]]), np.array([[5.0, 2.0]]))[0]
    assert placed.forbids_lines(np.array([[3.0, 2.0]]), np.array([[3.0, 6.0]]))[0]


def test_priority_counts_most_inside_and_less_with_the_distance() -> None:
    placed = place([polygon("priority", "map", 5.0, [SQUARE])], Planar(0.0, 0.0, 0.0), False)
    boosts = [placed.boost(x, 2.0) for x in (2.0, 5.0, 14.0, 200.0)]
    assert boosts[0] == 5.0
    assert boosts == sorted(boosts, reverse=True)
    assert boosts[-1] == pytest.approx(1.0)
    weights = placed.weights(SPEC)
    assert weights is not None
    assert (weights.min(), weights.max()) == (1.0, 5.0)


def test_a_view_survives_its_snapshot() -> None:
    class Drawn:
        kind, frame, weight = "no_go", "map", 1.0

        class Ring:
            points = SQUARE

        rings = (Ring(),)

    view, twin = FenceView(), FenceView()
    assert view.update(3, [Drawn()])
    assert not view.update(3, [Drawn()])
    twin.set_state(view.state())
    frame = Planar(0.3, -0.2, 0.1)
    first, second = view.shut(SPEC, frame), twin.shut(SPEC, frame)
    assert first is not None and second is not None
    assert twin.version == 3
    assert np.array_equal(first.mask, second.mask)
