"""The FrontierManager against brute force on random windows, and its memory over time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from planning.clusters import label_components
from planning.coverage import LOG_2
from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec
from schemas.snapshot import pack_snapshot, unpack_snapshot
from services.irm.borders import block_gains, block_places, find_frontiers, mark_borders, spread_blocks
from services.irm.config import Config
from services.irm.frontiers import FrontierManager
from services.irm.window import Window
from tests.irm.worlds import Belief, Flat, cluttered, room

EIGHT = np.ones((3, 3), np.bool_)
SECOND = 10**9
RES = 0.5
CONFIG = Config(
    frontier_block_m=2.0,
    frontier_reach_m=3.0,
    frontier_min_gain=0.3,
    opening_depth_m=1.2,
    unknown_max_gain=1.5,
    opening_min_m2=0.6,
    opening_range_m=7.0,
    frontier_enough_gain=0.7,
    spacing_m=1.0,
)


def random_window(seed: int) -> Window:
    """Random but consistent layers: uncovered within ground within free cells, entropy on ground only."""
    rng = np.random.default_rng(seed)
    spec = GridSpec(RES, int(rng.integers(-40, 40)), int(rng.integers(-40, 40)), 26, 21)
    noise = ndimage.gaussian_filter(rng.normal(size=spec.shape), 1.2)
    ground = noise > np.quantile(noise, rng.uniform(0.1, 0.5))
    state = np.where(ground, FREE, rng.choice(np.array([UNKNOWN, FREE, LETHAL]), spec.shape)).astype(np.uint8)
    dark = ndimage.gaussian_filter(rng.normal(size=spec.shape), 1.5)
    state[dark > np.quantile(dark, rng.uniform(0.6, 1.0))] = UNKNOWN  # in solid pieces, over ground too
    old = ndimage.gaussian_filter(rng.normal(size=spec.shape), 1.5)
    forgotten = ground | (old > np.quantile(old, rng.uniform(0.5, 1.0)))
    hopeful = (state == UNKNOWN) & ~forgotten & (rng.random(spec.shape) < rng.uniform(0.3, 1.0))
    other = ndimage.gaussian_filter(rng.normal(size=spec.shape), 1.5)
    uncovered = ground & (other > np.quantile(other, rng.uniform(0.0, 0.9)))
    entropy = np.where(ground, rng.uniform(0.0, LOG_2, spec.shape) * RES**2, 0.0).astype(np.float32)
    reachable = ground & (rng.random(spec.shape) < 0.8)
    zeros = np.zeros(spec.shape, np.float32)
    return Window(
        spec=spec,
        state=state,
        hopeful=hopeful,
        clearance_m=zeros,
        hazard=zeros,
        step_cost=zeros + 1,
        free_space=reachable & (rng.random(spec.shape) < 0.5),
        reachable=reachable,
        ground=ground,
        uncovered=uncovered,
        probability=zeros,
        entropy=entropy,
        robot_cell=(int(rng.integers(0, 21)), int(rng.integers(0, 26))),
        elevation_m=zeros,
    )


def open_of(window: Window) -> NDArray[np.bool_]:
    """Uncovered ground seen now, and reachable ground at the edge of what may be entered unseen, by brute force."""
    rows, columns = np.indices(window.spec.shape)
    away = np.hypot(rows - window.robot_cell[0], columns - window.robot_cell[1]) * window.spec.resolution_m
    near = away <= CONFIG.opening_range_m
    edge = near & window.reachable & (window.state == FREE) & _brute_edge(window)
    joined = window.reachable & (window.state == FREE) & ndimage.binary_dilation(edge, EIGHT)
    found: NDArray[np.bool_] = (window.uncovered & (window.state == FREE)) | joined
    return found


def blocks_of(window: Window, config: Config) -> tuple[NDArray[np.int32], int, NDArray[np.int32]]:
    """(block of each cell before spreading, number of blocks, pieces)."""
    s = window.spec
    labels = np.zeros(s.shape, np.int32)
    open_ground = open_of(window)
    pieces = label_components(open_ground, labels)
    block = np.full(s.shape, -1, np.int32)
    cells = round(config.frontier_block_m / s.resolution_m)
    covered = window.ground & ~open_ground
    robot = window.robot_cell
    blocks = mark_borders(open_ground, covered, labels, s.ix0, s.iy0, cells, pieces, robot, block)
    return block, blocks, labels


def _brute_borders(window: Window) -> dict[tuple[int, ...], set[tuple[int, int]]]:
    """Border cells by (piece, block row, block column); of a piece without border the cell nearest to the robot."""
    s, size = window.spec, round(CONFIG.frontier_block_m / RES)
    open_ground = open_of(window)
    pieces, count = ndimage.label(open_ground, EIGHT)
    near_covered = ndimage.binary_dilation(window.ground & ~open_ground, EIGHT)
    found: dict[tuple[int, ...], set[tuple[int, int]]] = {}
    for piece in range(1, count + 1):
        mine = np.argwhere((pieces == piece) & near_covered)
        if len(mine) == 0:
            cells = np.argwhere(pieces == piece)
            mine = cells[[int(np.argmin(((cells - window.robot_cell) ** 2).sum(axis=1)))]]
        for r, c in mine:
            key = (piece, (s.iy0 + int(r)) // size, (s.ix0 + int(c)) // size)
            found.setdefault(key, set()).add((int(r), int(c)))
    return found


@given(seed=st.integers(0, 100_000))
def test_blocks_are_the_border_of_covered_and_open_ground(seed: int) -> None:
    window = random_window(seed)
    block, blocks, _ = blocks_of(window, CONFIG)
    found = [frozenset(map(tuple, np.argwhere(block == b).tolist())) for b in range(blocks)]
    assert sorted(map(sorted, found)) == sorted(map(sorted, _brute_borders(window).values()))


def _steps_from(cells: NDArray[np.bool_], within: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Number of moves to each cell from the nearest of `cells`, over cells of `within`, inf where none."""
    steps = np.where(cells, 0.0, np.inf)
    grown = cells
    for k in range(1, within.size):
        wider = ndimage.binary_dilation(grown, EIGHT, mask=within)
        if (wider == grown).all():
            break
        steps[wider & ~grown] = k
        grown = wider
    return steps


