"""The true robot: a disc that drives like a unicycle, slips, and is stopped or broken by walls and by the ground."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.sim.config import RobotConfig, SimConfig
from services.sim.geometry import clearance
from services.sim.scene import Scene
from services.sim.terrain import Heights, body_solid
from services.sim.terrain_robot import (
    HIT_LEDGE,
    HIT_MOVER,
    HIT_WALL,
    LOST_REASONS,
    NOT_LOST,
    SLOPE_SLIP,
    attitude,
    body_parameters,
    ledge_ahead,
    support_plane,
    verdict,
)
from services.sim.world import World

LONGEST_SUBSTEP_S = 0.02
RELEASE_M = 0.02
"""Clearance beyond the radius at which contact ends."""
_TOLERANCE = 1e-9
_NO_FLOOR: Heights = np.zeros((0, 0), np.float32)
_NO_FLOOR.setflags(write=False)  # as a world's floor: another kind of array would be another compilation

# Columns of the kernel's state vector.
_X, _Y, _YAW, _SPEED, _TURN, _SLIP_DISTANCE, _SLIP_TURN, _BLOCKED, _TOUCHING, _CONTACTS, _LOST = range(11)
_Z, _ROLL, _PITCH, _LOST_BY = range(11, 15)


class RobotState(NamedTuple):
    """True state; speeds are the robot's own (wheels), before slip."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    turn_rate_radps: float
    slip_distance: float
    """Slip of the distance now, in standard deviations."""
    slip_turn: float
    blocked: bool
    """A wall stopped the robot during the last step."""
    touching: bool
    """It has not moved off by `RELEASE_M` since a wall stopped it: further blocks are the same contact."""
    contacts: int
    """How often contact began."""
    lost: bool
    """Broken, and will not move again."""
    z_m: float = 0.0
    """Mean height of the ground under its feet."""
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    """Of the support plane; the nose up is negative (REP-103)."""
    lost_by: int = NOT_LOST
    """Index into `LOST_REASONS`."""


class Robot:
    """Unicycle with limits on speed, turn rate and their rates of change, and with slip.

    Slip multiplies distance and turn by 1 + `slip_fraction` n, n an Ornstein-Uhlenbeck process of unit
    variance and time constant `slip_correlation_s`. Contact is exact: the disc's centre is never nearer to a
    wall's area than the radius, up to rounding. A motion that would bring it nearer is dropped and the speed
    set to zero; motion away from the wall and turning are always possible. A mover is a round wall; one that walks
    into the robot is a contact too, but does not break it.

    On uneven ground a ledge that it cannot climb is a wall to its rim, and so is a ceiling it does not fit under; its
    height and attitude are those of the plane under its feet; it is lost when it tips, drops or is high-centred.
    """

    def __init__(
        self, world: World, config: SimConfig, rng: np.random.Generator, scene: Scene | None = None
    ) -> None:
        self._scene = scene or Scene(world)
        self._floor_m: Heights = _NO_FLOOR if world.floor_m is None else world.floor_m
        self._solid = body_solid(world, config.robot.height_m) if world.has_terrain else None
        self._body = body_parameters(config.robot, config.slope_slip_fraction)
        self._lost_speed_mps = config.contact_lost_speed_mps
        self.rng = rng
        """Of the slip; a driver may give another for every step."""
        self._parameters = _kernel_parameters(world, config)
        self._robot: RobotConfig = config.robot
        x_m, y_m, yaw_rad = world.start
        slip_distance, slip_turn = rng.standard_normal(2).tolist()
        state = RobotState(x_m, y_m, yaw_rad, 0.0, 0.0, slip_distance, slip_turn, False, False, 0, False)
        if world.has_terrain:
            _, forward, left, height_m = support_plane(
                self._floor_m, world.spec.resolution_m, *world.to_cells(x_m, y_m), yaw_rad, self._body
            )
            roll_rad, pitch_rad = attitude(forward, left)
            state = state._replace(z_m=height_m, roll_rad=roll_rad, pitch_rad=pitch_rad)
        self.state = state

    @property
    def lost_reason(self) -> str:
        """Why it was lost; empty while it is not."""
        return LOST_REASONS[self.state.lost_by].format(contact_lost_speed_mps=self._lost_speed_mps)

    def step(self, speed_mps: float, turn_rate_radps: float, duration_s: float) -> RobotState:
        """Drive towards the commanded speed and turn rate for a while.

        Raises ValueError if a number is not finite or the duration is not positive.
        """
        if not (math.isfinite(speed_mps) and math.isfinite(turn_rate_radps) and 0.0 < duration_s < math.inf):
            raise ValueError(f"robot command {speed_mps}, {turn_rate_radps} for {duration_s} s")
        substeps = math.ceil(duration_s / LONGEST_SUBSTEP_S - 1e-9)
        top, turn_top = self._robot.max_speed_mps, self._robot.max_turn_rate_radps
        command = np.array([min(max(speed_mps, -top), top), min(max(turn_rate_radps, -turn_top), turn_top)])
        state = np.array(self.state, dtype=np.float64)
        occupied = self._scene.occupied if self._solid is None else self._solid
        drive(
            occupied, self._floor_m, self._scene.movers, state, command, duration_s / substeps,
            self.rng.standard_normal((substeps, 2)), self._parameters, self._body,
        )  # fmt: skip
        self.state = _state_of(state)
        return self.state


