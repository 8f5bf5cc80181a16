"""The terrain model in synthetic worlds: what it takes for ground, what for obstacles, and what it leaves unknown."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.grid import FREE, LETHAL, UNKNOWN
from schemas.base import Pose
from schemas.sensing import PointCloud
from services.riskmap.cells import CEILING, CEILING_SEEN, LOG_ODDS, MEAN, SEEN, VARIANCE
from services.riskmap.collision import RiskLayers
from services.riskmap.config import Config
from services.riskmap.flat_model import FlatModel
from services.riskmap.ring import RingWindow
from services.riskmap.terrain_model import TerrainModel
from tests.riskmap.rough import MOUNT, Heights, cloud_at, flat, ledge, plane, stand_on

WINDOW_M = 20.0


def config(**fields: object) -> Config:
    return Config.model_validate({"model": "terrain", "profile": "husky", "window_m": WINDOW_M, **fields})


def drive(
    heights: Heights,
    xs: Iterable[float],
    model: TerrainModel | None = None,
    y_m: float = 0.0,
    noise_m: float = 0.01,
    ceiling_m: float = math.inf,
    **fields: object,
) -> tuple[TerrainModel, Pose]:
    model = TerrainModel(config(**fields)) if model is None else model
    rng = np.random.default_rng(0)
    base = Pose()
    for k, x in enumerate(xs):
        base = stand_on(heights, float(x), y_m)
        model.roll_to(base.x_m, base.y_m)
        model.integrate(cloud_at(heights, base, k + 1, noise_m=noise_m, rng=rng, ceiling_m=ceiling_m))
    return model, base


def cells_of(model: TerrainModel) -> NDArray[np.float32]:
    window: RingWindow = model._window
    return window.ordered()


def at(model: TerrainModel, layer: NDArray[np.float32] | NDArray[np.uint8], x: float, y: float) -> float:
    return float(layer[model.spec.cell_of(x, y)])


def places(model: TerrainModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    grid = np.meshgrid(model.spec.centres_x(), model.spec.centres_y())
    return grid[0], grid[1]


def layers_of(model: TerrainModel, base: Pose) -> RiskLayers:
    return model.layers(base)[0]


def block(x0: float, x1: float, y0: float, y1: float, z: float) -> Heights:
    return lambda x, y: np.where((x > x0) & (x < x1) & (y > y0) & (y < y1), z, 0.0)


# --- ground -----------------------------------------------------------------------------------------------------


def sparse_cloud(points: NDArray[np.float64], stamp_ns: int) -> PointCloud:
    """Points given in odom, seen from a robot at the origin."""
    in_sensor = points - np.array([0.0, 0.0, MOUNT.z_m])
    return PointCloud(
        stamp_ns=stamp_ns, sensor_in_odom=MOUNT, sensor_in_base=MOUNT, range_m=20.0,
        points_m=in_sensor.astype(np.float32),
    )  # fmt: skip


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000), sweeps=st.integers(1, 8))
def test_the_height_of_a_cell_is_that_of_a_kalman_filter(seed: int, sweeps: int) -> None:
    """Against the filter written down: points of one cell and bearing, a few centimetres apart."""
    rng = np.random.default_rng(seed)
    c = config(range_sigma_m=0.02, angle_sigma_rad=0.003)
    model = TerrainModel(c)
    mean = variance = 0.0
    total = 0
    for k in range(sweeps):
        n = int(rng.integers(1, 6))
        z = rng.normal(0.02, 0.008, n)
        points = np.column_stack([rng.uniform(4.02, 4.08, n), np.full(n, 0.005), z])
        model.integrate(sparse_cloud(points, k + 1))
        z, away = z.astype(np.float32), float(points[:, 0].max())
        noise = (0.003 * away) ** 2 + (0.02**2 + float(z.var())) / n
        gain = 1.0 if k == 0 else variance / (variance + noise)
        mean += gain * (float(z.mean()) - mean)
        variance = noise if k == 0 else (1.0 - gain) * variance
        total += n
    cells = cells_of(model)
    assert at(model, cells[SEEN], 4.05, 0.05) == total
    assert at(model, cells[MEAN], 4.05, 0.05) == pytest.approx(mean, abs=1e-4)
    assert at(model, cells[VARIANCE], 4.05, 0.05) == pytest.approx(variance, rel=2e-3)


@pytest.mark.parametrize("heights", [flat, plane(0.2, -0.1), plane(-0.3)])
def test_ground_is_found_within_its_own_deviation(heights: Heights) -> None:
    model, _ = drive(heights, np.arange(0.0, 1.0, 0.1))
    cells, (x, y) = cells_of(model), places(model)
    seen = cells[SEEN] > 0
    error = (cells[MEAN] - heights(x, y))[seen]
    sigma = np.sqrt(cells[VARIANCE][seen])
    slope = 0.05 * max(abs(float(heights(np.array(1.0), np.array(0.0)))), 0.05)
    assert np.abs(error).max() < 0.06
    assert (np.abs(error) < 3.0 * sigma + slope).mean() > 0.97


def test_between_rings_ground_is_filled_and_beyond_the_gap_unknown() -> None:
    """Ground hits at 3.0, 3.5, 4.1, 5.0, 6.5 and 9.1 m: gaps of up to 1.5 m close, the one of 2.6 m does not."""
    model, base = drive(flat, [0.0])
    state = layers_of(model, base).state
    cells, (x, y) = cells_of(model), places(model)
    away = np.hypot(x, y)
    assert (state[away < 6.2] == FREE).all()
    assert (state[(away > 6.9) & (away < 8.8)] == UNKNOWN).all()
    filled = (cells[SEEN] == 0) & (away > 5.3) & (away < 6.2)
    tight = (cells[SEEN] == 0) & (away > 3.15) & (away < 3.35)
    assert filled.any() and tight.any()
    assert cells[VARIANCE][filled].max() > 2 * cells[VARIANCE][tight].max()


def test_without_a_gap_nothing_is_filled() -> None:
    model, _ = drive(flat, [0.0], max_gap_m=0.0, start_radius_m=0.0)
    cells, (x, y) = cells_of(model), places(model)
    away = np.hypot(x, y)
    assert not (cells[VARIANCE][(away > 0.6) & (away < 2.8)] > 0).any()
    assert not (cells[VARIANCE][(away > 5.2) & (away < 6.2)] > 0).any()


def test_the_ground_around_the_start_is_supposed_up_to_what_is_seen() -> None:
    walls: Heights = lambda x, y: np.where(np.abs(y) > 1.2, 2.5, 0.0) + 0.0 * x  # noqa: E731
    model, base = drive(walls, [0.0])
    cells = cells_of(model)
    for x, y in ((1.0, 0.5), (2.5, 0.0), (-2.0, -0.8)):
        assert at(model, cells[SEEN], x, y) == 0 and at(model, cells[VARIANCE], x, y) >= 0.05**2
        assert at(model, layers_of(model, base).state, x, y) == FREE
    for y in (1.6, -2.0):
        assert at(model, layers_of(model, base).state, 0.3, y) == UNKNOWN


def test_no_ground_is_supposed_over_a_cliff_beside_the_start() -> None:
    model, base = drive(ledge(1.6, -4.0), [0.0])
    state, (x, _) = layers_of(model, base).state, places(model)
    assert not (state[x > 1.7] == FREE).any()
    assert at(model, state, -1.5, 0.0) == FREE


def test_where_the_robot_stands_there_is_ground() -> None:
    """Even if nothing was ever seen of it; its plane is the body's."""
    heights = plane(0.25)
    model, _ = drive(heights, [0.0], start_radius_m=0.0)
    cells = cells_of(model)
    for x in (-0.25, 0.05, 0.25):
        assert at(model, cells[MEAN], x, 0.05) == pytest.approx(0.25 * x, abs=0.02)
    assert at(model, cells[VARIANCE], 0.8, 0.05) == 0.0