@given(seed=st.integers(0, 100_000))
def test_each_open_cell_counts_for_its_nearest_block_and_for_no_other(seed: int) -> None:
    window = random_window(seed)
    open_ground = open_of(window)
    border, blocks, _ = blocks_of(window, CONFIG)
    block, reach = border.copy(), round(CONFIG.frontier_reach_m / RES)
    spread_blocks(open_ground, block, reach, blocks)
    assert not (block[~open_ground] >= 0).any()
    if blocks == 0:
        assert not open_ground.any()
        return
    steps = np.stack([_steps_from(border == b, open_ground) for b in range(blocks)])
    nearest = steps.min(axis=0)
    assert ((block >= 0) == (nearest <= reach)).all()
    rows, columns = np.nonzero(block >= 0)
    assert (steps[block[rows, columns], rows, columns] == nearest[rows, columns]).all()


CROSS = ndimage.generate_binary_structure(2, 1)


def _brute_edge(window: Window) -> NDArray[np.bool_]:
    """Cells beside ground never seen that the robot may enter."""
    grown: NDArray[np.bool_] = ndimage.binary_dilation(window.hopeful, CROSS)
    return grown


def _behind(window: Window) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """(labels, sizes) of the pieces of hopeful ground."""
    labels = np.zeros(window.spec.shape, np.int32)
    count = label_components(window.hopeful, labels)
    return labels, np.array([(labels == k + 1).sum() for k in range(count)], np.int64)


def _brute_hidden(window: Window, cells: NDArray[np.bool_]) -> float:
    """Area of the largest piece of hopeful ground that these cells have a side in common with, m2."""
    pieces, count = ndimage.label(window.hopeful, EIGHT)
    touched = ndimage.binary_dilation(cells, CROSS)
    sizes = [int((pieces == k).sum()) for k in range(1, count + 1) if (touched & (pieces == k)).any()]
    return max(sizes, default=0) * RES**2


