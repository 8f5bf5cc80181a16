"""What uneven ground does to the robot: how it stands, which ledges stop it, and what loses it.

The robot stands on four feet (or wheels) at the corners of its contact area, drawn in to the rim of its footprint:
the planners take it for that disc, and so does whatever breaks it. A foot stands on the highest ground of a small
patch, so that it bridges cracks; the support plane is the least-squares plane through the four.

A ledge is measured between two points `_BASE_M` apart, as what remains of the difference of height after the slope
before it (a steady slope is no ledge, its foot and its crest are small ones).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from services.sim.config import RobotConfig
from services.sim.terrain import Heights, height_at

_BASE_M = 0.25
_FOOT_M = 0.12
"""Half the side of the patch of ground that a foot or wheel stands on: narrower cracks carry it."""
_RIM_POINTS = 16
_BELLY_POINTS = 5

NOT_LOST, HIT_WALL, HIT_LEDGE, HIT_MOVER, TIPPED, DROPPED, HIGH_CENTRED = range(7)
LOST_REASONS: tuple[str, ...] = (
    "",
    "ran into a wall at more than {contact_lost_speed_mps:g} m/s",
    "ran into a ledge it cannot climb at more than {contact_lost_speed_mps:g} m/s",
    "ran into somebody at more than {contact_lost_speed_mps:g} m/s",
    "tipped over",
    "dropped off a ledge",
    "high-centred: the ground holds up its belly",
)
"""Why a robot was lost, by code."""

# Entries of the body's vector.
FOOT_X, FOOT_Y, RADIUS, TIP_ROLL, TIP_PITCH, CLIMB, DROP, BELLY, SLOPE_SLIP = range(9)


def body_parameters(robot: RobotConfig, slope_slip_fraction: float) -> NDArray[np.float64]:
    """(foot x, foot y, radius, tip roll, tip pitch, climb, drop, belly, slope slip) in metres and radians."""
    half_x, half_y = 0.5 * robot.length_m, 0.5 * robot.width_m
    drawn_in = min(1.0, robot.footprint_radius_m / math.hypot(half_x, half_y))
    return np.array(
        [
            half_x * drawn_in, half_y * drawn_in, robot.footprint_radius_m, robot.tip_roll_rad,
            robot.tip_pitch_rad, robot.max_climb_m, robot.max_drop_m, robot.belly_m, slope_slip_fraction,
        ]
    )  # fmt: skip


@njit
def _foot(pose: tuple[float, float, float], fx: float, fy: float, cell_m: float) -> tuple[float, float]:
    cos_yaw, sin_yaw = math.cos(pose[2]), math.sin(pose[2])
    return (
        pose[0] + (cos_yaw * fx - sin_yaw * fy) / cell_m,
        pose[1] + (sin_yaw * fx + cos_yaw * fy) / cell_m,
    )


@njit
def foot_height(floor_m: Heights, cell_m: float, x: float, y: float) -> tuple[float, float]:
    """(highest, mean) ground in the patch of a foot; x, y in cells. A foot stands on the highest."""
    total, top = 0.0, -math.inf
    for i in range(-1, 2):
        for k in range(-1, 2):
            height = height_at(floor_m, x + i * _FOOT_M / cell_m, y + k * _FOOT_M / cell_m)
            total += height
            top = max(top, height)
    return top, total / 9.0


@njit
def support_plane(
    floor_m: Heights, cell_m: float, x: float, y: float, yaw_rad: float, body: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    """(height, rise per metre forward, rise per metre to the left) of the plane that carries the feet, at the middle,
    and the mean height of the ground under them."""
    height, forward, left, mean = 0.0, 0.0, 0.0, 0.0
    for k in range(4):
        fx = body[FOOT_X] if k < 2 else -body[FOOT_X]
        fy = body[FOOT_Y] if k % 2 == 0 else -body[FOOT_Y]
        px, py = _foot((x, y, yaw_rad), fx, fy, cell_m)
        top, average = foot_height(floor_m, cell_m, px, py)
        height += 0.25 * top
        forward += 0.25 * top / fx
        left += 0.25 * top / fy
        mean += 0.25 * average
    return height, forward, left, mean


@njit
def attitude(forward: float, left: float) -> tuple[float, float]:
    """(roll, pitch) of a body whose plane rises so per metre forward and to the left; the nose up is negative."""
    pitch = -math.atan(forward)
    return math.atan(left * math.cos(pitch)), pitch


@njit
def ledge_down(floor_m: Heights, cell_m: float, x: float, y: float, way_x: float, way_y: float) -> float:
    """Depth (not positive) of the ledge that ends at a point (cells) reached along a unit vector."""
    base = _BASE_M / cell_m
    here = height_at(floor_m, x, y)
    before = height_at(floor_m, x - base * way_x, y - base * way_y)
    long_before = height_at(floor_m, x - 2.0 * base * way_x, y - 2.0 * base * way_y)
    return min(max(here - before, here - 2.0 * before + long_before), 0.0)


@njit
def ledge_up(floor_m: Heights, cell_m: float, x: float, y: float, way_x: float, way_y: float) -> float:
    """Height (not negative) of the ledge that ends at a point; the ground before it carries over its cracks."""
    base = _BASE_M / cell_m
    here = height_at(floor_m, x, y)
    before = foot_height(floor_m, cell_m, x - base * way_x, y - base * way_y)[0]
    if here <= before:
        return 0.0
    long_before = foot_height(floor_m, cell_m, x - 2.0 * base * way_x, y - 2.0 * base * way_y)[0]
    return max(min(here - before, here - 2.0 * before + long_before), 0.0)


@njit
def ledge_ahead(
    floor_m: Heights,
    cell_m: float,
    x: float,
    y: float,
    way_x: float,
    way_y: float,
    body: NDArray[np.float64],
) -> float:
    """How straight the rim meets ground that it cannot climb, when its middle moves to (x, y) along a unit vector.

    The greatest cosine between the way and the rim's outward normal among the points that meet such a ledge; 0:
    none does.
    """
    straight = 0.0
    for k in range(_RIM_POINTS // 2 + 1):
        angle = (k / (_RIM_POINTS // 2) - 0.5) * math.pi
        c, s = math.cos(angle), math.sin(angle)
        if c < 1e-6:
            continue
        out_x, out_y = c * way_x - s * way_y, s * way_x + c * way_y
        px, py = x + body[RADIUS] * out_x / cell_m, y + body[RADIUS] * out_y / cell_m
        if ledge_up(floor_m, cell_m, px, py, out_x, out_y) > body[CLIMB]:
            straight = max(straight, c)
    return straight


@njit
def hangs(
    floor_m: Heights,
    cell_m: float,
    before: tuple[float, float, float],
    after: tuple[float, float, float],
    body: NDArray[np.float64],
) -> tuple[bool, bool]:
    """Whether the middle of a foot, and whether all of its patch, went over a ledge higher than the robot's limit.

    `before` and `after` are poses (x, y in cells, yaw).
    """
    middle, whole = False, False
    for k in range(4):
        fx = body[FOOT_X] if k < 2 else -body[FOOT_X]
        fy = body[FOOT_Y] if k % 2 == 0 else -body[FOOT_Y]
        ax, ay = _foot(before, fx, fy, cell_m)
        bx, by = _foot(after, fx, fy, cell_m)
        way = math.hypot(bx - ax, by - ay)
        if way < 1e-9:
            continue
        fall = ledge_down(floor_m, cell_m, bx, by, (bx - ax) / way, (by - ay) / way)
        held = foot_height(floor_m, cell_m, bx, by)[0] - height_at(floor_m, bx, by)
        middle = middle or fall < -body[DROP]
        whole = whole or fall + held < -body[DROP]
    return middle, whole


@njit
def belly_height(
    floor_m: Heights,
    cell_m: float,
    pose: tuple[float, float, float],
    plane: tuple[float, float, float, float],
    body: NDArray[np.float64],
) -> float:
    """How high the ground stands over the support plane at most, between the feet, in metres."""
    highest = 0.0
    for i in range(_BELLY_POINTS):
        for k in range(_BELLY_POINTS):
            fx = body[FOOT_X] * (2.0 * i / (_BELLY_POINTS - 1) - 1.0)
            fy = body[FOOT_Y] * (2.0 * k / (_BELLY_POINTS - 1) - 1.0)
            px, py = _foot(pose, fx, fy, cell_m)
            over = height_at(floor_m, px, py) - plane[0] - plane[1] * fx - plane[2] * fy
            highest = max(highest, over)
    return highest


@njit
def verdict(
    floor_m: Heights,
    cell_m: float,
    before: tuple[float, float, float],
    after: tuple[float, float, float],
    body: NDArray[np.float64],
) -> int:
    """What loses the robot between two poses (x, y in cells, yaw); `NOT_LOST` if nothing does."""
    hanging, dropped = hangs(floor_m, cell_m, before, after, body)
    plane = support_plane(floor_m, cell_m, after[0], after[1], after[2], body)
    roll, pitch = attitude(plane[1], plane[2])
    found = NOT_LOST
    if abs(roll) > body[TIP_ROLL] or abs(pitch) > body[TIP_PITCH]:
        found = TIPPED
    elif belly_height(floor_m, cell_m, after, plane, body) > body[BELLY]:
        found = HIGH_CENTRED
    # On its way over an edge it tips or sits on it first: the edge is the reason.
    return DROPPED if dropped or (hanging and found != NOT_LOST) else found
