"""The riskmap stage: when it publishes, what it ignores, and that it goes on from a snapshot."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec
from schemas.base import Pose
from schemas.codec import Envelope, decode, encode
from schemas.contract import SECOND_NS, Outputs, StageSetup
from schemas.sensing import PointCloud, ReadyGrid
from schemas.topics import CLOUD, MOVING, ODOMETRY, READY_GRID, RISK_MAP
from schemas.world import RiskMap
from services.riskmap.stage import Config, RiskMapStage, create, spec, warm_up
from tests.riskmap.helpers import cloud, inputs, merged, odometry, rectangle

ROOM = rectangle(-4.0, -3.0, 4.0, 3.0)
TENTH = SECOND_NS // 10
SETUP = StageSetup("husky1", 1)
_ENVELOPE = Envelope("husky1", "riskmap", 1, 1, 0, {})


def stage(model: str = "flat", **fields: float) -> RiskMapStage:
    return RiskMapStage(Config.model_validate({"window_m": 12.0, "model": model, **fields}))


both = pytest.mark.parametrize("model", ["flat", "terrain"])


def step(
    room: RiskMapStage, now_ns: int, x_m: float = 0.0, y_m: float = 0.0, stamp_ns: int | None = None
) -> Outputs:
    stamp = now_ns if stamp_ns is None else stamp_ns
    given = inputs((CLOUD, cloud(ROOM, x_m, y_m, stamp)), (ODOMETRY, odometry(x_m, y_m)))
    return maps(room.step(now_ns, given))


def maps(outputs: Outputs) -> Outputs:
    """Those that are risk maps."""
    return [output for output in outputs if output.topic is RISK_MAP]


def risk_map(outputs: Outputs) -> RiskMap:
    assert len(outputs) == 1 and outputs[0].topic is RISK_MAP
    assert isinstance(outputs[0].message, RiskMap)
    return outputs[0].message


def wire(message: RiskMap) -> bytes:
    """Its bytes, once through the real codec, within the size that the table allows."""
    payload = encode(message, _ENVELOPE)
    assert len(payload) <= RISK_MAP.max_bytes
    decode(payload, RiskMap, RISK_MAP.max_bytes)
    return payload


def state_at(message: RiskMap, x_m: float, y_m: float) -> int:
    g = message.grid
    row, column = GridSpec(g.resolution_m, g.ix0, g.iy0, g.width, g.height).cell_of(x_m, y_m)
    return int(message.state[row, column])


def test_it_publishes_at_its_period_while_there_is_news() -> None:
    room = stage()
    published = [len(step(room, k * TENTH, stamp_ns=k * TENTH + 1)) for k in range(9)]
    assert published == [1, 0, 1, 0, 1, 0, 1, 0, 1]
    assert room.step(9 * TENTH, inputs()) == []
    assert room.step(20 * TENTH, inputs()) == []


def test_news_between_two_periods_is_published_when_the_next_is_due() -> None:
    room = stage()
    assert len(step(room, TENTH)) == 1
    assert step(room, 2 * TENTH) == []
    late = risk_map(room.step(3 * TENTH, inputs()))
    assert late.stamp_ns == 2 * TENTH
    assert room.step(9 * TENTH, inputs()) == []


def test_the_map_names_the_newest_cloud_and_the_robots_place() -> None:
    room = stage()
    message = risk_map(step(room, 5 * TENTH, 0.4, 0.3, stamp_ns=4 * TENTH))
    assert message.stamp_ns == 4 * TENTH
    assert (message.robot_pose.x_m, message.robot_pose.y_m) == (0.4, 0.3)
    assert message.footprint_radius_m == Config().footprint_radius_m
    wire(message)


def test_unseen_ground_is_unknown_and_seen_ground_is_free() -> None:
    message = risk_map(step(stage(), TENTH))
    assert state_at(message, 2.0, 1.0) == FREE
    assert state_at(message, 4.01, 0.01) == LETHAL
    assert state_at(message, 5.0, 0.0) == UNKNOWN


@pytest.mark.parametrize(("age_s", "outputs"), [(0.9, 1), (1.1, 0)])
def test_a_stale_cloud_is_ignored(age_s: float, outputs: int) -> None:
    room = stage()
    found = maps(room.step(5 * SECOND_NS, inputs((CLOUD, cloud(ROOM, 0, 0, SECOND_NS)), age_s=age_s)))
    assert len(found) == outputs


@pytest.mark.parametrize("stamp_ns", [TENTH - 1, TENTH])
def test_old_stamps_are_ignored(stamp_ns: int) -> None:
    room = stage()
    step(room, TENTH)
    before = room.snapshot()
    assert step(room, 5 * TENTH, stamp_ns=stamp_ns) == []
    assert room.snapshot() == before


def test_a_message_seen_before_is_not_counted_twice() -> None:
    room = stage()
    seen = inputs((CLOUD, cloud(ROOM, 0, 0, TENTH)))
    again = inputs((CLOUD, cloud(ROOM, 0, 0, 2 * TENTH)), fresh=False)
    room.step(TENTH, seen)
    before = room.snapshot()
    assert room.step(9 * TENTH, again) == []
    assert room.snapshot() == before


def test_an_empty_cloud_is_ignored() -> None:
    empty = PointCloud(
        stamp_ns=TENTH, sensor_in_odom=Pose(x_m=30.0), range_m=20.0, points_m=np.empty((0, 3), np.float32)
    )
    room = stage()
    before = room.snapshot()
    assert room.step(TENTH, inputs((CLOUD, empty))) == []
    assert room.snapshot() == before


def test_the_map_rolls_with_the_robot_and_keeps_what_it_knew() -> None:
    room = stage()
    first = risk_map(step(room, TENTH))
    second = risk_map(step(room, 9 * TENTH, 2.03, 1.0))
    assert (second.grid.ix0 - first.grid.ix0, second.grid.iy0 - first.grid.iy0) == (20, 10)
    known = [risk_map(step(stage(), TENTH)), second]
    assert all(state_at(message, 1.0, 1.0) == FREE for message in known)


@both
@pytest.mark.parametrize("news", [False, True])
def test_a_snapshot_goes_on_with_the_same_bytes(news: bool, model: str) -> None:
    one, other = stage(model), create(Config.model_validate({"window_m": 12.0, "model": model}), SETUP)
    one.step(0, inputs((READY_GRID, grid_of(np.zeros((16, 16), np.int8), 0))))
    for k in range(1, 5 + news):
        step(one, k * TENTH, 0.1 * k, 0.0)
    other.restore(one.snapshot())
    assert other.snapshot() == one.snapshot()
    for k in range(6, 14):
        found = [
            room.step(
                k * TENTH,
                merged(
                    inputs((CLOUD, cloud(ROOM, 0.1 * k, 0, k * TENTH))), inputs((ODOMETRY, odometry(0, 0)))
                ),
            )
            if k > 7
            else room.step(k * TENTH, inputs())
            for room in (one, other)
        ]
        assert len(found[0]) == len(found[1])
        for a, b in zip(*found, strict=True):
            assert encode(a.message, _ENVELOPE) == encode(b.message, _ENVELOPE)


def grid_of(occupancy: NDArray[np.int8], stamp_ns: int) -> ReadyGrid:
    return ReadyGrid(
        stamp_ns=stamp_ns,
        resolution_m=0.25,
        origin_x_m=-2.0,
        origin_y_m=-2.0,
        height=occupancy.shape[0],
        width=occupancy.shape[1],
        occupancy=occupancy,
    )


@both
def test_a_ready_grid_alone_makes_a_risk_map(model: str) -> None:
    occupancy = np.zeros((16, 16), np.int8)
    occupancy[:, 12] = 100
    occupancy[0] = -1
    room = stage(model)
    message = risk_map(room.step(TENTH, inputs((READY_GRID, grid_of(occupancy, 7)))))
    assert message.stamp_ns == 7
    assert state_at(message, 0.0, 0.0) == FREE
    assert state_at(message, 1.05, 0.0) == LETHAL and state_at(message, 1.24, 0.0) == LETHAL
    assert state_at(message, 0.0, -1.9) == UNKNOWN
    wire(message)


@both
def test_ready_grids_do_not_silence_the_clouds(model: str) -> None:
    """A cloud takes longer to come than a grid: its stamp is older than that of the grid which was there before it."""
    room = stage(model)
    taken = 0
    for k in range(5, 15):
        free = grid_of(np.zeros((16, 16), np.int8), k * TENTH)
        room.step(k * TENTH, inputs((READY_GRID, free)))
        late = room.step(k * TENTH + 1, inputs((CLOUD, cloud(ROOM, 0, 0, k * TENTH - TENTH // 2))))
        taken += sum(output.topic is MOVING for output in late)
    assert taken == 10
    message = risk_map(room.step(20 * TENTH, inputs()))
    assert message.stamp_ns >= 14 * TENTH, "of the newer of both"
    assert state_at(message, 4.01, 0.01) == LETHAL, "seen by the clouds alone"


def large_grid(stamp_ns: int) -> ReadyGrid:
    return ReadyGrid(
        stamp_ns=stamp_ns, resolution_m=0.5, origin_x_m=-50.0, origin_y_m=-50.0, height=200, width=200,
        occupancy=np.zeros((200, 200), np.int8),
    )  # fmt: skip


@both
def test_a_mission_on_one_ready_grid_goes_on(model: str) -> None:
    """The latched grid is there for what rolls in, and the map is published with the stamp of the odometry."""
    room = stage(model)
    room.step(0, inputs((READY_GRID, large_grid(0))))
    for k in (2, 4, 300):
        pose = odometry(0.3 * k / 10, 0.0, stamp_ns=k * TENTH - 1)
        message = risk_map(room.step(k * TENTH, inputs((ODOMETRY, pose))))
        assert message.stamp_ns == k * TENTH - 1
        assert (message.state == FREE).all()
    assert message.grid.ix0 == 30
    wire(message)
    assert risk_map(room.step(400 * TENTH, inputs())).stamp_ns == 400 * TENTH


def test_a_ready_grid_may_grow_old() -> None:
    room = stage(grid_timeout_s=2.0)
    room.step(0, inputs((READY_GRID, large_grid(0))))
    assert len(room.step(20 * TENTH, inputs())) == 1
    assert room.step(23 * TENTH, inputs()) == []


@both
def test_messages_from_the_future_are_counted_and_block_nothing(model: str) -> None:
    room = stage(model)
    assert step(room, TENTH, stamp_ns=TENTH + SECOND_NS) == []
    assert room.step(TENTH, inputs((READY_GRID, large_grid(TENTH + SECOND_NS)))) == []
    assert room.future_messages == 2
    assert len(step(room, 2 * TENTH)) == 1


def test_the_terrain_model_makes_a_risk_map_of_a_room() -> None:
    room = stage("terrain")
    for k in range(1, 5):
        step(room, k * TENTH)
    message = risk_map(step(room, 5 * TENTH))
    assert state_at(message, 2.0, 1.0) == FREE
    assert state_at(message, 4.01, 0.01) == LETHAL
    assert state_at(message, 5.0, 0.0) == UNKNOWN
    assert message.elevation_m[message.state == FREE] == pytest.approx(0.0, abs=0.05)
    wire(message)


def test_two_runs_of_the_terrain_model_give_the_same_bytes() -> None:
    found = []
    for _ in range(2):
        room = stage("terrain")
        found.append([wire(risk_map(out)) for k in range(1, 6) if (out := step(room, k * TENTH, 0.1 * k))])
    assert found[0] == found[1] and len(found[0]) == 3


def test_the_profile_sets_the_defaults_and_fields_override_it() -> None:
    husky = Config.model_validate({"profile": "husky", "max_step_m": 0.07})
    assert (husky.footprint_radius_m, husky.max_slope_rad, husky.max_step_m) == (0.335, 0.42, 0.07)
    assert Config() == Config(profile="spot")
    assert (Config(risk_blind=True).alpha, Config(cvar_alpha=0.0).alpha, Config().alpha) == (0.0, 0.0, 0.9)
    with pytest.raises(ValueError, match="profile"):
        Config.model_validate({"profile": "tank"})


@both
def test_points_that_are_not_finite_are_counted_and_skipped(model: str) -> None:
    points = cloud(ROOM, 0, 0, TENTH).points_m.copy()
    clean = stage(model)
    clean._integrate(PointCloud(stamp_ns=TENTH, sensor_in_odom=Pose(z_m=0.8), range_m=20.0, points_m=points))
    dirty = stage(model)
    message = PointCloud.model_construct(
        stamp_ns=TENTH,
        sensor_in_odom=Pose(z_m=0.8),
        ground_z_m=0.0,
        range_m=20.0,
        points_m=np.concatenate((points, np.full((5, 3), np.nan, np.float32))),
    )
    dirty._integrate(message)
    assert (clean.bad_points, dirty.bad_points) == (0, 5)
    assert clean.snapshot() == dirty.snapshot()


def test_it_runs_at_the_rate_of_the_clouds_and_warms_up() -> None:
    assert spec(Config()).name == "riskmap"
    assert spec(Config()).period_ns <= TENTH
    warm_up()
