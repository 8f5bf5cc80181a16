"""The fine layers around the robot against brute force: where it fits, what it can reach and touch."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from planning.coverage import LOG_2, entropy
from planning.grid import FREE, LETHAL, UNKNOWN
from services.irm.config import Config
from services.irm.window import connected_free_space, dilate_disc, window_picture, without_slivers
from tests.irm.worlds import RADIUS_M, Belief, cluttered, room, two_rooms

RES = 0.1


def _reachable(passable: NDArray[np.bool_], robot: tuple[int, int]) -> NDArray[np.bool_]:
    """The 4-connected component of the robot's cell."""
    labels, _ = ndimage.label(passable)
    reached: NDArray[np.bool_] = (labels == labels[robot]) & passable
    return reached


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_free_space_and_ground_equal_brute_force(seed: int) -> None:
    flat = cluttered(seed)
    risk, belief = flat.risk_map(), Belief.new(Config(), RES)
    window = belief.window(risk, 0.0, 0.0)
    passable = (flat.state == FREE) & (risk.clearance_m >= RADIUS_M)
    free = _reachable(passable, flat.spec.cell_of(0.0, 0.0))
    assert np.array_equal(window.free_space, free)
    away = ndimage.distance_transform_edt(~free) * RES
    near = (away <= RADIUS_M - 1e-6) & (flat.state == FREE)
    wide = (away <= RADIUS_M + 1e-6) & (flat.state == FREE)
    assert not (near & ~window.ground).any() and not (window.ground & ~wide).any()
    assert not (window.ground & (flat.state != FREE)).any()


@given(seed=st.integers(0, 10_000), radius=st.floats(0.0, 4.0))
def test_dilation_by_a_disc_equals_brute_force(seed: int, radius: float) -> None:
    source = np.random.default_rng(seed).random((14, 17)) < 0.2
    out = np.zeros(source.shape, np.bool_)
    dilate_disc(source, radius, out)
    cells = np.argwhere(source)
    for r in range(14):
        for c in range(17):
            squared = ((cells - (r, c)) ** 2).sum(axis=1).min(initial=999)
            assert out[r, c] == (squared <= radius**2 + 1e-9)


@given(seed=st.integers(0, 10_000), share=st.floats(0.1, 0.9))
def test_slivers_are_what_has_no_broad_cell_beside_it(seed: int, share: float) -> None:
    mask = np.random.default_rng(seed).random((13, 16)) < share
    mask[5:9, 5:9] = True
    kept = without_slivers(mask)
    around = ndimage.convolve(mask.astype(int), np.ones((3, 3), int), mode="constant")
    core = mask & (around >= 6)
    assert np.array_equal(kept, mask & ndimage.binary_dilation(core, np.ones((3, 3), np.bool_)))
    assert kept[5:9, 5:9].all()


def test_a_door_is_passable_when_the_robot_fits_and_not_when_it_does_not() -> None:
    """The lethal points are the cells' centres here: half a cell of room more on either side."""
    for door_m, passes in ((0.4, False), (0.8, True)):
        flat = two_rooms(door_m)
        window = Belief.new(Config(), RES).window(flat.risk_map(), -2.5, 0.0)
        assert window.free_space[flat.spec.cell_of(-1.0, 1.0)]
        assert bool(window.free_space[flat.spec.cell_of(2.0, 1.0)]) is passes
        assert bool(window.ground[flat.spec.cell_of(4.0, -2.0)]) is passes


def test_what_was_passable_stays_so_while_clearance_wavers() -> None:
    flat = two_rooms(0.8)
    risk = flat.risk_map()
    tight = risk.clearance_m[flat.spec.cell_of(0.1, 0.0)]
    hysteresis = Config().clearance_hysteresis_m
    assert hysteresis > 0.0
    for share, passes in ((0.6, True), (1.4, False)):
        belief, waver = Belief.new(Config(), RES), share * hysteresis
        exact = risk.model_copy(update={"footprint_radius_m": float(tight) - 1e-4})
        assert belief.window(exact, -2.5, 0.0).free_space[flat.spec.cell_of(2.0, 0.0)]
        narrower = exact.model_copy(
            update={"clearance_m": np.maximum(risk.clearance_m - np.float32(waver), 0)}
        )
        again = belief.window(narrower, -2.5, 0.0)
        assert bool(again.free_space[flat.spec.cell_of(2.0, 0.0)]) is passes
    fresh = Belief.new(Config(), RES).window(narrower, -2.5, 0.0)
    assert not fresh.free_space[flat.spec.cell_of(2.0, 0.0)]


