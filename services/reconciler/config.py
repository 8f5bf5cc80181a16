"""Parameters of the reconciler. The paper gives none; every number is a starting choice."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from planning.reward import RewardWeights


class Config(BaseModel):
    """Configuration of the reconciler; unknown keys are refused at every level."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    profile: Literal["default", "paper", "always_new", "always_old"] = Field(
        "default",
        description="paper: tau* by the literal rule; default: with regulariser and value of replanning; always_new: "
        "no more is kept than latency and braking need; always_old: all that can still be driven, and episodes open "
        "near its end only.",
    )
    weights: RewardWeights = RewardWeights()
    # episodes
    episode_period_s: float = Field(1.5, ge=0.2, le=20, description="Time between planning episodes, s.")
    episode_timeout_s: float = Field(
        3.0, ge=0.5, le=60, description="An unanswered episode is dropped then, s."
    )
    simulations: int = Field(4096, ge=1, le=10_000_000, description="POMCP simulations of an episode.")
    horizon_m: float = Field(30.0, gt=1, le=1000, description="Travel that a policy looks ahead, m.")
    particles: int = Field(32, ge=1, le=10_000, description="Particles of the junction belief.")
    # tau*
    planning_latency_s: float = Field(
        0.6, ge=0, le=10, description="tau covers at least this and braking, s."
    )
    max_kept_m: float = Field(8.0, gt=0, le=100, description="No more of the old path is kept, m.")
    regulariser: float = Field(
        0.3, ge=0, le=100, description="lambda: weight of the mismatch at the junction."
    )
    replan_rollouts: int = Field(16, ge=1, le=1000, description="Rollouts for the value of replanning.")
    rollout_moves: int = Field(40, ge=1, le=500, description="Moves of those rollouts.")
    # motion limits
    max_speed_mps: float = Field(1.0, gt=0, le=10, description="Speed limit, m/s.")
    min_speed_mps: float = Field(0.35, gt=0, le=10, description="Speed in the narrowest places, m/s.")
    max_acceleration_mps2: float = Field(0.8, gt=0, le=10, description="Speeding up and braking, m/s2.")
    max_turn_rate_radps: float = Field(1.2, gt=0, le=10, description="Turn rate, rad/s.")
    footprint_radius_m: float = Field(0.25, gt=0.05, le=2, description="The robot's disc, m.")
    clearance_margin_m: float = Field(
        0.0, ge=0, le=1, description="Paths keep so much more off obstacles, m."
    )
    turn_room_m: float = Field(
        0.0,
        ge=0,
        le=1,
        description="With less room than the disc and this it goes back before it turns on the spot, m; 0: never.",
    )
    tight_clearance_m: float = Field(0.3, gt=0, le=2, description="Up to here the slowest speed, m.")
    free_clearance_m: float = Field(0.6, gt=0, le=5, description="From here on no slowing down, m.")
    comfort_clearance_m: float = Field(
        0.45, gt=0, le=2, description="Paths are pushed this far off walls, m."
    )
    # safety
    plan_ttl_s: float = Field(1.5, gt=0.1, le=30, description="The follower stops without a newer plan, s.")
    risk_stale_s: float = Field(1.5, gt=0, le=30, description="Older risk maps hold the robot, s.")
    odometry_stale_s: float = Field(0.5, gt=0, le=30, description="Older poses hold the robot, s.")
    irm_stale_s: float = Field(3.0, gt=0, le=60, description="Older Local IRMs degrade, s.")
    policy_silent_s: float = Field(
        6.0, gt=0, le=60, description="Without answers of lcp so long: degraded, s."
    )
    degraded_speed_share: float = Field(
        0.5, gt=0, le=1, description="Share of the speed limits when degraded."
    )
    separation_margin_m: float = Field(
        0.15, ge=0, le=2, description="Kept between the robot's disc and what moves, m."
    )
    mover_speed_mps: float = Field(
        0.8, ge=0, le=3, description="What moves is taken to be no faster, m/s; ISO 13855 has 1.6 for people."
    )
    reaction_s: float = Field(
        0.4, ge=0, le=5, description="From a cloud to the robot's braking because of it, at most, s."
    )
    off_path_m: float = Field(0.6, gt=0.05, le=5, description="Farther off its path the robot plans anew, m.")
    blocked_s: float = Field(
        1.0, gt=0, le=60, description="Blocked or stuck so long, the path is dropped, s."
    )
    idle_s: float = Field(
        6.0, gt=0, le=600, description="Without a way on for so long, it goes back twice as far as that, s."
    )
    back_off_m: float = Field(
        0.4, ge=0, le=2, description="Blocked, the robot drives back so far on the way that it came, m."
    )
