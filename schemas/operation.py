"""Mission, health and judgement."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Array, Header, Message, Pose, column


class MissionPhase(StrEnum):
    """Where the mission is. Only the mission service changes it."""

    IDLE = "idle"
    EXPLORE = "explore"
    PAUSED = "paused"
    RETURN = "return"
    STOPPED = "stopped"
    DONE = "done"


class FinishReason(StrEnum):
    """Why the mission ended; empty while it goes on."""

    NONE = ""
    COVERED = "covered"
    TIME_BUDGET = "time_budget"
    ENERGY_BUDGET = "energy_budget"
    STOPPED = "stopped"
    RETURNED = "returned"
    NO_PROGRESS = "no_progress"


class LeftOver(Header):
    """Ground that was not covered, and why."""

    x_m: float
    y_m: float
    gain: float = Field(ge=0)
    reason: str


class MissionState(Message):
    """The mission's one truth. elapsed_s counts from the start command, pauses included."""

    schema_name: ClassVar[str] = "mission_state"

    phase: MissionPhase
    finish: FinishReason
    reason: str
    elapsed_s: float = Field(ge=0)
    time_budget_s: float = Field(ge=0, description="0: none.")
    distance_m: float = Field(ge=0)
    return_distance_m: float = Field(ge=0)
    home: Pose
    coverage: float = Field(ge=0, le=1)
    left: list[LeftOver]


class CommandKind(StrEnum):
    """What an operator may ask of the mission."""

    START = "start"
    PAUSE = "pause"
    RESUME = "resume"
    HOME = "home"
    STOP = "stop"


class MissionCommand(Message):
    """A command. command_id: repeated commands with the same id are carried out once."""

    schema_name: ClassVar[str] = "mission_command"

    command_id: str = Field(min_length=1, max_length=64)
    kind: CommandKind


class StageHealth(Message):
    """How a service is: published by its driver, not by the stage.

    dropped: refused messages by reason. waiting_for: inputs without which it does nothing useful.
    """

    schema_name: ClassVar[str] = "stage_health"

    service: str
    ready: bool
    steps: int = Field(ge=0)
    step_p50_ms: float = Field(ge=0)
    step_p99_ms: float = Field(ge=0)
    rate_hz: float = Field(ge=0)
    memory_mb: float = Field(ge=0)
    pid: int = Field(ge=0)
    errors: int = Field(ge=0)
    last_error: str
    dropped: dict[str, int]
    waiting_for: list[str]


class LinkReport(Message):
    """How the link to the base station is, told by the link process on the robot.

    connected: both connections stand. holder, lease: of each service that may run at the base, who is obeyed (`base`
    or `standby`) and the epoch of that lease. down_kb_per_s (robot to base), up_kb_per_s (base to robot): bytes on the
    link by topic over the last seconds, in 1000 bytes/s. queued_kb: waiting to be sent, by lane. dropped: by
    `topic:reason`, since the start. base_age_s: since the newest good word from the base, by service; -1: none yet.
    """

    schema_name: ClassVar[str] = "link_report"

    connected: bool
    holder: dict[str, str]
    lease: dict[str, int]
    takeovers: int = Field(ge=0)
    hand_backs: int = Field(ge=0)
    down_kb_per_s: dict[str, float]
    up_kb_per_s: dict[str, float]
    queued_kb: dict[str, float]
    base_age_s: dict[str, float]
    dropped: dict[str, int]


class JudgeReport(Message):
    """The simulator's judgement, from true poses; no planner reads it."""

    schema_name: ClassVar[str] = "judge_report"

    world: str
    true_pose: Pose
    coverage: float = Field(ge=0, le=1)
    covered_area_m2: float = Field(ge=0)
    reachable_area_m2: float = Field(ge=0)
    distance_m: float = Field(ge=0)
    contacts: int = Field(ge=0)
    lost: bool
    lost_reason: str


class WorldPicture(Message):
    """The simulator's world, for the result's picture: sent rarely; no planner reads it.

    cell: 0 solid, 1 free, 2 reachable, 3 reachable and covered.
    """

    schema_name: ClassVar[str] = "world_picture"

    resolution_m: float = Field(gt=0)
    ix0: int
    iy0: int
    cell: Annotated[Array, column("uint8", "h", "w", maximum=3)]