def _state_of(columns: NDArray[np.float64]) -> RobotState:
    """The kernel's state vector, named."""
    x, y, yaw, speed, turn_rate, slip, slip_turn, blocked, touching, contacts, lost, *rest = columns.tolist()
    z, roll, pitch, lost_by = rest
    return RobotState(
        x,
        y,
        math.remainder(yaw, 2.0 * math.pi),
        speed,
        turn_rate,
        slip,
        slip_turn,
        bool(blocked),
        bool(touching),
        int(contacts),
        bool(lost),
        z,
        roll,
        pitch,
        int(lost_by),
    )


def _kernel_parameters(world: World, config: SimConfig) -> NDArray[np.float64]:
    """(cell m, ix0, iy0, radius, acceleration, turn acceleration, slip fraction, slip time s, lost speed)."""
    robot, spec = config.robot, world.spec
    return np.array(
        [
            spec.resolution_m, spec.ix0, spec.iy0, robot.footprint_radius_m, robot.max_acceleration_mps2,
            robot.max_turn_acceleration_radps2, config.slip_fraction, config.slip_correlation_s,
            config.contact_lost_speed_mps,
        ]
    )  # fmt: skip


@njit
def drive(
    occupied: NDArray[np.bool_],
    floor_m: Heights,
    movers: NDArray[np.float64],
    state: NDArray[np.float64],
    command: NDArray[np.float64],
    substep_s: float,
    noise: NDArray[np.float64],
    parameters: NDArray[np.float64],
    body: NDArray[np.float64],
) -> None:
    """Advance `state` (the columns above, changed in place) by one sub-step per row of `noise`[n, 2].

    `floor_m` is empty on flat ground. `movers`[n, 5] begins with x, y and radius in metres. `body`: see
    `terrain_robot.body_parameters`.
    """
    acceleration, turn_acceleration = parameters[4] * substep_s, parameters[5] * substep_s
    slip_fraction, keep = parameters[6], math.exp(-substep_s / parameters[7])
    fresh = math.sqrt(1.0 - keep * keep)
    state[_BLOCKED] = 0.0
    if state[_LOST] == 0.0:
        _meet_movers(movers, state, parameters)
    for k in range(noise.shape[0]):
        if state[_LOST] > 0.0:
            return
        state[_SPEED] += min(max(command[0] - state[_SPEED], -acceleration), acceleration)
        state[_TURN] += min(max(command[1] - state[_TURN], -turn_acceleration), turn_acceleration)
        state[_SLIP_DISTANCE] = keep * state[_SLIP_DISTANCE] + fresh * noise[k, 0]
        state[_SLIP_TURN] = keep * state[_SLIP_TURN] + fresh * noise[k, 1]
        turn = state[_TURN] * substep_s * (1.0 + slip_fraction * state[_SLIP_TURN])
        distance = state[_SPEED] * substep_s * (1.0 + slip_fraction * state[_SLIP_DISTANCE])
        yaw = state[_YAW] + 0.5 * turn
        if floor_m.size == 0:
            dx_m, dy_m = distance * math.cos(yaw), distance * math.sin(yaw)
            _translate(occupied, movers, state, dx_m, dy_m, parameters)
            state[_YAW] += turn
        else:
            _over_terrain(occupied, floor_m, movers, state, distance, turn, parameters, body)


