"""Parameters of the risk map. The paper gives none; every number is a starting choice."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class Config(BaseModel):
    """Configuration of riskmap; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    window_m: float = Field(40.0, gt=5, le=200, description="Side of the rolling window, m.")
    resolution_m: float = Field(0.1, ge=0.05, le=0.5, description="Cell size, m; doors need 0.1.")
    footprint_radius_m: float = Field(0.25, gt=0.05, le=2, description="The robot's disc, m.")
    robot_height_m: float = Field(0.9, gt=0.1, le=5, description="Points above it do not touch the robot, m.")
    ground_tolerance_m: float = Field(0.15, gt=0, le=1, description="Points up to this height are ground, m.")
    self_radius_m: float = Field(
        0.2, ge=0, le=2, description="Points this near to the robot are its own body, m."
    )
    hit_log_odds: float = Field(1.2, gt=0, le=10, description="Evidence of one sweep that hits the cell.")
    pass_log_odds: float = Field(0.5, gt=0, le=10, description="Evidence of one sweep that passes the cell.")
    clamp_log_odds: float = Field(
        4.0, gt=0.5, le=20, description="Bound: smaller forgets moved things sooner."
    )
    free_log_odds: float = Field(0.4, gt=0, le=10, description="A cell is free below minus this.")
    collision_hazard_per_m: float = Field(
        2.0, gt=0, le=100, description="Hazard rate inside an obstacle, 1/m."
    )
    cvar_alpha: float = Field(0.9, gt=0, lt=1, description="CVaR level: more is more careful.")
    max_clearance_m: float = Field(1.5, gt=0.3, le=5, description="Clearance is measured up to this, m.")
    publish_period_s: float = Field(0.2, ge=0.05, le=5, description="Time between risk maps, s.")
    cloud_timeout_s: float = Field(1.0, gt=0, le=60, description="Older clouds are not used, s.")
