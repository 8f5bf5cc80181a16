"""What `/api/v1/status` answers. Lengths in metres, angles in radians, times in seconds, places in `map`."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PlaceReport(_Part):
    """The robot's pose."""

    x_m: float
    y_m: float
    yaw_rad: float


class CoverageReport(_Part):
    """belief: share of the ground known to be reachable. judge: the simulator's own, null on a real robot."""

    belief: float
    covered_area_m2: float
    reachable_area_m2: float
    frontiers: int
    judge: float | None = None


class TargetReport(_Part):
    """The frontier that the global planner sends the robot to, and why. id -1: none."""

    id: int
    x_m: float
    y_m: float
    gain: float
    distance_m: float
    risk: float
    q: float
    reason: str


class PlanReport(_Part):
    """The motion output. tau_s: how much of the old policy was kept."""

    safety: str
    valid: bool
    reason: str
    tau_s: float
    age_s: float
    length_m: float


class MissionReport(_Part):
    """As the mission service says it; left: places that are not covered."""

    phase: str
    finish: str
    reason: str
    elapsed_s: float
    time_budget_s: float
    distance_m: float
    return_distance_m: float
    left: int
    fences_version: int = 0


class LeftReport(_Part):
    """Ground that is not covered, and why; in `map`."""

    x_m: float
    y_m: float
    gain: float
    reason: str


class MissionDetail(MissionReport):
    """The mission with the places that are left, best first."""

    home: PlaceReport
    places_left: list[LeftReport]


class AlternativeReport(_Part):
    """A frontier that the global planner weighed. gain: nats of whole patches; cells: the same in whole patches."""

    frontier: int
    x_m: float
    y_m: float
    gain: float
    cells: float
    distance_m: float
    risk: float
    q: float
    words: str = Field(examples=["frontier 41: 38 cells expected, 12 m, low risk"])


class PolicyNode(_Part):
    """Of the QMDP policy: the node that it goes to next from a node (-1: stay), and its value."""

    node: int
    x_m: float
    y_m: float
    next: int
    value: float


class LocalSearch(_Part):
    """The local planner's last answer. phase: guide, cover or none."""

    episode: int
    phase: str
    reason: str
    simulations: int
    tree_nodes: int
    root_value: float
    rollout_value: float
    planning_ms: float


class PlannerReport(_Part):
    """What the planners think. tau_s: how much of the old policy was kept."""

    target: TargetReport | None
    alternatives: list[AlternativeReport]
    policy: list[PolicyNode]
    route: list[tuple[float, float]]
    tau_s: float | None
    local: LocalSearch | None


class StageReport(_Part):
    """How one service is. state: ok, not_ready, silent (it was there) or missing (never heard of)."""

    service: str
    state: str
    age_s: float | None = Field(None, description="Since its last sign of life.")
    rate_hz: float = 0.0
    steps: int = 0
    step_p50_ms: float = 0.0
    step_p99_ms: float = 0.0
    memory_mb: float = 0.0
    pid: int = 0
    errors: int = 0
    last_error: str = ""
    degraded: str = Field("", description="What it has to do without, such as its journal; empty: nothing.")
    dropped: dict[str, int] = {}
    waiting_for: list[str] = []


class TopicReport(_Part):
    """One topic as received here."""

    name: str
    messages: int
    age_s: float
    rate_hz: float
    stale: bool


class StatusReport(_Part):
    """Everything about the mission in one answer; what is not known yet is null."""

    robot: str
    silent_s: float | None = Field(
        None, description="So long nothing has come from the robot; null: it is heard, or never was."
    )
    ready: bool
    not_ready_because: list[str]
    mission: MissionReport | None
    pose: PlaceReport | None
    speed_mps: float | None
    coverage: CoverageReport | None
    target: TargetReport | None
    target_switches: int
    plan: PlanReport | None
    lost: bool | None = Field(description="The simulator's judgement; null on a real robot.")
    stages: list[StageReport]
    topics: list[TopicReport]


class Readiness(_Part):
    """Answer of `/readyz`."""

    ready: bool
    reasons: list[str]