@njit
def _over_terrain(
    occupied: NDArray[np.bool_],
    floor_m: Heights,
    movers: NDArray[np.float64],
    state: NDArray[np.float64],
    distance: float,
    turn: float,
    parameters: NDArray[np.float64],
    body: NDArray[np.float64],
) -> None:
    """One sub-step over uneven ground: slopes shorten and skew the way, ledges stop it, the ground may break it."""
    cell, ix0, iy0 = parameters[0], parameters[1], parameters[2]
    before = (state[_X] / cell - ix0, state[_Y] / cell - iy0, state[_YAW])
    rise, left = -math.tan(state[_PITCH]), math.tan(state[_ROLL])
    forward_m = (
        distance * math.cos(state[_PITCH]) * (1.0 - body[SLOPE_SLIP] * rise * math.copysign(1.0, distance))
    )
    side_m = -abs(distance) * body[SLOPE_SLIP] * left
    yaw = state[_YAW] + 0.5 * turn
    dx_m = forward_m * math.cos(yaw) - side_m * math.sin(yaw)
    dy_m = forward_m * math.sin(yaw) + side_m * math.cos(yaw)
    straight = _ledge_after(floor_m, state, dx_m, dy_m, 0.0, parameters, body)
    if straight > 0.0:
        _contact(state, straight, HIT_LEDGE, parameters)
    else:
        touched = state[_TOUCHING]
        _translate(occupied, movers, state, dx_m, dy_m, parameters)
        if touched > 0.0 and _ledge_after(floor_m, state, dx_m, dy_m, RELEASE_M, parameters, body) > 0.0:
            state[_TOUCHING] = 1.0  # not yet off the ledge: further blocks are the same contact
    state[_YAW] += turn
    after = (state[_X] / cell - ix0, state[_Y] / cell - iy0, state[_YAW])
    _, forward, leftward, state[_Z] = support_plane(floor_m, cell, after[0], after[1], after[2], body)
    state[_ROLL], state[_PITCH] = attitude(forward, leftward)
    found = verdict(floor_m, cell, before, after, body)
    if found != NOT_LOST and state[_LOST] == 0.0:
        state[_LOST], state[_LOST_BY] = 1.0, found
        state[_SPEED] = state[_TURN] = 0.0


@njit
def _ledge_after(
    floor_m: Heights,
    state: NDArray[np.float64],
    dx_m: float,
    dy_m: float,
    further_m: float,
    parameters: NDArray[np.float64],
    body: NDArray[np.float64],
) -> float:
    """`ledge_ahead` of a motion by (dx, dy), `further_m` beyond it."""
    way = math.hypot(dx_m, dy_m)
    if way < 1e-12:
        return 0.0
    cell, more = parameters[0], 1.0 + further_m / way
    x = (state[_X] + more * dx_m) / cell - parameters[1]
    y = (state[_Y] + more * dy_m) / cell - parameters[2]
    return ledge_ahead(floor_m, cell, x, y, dx_m / way, dy_m / way, body)