def test_crowns_and_decks_are_ceiling_and_not_ground() -> None:
    """A deck at 2.2 m is over the robot: the ground below it stays what it is, and free."""
    model, base = drive(flat, np.arange(0.0, 0.5, 0.1), ceiling_m=2.2)
    cells, state = cells_of(model), layers_of(model, base).state
    covered = cells[CEILING_SEEN] > 0
    assert covered.sum() > 50
    assert cells[CEILING][covered] == pytest.approx(2.2, abs=0.1)
    assert np.abs(cells[MEAN][cells[VARIANCE] > 0]).max() < 0.1
    assert not (state == LETHAL).any()


def test_ground_that_rises_is_no_ceiling_of_itself() -> None:
    """Seen from afar, with nothing known of what leads there, a slope's far part hangs in the air."""
    y = np.arange(-0.5, 0.5, 0.01)

    def slope(*xs: float) -> NDArray[np.float64]:
        return np.concatenate(
            [np.stack([0.0 * y + x, y, 0.0 * y + max(0.0, 0.4 * (x - 4.0))], axis=1) for x in xs]
        )

    model = TerrainModel(config(profile="spot"))
    model.integrate(sparse_cloud(slope(3.0, 3.9, 8.05), 1))
    assert at(model, cells_of(model)[CEILING_SEEN], 8.05, 0.05) > 0, "taken for something overhead at first"
    for k in range(3):
        model.integrate(sparse_cloud(slope(*np.arange(2.0, 9.0, 0.05)), k + 2))
    state = layers_of(model, Pose()).state
    near = [int(at(model, state, x, 0.05)) for x in (7.85, 7.95, 8.05, 8.15)]
    assert near == [FREE] * 4


