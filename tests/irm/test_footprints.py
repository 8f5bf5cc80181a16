"""Coverage footprints: what a look sees, one Bayes update a keyframe, and what happens when keyframes move."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from planning.coverage import look_log_odds, probability
from planning.frames import Planar
from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec
from schemas.snapshot import pack_snapshot, unpack_snapshot
from services.irm.footprints import FootprintStore
from services.irm.resample import resample
from services.irm.tiles import TileLayer
from services.irm.window import Relief
from tests.irm.worlds import DETECTION, scan_at

ORIGIN = Planar(0.0, 0.0, 0.0)
LOOK = look_log_odds(DETECTION)
RES = 0.2
WIDE = GridSpec(RES, -200, -200, 400, 400)


def random_world(seed: int, size: int = 22) -> tuple[NDArray[np.uint8], GridSpec, np.random.Generator]:
    rng = np.random.default_rng(seed)
    state = np.full((size, size + 3), FREE, np.uint8)
    state[rng.random(state.shape) < 0.12] = LETHAL
    state[rng.random(state.shape) < 0.06] = UNKNOWN
    return state, GridSpec(RES, int(rng.integers(-30, 30)), int(rng.integers(-30, 30)), size + 3, size), rng


def random_pose(spec: GridSpec, rng: np.random.Generator) -> Planar:
    x = (spec.ix0 + rng.uniform(3, spec.width - 3)) * RES
    y = (spec.iy0 + rng.uniform(3, spec.height - 3)) * RES
    return Planar(float(x), float(y), float(rng.uniform(-math.pi, math.pi)))


def layer_and_store() -> tuple[TileLayer, FootprintStore]:
    layer = TileLayer("float32", 0.0, RES)
    return layer, FootprintStore(layer)


def _crossing(
    low_x: NDArray[np.float64],
    low_y: NDArray[np.float64],
    side: float,
    start: tuple[float, float],
    end: tuple[float, float],
) -> bool:
    """Whether a segment goes through any of the squares with these lower left corners."""
    enter, leave = np.zeros(low_x.shape), np.ones(low_x.shape)
    for low, a, b in ((low_x, start[0], end[0]), (low_y, start[1], end[1])):
        slope = b - a if abs(b - a) > 1e-12 else 1e-12
        t0, t1 = (low - a) / slope, (low + side - a) / slope
        enter, leave = np.maximum(enter, np.minimum(t0, t1)), np.minimum(leave, np.maximum(t0, t1))
    return bool((leave > enter).any())


def _brute_look(
    state: NDArray[np.uint8], spec: GridSpec, pose: Planar, range_m: float, fov_rad: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(surely seen, perhaps seen): obstacles a hair larger and a hair smaller than their cells."""
    sure, maybe = np.zeros(state.shape, np.bool_), np.zeros(state.shape, np.bool_)
    x, y = pose.x_m / RES - spec.ix0, pose.y_m / RES - spec.iy0
    own = (math.floor(y), math.floor(x))
    walls = np.array([w for w in np.argwhere(state != FREE) if tuple(w) != own], np.float64).reshape(-1, 2)
    hair = 1e-4
    for row, column in np.argwhere(state == FREE):
        dx, dy = column + 0.5 - x, row + 0.5 - y
        off = abs(math.remainder(math.atan2(dy, dx) - pose.yaw_rad, 2 * math.pi))
        if (row, column) != own:
            if math.hypot(dx, dy) * RES > range_m + 1e-9 or off > 0.5 * fov_rad + 1e-6:
                continue
            if _crossing(walls[:, 1] + hair, walls[:, 0] + hair, 1 - 2 * hair, (x, y), (x + dx, y + dy)):
                continue
        maybe[row, column] = True
        clear = not _crossing(walls[:, 1] - hair, walls[:, 0] - hair, 1 + 2 * hair, (x, y), (x + dx, y + dy))
        within = math.hypot(dx, dy) * RES < range_m - 1e-9 and off < 0.5 * fov_rad - 1e-6
        sure[row, column] = (row, column) == own or (clear and within)
    return sure, maybe


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), range_m=st.floats(0.5, 5.0), fov_rad=st.floats(0.5, 6.28))
def test_a_look_covers_the_free_ground_in_range_field_of_view_and_sight(
    seed: int, range_m: float, fov_rad: float
) -> None:
    state, spec, rng = random_world(seed)
    pose = random_pose(spec, rng)
    layer, store = layer_and_store()
    new = store.add(scan_at(pose, range_m=range_m, fov_rad=fov_rad), ORIGIN, state, spec, ORIGIN)
    seen = layer.read(spec)
    sure, maybe = _brute_look(state, spec, pose, range_m, fov_rad)
    assert not (sure & (seen == 0)).any()
    free = state == FREE
    assert not (free & (seen > 0) & ~maybe).any()
    surface = ndimage.binary_dilation(free & (seen > 0), np.ones((3, 3), np.bool_)) & (state == LETHAL)
    behind = ndimage.binary_dilation(surface, np.ones((3, 3), np.bool_)) & ~free
    assert np.array_equal((seen > 0) & ~free, surface | behind)
    assert np.allclose(seen[seen > 0], LOOK)
    assert new == int((layer.read(WIDE) > 0).sum()) == int((seen > 0).sum())


