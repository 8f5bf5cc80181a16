"""Mission, health and judgement."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Array, Header, Message, Pose, column
from schemas.fences import MAX_FENCES, Fence


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
    """The mission's one truth. elapsed_s counts from the start command, pauses included.

    fences_version: of the fences that hold now (`mission/fences`); who has others must not move the robot.
    """

    schema_name: ClassVar[str] = "mission_state"
    schema_version: ClassVar[int] = 2

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
    fences_version: int = Field(0, ge=0)


class CommandKind(StrEnum):
    """What an operator may ask of the mission.

    budget: another time budget. fence: add polygons; a geofence replaces the one before, and a polygon with the id of
    one that there is replaces that one. unfence: take polygons away.
    """

    START = "start"
    PAUSE = "pause"
    RESUME = "resume"
    HOME = "home"
    STOP = "stop"
    BUDGET = "budget"
    FENCE = "fence"
    UNFENCE = "unfence"


class MissionCommand(Message):
    """A command. command_id: repeated commands with the same id are carried out once, and answered alike.

    time_budget_s: for `budget`, mission time from start to end (0: none). fences: for `fence`. fence_ids: for
    `unfence`; empty: all.
    """

    schema_name: ClassVar[str] = "mission_command"
    schema_version: ClassVar[int] = 2

    command_id: str = Field(min_length=1, max_length=64)
    kind: CommandKind
    time_budget_s: float = Field(0.0, ge=0, le=1e9)
    fences: list[Fence] = Field(default_factory=list, max_length=MAX_FENCES)
    fence_ids: list[str] = Field(default_factory=list, max_length=MAX_FENCES)


class CommandAnswer(Message):
    """What became of a command: one for every command received, for a repeated one the same as before.

    reason: in plain words. phase: of the mission after it. fence_ids: of the polygons that it added, replaced or took
    away. fences_version: of the fences after it.
    """

    schema_name: ClassVar[str] = "command_answer"

    command_id: str = Field(min_length=1, max_length=64)
    kind: CommandKind
    accepted: bool
    reason: str
    phase: MissionPhase
    fence_ids: list[str]
    fences_version: int = Field(ge=0)


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