def _brute_mouth_m(window: Window, cells: NDArray[np.bool_]) -> float:
    """How far apart those of these cells are that have a side in common with hopeful ground, m."""
    touching = np.argwhere(cells & ndimage.binary_dilation(window.hopeful, CROSS))
    return float(1.0 + np.hypot(*np.ptp(touching, axis=0))) * RES if len(touching) else 0.0


def _gains(
    window: Window, openings: bool = True
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int32]]:
    """(block of each cell, gain of each block, pieces) by brute force. openings: much hidden is enough."""
    block, blocks, labels = blocks_of(window, CONFIG)
    spread_blocks(open_of(window), block, round(CONFIG.frontier_reach_m / RES), blocks)
    hidden = [_brute_hidden(window, block == b) for b in range(blocks)]
    likely = [
        min(hidden[b], CONFIG.opening_depth_m * _brute_mouth_m(window, block == b)) for b in range(blocks)
    ]
    gains = [
        float(window.entropy[block == b].sum(dtype=np.float64))
        + min(LOG_2 * likely[b], CONFIG.unknown_max_gain)
        for b in range(blocks)
    ]
    for b in range(blocks):
        if openings and hidden[b] >= CONFIG.opening_min_m2:
            gains[b] = max(gains[b], CONFIG.frontier_enough_gain)
    return block, np.array(gains), labels


@given(seed=st.integers(0, 100_000))
def test_a_gain_is_the_entropy_of_its_cells_and_of_the_unseen_beside_them(seed: int) -> None:
    window = random_window(seed)
    block, gains, _ = _gains(window, openings=False)
    gain, sums = np.zeros(len(gains)), np.zeros((len(gains), 3))
    hidden, mouth = np.zeros(len(gains)), np.zeros(len(gains))
    block_gains(window.entropy, *_behind(window), block, gain, sums, hidden, mouth)
    likely = np.minimum(hidden * RES**2, mouth * RES * CONFIG.opening_depth_m)
    behind = np.minimum(likely * LOG_2, CONFIG.unknown_max_gain)
    assert gain + behind == pytest.approx(gains, abs=1e-6)
    for b in range(len(gains)):
        cells = np.argwhere(block == b)
        assert sums[b].tolist() == [len(cells), *cells.sum(axis=0)]
    assert gain.sum() <= window.entropy.sum(dtype=np.float64) + 1e-6


@given(seed=st.integers(0, 100_000))
def test_a_place_can_be_reached_near_its_block_and_is_best_for_it(seed: int) -> None:
    window = random_window(seed)
    block, gains, _ = _gains(window)
    gain, hidden, mouth = np.zeros((3, len(gains)))
    sums = np.zeros((len(gains), 3))
    block_gains(window.entropy, *_behind(window), block, gain, sums, hidden, mouth)
    reach = 2
    places = block_places(window.reachable, block, sums, reach)
    free = np.argwhere(window.reachable)
    for b, place in enumerate(places):
        cells = np.argwhere(block == b)
        middle = cells.mean(axis=0)
        best = math.inf
        for cell in cells:
            near = 0 if window.reachable[tuple(cell)] else reach
            for f in free[np.abs(free - cell).max(axis=1) <= near]:
                best = min(best, float(((f - middle) ** 2).sum() + 4 * ((f - cell) ** 2).sum()))
        if math.isinf(best):
            assert place.tolist() == [-1, -1]
            continue
        assert window.reachable[tuple(place)]
        score = min(
            float(((place - middle) ** 2).sum() + 4 * ((place - cell) ** 2).sum())
            for cell in cells
            if np.abs(place - cell).max() <= (0 if window.reachable[tuple(cell)] else reach)
        )
        assert score == pytest.approx(best)