def test_a_wall_that_turns_out_to_stand_farther_back_leaves_nothing_unseen_before_it() -> None:
    """Drifting odometry moves walls by a cell or two after they were looked at."""
    state = np.full((21, 21), FREE, np.uint8)
    state[:, 15:] = UNKNOWN
    state[:, 15] = LETHAL
    spec = GridSpec(RES, 0, 0, 21, 21)
    layer, store = layer_and_store()
    store.add(scan_at(Planar(2.1, 2.1, 0.0), range_m=4.0), ORIGIN, state, spec, ORIGIN)
    assert (layer.read(spec)[5:16, 10:17] > 0).all()
    assert not (layer.read(spec)[:, 17:] > 0).any()


@given(seed=st.integers(0, 10_000), looks=st.integers(2, 5))
def test_all_looks_of_a_keyframe_are_one_bayes_update_of_their_union(seed: int, looks: int) -> None:
    state, spec, rng = random_world(seed)
    poses = [random_pose(spec, rng) for _ in range(looks)]
    keyframes = [int(k) for k in rng.integers(0, 2, looks)]
    layer, store = layer_and_store()
    expected = np.zeros(WIDE.shape, np.float32)
    unions: dict[int, NDArray[np.bool_]] = {}
    for pose, keyframe in zip(poses, keyframes, strict=True):
        store.add(scan_at(pose, keyframe), ORIGIN, state, spec, ORIGIN)
        alone, single = layer_and_store()
        single.add(scan_at(pose), ORIGIN, state, spec, ORIGIN)
        unions[keyframe] = unions.get(keyframe, np.zeros(WIDE.shape, np.bool_)) | (alone.read(WIDE) > 0)
    for union in unions.values():
        expected[union] += np.float32(LOOK)
    assert np.allclose(layer.read(WIDE), expected, atol=1e-5)
    twice = DETECTION**2 / (DETECTION**2 + (1 - DETECTION) ** 2)
    p = probability(layer.read(WIDE))
    for times, value in ((0, 0.5), (1, DETECTION), (2, twice)):
        cells = sum(u.astype(int) for u in unions.values()) == times
        assert np.allclose(p[cells], value, atol=1e-5)


def _shifted(spec: GridSpec, dx: int, dy: int) -> GridSpec:
    return GridSpec(spec.resolution_m, spec.ix0 + dx, spec.iy0 + dy, spec.width, spec.height)