def test_ground_once_seen_is_not_taken_for_overhead_when_what_leads_there_is_missed() -> None:
    """The far part of a ramp, seen a few times, and then by a sweep that lost the rings before it."""
    y = np.arange(-0.5, 0.5, 0.2)

    def slope(*xs: float) -> NDArray[np.float64]:
        return np.concatenate(
            [np.stack([0.0 * y + x, y, 0.0 * y + max(0.0, 0.5 * (x - 4.0))], axis=1) for x in xs]
        )

    model = TerrainModel(config(profile="spot"))
    for k in range(2):
        model.integrate(sparse_cloud(slope(*np.arange(2.0, 9.0, 0.05)), 2 * k + 1))
        model.integrate(sparse_cloud(slope(3.0, 3.9, 8.05), 2 * k + 2))
    assert at(model, cells_of(model)[SEEN], 8.05, 0.1) > 0
    assert at(model, cells_of(model)[CEILING_SEEN], 8.05, 0.1) == 0
    assert at(model, layers_of(model, Pose()).state, 8.05, 0.1) == FREE


def test_supposed_ground_is_no_ceiling_of_itself_either() -> None:
    """The far part of a ramp is seen before what leads there; then all but a strip of it, which is supposed between. A
    thing that hangs over the strip stays."""
    y = np.arange(-0.5, 0.5, 0.01)

    def ramp(*xs: float, over_m: float = 0.0) -> NDArray[np.float64]:
        return np.concatenate(
            [np.stack([0.0 * y + x, y, 0.0 * y + max(0.0, 0.4 * (x - 4.0)) + over_m], axis=1) for x in xs]
        )

    around = [*np.arange(2.0, 7.95, 0.05), *np.arange(8.2, 9.0, 0.05)]
    for over_m, what in ((0.0, FREE), (0.5, LETHAL)):
        model = TerrainModel(config(profile="spot"))
        model.integrate(sparse_cloud(ramp(3.0, 3.9, 8.05, over_m=over_m), 1))
        assert at(model, cells_of(model)[CEILING_SEEN], 8.05, 0.05) > 0, (
            "taken for something overhead at first"
        )
        for k in range(3):
            model.integrate(sparse_cloud(ramp(*around), k + 2))
        assert at(model, cells_of(model)[SEEN], 8.05, 0.05) == 0, "supposed"
        assert at(model, cells_of(model)[VARIANCE], 8.05, 0.05) > 0
        assert int(at(model, layers_of(model, Pose()).state, 8.05, 0.05)) == what
        model.integrate(sparse_cloud(ramp(3.0, 3.9, 8.05), 9))
        assert int(at(model, layers_of(model, Pose()).state, 8.05, 0.05)) == what, "seen once more from afar"


