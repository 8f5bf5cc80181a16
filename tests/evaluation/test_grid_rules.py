"""The grid protocols: kernels against brute force, worlds on hand-made maps, the peers' figures on third-party maps."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from plgrim.evaluation.grid_kernels import (
    OPEN,
    SOLID,
    UNSEEN,
    block_minimum,
    connected_open,
    frontier_cells,
    in_sight,
    is_open_line,
    scan,
    without_settled,
)
from plgrim.evaluation.grid_peers import best_node, discounted_utility, explore, nearest
from plgrim.evaluation.grid_rules import (
    AriadneWorld,
    DareWorld,
    GridMap,
    MapError,
    ariadne_map,
    dare_map,
    first_move,
    make_world,
    ray_ends,
    read_map,
)

DATA = Path(os.environ.get("PLGRIM_DATA_DIR", Path(__file__).parents[3] / "shared" / "data")) / "protocol"
needs_maps = pytest.mark.skipif(
    not (DATA / "peers_ariadne.csv").is_file(), reason=f"third-party maps are not here ({DATA})"
)


def line_cells(x0: int, y0: int, x1: int, y1: int) -> list[tuple[int, int]]:
    """The peers' line, cell by cell: one step along one axis at a time, whichever is behind."""
    cells, x, y = [(x0, y0)], x0, y0
    dx, dy = abs(x1 - x0), abs(y1 - y0)
    error = dx - dy
    while (x, y) != (x1, y1):
        if error > 0:
            x, error = x + (1 if x1 > x0 else -1), error - 2 * dy
        else:
            y, error = y + (1 if y1 > y0 else -1), error + 2 * dx
        cells.append((x, y))
    return cells


def brute_scan(truth: NDArray[np.uint8], x: int, y: int, range_cells: int, depth: int) -> NDArray[np.uint8]:
    belief = np.full(truth.shape, UNSEEN, np.uint8)
    for x1, y1 in ray_ends(x, y, range_cells).tolist():
        walls = 0
        for cx, cy in line_cells(x, y, x1, y1)[:-1]:
            if not (0 <= cx < truth.shape[1] and 0 <= cy < truth.shape[0]):
                break
            if truth[cy, cx] == OPEN and walls:
                break
            walls += int(truth[cy, cx] == SOLID)
            if walls > depth:
                break
            belief[cy, cx] = truth[cy, cx]
    return belief


random_maps = st.integers(0, 2**32 - 1).map(
    lambda seed: np.where(np.random.default_rng(seed).random((24, 31)) < 0.2, SOLID, OPEN).astype(np.uint8)
)


@settings(max_examples=25, deadline=None)
@given(random_maps, st.integers(0, 30), st.integers(0, 23), st.sampled_from([1, 3, 9]))
def test_scan_is_the_rays_cell_by_cell(truth: NDArray[np.uint8], x: int, y: int, depth: int) -> None:
    belief = np.full(truth.shape, UNSEEN, np.uint8)
    scan(truth, belief, x, y, ray_ends(x, y, 10), depth)
    assert np.array_equal(belief, brute_scan(truth, x, y, 10, depth))


@settings(max_examples=40, deadline=None)
@given(random_maps, st.tuples(*[st.integers(0, 30), st.integers(0, 23)] * 2))
def test_a_line_is_open_when_all_before_its_end_is(
    truth: NDArray[np.uint8], ends: tuple[int, int, int, int]
) -> None:
    cells = line_cells(*ends)[:-1]
    assert is_open_line(truth, *ends) == all(truth[y, x] == OPEN for x, y in cells)


def test_there_are_720_rays() -> None:
    assert len(ray_ends(0, 0, 80)) == 720
    assert np.all(np.abs(np.hypot(*ray_ends(0, 0, 80).T) - 80.0) < 1.0)


