"""The Local IRM against brute force: anchors, edges, patch sums, sight, and nodes that keep their identity."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.grid import DIRECTION_DX, DIRECTION_DY, FREE, LETHAL, UNKNOWN
from planning.rays import visible_cells
from schemas.base import Pose
from schemas.codec import Envelope, decode, encode
from schemas.topics import LOCAL_IRM
from schemas.world import LocalIrm, RiskMap
from services.irm.config import Config
from services.irm.local_irm import LocalIrmBuilder
from services.irm.window import Window
from tests.irm.worlds import RADIUS_M, Belief, Flat, cluttered, room, two_rooms

RES = 0.1
CONFIG = Config(size=9, sensor_range_m=3.0)


def build(
    flat: Flat, x_m: float = 0.0, y_m: float = 0.0, covered_below_x: float = -99.0
) -> tuple[LocalIrm, Window, RiskMap]:
    belief = Belief.new(CONFIG, RES)
    x, _ = np.meshgrid(flat.spec.centres_x(), flat.spec.centres_y())
    belief.cover(flat.spec, x < covered_below_x)
    risk = flat.risk_map()
    window = belief.window(risk, x_m, y_m)
    builder = LocalIrmBuilder(CONFIG, RADIUS_M)
    return builder.build(window, Pose(x_m=x_m, y_m=y_m), Pose(), 1), window, risk


def polylines(irm: LocalIrm) -> dict[tuple[int, int], NDArray[np.float64]]:
    """The line of each edge by (node, k), k < 4, from anchor to anchor."""
    bent = {int(e): i for i, e in enumerate(irm.bent_edge)}
    lines = {}
    for node, k in np.argwhere(irm.edge_distance_m[:, :4] > 0):
        other = node + DIRECTION_DY[k] * irm.size + DIRECTION_DX[k]
        inner = np.empty((0, 2))
        index = bent.get(int(node * 8 + k))
        if index is not None:
            inner = irm.bent_xy[irm.bent_start[index] : irm.bent_start[index + 1]].astype(np.float64)
        lines[int(node), int(k)] = np.concatenate((irm.anchor_m[[node]], inner, irm.anchor_m[[other]]))
    return lines


def _dense(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points every centimetre or so along a polyline, (n, 2)."""
    parts = [line[:1]]
    for a, b in pairwise(line):
        steps = max(1, math.ceil(float(np.hypot(*(b - a))) / 0.01))
        parts.append(a + (b - a) * (np.arange(1, steps + 1) / steps)[:, None])
    return np.concatenate(parts)