@pytest.mark.parametrize("in_one_sweep", [True, False])
def test_a_roof_below_which_a_ray_has_passed_is_not_taken_for_ground_that_rises(in_one_sweep: bool) -> None:
    """The roof of a neck, 1.3 m over its floor, is the first that a level ray meets after a gap between the rings."""
    near = [(x, 0.0) for x in np.arange(0.9, 2.8, 0.3)]
    roof, beyond = (7.15, 1.3), (9.35, 0.1 if in_one_sweep else -1.3)
    sweeps = [[*near, roof, beyond]] if in_one_sweep else [[*near, beyond], [*near, roof]]
    y = np.arange(-0.3, 0.31, 0.01)
    model = TerrainModel(config(profile="spot"))
    for k, sweep in enumerate(sweeps):
        points = [np.stack([0.0 * y + x, y * x / 9.0, 0.0 * y + z], axis=1) for x, z in sweep]
        model.integrate(sparse_cloud(np.concatenate(points), k + 1))
    assert at(model, cells_of(model)[SEEN], 7.15, 0.05) <= 0
    assert at(model, cells_of(model)[MEAN], 7.15, 0.05) < 0.6
    assert at(model, cells_of(model)[SEEN], 9.35, 0.05) > 0, "what lies beyond is ground"


def test_a_roof_over_ground_that_falls_away_is_no_obstacle_once_the_ground_is_seen() -> None:
    """From the crest, what hangs low over the slope behind it stands in the way, until the floor is seen."""
    y = np.arange(-0.3, 0.31, 0.01)

    def rows(*places: tuple[float, float]) -> NDArray[np.float64]:
        return np.concatenate([np.stack([0.0 * y + x, y * x / 9.0, 0.0 * y + z], axis=1) for x, z in places])

    crest = [(x, 0.0) for x in np.arange(0.9, 7.0, 0.25)]
    model = TerrainModel(config(profile="spot"))
    for k in range(3):
        model.integrate(sparse_cloud(rows(*crest, (7.15, 0.7)), k + 1))
    assert at(model, cells_of(model)[LOG_ODDS], 7.15, 0.05) > 0
    model.integrate(sparse_cloud(rows(*crest[:-2], (7.15, -1.0)), 4))
    cells = cells_of(model)
    assert at(model, cells[LOG_ODDS], 7.15, 0.05) <= 0
    assert at(model, cells[CEILING_SEEN], 7.15, 0.05) > 0
    assert at(model, cells[CEILING], 7.15, 0.05) == pytest.approx(0.7, abs=0.01)


def test_a_ceiling_seen_over_a_crest_is_not_taken_for_the_ground_that_lies_below() -> None:
    """From the upper end of a slope, rays pass over its lower part and meet the ceiling beyond: z = 1 over -1.2."""
    y = np.arange(-0.5, 0.5, 0.05)

    def points(*places: tuple[float, float]) -> NDArray[np.float64]:
        return np.concatenate([np.stack([0.0 * y + x, y, 0.0 * y + z], axis=1) for x, z in places])

    upper = [(x, 0.0) for x in np.arange(2.0, 5.0, 0.05)]
    lower = [(x, max(-1.2, -0.6 * (x - 5.0))) for x in np.arange(5.0, 9.0, 0.05)]
    model = TerrainModel(config(profile="spot"))
    for k in range(5):
        model.integrate(sparse_cloud(points(*upper, *lower), k + 1))
    before = at(model, cells_of(model)[MEAN], 8.05, 0.05)
    for k in range(5):
        model.integrate(sparse_cloud(points(*upper, (8.05, 1.0)), k + 6))
    assert before == pytest.approx(-1.2, abs=0.05)
    assert at(model, cells_of(model)[MEAN], 8.05, 0.05) == pytest.approx(before, abs=0.05)
    assert at(model, cells_of(model)[CEILING], 8.05, 0.05) == pytest.approx(1.0, abs=0.05)
    assert at(model, layers_of(model, Pose()).state, 8.05, 0.05) == FREE