def test_a_wall_is_marked_nine_cells_deep() -> None:
    truth = np.full((41, 80), SOLID, np.uint8)
    truth[10:31, :30] = OPEN
    belief = np.full(truth.shape, UNSEEN, np.uint8)
    scan(truth, belief, 10, 20, ray_ends(10, 20, 60), 9)
    assert np.flatnonzero(belief[20] == SOLID).tolist() == list(range(30, 39))


def test_frontier_cells_have_two_to_seven_unseen_neighbours() -> None:
    belief = np.full((5, 6), UNSEEN, np.uint8)
    belief[:, :3] = OPEN
    assert frontier_cells(belief).tolist() == [[2, row] for row in range(5)]
    belief[:, 3:] = SOLID
    belief[2, 4] = UNSEEN
    assert len(frontier_cells(belief)) == 0


def test_blocks_take_the_minimum() -> None:
    belief = np.full((4, 8), OPEN, np.uint8)
    belief[1, 1], belief[3, 6] = UNSEEN, SOLID
    assert block_minimum(belief, 4).tolist() == [[UNSEEN, SOLID]]


def test_connected_goes_around_corners_only_where_it_is_open() -> None:
    belief = np.array([[OPEN, SOLID, OPEN], [SOLID, OPEN, SOLID], [SOLID, SOLID, SOLID]], np.uint8)
    assert connected_open(belief, 0, 0).sum() == 3
    belief[1, 1] = UNSEEN
    assert connected_open(belief, 0, 0).sum() == 1


def room_map(rules: str) -> GridMap:
    """Two rooms and a corridor, start in the first room; large enough for either rules' marker."""
    gray = np.full((480, 640), 127, np.int64)
    gray[100:220, 100:220] = gray[140:180, 220:400] = gray[60:260, 400:520] = 195
    gray[150:166, 150:166] = 208
    return ariadne_map("rooms", gray) if rules == "ariadne" else dare_map("rooms", gray)


def test_starts_are_the_128th_pixel_and_the_11th_cell() -> None:
    assert room_map("ariadne").start == (150 + 127 % 16, 150 + 127 // 16)
    assert room_map("dare").start == (75 + 10 % 8, 75 + 10 // 8)
    with pytest.raises(MapError, match="marker"):
        ariadne_map("empty", np.full((50, 50), 195, np.int64))


def test_grays_of_dare() -> None:
    gray = np.repeat(np.array([[195, 60, 127, 90]]), 12, axis=0).repeat(2, axis=1)
    gray[:, :2] = 208
    gray = np.repeat(gray, 2, axis=0)
    assert np.array_equal(dare_map("grays", gray).truth[0], [OPEN, OPEN, SOLID, SOLID])


@pytest.mark.parametrize("rules", ["ariadne", "dare"])
def test_moves_cost_their_length_and_only_edges_are_moves(rules: str) -> None:
    world = make_world(room_map(rules), rules)  # type: ignore[arg-type]
    node, length = next(iter(world.edges[world.at].items()))
    expected = math.dist(world.place[world.at], world.place[node])
    assert length == pytest.approx(expected)
    goal = world.node[node].tolist()
    world.move(node)
    assert world.travelled == pytest.approx(expected)
    assert world.node[world.at].tolist() == goal
    with pytest.raises(ValueError, match="no edge"):
        world.move(world.at)


@pytest.mark.parametrize("rules", ["ariadne", "dare"])
@pytest.mark.parametrize("rule", [nearest, discounted_utility])
def test_simple_rules_end_with_the_map_known(rules: str, rule: object) -> None:
    world = make_world(room_map(rules), rules)  # type: ignore[arg-type]
    assert explore(world, rule)  # type: ignore[arg-type]
    assert world.unseen_cells() <= 250
    assert np.array_equal(world.belief[world.belief != UNSEEN], world.truth[world.belief != UNSEEN])
    goal, _ = best_node(world, nearest)
    assert goal < 0 or isinstance(world, AriadneWorld)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.6), st.floats(0.0, 0.3))