@njit
def _translate(
    occupied: NDArray[np.bool_],
    movers: NDArray[np.float64],
    state: NDArray[np.float64],
    dx_m: float,
    dy_m: float,
    parameters: NDArray[np.float64],
) -> None:
    """Move by (dx, dy) unless a wall or a mover is in the way; then stop, count the contact, judge its force."""
    cell, radius = parameters[0], parameters[3] / parameters[0]
    x, y = state[_X] / cell - parameters[1], state[_Y] / cell - parameters[2]
    release = RELEASE_M / cell
    reach = radius + release + 1.0
    room, near_x, near_y = clearance(occupied, x + dx_m / cell, y + dy_m / cell, reach)
    free = room >= radius - _TOLERANCE or room >= clearance(occupied, x, y, reach)[0]
    mover = _mover_in_the_way(movers, state[_X], state[_Y], dx_m, dy_m, parameters[3])
    if free and mover < 0:
        state[_X] += dx_m
        state[_Y] += dy_m
        if room > radius + release and not _is_touched(
            movers, state[_X], state[_Y], parameters[3] + RELEASE_M
        ):
            state[_TOUCHING] = 0.0
        return
    if not free:
        into_wall = _cosine(dx_m, dy_m, near_x - x, near_y - y)
        _contact(state, max(into_wall, 0.0), HIT_WALL, parameters)
    else:
        into = _cosine(dx_m, dy_m, movers[mover, 0] - state[_X], movers[mover, 1] - state[_Y])
        _contact(state, max(into, 0.0), HIT_MOVER, parameters)


@njit
def _contact(state: NDArray[np.float64], into: float, by: int, parameters: NDArray[np.float64]) -> None:
    """Stop at something met with the share `into` of the speed, count it once, and judge its force."""
    if state[_TOUCHING] == 0.0:
        state[_CONTACTS] += 1.0
    state[_TOUCHING] = state[_BLOCKED] = 1.0
    if abs(state[_SPEED]) * into > parameters[8]:
        state[_LOST] = 1.0
        state[_LOST_BY] = by
        state[_TURN] = 0.0
    state[_SPEED] = 0.0


@njit
def _mover_in_the_way(
    movers: NDArray[np.float64], x_m: float, y_m: float, dx_m: float, dy_m: float, radius_m: float
) -> int:
    """The first mover that a motion by (dx, dy) brings the robot into, or farther into; -1: none."""
    for k in range(movers.shape[0]):
        gap = math.hypot(movers[k, 0] - x_m - dx_m, movers[k, 1] - y_m - dy_m)
        nearer = gap < math.hypot(movers[k, 0] - x_m, movers[k, 1] - y_m)
        if nearer and gap < radius_m + movers[k, 2] - _TOLERANCE:
            return k
    return -1


@njit
def _is_touched(movers: NDArray[np.float64], x_m: float, y_m: float, radius_m: float) -> bool:
    """Whether a mover overlaps a disc at the point."""
    for k in range(movers.shape[0]):
        if math.hypot(movers[k, 0] - x_m, movers[k, 1] - y_m) < radius_m + movers[k, 2]:
            return True
    return False


@njit
def _meet_movers(
    movers: NDArray[np.float64], state: NDArray[np.float64], parameters: NDArray[np.float64]
) -> None:
    """Count the contact with somebody who has walked into the robot."""
    if state[_TOUCHING] == 0.0 and _is_touched(movers, state[_X], state[_Y], parameters[3] - _TOLERANCE):
        state[_CONTACTS] += 1.0
        state[_TOUCHING] = 1.0


@njit
def _cosine(ax: float, ay: float, bx: float, by: float) -> float:
    """Cosine of the angle between two vectors; 1 if either is zero."""
    product = math.hypot(ax, ay) * math.hypot(bx, by)
    return (ax * bx + ay * by) / product if product > 0.0 else 1.0
