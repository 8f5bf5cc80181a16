"""Rotations against scipy's, the robot's pose from its sensor's, and the body that is cut out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from planning.robot_profile import HUSKY
from schemas.base import Pose
from services.riskmap.config import Config
from services.riskmap.extrinsics import base_in_odom, body_box, transform, without_body

_angle = st.floats(-1.4, 1.4)
_poses = st.builds(
    Pose,
    x_m=st.floats(-50, 50), y_m=st.floats(-50, 50), z_m=st.floats(-5, 5),
    yaw_rad=st.floats(-math.pi, math.pi), roll_rad=_angle, pitch_rad=_angle,
)  # fmt: skip


@given(pose=_poses)
def test_the_rotation_is_yaw_pitch_roll(pose: Pose) -> None:
    expected = Rotation.from_euler("ZYX", [pose.yaw_rad, pose.pitch_rad, pose.roll_rad]).as_matrix()
    matrix = transform(pose)
    assert matrix[:3, :3] == pytest.approx(expected, abs=1e-12)
    assert matrix[:3, 3].tolist() == [pose.x_m, pose.y_m, pose.z_m]


def test_a_positive_pitch_looks_down() -> None:
    """REP-103: x forward, y left, z up, right-handed."""
    forward = transform(Pose(pitch_rad=0.3)) @ np.array([1.0, 0.0, 0.0, 1.0])
    assert forward[2] == pytest.approx(-math.sin(0.3))


@given(base=_poses, mount=_poses)
def test_the_robots_pose_undoes_the_extrinsics(base: Pose, mount: Pose) -> None:
    """The sensor's pose is built from matrices; its angles are read back by scipy."""
    sensor = transform(base) @ transform(mount)
    yaw, pitch, roll = Rotation.from_matrix(sensor[:3, :3]).as_euler("ZYX")
    pose = Pose(
        x_m=float(sensor[0, 3]), y_m=float(sensor[1, 3]), z_m=float(sensor[2, 3]),
        yaw_rad=float(yaw), pitch_rad=float(pitch), roll_rad=float(roll),
    )  # fmt: skip
    assert base_in_odom(pose, mount) == pytest.approx(transform(base), abs=1e-6)


@given(mount=_poses, seed=st.integers(0, 1000))
def test_points_inside_the_body_are_dropped_in_its_own_frame(mount: Pose, seed: int) -> None:
    config = Config(profile="husky", body_margin_m=0.05, base_height_m=0.13)
    in_base = np.random.default_rng(seed).uniform((-1, -1, -0.5), (1, 1, 1.5), (200, 3))
    matrix = transform(mount)
    in_sensor = ((in_base - matrix[:3, 3]) @ matrix[:3, :3]).astype(np.float32)
    again = in_sensor.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    inside = (
        (np.abs(again[:, 0]) <= HUSKY.length_m / 2 + 0.05)
        & (np.abs(again[:, 1]) <= HUSKY.width_m / 2 + 0.05)
        & (again[:, 2] >= -0.13 - 0.05)
        & (again[:, 2] <= -0.13 + HUSKY.height_m + 0.05)
    )
    kept = without_body(in_sensor, matrix, body_box(config))
    assert kept.tolist() == in_sensor[~inside].tolist()


def test_points_that_are_not_finite_are_left_to_those_who_count_them() -> None:
    points = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 0]], dtype=np.float32)
    assert len(without_body(points, transform(Pose(z_m=0.4)), body_box(Config()))) == 2