def _min_clearance(points: NDArray[np.float64], flat: Flat) -> float:
    """Distance from the points to the nearest lethal cell's centre."""
    rows, columns = np.nonzero(flat.state == LETHAL)
    lx, ly = flat.spec.centres_x()[columns], flat.spec.centres_y()[rows]
    return min(float(np.hypot(lx - px, ly - py).min(initial=math.inf)) for px, py in points[::5])


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_anchors_stand_in_free_space_and_in_their_own_patch(seed: int) -> None:
    flat = cluttered(seed)
    irm, window, _ = build(flat)
    s = flat.spec
    for node in range(irm.size**2):
        low_x, low_y = irm.ix0 + node % irm.size, irm.iy0 + node // irm.size
        x, y = irm.anchor_m[node]
        assert low_x < x < low_x + 1 and low_y < y < low_y + 1
        columns = slice(max(0, 10 * low_x - s.ix0), max(0, 10 * low_x - s.ix0 + 10))
        rows = slice(max(0, 10 * low_y - s.iy0), max(0, 10 * low_y - s.iy0 + 10))
        if window.free_space[rows, columns].any():
            assert irm.state[node] == 1
            assert window.free_space[s.cell_of(x, y)]
        else:
            known = (window.state[rows, columns] != UNKNOWN).sum()
            assert irm.state[node] == (2 if known >= 50 else 0)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_edges_are_symmetric_of_their_own_length_and_never_through_a_wall(seed: int) -> None:
    """The robot fits along each edge's line (5 cm: clearance is read between the cells), on free ground only."""
    flat = cluttered(seed, boxes=14)
    irm, window, _ = build(flat)
    for node in range(irm.size**2):
        for k in range(8):
            row, column = node // irm.size + DIRECTION_DY[k], node % irm.size + DIRECTION_DX[k]
            if not (0 <= row < irm.size and 0 <= column < irm.size):
                assert irm.edge_distance_m[node, k] == 0
                continue
            other = row * irm.size + column
            assert irm.edge_distance_m[node, k] == irm.edge_distance_m[other, (k + 4) % 8]
            assert irm.edge_risk[node, k] == irm.edge_risk[other, (k + 4) % 8]
            if irm.edge_distance_m[node, k] > 0:
                assert irm.state[node] == irm.state[other] == 1
    bent = set(irm.bent_edge.tolist())
    for (node, k), line in polylines(irm).items():
        length = float(np.hypot(*np.diff(line, axis=0).T).sum())
        assert irm.edge_distance_m[node, k] == pytest.approx(length, abs=1e-3)
        points = _dense(line)
        assert _min_clearance(points, flat) >= RADIUS_M - CONFIG.clearance_hysteresis_m - 0.05
        crossed = np.array([window.state[flat.spec.cell_of(x, y)] for x, y in points])
        assert not (crossed == LETHAL).any()
        assert (crossed == UNKNOWN).sum() <= 5  # a corner of an unknown cell may be cut by half a cell
        if node * 8 + k in bent:
            assert all(window.free_space[flat.spec.cell_of(x, y)] for x, y in line)
        else:
            assert len(line) == 2


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_where_the_straight_line_has_room_there_is_an_edge(seed: int) -> None:
    flat = cluttered(seed)
    irm, window, _ = build(flat)
    lines = polylines(irm)
    for node in np.flatnonzero(irm.state == 1):
        for k in range(4):
            row, column = node // irm.size + DIRECTION_DY[k], node % irm.size + DIRECTION_DX[k]
            inside = 0 <= row < irm.size and 0 <= column < irm.size
            if not inside or irm.state[row * irm.size + column] != 1:
                continue
            points = _dense(irm.anchor_m[[node, row * irm.size + column]])
            free = all(window.free_space[flat.spec.cell_of(x, y)] for x, y in points)
            if free and _min_clearance(points, flat) >= RADIUS_M + 0.05:
                assert (int(node), k) in lines and len(lines[int(node), k]) == 2


def test_rooms_are_joined_through_their_door_only() -> None:
    flat = two_rooms(0.8)
    irm, window, _ = build(flat, -1.5, 0.0)
    assert window.free_space[flat.spec.cell_of(2.0, 0.0)]
    across = [
        line
        for line in polylines(irm).values()
        if min(line[0, 0], line[-1, 0]) < 0.0 < max(line[0, 0], line[-1, 0])
    ]
    assert across
    for line in across:
        points = _dense(line)
        inside = points[(points[:, 0] > 0.0) & (points[:, 0] < 0.2)]
        assert len(inside) and (np.abs(inside[:, 1]) < 0.4).all()


def _parts(irm: LocalIrm) -> set[frozenset[int]]:
    """The connected components of the traversable nodes."""
    parts: dict[int, set[int]] = {int(node): {int(node)} for node in np.flatnonzero(irm.state == 1)}
    for node, k in np.argwhere(irm.edge_distance_m > 0):
        a = int(node)
        b = a + int(DIRECTION_DY[k]) * irm.size + int(DIRECTION_DX[k])
        if parts[a] is not parts[b]:
            parts[a] |= parts[b]
            for member in parts[b]:
                parts[member] = parts[a]
    return {frozenset(part) for part in parts.values()}


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_the_lattice_does_not_fall_apart_for_want_of_a_long_way_round(seed: int) -> None:
    """However short edges are wanted, what can be joined by a longer one is joined."""
    flat = cluttered(seed, boxes=14)
    belief = Belief.new(CONFIG, RES)
    window = belief.window(flat.risk_map(), 0.0, 0.0)
    strict, lax = (
        LocalIrmBuilder(CONFIG.model_copy(update={"edge_detour": d}), RADIUS_M).build(
            window, Pose(), Pose(), 1
        )
        for d in (0.01, 1e3)
    )
    assert _parts(strict) == _parts(lax)
    assert (strict.edge_distance_m > 0).sum() <= (lax.edge_distance_m > 0).sum()