def test_a_robot_whose_own_cell_is_too_tight_starts_at_the_nearest_good_one() -> None:
    flat = room(-3, -3, 3, 3)
    window = Belief.new(Config(), RES).window(flat.risk_map(), 2.95, 0.0)
    assert not window.free_space[flat.spec.cell_of(2.95, 0.0)]
    assert window.free_space[flat.spec.cell_of(0.0, 0.0)]
    outside = Belief.new(Config(), RES).window(flat.risk_map(), 50.0, 0.0)
    assert not outside.free_space.any() and not outside.ground.any()


def test_ground_is_remembered_where_the_map_has_forgotten_it_and_goes_when_it_turns_out_solid() -> None:
    flat = room(-3, -3, 3, 3)
    belief = Belief.new(Config(), RES)
    belief.window(flat.risk_map(), 0.0, 0.0)
    flat.fill(1.0, -3.0, 3.0, 3.0, UNKNOWN)
    forgotten = belief.window(flat.risk_map(), 0.0, 0.0)
    assert forgotten.ground[flat.spec.cell_of(2.0, 0.0)]
    flat.fill(1.0, -3.0, 3.0, 3.0, LETHAL)
    solid = belief.window(flat.risk_map(), 0.0, 0.0)
    assert not solid.ground[flat.spec.cell_of(2.0, 0.0)]


def test_ground_beyond_what_the_map_has_forgotten_can_still_be_reached_but_not_beyond_the_unseen() -> None:
    """No path is searched over forgotten ground (it is no free space), and what turns out lethal ends it."""
    beyond, gap = (2.0, 0.0), (0.0, -3.0, 1.0, 3.0)
    for seen_before in (True, False):
        flat, belief = room(-3, -3, 3, 3), Belief.new(Config(), RES)
        cell = flat.spec.cell_of(*beyond)
        if seen_before:
            belief.window(flat.risk_map(), -2.0, 0.0)
        window = belief.window(flat.fill(*gap, UNKNOWN).risk_map(), -2.0, 0.0)
        assert not window.free_space[cell]
        assert bool(window.reachable[cell]) is seen_before
        assert bool(window.ground[cell]) is seen_before
        assert not (window.free_space & ~window.reachable).any()
    belief = Belief.new(Config(), RES)
    belief.window(room(-3, -3, 3, 3).risk_map(), -2.0, 0.0)
    shut = belief.window(flat.fill(*gap, LETHAL).risk_map(), -2.0, 0.0)
    assert not shut.reachable[cell] and not shut.ground[cell]


