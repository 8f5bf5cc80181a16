"""Unknown keys and senseless values are refused at every level."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from services.sim.config import LidarConfig, RobotConfig, SimConfig


@pytest.mark.parametrize(
    "data",
    [
        {"typo": 1},
        {"robot": {"typo": 1}},
        {"lidar": {"typo": 1}},
        {"coverage_sensor": {"typo": 1}},
        {"slam": {"typo": 1}},
        {"start": {"x_m": 0.0, "y_m": 0.0, "typo": 1}},
    ],
)
def test_unknown_keys(data: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="typo"):
        SimConfig.model_validate(data)


@pytest.mark.parametrize(
    "data",
    [
        {"lidar": {"range_m": float("inf")}},
        {"lidar": {"range_m": float("nan")}},
        {"lidar": {"elevation_min_deg": 20.0}},
        {"coverage_sensor": {"fov_deg": 400.0}},
        {"robot": {"max_speed_mps": 0.0}},
        {"robot": {"profile": "mule"}},
        {"seed": -1},
    ],
)
def test_senseless_values(data: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        SimConfig.model_validate(data)


def test_profiles_set_defaults_that_fields_override() -> None:
    assert RobotConfig() == RobotConfig(profile="spot")
    assert RobotConfig(profile="husky").footprint_radius_m == 0.335
    assert RobotConfig(profile="spot").footprint_radius_m == 0.25
    assert RobotConfig(profile="spot", footprint_radius_m=0.3).footprint_radius_m == 0.3
    assert SimConfig.model_validate({"robot": {"profile": "spot"}}).robot.footprint_radius_m == 0.25


def test_configs_are_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        LidarConfig().range_m = 3.0  # type: ignore[misc]