def test_a_closed_door_parts_the_lattice() -> None:
    irm, _, _ = build(two_rooms(0.0), -1.5, 0.0)
    right = irm.anchor_m[:, 0] > 0.2
    assert (irm.state[right] != 1).all()


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), covered=st.floats(-3, 3))
def test_patch_sums_equal_brute_force(seed: int, covered: float) -> None:
    flat = cluttered(seed)
    irm, window, _ = build(flat, covered_below_x=covered)
    x, y = np.meshgrid(flat.spec.centres_x(), flat.spec.centres_y())
    for node in range(irm.size**2):
        patch = (np.floor(x) == irm.ix0 + node % irm.size) & (np.floor(y) == irm.iy0 + node // irm.size)
        total = float(window.entropy[patch].sum())
        if abs(total - CONFIG.min_node_entropy) > 1e-4:
            expected = total if total >= CONFIG.min_node_entropy else 0.0
            assert irm.entropy[node] == pytest.approx(expected, abs=1e-4)
        ground, known = patch & window.ground, patch & (window.state != UNKNOWN)
        mean = float(window.probability[ground].mean()) if ground.any() else 0.0
        hazard = float(window.hazard[known].mean()) if known.any() else 0.0
        assert irm.coverage[node] == pytest.approx(mean, abs=1e-4)
        assert irm.node_risk[node] == pytest.approx(hazard, abs=1e-4)
    assert irm.entropy.max() <= math.log(2) + 1e-4


def _halves(window: Window) -> tuple[NDArray[np.bool_], NDArray[np.float32], tuple[int, int]]:
    """Opaque (two of four cells not free), uncovered entropy, and (row, column) of the first cell, all by pairs of
    cells of even global index.
    """
    s = window.spec
    top, left = s.iy0 % 2, s.ix0 % 2
    rows, columns = (s.height - top) // 2 * 2, (s.width - left) // 2 * 2

    def by_four(values: NDArray[np.float32]) -> NDArray[np.float32]:
        part = values[top : top + rows, left : left + columns]
        sums: NDArray[np.float32] = part.reshape(rows // 2, 2, columns // 2, 2).sum(axis=(1, 3))
        return sums

    closed = by_four((window.state != FREE).astype(np.float32)) >= 2
    mass = by_four(np.where(window.uncovered, window.entropy, np.float32(0)))
    return closed, mass, (s.iy0 + top, s.ix0 + left)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), covered=st.floats(-3, 1))
def test_a_node_sees_those_of_whose_uncovered_ground_it_sees_half(seed: int, covered: float) -> None:
    flat = cluttered(seed)
    irm, window, _ = build(flat, covered_below_x=covered)
    opaque, mass, (first_y, first_x) = _halves(window)
    reach = irm.reach
    y, x = np.indices(opaque.shape)
    column = (first_x + 2 * x + 1) // 10 - irm.ix0
    row = (first_y + 2 * y + 1) // 10 - irm.iy0
    inside = (row >= 0) & (row < irm.size) & (column >= 0) & (column < irm.size)
    patch = np.where(inside, row * irm.size + column, -1)
    whole = np.bincount(patch[inside], weights=mass[inside], minlength=irm.size**2)
    wanted = (irm.entropy > 0) & (whole > 0)
    for node in range(irm.size**2):
        expected = np.zeros(2 * reach + 1, np.uint32)
        if irm.state[node] == 1:
            seen = np.zeros(opaque.shape, np.uint8)
            ax, ay = ((math.floor(v / RES) + 0.5) for v in irm.anchor_m[node])
            ax, ay = (ax - first_x) / 2, (ay - first_y) / 2
            visible_cells(opaque, ax, ay, CONFIG.sensor_range_m / (2 * RES), 0.0, 7.0, seen)
            part = np.bincount(patch[inside], weights=(mass * seen)[inside], minlength=irm.size**2)
            shares = part[wanted] / whole[wanted]
            if (np.abs(shares - 0.5) < 1e-4).any():
                continue  # a matter of rounding
            for other in np.flatnonzero(wanted)[shares >= 0.5]:
                dr, dc = other // irm.size - node // irm.size, other % irm.size - node % irm.size
                if max(abs(dr), abs(dc)) <= reach:
                    expected[dr + reach] |= np.uint32(1 << int(dc + reach))
        assert irm.visible[node].tolist() == expected.tolist()