def test_a_beam_below_the_robots_height_is_an_obstacle() -> None:
    points = [(4.0 + 0.02 * k, 0.005 * j, 0.0) for k in range(5) for j in range(5)]
    beam = [(4.05, 0.005 * j, 0.7) for j in range(5)]
    model = TerrainModel(config())
    model.integrate(sparse_cloud(np.array(points + beam), 1))
    assert at(model, cells_of(model)[LOG_ODDS], 4.05, 0.01) > 0


# --- slopes, ledges, pits -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("angle", "state"), [(0.2, FREE), (0.36, FREE), (0.52, LETHAL)])
def test_slopes_are_judged_by_the_profile(angle: float, state: int) -> None:
    model, base = drive(plane(math.tan(angle)), np.arange(0.0, 1.0, 0.1))
    found, (x, y) = layers_of(model, base).state, places(model)
    ring = (np.hypot(x - 0.9, y) > 3.6) & (np.hypot(x - 0.9, y) < 4.6)
    assert (found[ring] == state).mean() > 0.97


def test_spot_climbs_what_husky_does_not() -> None:
    found = []
    for profile in ("husky", "spot"):
        model, base = drive(ledge(4.0, 0.15), np.arange(0.0, 2.5, 0.1), profile=profile)
        state, (x, y) = layers_of(model, base).state, places(model)
        edge = (np.abs(x - 4.0) < 0.1) & (np.abs(y) < 2.0)
        found.append((state[edge].reshape(-1, 2) == LETHAL).any(axis=1).mean())
    assert found[0] > 0.9
    assert found[1] == 0.0


def test_a_pit_is_unknown_and_its_rim_is_lethal() -> None:
    model, base = drive(block(4.0, 6.0, -1.0, 1.0, -1.0), np.arange(0.0, 2.6, 0.1))
    state, (x, y) = layers_of(model, base).state, places(model)
    near_rim = (x > 3.8) & (x < 4.0) & (np.abs(y) < 0.8)
    assert (state[near_rim].reshape(-1, 2) == LETHAL).any(axis=1).mean() > 0.8
    inside = (x > 4.2) & (x < 5.8) & (np.abs(y) < 0.8)
    assert not (state[inside] == FREE).any()
    assert (state[(x > 1.0) & (x < 3.6) & (np.abs(y) < 1.0)] == FREE).all()


def test_a_pit_that_was_bridged_from_afar_is_found_when_rays_pass_below() -> None:
    """Filled ground gives way to a ray that goes below it."""
    trench: Heights = lambda x, y: np.where((x > 5.3) & (x < 6.3), -1.5, 0.0) + 0.0 * y  # noqa: E731
    model, base = drive(trench, [0.0])
    assert at(model, cells_of(model)[VARIANCE], 5.7, 0.0) > 0
    model, base = drive(trench, np.arange(0.1, 3.5, 0.1), model)
    assert at(model, layers_of(model, base).state, 5.7, 0.0) != FREE


def test_a_drop_is_lethal_along_its_edge() -> None:
    model, base = drive(ledge(4.0, -0.6), np.arange(0.0, 2.0, 0.1))
    state, (x, y) = layers_of(model, base).state, places(model)
    edge = (x > 3.8) & (x < 4.0) & (np.abs(y) < 2.0)
    assert (state[edge].reshape(-1, 2) == LETHAL).any(axis=1).mean() > 0.9
    assert not (state[(x > 4.0) & (x < 4.5) & (np.abs(y) < 2.0)] == FREE).any()


# --- obstacles ----------------------------------------------------------------------------------------------------


def test_a_rock_is_lethal_and_stays_when_rays_pass_over_it() -> None:
    """Nearer than 3 m no ray comes down to it: those above it do not wipe it out."""
    rock = block(4.0, 4.4, -0.2, 0.2, 0.35)
    model, base = drive(rock, np.arange(0.0, 3.2, 0.1))
    state, (x, y) = layers_of(model, base).state, places(model)
    front = (np.abs(x - 4.05) < 0.06) & (np.abs(y) < 0.19)
    assert (state[front] == LETHAL).all()
    assert (state[(x > 0.5) & (x < 3.7) & (np.abs(y) < 1.0)] == FREE).all()


