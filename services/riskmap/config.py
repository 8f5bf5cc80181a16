"""Parameters of the risk map. The paper gives none; every number is a starting choice."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from planning.robot_profile import PROFILES, SPOT

_BELLY_SHARE = 0.35
"""Roughness (rms under the robot's disc) that is a limit, as a share of the height under its belly."""

MAX_SIDE_CELLS = 800
"""Of a window: a risk map has 25 bytes a cell, and a message at most 16 MiB."""


class Config(BaseModel):
    """Configuration of riskmap; unknown keys are refused. `profile` sets the defaults of the robot's fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    model: Literal["flat", "terrain"] = Field(
        "flat", description="Flat ground, or ground and obstacles from clouds."
    )
    window_m: float = Field(40.0, gt=5, le=200, description="Side of the rolling window, m.")
    resolution_m: float = Field(0.1, ge=0.05, le=0.5, description="Cell size, m; doors need 0.1.")
    # the robot
    profile: Literal["husky", "spot"] = Field(
        "spot", description="Robot whose numbers are the defaults below."
    )
    footprint_radius_m: float = Field(
        SPOT.footprint_radius_m, gt=0.05, le=2, description="The robot's disc, m."
    )
    robot_height_m: float = Field(
        SPOT.height_m, gt=0.1, le=5, description="Points above it do not touch the robot, m."
    )
    body_length_m: float = Field(
        SPOT.length_m, ge=0, le=5, description="Of the box whose points are its own, m."
    )
    body_width_m: float = Field(SPOT.width_m, ge=0, le=5, description="Of the same box, m.")
    body_margin_m: float = Field(
        0.02, ge=0, le=0.5, description="The box is larger by this on every side, m."
    )
    base_height_m: float = Field(
        0.0, ge=-1, le=2, description="Of base_link above the ground it stands on, m."
    )
    self_radius_m: float = Field(
        0.2, ge=0, le=2, description="Points this near to the sensor are its own body (flat model), m."
    )
    # evidence of obstacles
    ground_tolerance_m: float = Field(
        0.15, gt=0, le=1, description="Points up to this height are ground (flat model), m."
    )
    hit_log_odds: float = Field(1.2, gt=0, le=10, description="Evidence of one sweep that hits the cell.")
    pass_log_odds: float = Field(0.5, gt=0, le=10, description="Evidence of one sweep that passes the cell.")
    clamp_log_odds: float = Field(
        4.0, gt=0.5, le=20, description="Bound: smaller forgets moved things sooner."
    )
    free_log_odds: float = Field(
        0.4, gt=0, le=10, description="A cell is free below minus this (flat model)."
    )
    odometry_memory_m: float = Field(
        30.0,
        ge=0,
        le=10_000,
        description="What was last seen so far a way ago is forgotten, as odometry drifts (flat model), m; 0: never.",
    )
    # what moves (flat model)
    settle_s: float = Field(
        1.5, gt=0, le=60, description="What stands in free ground for longer no longer counts as moving, s."
    )
    moving_range_m: float = Field(
        8.0, ge=0, le=50, description="Moving things are looked for up to this range, m; 0: not at all."
    )
    # where ground is missing (flat model)
    void_range_m: float = Field(
        3.0,
        ge=0,
        le=20,
        description="Where a direction that shows ground shows none, unknown cells up to here are a drop, m; 0: off.",
    )
    # ground (terrain model)
    range_sigma_m: float = Field(0.015, gt=0, le=0.5, description="Deviation of a point's height, m.")
    angle_sigma_rad: float = Field(
        0.002,
        ge=0,
        le=0.1,
        description="Deviation of a sweep's attitude: heights err by this times the range, rad.",
    )
    height_drift_per_m: float = Field(
        0.005,
        ge=0,
        le=0.2,
        description="Odometry's height drifts by this per metre driven: old ground grows uncertain.",
    )
    max_gap_m: float = Field(1.5, ge=0, le=5, description="Longest gap between rings that is filled in, m.")
    fill_sigma_per_m: float = Field(
        0.05, ge=0, le=1, description="Deviation of filled ground per metre from the nearer hit."
    )
    start_radius_m: float = Field(
        3.3,
        ge=0,
        le=10,
        description="The ground this near to the first pose is supposed level until seen, m.",
    )
    start_sigma_m: float = Field(0.06, gt=0, le=1, description="Deviation of that ground, m.")
    stand_sigma_m: float = Field(
        0.04, gt=0, le=1, description="Deviation of ground that the robot stands on, m."
    )
    # limits of the terrain (terrain model)
    max_slope_rad: float = Field(SPOT.max_slope_rad, gt=0.05, le=1.2, description="Steeper is lethal, rad.")
    max_step_m: float = Field(
        SPOT.max_step_m,
        gt=0.02,
        le=1,
        description="A higher step is lethal, and points above it are obstacles, m.",
    )
    max_drop_m: float = Field(
        SPOT.max_drop_m, gt=0.02, le=2, description="A deeper drop behind an edge is lethal, m."
    )
    max_roughness_m: float = Field(
        _BELLY_SHARE * SPOT.belly_m,
        gt=0.01,
        le=1,
        description="Rms over the plane under the disc; more is lethal, m.",
    )
    step_reach_m: float = Field(0.25, gt=0.05, le=1, description="Steps are height differences over this, m.")
    drop_reach_m: float = Field(
        1.5, gt=0.1, le=5, description="Lower ground counts this far behind an edge, m."
    )
    lethal_sigmas: float = Field(
        1.0, ge=0, le=5, description="A limit counts as passed with so many standard deviations to spare."
    )
    # hazard
    collision_hazard_per_m: float = Field(
        2.0, gt=0, le=100, description="Hazard rate inside an obstacle, 1/m."
    )
    limit_hazard_per_m: float = Field(
        0.2, gt=0, le=100, description="Hazard rate of terrain at a limit, 1/m."
    )
    cvar_alpha: float = Field(
        0.9, ge=0, lt=1, description="CVaR level: more is more careful; 0: the mean hazard, no CVaR."
    )
    max_clearance_m: float = Field(1.5, gt=0.3, le=5, description="Clearance is measured up to this, m.")
    risk_blind: bool = Field(
        False,
        description="Experiments only: terrain is neither hazard nor lethal, only what is above the knee an obstacle; "
        "no CVaR.",
    )
    knee_height_m: float = Field(
        0.4, gt=0, le=2, description="What a risk-blind robot takes for an obstacle, m."
    )
    bump_memory_s: float = Field(
        90.0, ge=0, le=3600, description="Where something stopped the robot twice stays lethal so long, s."
    )
    # when
    publish_period_s: float = Field(0.2, ge=0.05, le=5, description="Time between risk maps, s.")
    cloud_timeout_s: float = Field(1.0, gt=0, le=60, description="Older clouds are not used, s.")
    grid_timeout_s: float = Field(
        0.0, ge=0, le=3600, description="Older ready grids are not used, s; 0: for ever."
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_from_profile(cls, data: Any) -> Any:
        profile = PROFILES.get(str(data.get("profile", "spot"))) if isinstance(data, dict) else None
        if profile is None:
            return data
        own = {
            "footprint_radius_m": profile.footprint_radius_m,
            "robot_height_m": profile.height_m,
            "body_length_m": profile.length_m,
            "body_width_m": profile.width_m,
            "max_slope_rad": profile.max_slope_rad,
            "max_step_m": profile.max_step_m,
            "max_drop_m": profile.max_drop_m,
            "max_roughness_m": _BELLY_SHARE * profile.belly_m,
        }
        return {**own, **data}

    @model_validator(mode="after")
    def _check_size(self) -> Config:
        if self.window_m / self.resolution_m > MAX_SIDE_CELLS:
            raise ValueError(
                f"window_m / resolution_m: {self.window_m / self.resolution_m:.0f} cells a side are more than the "
                f"{MAX_SIDE_CELLS} that fit into a risk map's message; take larger cells or a smaller window"
            )
        return self

    @property
    def alpha(self) -> float:
        """The CVaR level in force; 0 (the mean) for a risk-blind robot."""
        return 0.0 if self.risk_blind else self.cvar_alpha