def test_hopeful_is_what_no_risk_map_ever_knew_and_where_the_robot_may_fit_and_get() -> None:
    flat = two_rooms(0.4)
    flat.fill(-1.2, -1.0, -0.2, 1.0, UNKNOWN)
    flat.fill(2.0, -1.0, 3.0, 1.0, UNKNOWN)
    belief, hole, far = Belief.new(Config(), RES), flat.spec.cell_of(-0.7, 0.0), flat.spec.cell_of(2.5, 0.0)
    beside_the_wall = flat.spec.cell_of(-0.25, 0.9)
    first = belief.window(flat.risk_map(), -2.5, 0.0)
    assert not (first.hopeful & (flat.state != UNKNOWN)).any()
    assert first.hopeful[hole]
    assert not first.hopeful[beside_the_wall], "its body would touch the wall"
    assert not first.hopeful[far], "the way there is a slit of 0.4 m"
    assert not first.hopeful[0].any(), "behind the walls"
    flat.fill(-9.0, -9.0, 9.0, 9.0, UNKNOWN)
    forgotten = belief.window(flat.risk_map(), -2.5, 0.0)
    assert not forgotten.hopeful[flat.spec.cell_of(-2.5, 1.0)], "what is forgotten was seen"
    assert forgotten.hopeful[hole], "as far as obstacles are known"
    flat.fill(-1.2, -1.0, -0.2, 1.0, FREE)
    assert not belief.window(flat.risk_map(), -2.5, 0.0).hopeful[hole]


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_entropy_is_that_of_the_uncovered_ground_in_nats_of_patches(seed: int) -> None:
    flat, belief = cluttered(seed), Belief.new(Config(), RES)
    rng = np.random.default_rng(seed)
    layer = rng.choice(np.array([0.0, 0.7, 3.0], np.float32), flat.spec.shape)
    layer = np.repeat(np.repeat(layer[::5, ::5], 5, axis=0), 5, axis=1)[: layer.shape[0], : layer.shape[1]]
    belief.coverage.write(flat.spec, layer)
    window = belief.window(flat.risk_map(), 0.0, 0.0)
    p = 1 / (1 + np.exp(-layer))
    assert np.allclose(window.probability, p, atol=1e-6)
    assert not (window.uncovered & ~(window.ground & (p < 0.9))).any()
    assert np.array_equal(window.uncovered, without_slivers(window.ground & (p < 0.9)))
    expected = np.where(window.uncovered, entropy(p.astype(np.float32)) * RES**2, 0.0)
    assert np.allclose(window.entropy, expected, atol=1e-7)
    assert window.entropy.max() <= LOG_2 * RES**2 + 1e-7


def test_where_the_robot_was_blocked_hazard_is_raised_there_only() -> None:
    flat = room(-3, -3, 3, 3)
    plain = Belief.new(Config(), RES).window(flat.risk_map(), 0.0, 0.0)
    blocked = Belief.new(Config(), RES).window(flat.risk_map(), 0.0, 0.0, [(1.0, 0.5), (99.0, 0.0)])
    raised = blocked.hazard - plain.hazard
    x, y = np.meshgrid(flat.spec.centres_x(), flat.spec.centres_y())
    near = np.maximum(np.abs(x - 1.0), np.abs(y - 0.5))
    assert np.allclose(raised[near < 0.35], 1.0) and np.allclose(raised[near > 0.55], 0.0)
    assert (blocked.step_cost >= plain.step_cost).all()


def test_paths_cost_more_near_walls_and_never_less_than_their_length() -> None:
    flat = room(-3, -3, 3, 3)
    window = Belief.new(Config(), RES).window(flat.risk_map(), 0.0, 0.0)
    middle, side = flat.spec.cell_of(0.0, 0.0), flat.spec.cell_of(2.65, 0.0)
    assert window.step_cost.min() >= 1.0
    assert math.isclose(window.step_cost[middle], 1.0, abs_tol=1e-5)
    assert window.step_cost[side] > 1.2


def test_the_picture_shows_each_kind_of_cell() -> None:
    flat = two_rooms(0.4)
    belief = Belief.new(Config(), RES)
    x, _ = np.meshgrid(flat.spec.centres_x(), flat.spec.centres_y())
    belief.cover(flat.spec, x < -3.0)
    cell = window_picture(belief.window(flat.risk_map(), -2.5, 0.0))
    places = [(9.0, 0.0), (-1.0, 0.0), (-4.0, 0.0), (-5.1, 0.0), (3.0, 0.0)]
    at = [flat.spec.cell_of(px, py) for px, py in places]
    shown = [int(cell[rc]) if flat.spec.contains(*rc) else 0 for rc in at]
    assert shown == [0, 1, 2, 3, 4]
    assert cell[0, 0] == 0


@given(row=st.integers(-60, 100), column=st.integers(-60, 100))
def test_a_robot_out_of_the_window_reaches_only_what_lies_beside_it(row: int, column: int) -> None:
    reached = connected_free_space(np.ones((40, 50), np.bool_), (row, column))
    away = max(-row, row - 39, -column, column - 49, 0)
    assert reached.all() if away <= 6 else not reached.any()
