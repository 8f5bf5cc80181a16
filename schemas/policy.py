"""What the planners say to each other, and the one motion output (paper, Hierarchical Value Learning and Eq. 16-19)."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Array, Header, Message, Pose, column


class Alternative(Header):
    """One frontier that the global planner weighed. distance_m, risk: along the best path; q: its action value."""

    frontier: int = Field(ge=0)
    x_m: float
    y_m: float
    gain: float
    distance_m: float
    risk: float
    q: float


class GlobalPolicy(Message):
    """The QMDP policy over the Global IRM, in `map`.

    node_id, action, value: of the nodes around the robot that are worth something, the next node of the policy (-1:
    stay) and V, staying for nothing being an action. value_to_go: V without the frontiers that the local planner can
    reach by itself: what the rest of the mission is worth from here. A node that is not told has neither.
    target: frontier id (-1: none). path_node, path_xyz_m: the way from the robot's node to the target as far as it runs
    around the robot, with the first node outside; of one piece (path_piece, ascending) each node is joined to the next,
    between two pieces the way runs outside. route_xyz_m: a few places of the whole way, to be shown.
    """

    schema_name: ClassVar[str] = "global_policy"
    schema_version: ClassVar[int] = 2

    irm_version: int = Field(ge=1)
    target: int = Field(ge=-1)
    target_xyz_m: tuple[float, float, float]
    target_gain: float
    target_q: float
    target_distance_m: float = Field(ge=0)
    target_risk: float = Field(ge=0, le=1)
    switched: bool = Field(
        description="The target replaced one that was still valid, reachable and uncovered."
    )
    reason: str
    alternatives: list[Alternative]
    map_to_odom: Pose
    node_id: Annotated[Array, column("int64", "n", minimum=0)]
    node_xyz_m: Annotated[Array, column("float64", "n", 3)]
    action: Annotated[Array, column("int64", "n", minimum=-1)]
    value: Annotated[Array, column("float64", "n")]
    value_to_go: Annotated[Array, column("float64", "n")]
    path_node: Annotated[Array, column("int64", "p", minimum=0)]
    path_xyz_m: Annotated[Array, column("float64", "p", 3)]
    path_piece: Annotated[Array, column("int32", "p", minimum=0)]
    route_xyz_m: Annotated[Array, column("float64", "r", 3)]


class EpisodeRequest(Message):
    """The reconciler opens a planning episode (DESIGN: planning episodes).

    The junction belief: particle_node/heading/weight (node index of that Local IRM, heading 0..7), time_ns: when the
    kept prefix ends, speed there. covered: (rows,) bits of nodes that the kept prefix will have covered, row r of the
    lattice. horizon_m: travel left after the junction. simulations: budget.
    """

    schema_name: ClassVar[str] = "episode_request"

    episode: int = Field(ge=1)
    irm_version: int = Field(ge=1)
    junction_ns: int = Field(ge=0)
    junction_speed_mps: float = Field(ge=0)
    horizon_m: float = Field(gt=0)
    simulations: int = Field(ge=1)
    particle_node: Annotated[Array, column("int32", "k", minimum=0)]
    particle_heading: Annotated[Array, column("uint8", "k", maximum=7)]
    particle_weight: Annotated[Array, column("float64", "k", minimum=0)]
    covered: Annotated[Array, column("uint64", "rows")]


class LocalPhase(StrEnum):
    """What the local planner did: guided to the target (phase 1), covered (phase 2), or found nothing to do."""

    GUIDE = "guide"
    COVER = "cover"
    NONE = "none"


class LocalPolicy(Message):
    """The answer to an episode request: a belief policy on the Local IRM of that version, in `odom`.

    root_value: of the policy at the junction; rollout_value: of the rollout rule alone, in the same model.
    path_*: the most likely branch from the junction: nodes (lattice indices, so that it keeps its meaning when the
    window rolls), the expected reward of the step into each (0 for the first), whether the tree or its rollout gave it,
    and whether a look hangs on it (path_look: driving another line would lose what it is made for). path_xy_m with
    path_node_point: the driven line, and the index of each node's point in it. tree_*: the policy with its observation
    branches: action (0..7 moves, 8.. macro), value, visits; children of tree node m:
    child_node[child_start[m]:child_start[m + 1]] under child_observation.
    """

    schema_name: ClassVar[str] = "local_policy"
    schema_version: ClassVar[int] = 2

    episode: int = Field(ge=1)
    irm_version: int = Field(ge=1)
    phase: LocalPhase
    reason: str
    target: int = Field(ge=-1)
    root_value: float
    rollout_value: float
    simulations: int = Field(ge=0)
    tree_nodes: int = Field(ge=0)
    planning_ms: float = Field(ge=0, description="0 in lock-step, where time is not measured.")
    path_lattice: Annotated[Array, column("int32", "p", 2)]
    path_reward: Annotated[Array, column("float64", "p")]
    path_in_tree: Annotated[Array, column("uint8", "p", maximum=1)]
    path_look: Annotated[Array, column("uint8", "p", maximum=1)]
    path_xy_m: Annotated[Array, column("float64", "q", 2)]
    path_node_point: Annotated[Array, column("int32", "p", minimum=0)]
    tree_action: Annotated[Array, column("int32", "m", minimum=-1)]
    tree_value: Annotated[Array, column("float64", "m")]
    tree_visits: Annotated[Array, column("int32", "m", minimum=0)]
    child_start: Annotated[Array, column("int32", "m1", minimum=0)]
    child_node: Annotated[Array, column("int32", "c", minimum=0)]
    child_observation: Annotated[Array, column("int32", "c")]


class SafetyState(StrEnum):
    """The reconciler's safety state, least severe first."""

    RUN = "run"
    DEGRADED = "degraded"
    HOLD = "hold"
    RETURN = "return"
    DONE = "done"


class Plan(Message):
    """The only motion output: a timed path in `odom` for the follower.

    plan_id: increases. valid: false means stop. A path whose first yaw points against its first step is driven
    backwards: a robot that backs off does not turn in the tight place where it was blocked. points from the robot's
    place on: x, y, yaw, speed (not to exceed), time since the stamp in seconds. ttl_s: the follower stops when no
    newer plan came for so long. tau_s: time of the old policy that was kept (tau*); kept_points: so many points
    belong to it. risk_stamp_ns: newest cloud that this plan knows of.
    """

    schema_name: ClassVar[str] = "plan"

    plan_id: int = Field(ge=1)
    episode: int = Field(ge=0)
    valid: bool
    safety: SafetyState
    reason: str
    tau_s: float = Field(ge=0)
    kept_points: int = Field(ge=0)
    ttl_s: float = Field(gt=0)
    risk_stamp_ns: int = Field(ge=0)
    x_m: Annotated[Array, column("float64", "k")]
    y_m: Annotated[Array, column("float64", "k")]
    yaw_rad: Annotated[Array, column("float64", "k")]
    speed_mps: Annotated[Array, column("float64", "k", minimum=0)]
    time_s: Annotated[Array, column("float64", "k", minimum=0)]