def test_a_moved_obstacle_fades() -> None:
    box = block(4.0, 4.6, -0.3, 0.3, 1.2)
    model, base = drive(box, [0.0] * 10)
    assert at(model, layers_of(model, base).state, 4.05, 0.0) == LETHAL
    sweeps = 0
    while at(model, layers_of(model, base).state, 4.05, 0.05) == LETHAL:
        drive(flat, [0.0], model)
        sweeps += 1
        assert sweeps < 40
    assert sweeps >= 8
    drive(flat, [0.0] * 10, model)
    assert at(model, layers_of(model, base).clearance_m, 4.05, 0.05) > 1.0


@settings(max_examples=5)
@given(low=st.floats(-0.45, -0.35), x=st.floats(3.4, 3.6))
def test_a_thin_door_keeps_its_clearance(low: float, x: float) -> None:
    """A door of 0.8 m anywhere between the cells, as in the flat model."""
    high = low + 0.8
    world: Heights = lambda a, b: np.where(  # noqa: E731
        (np.abs(b) > 1.6) | ((a > x) & (a < x + 0.2) & ((b < low) | (b > high))) | (a > x + 3.0), 2.5, 0.0
    )
    middle = 0.5 * (low + high)
    model, base = drive(world, np.arange(0.0, x + 1.5, 0.15), y_m=middle, noise_m=0.003)
    layers = layers_of(model, base)
    for column_x in (x - 0.3, x + 0.1, x + 0.4):
        cell = model.spec.cell_of(column_x, middle)
        cx, cy = model.spec.centre_of(*cell)
        away = max(x - cx, 0.0, cx - x - 0.2)
        exact = min(math.hypot(away, cy - low), math.hypot(away, high - cy))
        assert layers.clearance_m[cell] == pytest.approx(exact, abs=0.04), (cx, cy)
        assert layers.state[cell] == FREE


def test_a_corridor_is_free_between_its_walls() -> None:
    walls: Heights = lambda x, y: np.where(np.abs(y) > 1.03, 2.5, 0.0) + 0.0 * x  # noqa: E731
    model, base = drive(walls, np.arange(0.0, 2.0, 0.1), ceiling_m=2.4)
    state, (x, y) = layers_of(model, base).state, places(model)
    along = np.abs(x - 2.0) < 4.0
    assert (state[along & (np.abs(y) < 0.9)] == FREE).all()
    assert (state[along & (np.abs(np.abs(y) - 1.05) < 0.04)] == LETHAL).mean() > 0.95
    assert not (state[along & (np.abs(y) > 1.2)] == FREE).any()


def test_the_body_is_not_an_obstacle() -> None:
    """A mast on the robot itself, in the sensor's view: dropped by the box, an obstacle without it."""
    mast = np.array([[0.35, 0.03, 0.02 * k - 0.4] for k in range(20)], dtype=np.float32)
    for length, lethal in ((0.99, False), (0.2, True)):
        model = TerrainModel(config(body_length_m=length))
        cloud = cloud_at(flat, Pose())
        points = np.concatenate([cloud.points_m, mast])
        for k in range(3):
            model.integrate(cloud.model_copy(update={"points_m": points, "stamp_ns": k + 1}))
        assert (at(model, layers_of(model, Pose()).state, 0.35, 0.03) == LETHAL) == lethal


# --- the whole ------------------------------------------------------------------------------------------------------


def test_risk_blind_sees_walls_and_no_terrain() -> None:
    world: Heights = lambda x, y: (  # noqa: E731
        np.where(x > 7.0, 2.5, 0.0) + np.where((x > 3.6) & (np.abs(y) < 1.0), -0.6, 0.0)
    )
    found = []
    for blind in (False, True):
        model, base = drive(world, np.arange(0.0, 1.0, 0.1), risk_blind=blind)
        layers = layers_of(model, base)
        found.append((int((layers.state == LETHAL).sum()), float(layers.hazard_cvar.max())))
        assert at(model, layers.state, 7.05, 2.0) == LETHAL
        x, y = places(model)
        rim = (x > 3.3) & (x < 3.7) & (np.abs(y) < 0.8)
        assert (layers.state[rim] == LETHAL).any() != blind
        assert np.array_equal(layers.hazard_cvar, layers.hazard_mean) == blind


