"""Keyframes, the frame that goes with them, what is found by place, and which breadcrumbs hang together."""

from __future__ import annotations

import math

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.frames import Planar
from planning.grid import FREE, GridSpec
from schemas.contract import SECOND_NS
from schemas.sensing import PoseGraph
from services.irm.components import Components
from services.irm.footprints import FootprintStore, blur_level
from services.irm.keyframes import IDENTITY, NOBODY, Keyframes, OdomInMap
from services.irm.spatial import SpatialHash
from services.irm.tiles import TileLayer
from tests.irm.worlds import pose_graph, scan_at

RES = 0.2


def graph(keyframes: dict[int, Planar], variances: dict[int, float] | None = None) -> PoseGraph:
    """As a message; variances of x and y."""
    message = pose_graph(keyframes)
    values = variances or {}
    columns = [(values.get(k, 0.0), values.get(k, 0.0), 0.0) for k in sorted(keyframes)]
    return message.model_copy(update={"covariance": np.array(columns).reshape(-1, 3)})


def test_only_what_has_really_moved_is_told_and_small_motions_add_up() -> None:
    held = Keyframes()
    start = {k: Planar(float(k), 0.0, 0.0) for k in range(5)}
    assert held.read(graph(start)) == ({}, IDENTITY), "new ones have not moved"
    assert held.read(graph(start)) == ({}, IDENTITY)
    nudged = {**start, 2: Planar(2.012, 0.0, 0.0)}
    assert held.read(graph(nudged)) == ({}, IDENTITY)
    assert held.pose(2) == start[2]
    moved, motion = held.read(graph({**start, 2: Planar(2.024, 0.0, 0.0), 5: Planar(5.0, 0.0, 0.0)}))
    assert moved == {2: Planar(2.024, 0.0, 0.0)}
    assert motion.is_identity, "the newest one stayed"
    turned = {**start, 4: Planar(4.0, 0.0, math.tau + 0.5)}
    moved, motion = held.read(graph(turned))
    assert set(moved) == {2, 4}
    x, y = motion.apply(4.0, 0.0)
    assert (x, y, motion.yaw_rad) == pytest.approx((4.0, 0.0, 0.5)), "of the newest known before and after"
    assert held.pose(5) is None and held.pose(1) == start[1]


def test_the_keyframe_that_what_is_seen_belongs_to() -> None:
    held = Keyframes()
    assert held.reference(0.0, 0.0).keyframe == NOBODY
    held.read(graph({3: Planar(0.0, 0.0, 0.0), 7: Planar(50.0, 0.0, 0.0), 9: Planar(4.0, 0.0, 0.0)}))
    assert held.reference(0.1, 0.0).keyframe == 9, "the newest, though an older one seems nearer"
    assert held.reference(49.0, 0.0).keyframe == 7, "the newest is far: SLAM adds none where it has been"


def test_deviations_are_relative_to_the_robots_keyframe_not_to_the_start() -> None:
    held = Keyframes()
    places = {k: Planar(2.0 * k, 0.0, 0.0) for k in range(4)}
    held.read(graph(places, {0: 0.0, 1: 2.0, 2: 8.0, 3: 8.0}))  # x and y together: 0, 4, 16, 16
    found = held.deviations_m(held.reference(6.0, 0.0), 5.0, 0.5, 1.0)
    assert found == {1: pytest.approx(2.0), 2: 0.0, 3: 0.0}, "0 is too far away"
    found = held.deviations_m(held.reference(6.0, 0.0), 5.0, 0.5, 0.02)
    assert found == {1: pytest.approx(0.08), 2: 0.0, 3: 0.0}, "odometry knows what was driven lately"
    held.read(graph(places, dict.fromkeys(places, 100.0)))
    assert held.deviations_m(held.reference(6.0, 0.0), 5.0, 0.5, 1.0) == {}, "all have drifted alike"


@pytest.mark.parametrize("first", ["graph", "odometry"])
def test_the_frame_waits_for_both_halves_of_a_closure(first: str) -> None:
    frame, closed = OdomInMap(), Planar(2.0, 1.0, 0.1)
    assert frame.update(IDENTITY, 0, known=True) == IDENTITY
    if first == "graph":
        frame.follow(closed)
        assert frame.update(IDENTITY, SECOND_NS, known=True) == closed
        assert frame.update(closed, 2 * SECOND_NS, known=True) == closed
    else:
        assert frame.update(closed, SECOND_NS, known=True) == IDENTITY
        frame.follow(closed)
        assert frame.update(closed, 2 * SECOND_NS, known=True) == closed
    assert frame.update(Planar(2.05, 1.0, 0.1), 3 * SECOND_NS, known=True).x_m == 2.05, "small ones at once"