@given(seed=st.integers(0, 10_000), dx=st.integers(-60, 60), dy=st.integers(-60, 60))
def test_a_keyframe_moved_by_whole_cells_takes_its_coverage_along(seed: int, dx: int, dy: int) -> None:
    """The layer equals the one from scratch, with the same world and looks at the moved place."""
    state, spec, rng = random_world(seed)
    keyframe, other = random_pose(spec, rng), random_pose(spec, rng)
    moved = Planar(keyframe.x_m + dx * RES, keyframe.y_m + dy * RES, keyframe.yaw_rad)
    poses = [random_pose(spec, rng) for _ in range(3)]
    layer, store = layer_and_store()
    scratch, again = layer_and_store()
    store.add(scan_at(other, 1), other, state, spec, ORIGIN)
    again.add(scan_at(other, 1), other, state, spec, ORIGIN)
    for p in poses:
        store.add(scan_at(p), keyframe, state, spec, ORIGIN)
        there = Planar(p.x_m + dx * RES, p.y_m + dy * RES, p.yaw_rad)
        again.add(scan_at(there), moved, state, _shifted(spec, dx, dy), ORIGIN)
    assert store.follow({0: moved, 1: other}) == (1 if dx or dy else 0)
    assert np.allclose(layer.read(WIDE), scratch.read(WIDE), atol=1e-5)


@given(seed=st.integers(0, 10_000), quarters=st.integers(1, 3))
def test_a_keyframe_turned_by_quarters_takes_its_coverage_along(seed: int, quarters: int) -> None:
    state, spec, rng = random_world(seed)
    turned_state, turned_spec = state, spec
    for _ in range(quarters):  # a quarter to the left: cell (x, y) goes to (-y - 1, x)
        turned_state = np.ascontiguousarray(turned_state[::-1].T)
        turned_spec = GridSpec(
            RES,
            -turned_spec.iy0 - turned_spec.height,
            turned_spec.ix0,
            turned_spec.height,
            turned_spec.width,
        )
    turn = Planar(0.0, 0.0, quarters * math.pi / 2)
    keyframe, poses = random_pose(spec, rng), [random_pose(spec, rng) for _ in range(2)]
    layer, store = layer_and_store()
    scratch, again = layer_and_store()
    for p in poses:
        store.add(scan_at(p, fov_rad=2.0), keyframe, state, spec, ORIGIN)
        again.add(scan_at(turn.compose(p), fov_rad=2.0), keyframe, turned_state, turned_spec, ORIGIN)
    assert store.follow({0: turn.compose(keyframe)}) == 1
    assert np.allclose(layer.read(WIDE), scratch.read(WIDE), atol=1e-5)


def test_a_keyframe_that_stays_or_is_unknown_changes_nothing() -> None:
    state, spec, rng = random_world(3)
    keyframe = random_pose(spec, rng)
    layer, store = layer_and_store()
    store.add(scan_at(random_pose(spec, rng)), keyframe, state, spec, ORIGIN)
    before = layer.read(WIDE)
    near = Planar(keyframe.x_m + 0.001, keyframe.y_m, keyframe.yaw_rad + 2 * math.pi)
    assert store.follow({0: keyframe}) == store.follow({0: near}) == store.follow({7: ORIGIN}) == 0
    assert np.array_equal(layer.read(WIDE), before)


def test_looks_after_a_move_join_the_footprint_where_it_now_lies() -> None:
    state = np.full((30, 30), FREE, np.uint8)
    spec = GridSpec(RES, -15, -15, 30, 30)
    layer, store = layer_and_store()
    store.add(scan_at(ORIGIN, range_m=1.0), ORIGIN, state, spec, ORIGIN)
    moved = Planar(1.0, 0.0, 0.0)
    store.follow({0: moved})
    assert store.add(scan_at(moved, range_m=1.0), moved, state, spec, ORIGIN) == 0
    assert store.add(scan_at(ORIGIN, range_m=1.0), moved, state, spec, ORIGIN) > 0
    assert layer.read(WIDE).max() == pytest.approx(LOOK)


def test_looks_are_placed_by_the_pose_of_odom_in_map() -> None:
    state = np.full((30, 30), FREE, np.uint8)
    spec = GridSpec(RES, -15, -15, 30, 30)
    layer, store = layer_and_store()
    scratch, again = layer_and_store()
    pose, odom = Planar(0.07, 0.03, 0.2), Planar(2.0, -1.0, math.pi / 2)
    store.add(scan_at(pose, range_m=1.5, fov_rad=1.5), ORIGIN, state, spec, odom)
    again.add(
        scan_at(odom.compose(pose), range_m=1.5, fov_rad=1.5), ORIGIN, state, _shifted(spec, 10, -5), ORIGIN
    )
    assert np.allclose(layer.read(WIDE), scratch.read(WIDE), atol=1e-5)