def test_without_cvar_the_mean_counts_and_what_is_lethal_stays_so() -> None:
    world: Heights = lambda x, y: np.where((x > 3.6) & (np.abs(y) < 1.0), -0.6, 0.0)  # noqa: E731
    found = []
    for alpha in (0.9, 0.0):
        model, base = drive(world, np.arange(0.0, 1.0, 0.1), cvar_alpha=alpha)
        layers = layers_of(model, base)
        assert np.array_equal(layers.hazard_cvar, layers.hazard_mean) == (alpha == 0.0)
        found.append(layers)
    assert (found[0].state == LETHAL).any(), "the rim of the pit"
    assert np.array_equal(found[0].state, found[1].state)


def test_elevation_is_finite_everywhere_and_right_where_seen() -> None:
    heights = plane(0.1)
    model, base = drive(heights, np.arange(0.0, 1.0, 0.1))
    layers, elevation_m = model.layers(base)
    assert np.isfinite(elevation_m).all()
    x, y = places(model)
    free = layers.state == FREE
    assert np.abs(elevation_m - heights(x, y))[free].max() < 0.06


def test_rolling_away_and_back_forgets_and_rolling_along_keeps() -> None:
    model, base = drive(flat, [0.0])
    before = layers_of(model, base).state
    assert model.roll_to(3.0, 0.0)
    kept = layers_of(model, base).state
    assert np.array_equal(kept[:, :-30], before[:, 30:])
    assert (kept[:, -30:] == UNKNOWN).all()
    model.roll_to(50.0, 0.0)
    model.roll_to(0.0, 0.0)
    assert (layers_of(model, base).state == UNKNOWN).all()


@pytest.mark.parametrize("where", [(0.0, 0.0), (812.34, -377.7)])
def test_the_place_in_odom_does_not_matter(where: tuple[float, float]) -> None:
    """Shifted by whole cells, far from the origin, the same map comes out."""
    dx, dy = (round(v / 0.1) * 0.1 for v in where)
    rock = block(4.0, 4.4, -0.2, 0.2, 0.35)
    moved: Heights = lambda x, y: rock(x - dx, y - dy)  # noqa: E731
    one = TerrainModel(config())
    cloud = cloud_at(rock, Pose(x_m=0.03, y_m=0.02))
    one.roll_to(0.03, 0.02)
    one.integrate(cloud)
    other = TerrainModel(config())
    base = Pose(x_m=0.03 + dx, y_m=0.02 + dy)
    other.roll_to(base.x_m, base.y_m)
    other.integrate(cloud_at(moved, base, points_m=cloud.points_m))
    assert (layers_of(one, Pose()).state == layers_of(other, Pose()).state).mean() > 0.995


def test_tops_are_those_of_ground_of_what_stands_on_it_and_of_walls() -> None:
    """A rock of half a metre is as high as it is; what reaches the robot's height counts as a wall."""

    def world(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        rock = np.where((np.abs(x - 4.0) < 0.3) & (np.abs(y) < 0.3), 0.5, 0.0)
        return np.where(x > 7.0, 3.0, rock)

    model, base = drive(world, np.arange(0.0, 2.0, 0.1))
    height_m = model.layers(base)[1]
    top = model.tops(height_m)
    assert at(model, top, 2.05, 1.05) == pytest.approx(0.0, abs=0.05)
    assert at(model, top, 3.75, 0.05) == pytest.approx(0.5, abs=0.12)
    assert at(model, top, 7.05, 0.05) > 50.0


def test_flat_models_have_no_tops() -> None:
    model = FlatModel(Config(window_m=6.0))
    assert model.tops(model.layers(Pose())[1]).shape == (0, 0)