def test_a_frame_without_keyframes_or_that_never_agrees_is_taken_as_told() -> None:
    frame, far = OdomInMap(), Planar(3.0, 0.0, 0.0)
    assert frame.update(far, 0, known=False) == far
    assert frame.update(IDENTITY, SECOND_NS, known=True) == far
    assert frame.update(IDENTITY, 3 * SECOND_NS, known=True) == IDENTITY


def test_a_graph_that_comes_late_does_not_move_the_frame_a_second_time() -> None:
    frame, closed, again = OdomInMap(), Planar(2.0, 1.0, 0.1), Planar(0.5, 0.0, 0.0)
    frame.update(IDENTITY, 0, known=True)
    frame.update(closed, SECOND_NS, known=True)
    assert frame.update(closed, 3 * SECOND_NS, known=True) == closed, "waited for, then taken as told"
    frame.follow(closed)
    assert frame.update(closed, 4 * SECOND_NS, known=True) == closed
    frame.follow(again)
    assert frame.update(again.compose(closed), 5 * SECOND_NS, known=True) == again.compose(closed)


@given(st.floats(0.0, 20.0), st.floats(0.1, 2.0))
def test_the_blur_begins_at_its_bound_and_has_an_end(deviation_m: float, from_m: float) -> None:
    level = blur_level(deviation_m, from_m)
    assert 0 <= level <= 4
    assert level == 0 if deviation_m <= from_m else 2 ** (-level / 2) >= min(1.0, from_m / deviation_m) / 1.2


def test_uncertain_footprints_count_less_and_whole_again_after_a_closure() -> None:
    layer = TileLayer("float32", 0.0, RES)
    store = FootprintStore(layer)
    spec = GridSpec(RES, -20, -20, 40, 40)
    state = np.full(spec.shape, FREE, np.uint8)
    for k in (0, 1):
        store.add(scan_at(IDENTITY, k, range_m=1.0), IDENTITY, state, spec, IDENTITY)
    whole = layer.read(spec)
    assert store.blur({0: 0.3, 1: 0.4}, 0.5) == 0
    assert store.blur({0: 2.0}, 0.5) == 1
    assert layer.read(spec).max() == pytest.approx(whole.max() * (0.5 + 0.125), rel=1e-5)
    other = FootprintStore(layer)
    other.set_state(store.state())
    assert other.blur({0: 2.0}, 0.5) == 0, "the level is in the snapshot"
    assert store.follow({0: Planar(1.0, 0.0, 0.0)}) == 1
    assert store.follow({0: IDENTITY}) == 1
    assert store.blur({}, 0.5) == 1
    np.testing.assert_allclose(layer.read(spec), whole, atol=1e-5)


_PLACES = st.lists(st.tuples(st.floats(-30, 30), st.floats(-30, 30)), min_size=1, max_size=30)


@given(_PLACES, _PLACES, st.floats(0, 25))
def test_what_lies_near_is_found_wherever_it_was_put_before(
    first: list[tuple[float, float]], then: list[tuple[float, float]], radius: float
) -> None:
    index, places = SpatialHash(), dict(enumerate(first))
    for k, p in places.items():
        index.put(k, *p)
    for k, p in enumerate(then):
        places[k] = p
        index.put(k, *p)
    index.drop(0)
    index.drop(0)
    del places[0]
    found = list(index.around(1.0, -2.0, radius))
    assert len(found) == len(set(found)) and set(found) <= places.keys()
    assert {k for k, p in places.items() if math.dist(p, (1.0, -2.0)) <= radius} <= set(found)


@settings(max_examples=60)
@given(st.lists(st.tuples(st.integers(0, 11), st.integers(0, 11)), max_size=60))
def test_components_equal_those_of_a_search(toggles: list[tuple[int, int]]) -> None:
    """Each pair adds its edge, or takes it away when it is there."""
    held = Components()
    truth: nx.Graph[int] = nx.Graph()
    for node in range(12):
        held.add(node)
        truth.add_node(node)
    for a, b in toggles:
        if a == b:
            continue
        if truth.has_edge(a, b):
            truth.remove_edge(a, b)
            held.part(a, b, truth.neighbors)
        else:
            truth.add_edge(a, b)
            held.join(a, b)
        labels = [held.label(n) for n in range(12)]
        for part in nx.connected_components(truth):
            assert len({labels[n] for n in part}) == 1
        assert len(set(labels)) == nx.number_connected_components(truth)
    assert held.label(99) == -1
