"""Parameters of the simulator: frozen, with units in the names; an unknown key is refused at every level."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]

_PROFILES: dict[str, dict[str, float]] = {
    "husky": {"footprint_radius_m": 0.335, "max_speed_mps": 1.0, "height_m": 0.9},
    "spot": {"footprint_radius_m": 0.25, "max_speed_mps": 1.0, "height_m": 0.9},
}


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class LidarConfig(_Model):
    """A spinning LiDAR: `rings` elevations, evenly spaced with both ends, times `azimuths` directions."""

    range_m: float = Field(default=20.0, gt=0.0, le=1000.0)
    """Longest slant range that returns."""
    rings: int = Field(default=16, ge=1, le=128)
    azimuths: int = Field(default=900, ge=4, le=4096)
    rate_hz: Positive = 10.0
    elevation_min_deg: float = Field(default=-15.0, gt=-90.0, lt=90.0)
    elevation_max_deg: float = Field(default=15.0, gt=-90.0, lt=90.0)
    height_m: Positive = 0.8
    """Of the sensor above the ground."""
    range_noise_m: NotNegative = 0.01
    """Standard deviation along the ray."""
    dropout_probability: Probability = 0.01
    """That a ray which would return does not."""

    @model_validator(mode="after")
    def _elevations_are_ordered(self) -> Self:
        if self.elevation_min_deg > self.elevation_max_deg:
            raise ValueError(
                f"elevation_min_deg {self.elevation_min_deg} lies above "
                f"elevation_max_deg {self.elevation_max_deg}"
            )
        return self


class CoverageSensorConfig(_Model):
    """The sensor that covers ground (a camera, say): a sector ahead of the robot, cut by walls."""

    range_m: float = Field(default=6.0, gt=0.0, le=100.0)
    fov_deg: float = Field(default=120.0, gt=0.0, le=360.0)
    """Whole opening angle, centred on the robot's heading."""
    rate_hz: Positive = 10.0
    detection_probability: float = Field(default=0.95, gt=0.5, le=1.0)
    """That one look at a cell covers it, as the planners' belief assumes. The judge counts every look."""


class RobotConfig(_Model):
    """A ground robot with a disc for a footprint. `profile` sets the defaults of the other fields."""

    profile: Literal["husky", "spot"] = "spot"
    footprint_radius_m: Positive = 0.25
    """Half the robot's width: Husky 0.335 m, Spot 0.25 m."""
    max_speed_mps: float = Field(default=1.0, gt=0.0, le=20.0)
    max_acceleration_mps2: Positive = 1.0
    max_turn_rate_radps: float = Field(default=1.5, gt=0.0, le=20.0)
    max_turn_acceleration_radps2: Positive = 3.0
    height_m: Positive = 0.9

    @model_validator(mode="before")
    @classmethod
    def _fill_from_profile(cls, data: Any) -> Any:
        if isinstance(data, dict):
            return {**_PROFILES.get(str(data.get("profile", "spot")), {}), **data}
        return data


class SlamConfig(_Model):
    """What the simulated SLAM gives: a noisy pose that drifts, keyframes, and loop closures (see `slam.Slam`)."""

    pose_noise_m: NotNegative = 0.01
    """Standard deviation of x and of y."""
    yaw_noise_rad: NotNegative = 0.002
    """Standard deviation of the yaw."""
    keyframe_spacing_m: Positive = 1.0
    """A keyframe is added at this distance from the last one."""
    drift_fraction: float = Field(default=0.0, ge=0.0, le=0.2)
    """Error of dead reckoning as a share of the distance, rms, that of the yaw apart. 0: none."""
    drift_yaw_deg_per_10m: float = Field(default=0.0, ge=0.0, le=20.0)
    """Error of its yaw over 10 m, rms, in degrees. With both zero there is no drift, and no loop is closed."""
    drift_correlation_m: float = Field(default=100.0, ge=1.0, le=1e5)
    """Distance over which the drift stays alike: below it errors grow with the distance, beyond it with its root."""
    closure_radius_m: float = Field(default=2.0, ge=0.0, le=20.0)
    """So near to an old keyframe (true distance) a loop is closed. 0: never."""
    closure_min_path_m: float = Field(default=30.0, ge=1.0, le=1e5)
    """A keyframe is old when so much has been driven since."""
    closure_interval_m: float = Field(default=5.0, ge=0.1, le=1e4)
    """Distance driven between two loop closures, at least."""
    closure_noise_m: NotNegative = 0.05
    """Standard deviation of x and of y of the relative pose that a closure measures."""
    closure_yaw_noise_rad: NotNegative = 0.005
    """Standard deviation of its yaw."""


class Start(_Model):
    """Where the robot starts, in the frame of the world (map)."""

    x_m: float
    y_m: float
    yaw_rad: float | None = None
    """None: along the longest free ray."""


class SimConfig(_Model):
    """Everything the simulator needs; with the code and the mission's seed it fixes every byte of a run."""

    world: str = "subway_1x"
    """Name of a built-in world (see `worlds.WORLD_NAMES`); not used when `map_file` is given."""
    map_file: str | None = None
    """Path of a ROS map_server YAML file."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Of the built-in world; noise comes from the seed of the mission."""
    start: Start | None = None
    """None: the world's own start."""
    robot: RobotConfig = RobotConfig()
    lidar: LidarConfig = LidarConfig()
    coverage_sensor: CoverageSensorConfig = CoverageSensorConfig()
    slam: SlamConfig = SlamConfig()
    slip_fraction: float = Field(default=0.03, ge=0.0, le=0.5)
    """Standard deviation of the relative error of distance and of turn."""
    slip_correlation_s: Positive = 1.0
    """How long slip stays alike. Independent noise every step would average away."""
    contact_lost_speed_mps: Positive = 0.5
    """Contact at more than this speed into a wall breaks the robot: it is lost."""
