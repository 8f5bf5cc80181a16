"""Parameters of the mission service."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class Config(BaseModel):
    """What the mission may spend, and when it is over. Unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    period_s: float = Field(0.5, gt=0, le=5, description="Time between steps, s.")
    auto_start: bool = Field(
        True, description="Start with the first odometry; else wait for the start command."
    )
    time_budget_s: float = Field(0.0, ge=0, description="Mission time from start to end, s. 0: no limit.")
    energy_budget_m: float = Field(
        0.0, ge=0, description="Travel that the battery allows, m (energy modelled by distance). 0: no limit."
    )
    return_on_budget: bool = Field(
        True,
        description="Turn back while the budget still suffices for the way home; else end where it ends.",
    )
    return_when_done: bool = Field(False, description="Drive home when covered or without progress.")
    return_reserve_factor: float = Field(
        1.3, ge=1, le=5, description="The way back is budgeted this many times: more turns back earlier."
    )
    return_speed_mps: float = Field(0.8, gt=0, le=10, description="Mean speed expected on the way back, m/s.")
    home_radius_m: float = Field(1.5, gt=0, le=20, description="So near to home the robot has returned, m.")
    settle_s: float = Field(
        4.0, ge=0, le=600, description="Covered when there was nothing left to go to for so long, s."
    )
    worth_m_per_nat: float = Field(
        60.0,
        ge=0,
        le=1e6,
        description="What is farther away than this for each nat it promises is not worth the way, m. 0: all is,",
    )
    worth_share: float = Field(
        0.005, ge=0, le=1, description="as long as all such places are no more than this share of the ground."
    )
    no_progress_s: float = Field(
        600.0, gt=0, description="Give up when exploring so long without progress, s; pauses do not count."
    )
    progress_min_m2: float = Field(0.5, gt=0, description="Newly covered ground that counts as progress, m2.")
    progress_min_m: float = Field(
        1.0, gt=0, description="On the way back: so much less of the way left counts as progress, m."
    )
    fences_period_s: float = Field(
        2.0, gt=0, le=60, description="The fences are told at every change and so often, s."
    )
    ask_again_s: float = Field(2.0, gt=0, le=60, description="Time between requests for the whole graph, s.")
    max_left: int = Field(
        200, ge=1, le=1000, description="At most so many left-over places are reported, best first."
    )
