"""Drives a planned tour with the simulator's own robot and follower, and scores it with the simulator's own judge.

The peer is given what no robot has: true poses and wheels that do not slip. Speeds, accelerations and turn rates are
those of the robot, slopes slow it as they slow any, and ground that breaks robots breaks it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planning.randomness import stream
from plgrim.evaluation.known_ground import KnownGround, Points
from plgrim.evaluation.tour_plan import Stretch, speed_limit_mps
from plgrim.evaluation.viewpoints import Tell
from services.sim.config import SimConfig
from services.sim.coverage import Judge
from services.sim.follower import Follower, TimedPath
from services.sim.robot import Robot
from services.sim.world import World

TICK_S = 0.05
"""Between two commands of the follower, as in the simulator."""
_PIECE_M = 0.2
"""Speeds are set at points so far apart at most."""
_HELD_S = 1.5
"""Against a wall for so long: another way."""
_PATIENCE_S = 120.0
"""For a stretch, beyond three times what its length takes at walking pace."""

Column = NDArray[np.float64]


@dataclass(frozen=True)
class Driven:
    """What came of a drive. Columns float64[n], one row a look of the judge; the first is at time 0."""

    time_s: Column
    covered_m2: Column
    x_m: Column
    y_m: Column
    yaw_rad: Column
    length_m: float
    contacts: int
    skipped: int
    """Stretches given up because the robot was held."""
    lost_reason: str
    """Empty: it was not lost."""
    finished: bool
    """The tour ended before the time did."""


class _Drive:
    """One robot on one tour."""

    def __init__(self, world: World, config: SimConfig, judge: Judge, ground: KnownGround) -> None:
        ideal = config.model_copy(update={"slip_fraction": 0.0})
        self._robot = Robot(world, ideal, stream(0, "tour"))
        self._follower = Follower(config.robot)
        self._judge, self._ground, self._config = judge, ground, config
        self.rows: list[tuple[float, float, float, float, float]] = []
        self.tick, self.length_m = 0, 0.0
        judge.set_covered(np.zeros(judge.spec.shape, np.bool_))
        self._look()

    @property
    def now_s(self) -> float:
        return self.tick * TICK_S

    @property
    def at(self) -> tuple[float, float]:
        return self._robot.state.x_m, self._robot.state.y_m

    @property
    def lost_reason(self) -> str:
        return self._robot.lost_reason

    @property
    def contacts(self) -> int:
        return self._robot.state.contacts

    def _look(self) -> None:
        state = self._robot.state
        self._judge.update(*state[:3])
        self.rows.append((self.now_s, self._judge.covered_area_m2, *state[:3]))

    def follow(self, stretch: Stretch, until_s: float) -> bool:
        """Drive along a stretch to its end; False: held, lost, or out of time."""
        points = _subdivided(stretch.points_m)
        self._follower.set_path(self._path(points, stretch.yaw_rad))
        length = float(np.hypot(*np.diff(points, axis=0).T).sum()) if len(points) > 1 else 0.0
        give_up_s = min(until_s, self.now_s + _PATIENCE_S + 3.0 * length)
        held_s, rate = 0.0, self._config.coverage_sensor.rate_hz
        state = self._robot.state
        while self.now_s < give_up_s and not state.lost:
            command = self._follower.step(*state[:3], self.now_s, state.blocked)
            if command.arrived:
                return True
            held_s = held_s + TICK_S if state.blocked else 0.0
            if command.stuck or held_s > _HELD_S:
                return False
            before = state
            state = self._robot.step(command.speed_mps, command.turn_rate_radps, TICK_S)
            self.length_m += math.hypot(state.x_m - before.x_m, state.y_m - before.y_m)
            slot = math.floor(self.now_s * rate + 1e-6)
            self.tick += 1
            if math.floor(self.now_s * rate + 1e-6) > slot:
                self._look()
        return False

    def _path(self, points: Points, yaw_rad: float | None) -> TimedPath:
        yaw = np.zeros(len(points))
        if len(points) > 1:
            yaw[:-1] = np.arctan2(np.diff(points[:, 1]), np.diff(points[:, 0]))
            yaw[-1] = yaw[-2]
        else:
            yaw[-1] = self._robot.state.yaw_rad
        if yaw_rad is not None:
            yaw[-1] = yaw_rad
        speed = speed_limit_mps(self._ground.margin_at(points), self._config.robot.max_speed_mps)
        return TimedPath(points[:, 0], points[:, 1], yaw, speed, np.zeros(len(points)), 0.0, 1e9)

    def way_to(self, points: Points) -> Points:
        """From where the robot stands to the end of a stretch."""
        row, column = self._ground.nearest_cell(*points[-1].tolist())
        return self._ground.way(self.at, (row, column))[0]


def _subdivided(points: Points) -> Points:
    """The same way with points at most `_PIECE_M` apart, none twice in a row."""
    found = [points[:1]]
    for a, b in zip(points[:-1], points[1:], strict=True):
        length = float(np.hypot(*(b - a)))
        if length > 1e-6:
            share = np.arange(1, math.ceil(length / _PIECE_M) + 1) / math.ceil(length / _PIECE_M)
            found.append(a + share[:, None] * (b - a))
    return np.concatenate(found)


def drive_tour(
    world: World,
    config: SimConfig,
    judge: Judge,
    ground: KnownGround,
    stretches: list[Stretch],
    time_s: float,
    tell: Tell,
) -> Driven:
    """Drive so long, or to the tour's end. The judge begins with nothing covered."""
    drive = _Drive(world, config, judge, ground)
    skipped, told_s = 0, 0.0
    reached = True
    for stretch in stretches:
        points = stretch.points_m
        if not reached:  # the last stretch was given up: from here, not from its end
            points = np.concatenate([drive.way_to(points[:1]), points[1:]])
        reached = drive.follow(Stretch(points, stretch.yaw_rad), time_s)
        if not reached and not drive.lost_reason and drive.now_s < time_s:
            reached = drive.follow(Stretch(drive.way_to(points), stretch.yaw_rad), time_s)
            skipped += not reached
        if drive.lost_reason or drive.now_s >= time_s:
            break
        if drive.now_s - told_s > 300.0:
            told_s = drive.now_s
            tell(f"driven {drive.now_s:.0f} s: {judge.covered_area_m2:.0f} m2 covered")
    columns = np.array(drive.rows).T
    return Driven(
        *columns,
        drive.length_m,
        drive.contacts,
        skipped,
        drive.lost_reason,
        finished=drive.now_s < time_s and not drive.lost_reason,
    )