def test_a_look_from_outside_the_risk_map_covers_nothing() -> None:
    state, spec, _ = random_world(1)
    layer, store = layer_and_store()
    assert store.add(scan_at(Planar(500.0, 0.0, 0.0)), ORIGIN, state, spec, ORIGIN) == 0
    assert list(layer.tiles()) == []


def test_a_snapshot_keeps_every_footprint() -> None:
    state, spec, rng = random_world(5)
    layer, store = layer_and_store()
    keyframes = {k: random_pose(spec, rng) for k in range(4)}
    for k, pose in keyframes.items():
        store.add(scan_at(random_pose(spec, rng), k), pose, state, spec, ORIGIN)
    copied = TileLayer("float32", 0.0, RES)
    copied.set_state(unpack_snapshot(pack_snapshot(layer.state())))
    other = FootprintStore(copied)
    other.set_state(unpack_snapshot(pack_snapshot({"f": store.state()}))["f"])
    moved = {k: Planar(p.x_m + 1.0, p.y_m, p.yaw_rad + 0.4) for k, p in keyframes.items()}
    assert store.follow(moved) == other.follow(moved) == 4
    assert np.array_equal(layer.read(WIDE), copied.read(WIDE))


@given(seed=st.integers(0, 1000), dx=st.integers(-9, 9), dy=st.integers(-9, 9))
def test_resampling_by_whole_cells_copies(seed: int, dx: int, dy: int) -> None:
    values = np.random.default_rng(seed).integers(1, 9, (7, 11))
    spec, target = GridSpec(RES, 4, -3, 11, 7), GridSpec(RES, 0, -8, 20, 18)
    out = resample(values, spec, target, Planar(dx * RES, dy * RES, 0.0), 0)
    expected = np.zeros(target.shape, values.dtype)
    for r in range(7):
        for c in range(11):
            row, column = spec.iy0 + r + dy - target.iy0, spec.ix0 + c + dx - target.ix0
            if target.contains(row, column):
                expected[row, column] = values[r, c]
    assert np.array_equal(out, expected)


def test_on_rough_ground_a_look_passes_over_low_blocks_and_not_over_walls() -> None:
    """From 0.8 m, a strip of 0.3 m at 2 m hides what lies up to 2.8 m away; on flat ground, all behind it."""
    spec = GridSpec(RES, 0, 0, round(6.0 / RES), round(2.0 / RES))
    state = np.full(spec.shape, FREE, np.uint8)
    x = np.tile(spec.centres_x(), (spec.height, 1))
    strip = (x > 2.0) & (x < 2.0 + RES)
    state[strip] = LETHAL
    ground = np.zeros(spec.shape, np.float32)
    scan = scan_at(Planar(0.05, 1.05, 0.0), range_m=5.5, fov_rad=1.0)
    scan = scan.model_copy(update={"pose_in_odom": scan.pose_in_odom.model_copy(update={"z_m": 0.8})})
    far = {}
    for name, height_m in (("low", 0.3), ("wall", 50.0), ("flat", None)):
        layer, store = layer_and_store()
        top = np.where(strip, np.float32(height_m or 0.0), ground)
        relief = None if height_m is None else Relief(ground, top.astype(np.float32))
        store.add(scan, ORIGIN, state, spec, ORIGIN, relief)
        middle = layer.read(spec)[spec.cell_of(0.05, 1.05)[0]]
        far[name] = spec.centres_x()[middle > 0]
    assert ((far["low"] < 2.5) | (far["low"] > 2.7)).all() and far["low"].max() > 5.0
    assert (
        far["wall"].max() < 2.5 and far["flat"].max() < 2.5
    )  # the surface, and what is right behind it, count
