"""The path that is being driven: no turn on the spot where there is no room for it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from planning.footprint import clearance_m
from planning.grid import FREE, LETHAL, GridSpec
from schemas.base import Pose
from schemas.contract import SECOND_NS
from schemas.sensing import Odometry
from services.reconciler.config import Config
from services.reconciler.episode import Committed
from services.reconciler.following import Driven
from services.reconciler.path import Ground

SPEC = GridSpec(0.1, -20, -20, 80, 40)
TURN_ROOM = Config().model_copy(update={"turn_room_m": 0.1})


def gap() -> Ground:
    """Free ground, and from x = 1.5 m on walls at y = -0.35 m and 0.35 m: a gap with 0.3 m to either side."""
    state = np.full(SPEC.shape, FREE, np.uint8)
    y, x = SPEC.centres_y()[:, None], SPEC.centres_x()[None, :]
    state[(np.abs(y) > 0.3) & (np.abs(y) < 0.4) & (x > 1.5)] = LETHAL
    return Ground(SPEC, state, clearance_m(state == LETHAL, None, None, SPEC))


def odometry(x_m: float, speed_mps: float = 0.4) -> Odometry:
    return Odometry(
        stamp_ns=0, pose=Pose(x_m=x_m), map_to_odom=Pose(), speed_mps=speed_mps, turn_rate_radps=0.0,
        covariance=np.zeros((3, 3)),
    )  # fmt: skip


def driven_into(ground: Ground, config: Config, to_x_m: float, then_x_m: float) -> tuple[Driven, bool]:
    """A robot that came along y = 0 and whose new path leads from here to another x on that line."""
    driven = Driven(config)
    for k in range(round(to_x_m / 0.05) + 1):
        driven.follow(k * SECOND_NS // 10, odometry(0.05 * k), None, 1, ground)
    line = np.array([[x, 0.0] for x in np.arange(to_x_m, then_x_m, math.copysign(0.1, then_x_m - to_x_m))])
    driven.committed = Committed(line, np.zeros((0, 2), np.int64), np.zeros(0, np.int64))
    driven.end = len(line) - 1
    return driven, driven.follow(10 * SECOND_NS, odometry(to_x_m), None, 1, ground)


@pytest.mark.parametrize(
    ("config", "to_x_m", "then_x_m", "leaves"),
    [
        (TURN_ROOM, 2.2, -1.0, True),
        (TURN_ROOM, 2.2, 5.0, False),
        (TURN_ROOM, 0.6, -1.0, False),
        (TURN_ROOM, 1.25, -1.0, True),
        (Config(), 2.2, -1.0, False),
    ],
    ids=["turns in the gap", "goes on through it", "turns before it", "will stop in it", "switched off"],
)
def test_a_robot_in_a_gap_goes_back_before_it_turns(
    config: Config, to_x_m: float, then_x_m: float, leaves: bool
) -> None:
    ground = gap()
    driven, dropped = driven_into(ground, config, to_x_m, then_x_m)
    assert dropped == driven.backing == leaves
    if leaves:
        assert driven.committed is not None
        end = driven.committed.points[-1]
        room = driven._clearance_m(ground, end)
        assert driven.committed.points[0, 0] == pytest.approx(to_x_m, abs=0.06)
        assert room >= config.footprint_radius_m + 0.1
        assert "tight" in driven.why


def test_without_room_on_its_trail_it_turns_where_it_is() -> None:
    ground = gap()
    driven, dropped = driven_into(ground, TURN_ROOM, 3.9, -1.0)
    assert not dropped and not driven.backing