@settings(max_examples=40, deadline=None)
def test_unseen_cells_beside_settled_ground_alone_become_walls(
    seed: int, unseen: float, open_share: float
) -> None:
    random = np.random.default_rng(seed)
    belief = np.where(random.random((9, 12)) < unseen, UNSEEN, OPEN).astype(np.uint8)
    belief[random.random(belief.shape) < 0.2] = SOLID
    open_border = (random.random(belief.shape) < open_share) & (belief == OPEN)
    found = without_settled(belief, open_border)
    for row, column in np.ndindex(belief.shape):
        around = (slice(max(0, row - 1), row + 2), slice(max(0, column - 1), column + 2))
        shut = (
            belief[row, column] == UNSEEN and (belief[around] == OPEN).any() and not open_border[around].any()
        )
        assert found[row, column] == (SOLID if shut else belief[row, column])


def counted(world: DareWorld) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Frontier points (m, 2), whether any node sees each, and whether one with any utility does."""
    cells, place = world.frontier()
    seen = np.zeros((len(world.node), len(cells)), np.bool_)
    in_sight(world.belief, world.node, cells, world.place, place, world.utility_range, seen)
    counts = np.asarray(seen[world.utility > 0].any(axis=0), np.bool_)
    return cells, np.asarray(seen.any(axis=0), np.bool_), counts


def test_what_a_useful_node_counts_stays_unseen_and_the_rest_of_the_frontier_is_shut() -> None:
    world = make_world(room_map("dare"), "dare")
    assert isinstance(world, DareWorld)
    shut = 0
    while not world.done:
        goal, before = best_node(world, nearest)
        world.move(first_move(before, world.at, goal))
        given = world.belief_of_use()
        changed = given != world.belief
        assert np.all(world.belief[changed] == UNSEEN)
        assert np.all(given[changed] == SOLID)
        shut += int(changed.sum())
        cells, in_view, counts = counted(world)
        for x, y in cells[counts].tolist():
            assert not changed[y - 1 : y + 2, x - 1 : x + 2].any()
        left = {tuple(c) for c in frontier_cells(given).tolist()}
        alone = [c for c, s in zip(cells.tolist(), in_view & ~counts, strict=True) if s]
        assert len(left & {tuple(c) for c in alone}) < max(1, len(alone))
    assert shut > 0


def test_ariadne_shuts_openings_that_lead_to_less_than_may_stay_unseen() -> None:
    world = make_world(room_map("ariadne"), "ariadne")
    assert isinstance(world, AriadneWorld)
    world.belief[:60], world.belief[60:] = SOLID, OPEN
    world.belief[40:60, 40:48] = UNSEEN  # two blocks wide
    world.belief[40:60, 80:120] = UNSEEN
    shut = world.belief_of_use() != world.belief
    assert shut[59, 40:48].all()
    assert not shut[:, 80:120].any()


def test_dare_nodes_are_multiples_of_four_metres_from_the_start() -> None:
    world = make_world(room_map("dare"), "dare")
    assert isinstance(world, DareWorld)
    assert np.allclose(world.place / 4.0, np.round(world.place / 4.0))
    assert world.place[world.at].tolist() == [0.0, 0.0]
    for a, others in world.edges.items():
        for b in others:
            assert np.abs(world.place[a] - world.place[b]).max() <= 8.0 + 1e-9


@needs_maps
def test_the_peers_figures_come_out() -> None:
    """Utility times exp(-d / 160) travels what the peers' own environment gave, to the tenth of a pixel."""
    with (DATA / "peers_ariadne.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["map"] in ("img_6.png", "img_45.png")]
    for row in rows:
        world = make_world(read_map(DATA / row["set"] / row["map"], "ariadne"), "ariadne")
        assert explore(world, discounted_utility)
        assert world.travelled == pytest.approx(float(row["utility_px"]), abs=0.06), (row["set"], row["map"])


@needs_maps
def test_dare_maps_are_read() -> None:
    grid = read_map(DATA / "dare" / "1.png", "dare")
    assert grid.truth.shape == (250, 250)
    assert grid.truth[grid.start[1], grid.start[0]] == OPEN