@given(seed=st.integers(0, 100_000))
def test_every_piece_that_is_worth_it_has_a_frontier_and_no_gain_counts_twice(seed: int) -> None:
    window = random_window(seed)
    found = find_frontiers(window, CONFIG)
    block, gains, labels = _gains(window)
    for x, y, _, _ in found:
        assert window.reachable[window.spec.cell_of(x, y)]
    assert sum(g for _, _, g, _ in found) <= gains.sum() + 1e-6
    alone = [g for g in gains if g >= CONFIG.frontier_min_gain]
    for piece in range(1, int(labels.max()) + 1):
        mine = np.unique(block[(labels == piece) & (block >= 0)])
        worth = gains[mine].sum() >= CONFIG.frontier_min_gain
        cells = np.isin(block, mine) & window.reachable
        if worth and cells.any():  # a block that can be reached itself has a place
            best = mine[int(np.argmax(gains[mine]))]
            if (window.reachable & (block == best)).any():
                expected = gains[best] if gains[best] in alone else gains[mine].sum()
                assert any(g == pytest.approx(expected, abs=1e-5) for _, _, g, _ in found)
    assert all(g >= CONFIG.frontier_min_gain - 1e-9 for _, _, g, _ in found)


@given(seed=st.integers(0, 3000), share=st.floats(0.1, 0.9))
def test_in_a_real_window_every_piece_of_open_ground_has_a_frontier(seed: int, share: float) -> None:
    config = Config()
    flat = cluttered(seed, resolution_m=0.2)
    belief = Belief.new(config, 0.2)
    seen = np.random.default_rng(seed).uniform(-3, 3)
    x, y = np.meshgrid(flat.spec.centres_x(), flat.spec.centres_y())
    belief.cover(flat.spec, (x * math.cos(seen) + y * math.sin(seen)) < 6 * (share - 0.5))
    window = belief.window(flat.risk_map(), 0.0, 0.0)
    found = find_frontiers(window, config)
    open_ground = open_of(window)
    pieces, count = ndimage.label(open_ground, EIGHT)
    worth = 0
    for piece in range(1, count + 1):
        if float(window.entropy[pieces == piece].sum()) < config.frontier_min_gain:
            continue
        worth += 1
        cells = np.argwhere(pieces == piece) * 0.2 + np.array([flat.spec.iy0, flat.spec.ix0]) * 0.2 + 0.1
        assert any(np.hypot(cells[:, 1] - fx, cells[:, 0] - fy).min() <= 0.3 for fx, fy, _, _ in found)
    assert len(found) >= worth
    most = float(window.entropy.sum(dtype=np.float64)) + config.unknown_max_gain * len(found)
    assert sum(g for _, _, g, _ in found) <= most + 1e-4


def _manager(**changes: float) -> tuple[FrontierManager, Belief, Flat]:
    """A corridor of 16 x 3 m that lies in one row of blocks, so that its front is one frontier."""
    config = Config(**changes)
    return FrontierManager(config), Belief.new(config, 0.2), room(-8.0, 1.0, 8.0, 4.0, 0.2)


def _cover_up_to(belief: Belief, flat: Flat, x_m: float) -> None:
    x, _ = np.meshgrid(flat.spec.centres_x(), flat.spec.centres_y())
    belief.cover(flat.spec, x < x_m)


def test_ids_persist_while_the_border_creeps_and_are_never_used_twice() -> None:
    manager, belief, flat = _manager()
    next_id, lead = 1, []
    for step in range(24):
        _cover_up_to(belief, flat, -6.0 + 0.4 * step)
        window = belief.window(flat.risk_map(), -6.0, 2.5)
        before = set(manager.frontiers)
        next_id = manager.update(window, (-7.0, 2.5), step * SECOND, 1.0, next_id)
        assert all(k < next_id for k in manager.frontiers)
        assert not ({k for k in manager.frontiers if k not in before} & set(range(1, min(before, default=1))))
        lead.append(min(manager.frontiers, key=lambda k: manager.frontiers[k].x_m))
    # The front moves 0.4 m a step over 9 m: its frontier keeps its name for many steps.
    assert len(set(lead)) <= 3
    assert next_id - 1 <= 4


