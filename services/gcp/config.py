"""Parameters of the global coverage planner."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from planning.reward import RewardWeights


class HfeConfig(BaseModel):
    """Hierarchical frontier-based exploration, the paper's global baseline."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    scopes_m: tuple[Annotated[float, Field(gt=0, le=1e6)], ...] = Field(
        (12.0,), description="Frontiers within so much travel come before all others, smallest first, m."
    )
    gain_weight: float = Field(
        1.0, ge=0, le=1000, description="Weight of a frontier's gain against the way there. 0: the nearest."
    )
    risk_weight_m: float = Field(
        5.0, ge=0, le=1000, description="Metres of way that a risk of 1 counts in its paths."
    )
    switch_margin: float = Field(
        1.0,
        ge=0,
        le=1e9,
        description="The target is left for one of the same scope that pays so much more, nats. "
        "1e9: once chosen, it is gone to; smaller scopes come first all the same.",
    )


class Config(BaseModel):
    """What the QMDP weighs and how firmly it keeps its target. Unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    period_s: float = Field(1.0, gt=0, le=60, description="Time between steps without a new graph, s.")
    latency_s: float = Field(0.05, ge=0, le=10, description="Lock-step: time that a step takes, s.")
    reward: RewardWeights = RewardWeights()
    solver: Literal["qmdp", "orienteering", "hfe"] = Field(
        "orienteering",
        description="qmdp: the paper's; orienteering: the best order in which to visit all frontiers (after FIG-OP); "
        "hfe: the paper's frontier-based baseline.",
    )
    hfe: HfeConfig = HfeConfig()
    group_m: float = Field(
        4.0, ge=0, le=50, description="Frontiers so near to one another are one stop (orienteering), m."
    )
    groups: int = Field(16, ge=1, le=64, description="Stops weighed, the nearest ones (orienteering).")
    near_worth: float = Field(
        10.0,
        ge=0,
        le=1e6,
        description="When a tour over those is worth less, nats, as many far ones join that promise most for the way.",
    )
    tour_gamma_per_m: float = Field(
        0.995,
        gt=0,
        le=1,
        description="Discount for a metre before a stop of the tour: less is nearer to going where most is at hand.",
    )
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
