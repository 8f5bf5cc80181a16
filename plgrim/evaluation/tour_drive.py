"""Drives a planned tour with the simulator's own robot and follower, and scores it with the simulator's own judge.

The peer is given what no robot has: true poses and wheels that do not slip. Speeds, accelerations and turn rates are
those of the robot, slopes slow it as they slow any, and ground that breaks robots breaks it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planning.randomness import stream
from plgrim.evaluation.known_ground import KnownGround, Points
from plgrim.evaluation.tour_plan import Stretch, speed_limit_mps
from services.sim.config import SimConfig
from services.sim.coverage import Judge
from services.sim.follower import Follower, TimedPath
from services.sim.geometry import clearance
from services.sim.robot import Robot
from services.sim.terrain import body_solid
from services.sim.world import World

TICK_S = 0.05
"""Between two commands of the follower, as in the simulator."""
_PIECE_M = 0.2
"""Speeds are set at points so far apart at most."""
_HELD_S = 1.5
"""Against a wall for so long: another way."""
_AVOID_M = 0.3
"""Radius of the disc before the robot, where it was held, that ways then avoid."""
_TIGHT_M, _NUDGE_M, _NUDGES = 0.15, 0.01, 10
"""With less room than this beside the footprint, ways are moved to the middle, in so many steps of so much at most."""
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
        self._world, self._solid = world, body_solid(world, config.robot.height_m)
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
        points = self._centred(_subdivided(stretch.points_m))
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

    def _centred(self, points: Points) -> Points:
        """The points, those in tight places moved away from the nearest wall: cells are too coarse for the middle."""
        points, cell = points.copy(), self._world.spec.resolution_m
        wide = self._config.robot.footprint_radius_m + _TIGHT_M
        for k in np.flatnonzero(self._ground.margin_at(points) < wide).tolist():
            at = self._world.to_cells(*points[k].tolist())
            room, near_x, near_y = clearance(self._solid, *at, wide / cell + 1.0)
            for _ in range(_NUDGES):
                away = math.hypot(at[0] - near_x, at[1] - near_y)
                if room * cell >= wide or away < 1e-6:
                    break
                step = _NUDGE_M / cell / away
                moved = (at[0] + step * (at[0] - near_x), at[1] + step * (at[1] - near_y))
                found = clearance(self._solid, *moved, wide / cell + 1.0)
                if found[0] <= room:
                    break
                at, (room, near_x, near_y) = moved, found
            spec = self._world.spec
            points[k] = (at[0] + spec.ix0) * cell, (at[1] + spec.iy0) * cell
        return points

    def rejoin(self, stretch: Stretch, until_s: float) -> bool:
        """Drive to the beginning of a stretch and along it; False: held, lost, out of time, or there is no way."""
        points = self.way_to(stretch.points_m[0])
        if points is None:
            return False
        return self.follow(Stretch(np.concatenate([points, stretch.points_m[1:]]), stretch.yaw_rad), until_s)

    def avoid_this(self) -> None:
        """Take the place before the robot for impassable."""
        x_m, y_m, yaw_rad = self._robot.state[:3]
        ahead_x, ahead_y = x_m + _AVOID_M * math.cos(yaw_rad), y_m + _AVOID_M * math.sin(yaw_rad)
        self._ground = self._ground.without(ahead_x, ahead_y, _AVOID_M)

    def way_to(self, point: Points) -> Points | None:
        """From where the robot stands to a point (2,); None: there is none."""
        row, column = self._ground.nearest_cell(*point.tolist())
        points, cost = self._ground.way(self.at, (row, column))
        return points if math.isfinite(cost) else None


def _subdivided(points: Points) -> Points:
    """The same way with points at most `_PIECE_M` apart, none twice in a row."""
    found = [points[:1]]
    for a, b in itertools.pairwise(points):
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
) -> Driven:
    """Drive so long, or to the tour's end. The judge begins with nothing covered."""
    drive = _Drive(world, config, judge, ground)
    skipped, held = 0, False
    for stretch in stretches:
        held = not (drive.rejoin(stretch, time_s) if held else drive.follow(stretch, time_s))
        if drive.lost_reason or drive.now_s >= time_s:
            break
        if held:
            drive.avoid_this()
            held = not drive.rejoin(Stretch(stretch.points_m[-1:], stretch.yaw_rad), time_s)
            skipped += held
    time, covered, x, y, yaw = np.array(drive.rows).T
    return Driven(
        time,
        covered,
        x,
        y,
        yaw,
        drive.length_m,
        drive.contacts,
        skipped,
        drive.lost_reason,
        finished=drive.now_s < time_s and not drive.lost_reason,
    )