def test_what_a_node_sees_does_not_hang_on_where_the_window_lies() -> None:
    """The window rolled by one cell, an odd number, within ground that it knows."""
    flat = cluttered(5, side_m=10.0, boxes=20)
    seen = []
    for shift in (0.05, 0.15, 0.25):
        window = Belief.new(CONFIG, RES).window(flat.risk_map(shift, 0.05, window_m=9.0), 0.05, 0.05)
        irm = LocalIrmBuilder(CONFIG, RADIUS_M).build(window, Pose(x_m=0.05, y_m=0.05), Pose(), 1)
        inner = [node for node in range(81) if 3 <= node % 9 <= 5 and 3 <= node // 9 <= 5]
        assert (irm.state[inner] == 1).sum() >= 4
        seen.append(irm.visible[inner].tolist())
    assert seen[0] == seen[1] == seen[2]


def test_nobody_sees_through_the_wall() -> None:
    flat = two_rooms(0.6)
    irm, _, _ = build(flat, -1.5, 0.0)
    node = (1 - irm.iy0) * irm.size + (-2 - irm.ix0)  # the patch of (-1.5, 1.5)
    assert irm.state[node] == 1
    for other in np.flatnonzero((irm.anchor_m[:, 0] > 0.2) & (irm.anchor_m[:, 1] > 1.0)):
        dr, dc = other // irm.size - node // irm.size, other % irm.size - node % irm.size
        if max(abs(dr), abs(dc)) <= irm.reach:
            assert not irm.visible[node, dr + irm.reach] >> np.uint32(dc + irm.reach) & np.uint32(1)


def test_nodes_keep_their_index_and_their_anchor_as_the_robot_moves() -> None:
    flat = cluttered(7, side_m=9.0, boxes=12)
    belief, builder = Belief.new(CONFIG, RES), LocalIrmBuilder(CONFIG, RADIUS_M)
    places: dict[tuple[int, int], tuple[float, float]] = {}
    version = 0
    for k in range(12):
        x, y = 0.3 * k - 1.5, 0.11 * k - 0.6
        irm = builder.build(belief.window(flat.risk_map(), 0.0, 0.0), Pose(x_m=x, y_m=y), Pose(), k)
        assert irm.irm_version == version + 1
        version = irm.irm_version
        assert irm.ix0 == math.floor(x) - 4 and irm.iy0 == math.floor(y) - 4
        for node in np.flatnonzero(irm.state == 1):
            index = (irm.ix0 + int(node) % irm.size, irm.iy0 + int(node) // irm.size)
            place = (float(irm.anchor_m[node, 0]), float(irm.anchor_m[node, 1]))
            assert places.setdefault(index, place) == place


def test_an_anchor_keeps_its_place_unless_another_is_clearly_better() -> None:
    flat = room(-3, -3, 3, 3)
    belief, builder = Belief.new(CONFIG, RES), LocalIrmBuilder(CONFIG, RADIUS_M)

    def anchors() -> NDArray[np.float64]:
        risk = flat.risk_map()
        return builder.build(belief.window(risk, 0.0, 0.0), Pose(), Pose(), 1).anchor_m

    first = anchors()
    flat.fill(0.2, 1.9, 0.5, 2.0, LETHAL)  # makes the patch of (0.5, 1.5) a little less roomy
    node = (1 + 4) * 9 + 4
    assert anchors()[node].tolist() == first[node].tolist()
    flat.fill(0.0, 1.2, 1.0, 2.0, LETHAL)  # takes the anchor's place itself
    assert anchors()[node].tolist() != first[node].tolist()


def test_the_message_fits_the_wire_and_another_builder_goes_on_alike() -> None:
    flat = cluttered(11)
    belief = Belief.new(Config(), RES)
    builder = LocalIrmBuilder(Config(), RADIUS_M)
    window = belief.window(flat.risk_map(), 0.0, 0.0)
    message = builder.build(window, Pose(), Pose(), 5)
    payload = encode(message, Envelope("husky1", "irm", 1, 1, 0, {}))
    assert len(payload) <= LOCAL_IRM.max_bytes
    decode(payload, LocalIrm, LOCAL_IRM.max_bytes)
    other = LocalIrmBuilder(Config(), RADIUS_M, builder.version)
    other.set_state(builder.state())
    flat.fill(0.3, 0.3, 0.5, 0.5, LETHAL)
    window = belief.window(flat.risk_map(), 0.0, 0.0)
    pair = [
        encode(b.build(window, Pose(), Pose(), 6), Envelope("husky1", "irm", 1, 2, 0, {}))
        for b in (builder, other)
    ]
    assert pair[0] == pair[1]