def test_covered_frontiers_are_pruned_at_once() -> None:
    manager, belief, flat = _manager()
    _cover_up_to(belief, flat, 0.0)
    next_id = manager.update(belief.window(flat.risk_map(), -6.0, 2.5), (-6.0, 2.5), 0, 1.0, 1)
    assert manager.frontiers
    _cover_up_to(belief, flat, 99.0)
    again = manager.update(belief.window(flat.risk_map(), -6.0, 2.5), (-6.0, 2.5), SECOND, 1.0, next_id)
    assert manager.frontiers == {} and again == next_id


def test_frontiers_outside_the_window_are_kept_as_they_were() -> None:
    manager, belief, flat = _manager()
    _cover_up_to(belief, flat, 2.0)
    next_id = manager.update(belief.window(flat.risk_map(), 0.0, 2.5), (0.0, 2.5), 0, 1.0, 1)
    kept = {k: (f.x_m, f.y_m, f.gain) for k, f in manager.frontiers.items()}
    assert kept and all(x > 1.5 for x, _, _ in kept.values())
    small = belief.window(flat.risk_map(-5.0, 2.5, window_m=6.0), -5.0, 2.5)
    manager.update(small, (-5.0, 2.5), SECOND, 1.0, next_id)
    assert {k: (f.x_m, f.y_m, f.gain) for k, f in manager.frontiers.items()} == kept


def test_a_frontier_that_yields_nothing_is_given_up_and_comes_back_after_a_while() -> None:
    manager, belief, flat = _manager(give_up_s=5.0, retry_after_s=30.0, second_chance_gain=99.0)
    _cover_up_to(belief, flat, 6.0)
    window = belief.window(flat.risk_map(), 0.0, 2.5)
    next_id = manager.update(window, (-7.0, 2.5), 0, 1.0, 1)
    assert len(manager.frontiers) == 1
    beside = next((f.x_m, f.y_m) for f in manager.frontiers.values())
    seen_empty_at = None
    for second in range(1, 60):
        next_id = manager.update(window, beside, second * SECOND, 1.0, next_id)
        if not manager.frontiers and seen_empty_at is None:
            seen_empty_at = second
            assert manager.given_up[0].reason
            assert manager.given_up[0].until_ns == (second + 30) * SECOND
        if seen_empty_at is not None and second < seen_empty_at + 30:
            assert manager.frontiers == {} and len(manager.given_up) == 1
        if seen_empty_at is not None and second == seen_empty_at + 30:
            assert len(manager.frontiers) == 1 and manager.given_up == []
            break
    assert seen_empty_at == 6


def test_a_frontier_that_keeps_shrinking_is_not_given_up() -> None:
    manager, belief, flat = _manager(give_up_s=3.0)
    next_id = 1
    for second in range(12):
        _cover_up_to(belief, flat, 4.0 + 0.3 * second)
        window = belief.window(flat.risk_map(), 0.0, 2.5)
        beside = next(((f.x_m, f.y_m) for f in manager.frontiers.values()), (4.0, 2.5))
        next_id = manager.update(window, beside, second * SECOND, 1.0, next_id)
    assert manager.given_up == []


def test_a_robot_far_away_gives_nothing_up() -> None:
    manager, belief, flat = _manager(give_up_s=3.0)
    _cover_up_to(belief, flat, 4.0)
    window, next_id = belief.window(flat.risk_map(), 0.0, 2.5), 1
    for second in range(30):
        next_id = manager.update(window, (-6.0, 2.5), second * SECOND, 1.0, next_id)
    assert manager.given_up == [] and len(manager.frontiers) >= 1


def test_a_snapshot_goes_on_alike() -> None:
    manager, belief, flat = _manager(give_up_s=3.0)
    _cover_up_to(belief, flat, 4.0)
    window, next_id = belief.window(flat.risk_map(), 0.0, 2.5), 1
    for second in range(3):
        next_id = manager.update(window, (4.5, 2.5), second * SECOND, 1.0, next_id)
    other = FrontierManager(manager.config)
    other.set_state(unpack_snapshot(pack_snapshot(manager.state())))
    for second in range(3, 9):
        ids = [m.update(window, (4.5, 2.5), second * SECOND, 1.0, next_id) for m in (manager, other)]
        assert ids[0] == ids[1]
        next_id = ids[0]
        assert manager.state() == other.state()
