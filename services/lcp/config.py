"""Parameters of the local coverage planner. The paper gives none; every number is a starting choice."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from planning.reward import RewardWeights


class NbvConfig(BaseModel):
    """Next-best-view planning, the paper's local baseline."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    samples: int = Field(256, ge=1, le=20_000, description="Viewpoints that an answer samples.")
    radius_m: float = Field(
        12.0,
        ge=1,
        le=1000,
        description="Travel to the viewpoints sampled first, at most, m; then the window's.",
    )
    risk_weight_m: float = Field(
        5.0, ge=0, le=1000, description="Metres of way that a risk of 1 counts in its paths; 0: the shortest."
    )
    min_reward: float = Field(
        0.3,
        ge=0,
        le=100,
        description="A view that is worth less is not gone to; then it is led to the target.",
    )
    keep_best: bool = Field(True, description="The last best viewpoint is always among the candidates,")
    switch_share: float = Field(
        0.0,
        ge=0,
        le=1e9,
        description="and left for one that is worth more than it by this share. 1e9: gone to.",
    )


class HfeConfig(BaseModel):
    """The way to the frontier, of the paper's frontier-based baseline. Which frontier is gcp's."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    look_radius_m: float = Field(
        3.0,
        ge=0,
        le=60,
        description="At its end it looks at what is uncovered within this of the frontier, m.",
    )


class TourConfig(BaseModel):
    """The tour over all viewpoints of the window."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stops: int = Field(12, ge=1, le=14, description="Viewpoints that are put in order, the best ones.")
    early_per_nat: float = Field(
        0.2,
        ge=0,
        le=1000,
        description="Metres of way that a nat is worth for each metre that it is seen earlier; 0: the shortest tour.",
    )
    stop_gain: float = Field(
        0.0,
        ge=0,
        le=100,
        description="Every stop counts so many nats more in the order: the way back to one that was left behind grows "
        "with what is found meanwhile.",
    )
    near_m: float = Field(
        24.0, gt=0, le=1e6, description="Viewpoints are chosen by gain^power exp(-way / this), m,"
    )
    gain_power: float = Field(0.5, gt=0, le=4, description="with this power.")
    min_gain: float = Field(
        0.15, ge=0, le=100, description="What sees less is no viewpoint while there are others, nats."
    )
    detour: float = Field(
        1.3, ge=1, le=10, description="Way to a frontier beyond the window, for each metre straight there."
    )


class Config(BaseModel):
    """Configuration of lcp; unknown keys are refused at every level."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    planner: Literal["pomcp", "nbv", "hfe", "tour"] = Field(
        "pomcp",
        description="pomcp: the paper's planner; nbv, hfe: its baselines; tour: the order of all viewpoints that is "
        "short and early, where the map itself is the aim (irm: coverage known).",
    )
    tour: TourConfig = TourConfig()
    nbv: NbvConfig = NbvConfig()
    hfe: HfeConfig = HfeConfig()
    weights: RewardWeights = RewardWeights()
    max_depth: int = Field(24, ge=1, le=200, description="Horizon of the tree, actions.")
    max_nodes: int = Field(40_000, ge=100, le=5_000_000, description="Histories that the tree can hold.")
    exploration: float = Field(
        0.04, ge=0, le=10, description="UCB constant, in units of the range of returns."
    )
    horizon: int = Field(
        70, ge=1, le=500, description="Moves of every simulation, tree and rollout together."
    )
    rollout_random: float = Field(
        0.1,
        ge=0,
        le=1,
        description="Share of random moves in rollouts; 1: uniform, none by the informed rule.",
    )
    macros: bool = Field(True, description="Whether the tree has macro actions beside single moves.")
    path_steps: int = Field(
        24, ge=1, le=500, description="Moves of the path that is given to the reconciler."
    )
    value_rollouts: int = Field(64, ge=1, le=10_000, description="Rollouts for the value without planning.")
    min_visits: int = Field(12, ge=1, le=100_000, description="Tree nodes with fewer visits are not policy.")
    cover_begin_entropy: float = Field(
        1.5, ge=0, le=100, description="So much in reach starts covering, nats."
    )
    cover_end_entropy: float = Field(0.3, ge=0, le=100, description="Less in reach ends covering, nats.")
    cover_min_value: float = Field(
        0.4, ge=0, le=100, description="A policy worth less gives way to the target."
    )
    cover_radius_m: float = Field(
        14.0, ge=1, le=60, description="Ground up to here counts as in reach, m of travel."
    )
    promise_moves: int = Field(
        6, ge=1, le=100, description="Patches that so many moves are to cover count as promised."
    )
    promises: float = Field(
        14.0, ge=1, le=1e6, description="Answers that may promise a patch in vain; then it is left alone"
    )
    promise_rest_s: float = Field(180.0, ge=0, le=1e5, description="for so long, s.")
    seconds_per_deadline: float = Field(
        0.3, ge=0.01, le=10, description="Live planning time of an episode, s."
    )
