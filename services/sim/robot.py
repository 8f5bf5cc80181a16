"""The true robot: a disc that drives like a unicycle, slips, and is stopped or broken by walls."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.sim.config import RobotConfig, SimConfig
from services.sim.geometry import clearance
from services.sim.world import World

LONGEST_SUBSTEP_S = 0.02
RELEASE_M = 0.02
"""Clearance beyond the radius at which contact ends."""
_TOLERANCE = 1e-9

# Columns of the kernel's state vector.
_X, _Y, _YAW, _SPEED, _TURN, _SLIP_DISTANCE, _SLIP_TURN, _BLOCKED, _TOUCHING, _CONTACTS, _LOST = range(11)


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
    """Broken: ran into a wall too fast, and will not move again."""


class Robot:
    """Unicycle with limits on speed, turn rate and their rates of change, and with slip.

    Slip multiplies distance and turn by 1 + `slip_fraction` n, n an Ornstein-Uhlenbeck process of unit
    variance and time constant `slip_correlation_s`. Contact is exact: the disc's centre is never nearer to a
    wall's area than the radius, up to rounding. A motion that would bring it nearer is dropped and the speed
    set to zero; motion away from the wall and turning are always possible.
    """

    def __init__(self, world: World, config: SimConfig, rng: np.random.Generator) -> None:
        self._world = world
        self.rng = rng
        """Of the slip; a driver may give another for every step."""
        self._parameters = _kernel_parameters(world, config)
        self._robot: RobotConfig = config.robot
        x_m, y_m, yaw_rad = world.start
        slip_distance, slip_turn = rng.standard_normal(2).tolist()
        self.state = RobotState(x_m, y_m, yaw_rad, 0.0, 0.0, slip_distance, slip_turn, False, False, 0, False)

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
        drive(
            self._world.occupied, state, command, duration_s / substeps,
            self.rng.standard_normal((substeps, 2)), self._parameters,
        )  # fmt: skip
        x, y, yaw, speed, turn_rate, slip, slip_turn, blocked, touching, contacts, lost = state.tolist()
        self.state = RobotState(
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
        )
        return self.state


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
    state: NDArray[np.float64],
    command: NDArray[np.float64],
    substep_s: float,
    noise: NDArray[np.float64],
    parameters: NDArray[np.float64],
) -> None:
    """Advance `state` (the columns above, changed in place) by one sub-step per row of `noise`[n, 2]."""
    acceleration, turn_acceleration = parameters[4] * substep_s, parameters[5] * substep_s
    slip_fraction, keep = parameters[6], math.exp(-substep_s / parameters[7])
    fresh = math.sqrt(1.0 - keep * keep)
    state[_BLOCKED] = 0.0
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
        _translate(occupied, state, distance * math.cos(yaw), distance * math.sin(yaw), parameters)
        state[_YAW] += turn


@njit
def _translate(
    occupied: NDArray[np.bool_],
    state: NDArray[np.float64],
    dx_m: float,
    dy_m: float,
    parameters: NDArray[np.float64],
) -> None:
    """Move by (dx, dy) unless a wall is in the way; then stop, count the contact, and judge its force."""
    cell, radius = parameters[0], parameters[3] / parameters[0]
    x, y = state[_X] / cell - parameters[1], state[_Y] / cell - parameters[2]
    release = RELEASE_M / cell
    reach = radius + release + 1.0
    room, near_x, near_y = clearance(occupied, x + dx_m / cell, y + dy_m / cell, reach)
    if room >= radius - _TOLERANCE or room >= clearance(occupied, x, y, reach)[0]:
        state[_X] += dx_m
        state[_Y] += dy_m
        if room > radius + release:
            state[_TOUCHING] = 0.0
        return
    if state[_TOUCHING] == 0.0:
        state[_CONTACTS] += 1.0
    state[_TOUCHING] = state[_BLOCKED] = 1.0
    into_wall = _cosine(dx_m, dy_m, near_x - x, near_y - y)
    if abs(state[_SPEED]) * max(into_wall, 0.0) > parameters[8]:
        state[_LOST] = 1.0
        state[_TURN] = 0.0
    state[_SPEED] = 0.0


@njit
def _cosine(ax: float, ay: float, bx: float, by: float) -> float:
    """Cosine of the angle between two vectors; 1 if either is zero."""
    product = math.hypot(ax, ay) * math.hypot(bx, by)
    return (ax * bx + ay * by) / product if product > 0.0 else 1.0
