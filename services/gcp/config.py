"""Parameters of the global coverage planner."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from planning.reward import RewardWeights


class Config(BaseModel):
    """What the QMDP weighs and how firmly it keeps its target. Unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    period_s: float = Field(1.0, gt=0, le=60, description="Time between steps without a new graph, s.")
    latency_s: float = Field(0.05, ge=0, le=10, description="Lock-step: time that a step takes, s.")
    reward: RewardWeights = RewardWeights()
    solver: Literal["qmdp", "orienteering"] = Field(
        "qmdp",
        description="The paper's QMDP, or the best order in which to visit all frontiers (after FIG-OP).",
    )
    group_m: float = Field(
        4.0, ge=0, le=50, description="Frontiers so near to one another are one stop (orienteering), m."
    )
    groups: int = Field(16, ge=1, le=64, description="Stops weighed, the nearest ones (orienteering).")
    tour_margin: float = Field(
        2.0, ge=0, le=1000, description="The target is left for a tour that is better by this, nats, and"
    )
    tour_margin_relative: float = Field(
        0.1, ge=0, le=10, description="by this share of the value of the best that goes there first."
    )
    particles: int = Field(32, ge=1, le=4096, description="Samples of the robot's pose: the belief b(q).")
    max_pose_spread_m: float = Field(
        0.5, ge=0, le=20, description="Deviation of the pose among the nodes around it, at most, m."
    )
    switch_margin_relative: float = Field(
        2.0, ge=0, le=10, description="The target is left for one whose Q is better by this share of |Q|, and"
    )
    switch_margin: float = Field(
        16.0, ge=0, le=1000, description="better by this much too, nats: more keeps the target longer."
    )
    crumb_share: float = Field(
        0.1, ge=0, le=1, description="A target that promises less than this share of what it once did,"
    )
    crumb_gain: float = Field(
        1.0,
        ge=0,
        le=1000,
        description="or less than this, nats, is a crumb. It gives way to what is better by",
    )
    crumb_margin: float = Field(2.0, ge=0, le=1000, description="this, nats, and less than half as far")
    crumb_times: float = Field(
        0.0,
        ge=0,
        le=1e6,
        description="or promises so many times as much, and is less than twice as far; 0: no matter how much.",
    )
    same_target_m: float = Field(
        2.0, gt=0, le=20, description="A frontier so near to the target's place is the same target, m."
    )
    local_range_m: float = Field(
        18.0,
        ge=0,
        le=200,
        description="Frontiers so near are the local planner's: not in the value to go, m.",
    )
    policy_radius_m: float = Field(
        32.0,
        ge=1,
        le=1e6,
        description="Nodes so near are told with action and value, and the path there: at least the Local IRM, m.",
    )
    alternatives: int = Field(5, ge=1, le=50, description="Frontiers weighed exactly and reported.")
    ask_again_s: float = Field(2.0, gt=0, le=60, description="Time between requests for the whole graph, s.")
