"""Parameters of the Information RoadMaps. The paper gives none; every number is a starting choice."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

_MAX_REACH = 15
"""Nodes that a row of sight in a `LocalIrm` holds to either side."""


class Config(BaseModel):
    """Configuration of irm; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    # Local IRM
    spacing_m: float = Field(1.0, ge=0.3, le=3, description="Node spacing of the Local IRM, m.")
    size: int = Field(41, ge=5, le=61, description="Nodes a side of the Local IRM, odd.")
    local_period_s: float = Field(0.5, ge=0.1, le=10, description="Time between Local IRMs, s.")
    edge_detour: float = Field(
        1.6, ge=1, le=4, description="A bent edge may be this much longer than straight."
    )
    min_node_entropy: float = Field(
        0.08,
        ge=0,
        le=0.69,
        description="Patches with less entropy count as covered, nats (a whole one: 0.69).",
    )
    # what covers
    coverage: Literal["sensor", "known"] = Field(
        "sensor",
        description="sensor: known ground counts as covered when it was looked at; known: as soon as it is known.",
    )
    unknown_depth_m: float = Field(
        4.0, gt=0, le=100, description="coverage known: unknown ground so deep behind the known counts, m,"
    )
    unknown_decay_m: float = Field(
        4.0, gt=0, le=1000, description="less with its depth: exp(-depth / this), m."
    )
    unknown_solid: bool = Field(
        True,
        description="Unseen cells count amid unseen ones only: gaps between far rays are none. False: all.",
    )
    # coverage sensor, as the planners assume it
    sensor_range_m: float = Field(6.0, gt=0, le=100, description="Range of the coverage sensor, m.")
    sensor_fov_deg: float = Field(120.0, gt=0, le=360, description="Field of view of the coverage sensor.")
    sensor_height_m: float = Field(
        0.8, gt=0, le=5, description="Of the coverage sensor over the ground, on rough ground, m."
    )
    covered_probability: float = Field(
        0.9, gt=0.5, lt=1, description="From this probability a cell is covered."
    )
    blur_from_m: float = Field(
        2.0,
        ge=0,
        le=100,
        description="Looks from keyframes less certain than this relative to the robot's count less, m; 0: off.",
    )
    odometry_drift: float = Field(
        0.02, gt=0, le=1, description="Odometry errs by no more than this share of the way, m/m."
    )
    doubt_from_m: float = Field(
        0.5,
        gt=0,
        le=100,
        description="What belongs to keyframes less certain than this is neither joined nor judged, m.",
    )
    # traversability
    clearance_margin_m: float = Field(0.0, ge=-0.05, le=1, description="Added to the footprint's radius, m.")
    clearance_hysteresis_m: float = Field(0.03, ge=0, le=0.2, description="What was passable stays so, m.")
    hazard_margin_m: float = Field(0.1, ge=0, le=1, description="Hazard is felt this far around the body, m.")
    comfort_clearance_m: float = Field(
        0.5, ge=0, le=3, description="Nearer to obstacles a path costs more, m."
    )
    # Global IRM
    global_period_s: float = Field(1.0, ge=0.1, le=10, description="Time between Global IRMs, s.")
    breadcrumb_spacing_m: float = Field(2.0, gt=0.2, le=20, description="d_b: new breadcrumb beyond it, m.")
    max_edge_m: float = Field(10.0, gt=1, le=50, description="d_e: no longer edge between breadcrumbs, m.")
    max_edge_risk: float = Field(0.6, gt=0, le=1, description="rho_e: no riskier edge.")
    edges_per_node: int = Field(6, ge=1, le=50, description="A new breadcrumb is joined to so many.")
    # frontiers
    frontier_block_m: float = Field(
        5.0, ge=1, le=50, description="A frontier is no longer than about this, m."
    )
    frontier_reach_m: float = Field(
        8.0, ge=1, le=50, description="Ground up to here counts for a frontier, m."
    )
    frontier_min_gain: float = Field(
        0.1, gt=0, le=10, description="Less is no frontier anywhere, nats of patches."
    )
    frontier_min_share: float = Field(
        0.0005,
        ge=0,
        le=0.1,
        description="Less than this share of the ground known is no frontier (in large worlds),",
    )
    frontier_enough_gain: float = Field(
        0.5, gt=0, le=10, description="but so much always is one, nats of patches."
    )
    frontier_same_m: float = Field(
        2.5, ge=0, le=20, description="A frontier this near to an old one is that one."
    )
    missed_rounds: int = Field(8, ge=0, le=1000, description="Rounds that a cut-off frontier is waited for.")
    opening_min_m2: float = Field(
        0.5,
        gt=0,
        le=100,
        description="A border on so much unseen ground that the robot may enter is always a frontier, m2.",
    )
    opening_range_m: float = Field(
        7.0, gt=1, le=100, description="Such borders are looked for so near to the robot, m."
    )
    opening_rounds: int = Field(
        3, ge=1, le=100, description="Seen in fewer rounds and gone again, such a border never was one."
    )
    opening_depth_m: float = Field(
        4.0, ge=0, le=100, description="Behind each metre of such a border so much ground is expected, m, but"
    )
    unknown_max_gain: float = Field(
        12.0, ge=0, le=1000, description="this is the most that the unknown adds to a frontier, nats."
    )
    give_up_s: float = Field(6.0, gt=0, le=600, description="Time beside a frontier that yields nothing, s.")
    pursue_s: float = Field(
        90.0, gt=0, le=3600, description="A target that comes no nearer is given up then, s."
    )
    second_chance_gain: float = Field(
        1.0,
        gt=0,
        le=1000,
        description="A given-up frontier worth so much, nats, is tried once more when nothing else is left.",
    )
    give_up_radius_m: float = Field(1.5, gt=0, le=10, description="How near that is, m.")
    retry_after_s: float = Field(
        600.0, gt=0, le=1e5, description="A given-up frontier may come back then, s."
    )
    blocked_memory_s: float = Field(
        240.0, gt=0, le=1e4, description="Where the robot was blocked stays risky, s."
    )

    @model_validator(mode="after")
    def _fits_the_message(self) -> Config:
        if math.ceil(self.sensor_range_m / self.spacing_m) > _MAX_REACH:
            raise ValueError(f"sensor_range_m: its range is more than {_MAX_REACH} times spacing_m")
        if self.size % 2 == 0:
            raise ValueError(f"size: {self.size} is not odd, there is no middle node")
        return self
