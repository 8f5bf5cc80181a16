"""Where the sensor sits: rotations of 6-DoF poses, the robot's pose from the sensor's, and the robot's own body."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from schemas.base import Pose
from services.riskmap.config import Config


def transform(pose: Pose) -> NDArray[np.float64]:
    """The 4 x 4 matrix from the posed frame into the other one (REP-103: Rz(yaw) Ry(pitch) Rx(roll))."""
    cr, sr = math.cos(pose.roll_rad), math.sin(pose.roll_rad)
    cp, sp = math.cos(pose.pitch_rad), math.sin(pose.pitch_rad)
    cy, sy = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, pose.x_m],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, pose.y_m],
            [-sp, cp * sr, cp * cr, pose.z_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def base_in_odom(sensor_in_odom: Pose, sensor_in_base: Pose) -> NDArray[np.float64]:
    """The robot's pose as a 4 x 4 matrix, from its sensor's pose and the extrinsics."""
    mount = transform(sensor_in_base)
    inverse = np.eye(4)
    inverse[:3, :3] = mount[:3, :3].T
    inverse[:3, 3] = -mount[:3, :3].T @ mount[:3, 3]
    return transform(sensor_in_odom) @ inverse


def body_box(config: Config) -> NDArray[np.float64]:
    """The robot's body in base_link, margin included: (3, 2) lowest and highest x, y, z, m."""
    margin, feet = config.body_margin_m, -config.base_height_m
    x, y = 0.5 * config.body_length_m + margin, 0.5 * config.body_width_m + margin
    return np.array([[-x, x], [-y, y], [feet - margin, feet + config.robot_height_m + margin]])


@njit
def without_body(
    points_m: NDArray[np.float32], sensor_in_base: NDArray[np.float64], box_m: NDArray[np.float64]
) -> NDArray[np.float32]:
    """The points that are not inside the robot's body, in the same order (a point that is not finite stays).

    points_m: (n, 3) in the sensor's frame. sensor_in_base: (4, 4). box_m: (3, 2) lowest and highest x, y, z of the
    body in base_link.
    """
    kept = np.empty_like(points_m)
    count = 0
    for i in range(points_m.shape[0]):
        inside = True
        for axis in range(3):
            value = sensor_in_base[axis, 3]
            for k in range(3):
                value += sensor_in_base[axis, k] * points_m[i, k]
            inside = inside and box_m[axis, 0] <= value <= box_m[axis, 1]
        if not inside:
            for k in range(3):
                kept[count, k] = points_m[i, k]
            count += 1
    return kept[:count]
