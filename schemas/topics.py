"""The table of topics: one row a topic. Everything about the wire is derived from it."""

from __future__ import annotations

from typing import Any

from schemas.base import Message
from schemas.contract import SECOND_NS, Topic
from schemas.fences import Fences
from schemas.operation import (
    CommandAnswer,
    JudgeReport,
    MissionCommand,
    MissionState,
    StageHealth,
    WorldPicture,
)
from schemas.policy import EpisodeRequest, GlobalPolicy, LocalPolicy, Plan
from schemas.sensing import CoverageScan, FollowerState, Odometry, PointCloud, PoseGraph, ReadyGrid
from schemas.world import (
    CoverageSummary,
    CoverageWindow,
    GlobalIrm,
    GraphRequest,
    LocalIrm,
    MovingPoints,
    RiskMap,
)

SERVICES = ("riskmap", "irm", "gcp", "lcp", "reconciler", "mission", "status", "sim")
"""The services, in the order in which lock-step runs those that are due at the same time."""

_MS = SECOND_NS // 1000
_KIB = 1024
_MIB = 1024 * 1024


def _topic(
    message: type[Any],
    name: str,
    readers: str,
    says: str,
    *,
    period_ms: int,
    stale_ms: int = 0,
    max_bytes: int = 256 * _KIB,
    keep_all: bool = False,
    link: bool = False,
    journaled: bool = False,
) -> Topic[Any]:
    return Topic(
        name=name,
        message=message,
        writer=name.split("/")[0],
        readers=tuple(readers.split()),
        period_ns=period_ms * _MS,
        keep_all=keep_all,
        max_bytes=max_bytes,
        stale_after_ns=stale_ms * _MS,
        crosses_link=link,
        says=says,
        journaled=journaled,
    )


CLOUD: Topic[PointCloud] = _topic(
    PointCloud, "sim/cloud", "riskmap", "LiDAR sweep with the sensor's pose", period_ms=100, stale_ms=1000,
    max_bytes=8 * _MIB,
)  # fmt: skip
READY_GRID: Topic[ReadyGrid] = _topic(
    ReadyGrid, "sim/ready_grid", "riskmap", "occupancy grid built by somebody else", period_ms=0,
    max_bytes=64 * _MIB,
)  # fmt: skip
ODOMETRY: Topic[Odometry] = _topic(
    Odometry, "sim/odometry", "riskmap irm gcp lcp reconciler mission status", "pose, speed, map to odom",
    period_ms=50, stale_ms=500, link=True,
)  # fmt: skip
POSE_GRAPH: Topic[PoseGraph] = _topic(
    PoseGraph, "sim/pose_graph", "irm", "SLAM keyframes", period_ms=500, max_bytes=16 * _MIB, link=True,
    journaled=True,
)  # fmt: skip
COVERAGE_SCAN: Topic[CoverageScan] = _topic(
    CoverageScan, "sim/coverage_scan", "irm", "the coverage sensor has looked", period_ms=100, keep_all=True,
    max_bytes=4 * _KIB, link=True,
)  # fmt: skip
FOLLOWER: Topic[FollowerState] = _topic(
    FollowerState, "sim/follower", "riskmap reconciler irm", "progress and trouble of the path follower", period_ms=50,
    stale_ms=1000, max_bytes=4 * _KIB,
)  # fmt: skip
JUDGE: Topic[JudgeReport] = _topic(
    JudgeReport, "sim/judge", "status", "ground truth: true coverage, lost or not", period_ms=500,
    max_bytes=16 * _KIB, link=True, journaled=True,
)  # fmt: skip
WORLD_PICTURE: Topic[WorldPicture] = _topic(
    WorldPicture, "sim/world_picture", "", "the true world, for the result's picture", period_ms=5000,
    max_bytes=64 * _MIB,
)  # fmt: skip
RISK_MAP: Topic[RiskMap] = _topic(
    RiskMap, "riskmap/risk_map", "irm reconciler status", "hazard rate, state and clearance around the robot",
    period_ms=200, stale_ms=1500, max_bytes=16 * _MIB, link=True,
)  # fmt: skip
MOVING: Topic[MovingPoints] = _topic(
    MovingPoints, "riskmap/moving", "reconciler", "what moves in the newest cloud", period_ms=0, stale_ms=500,
)  # fmt: skip
LOCAL_IRM: Topic[LocalIrm] = _topic(
    LocalIrm, "irm/local_irm", "lcp reconciler status", "the Local IRM", period_ms=500, keep_all=True, stale_ms=3000,
    max_bytes=4 * _MIB, link=True,
)  # fmt: skip
GLOBAL_IRM: Topic[GlobalIrm] = _topic(
    GlobalIrm, "irm/global_irm", "gcp status mission", "the Global IRM, whole or as differences", period_ms=1000,
    stale_ms=10_000, max_bytes=32 * _MIB, keep_all=True, link=True, journaled=True,
)  # fmt: skip
COVERAGE: Topic[CoverageSummary] = _topic(
    CoverageSummary, "irm/coverage", "mission status gcp", "coverage by the belief, what is left and why",
    period_ms=1000, stale_ms=5000, link=True,
)  # fmt: skip
COVERAGE_WINDOW: Topic[CoverageWindow] = _topic(
    CoverageWindow, "irm/coverage_window", "status", "the belief around the robot as a picture", period_ms=1000,
    max_bytes=4 * _MIB, link=True,
)  # fmt: skip
GLOBAL_POLICY: Topic[GlobalPolicy] = _topic(
    GlobalPolicy, "gcp/global_policy", "irm lcp mission status reconciler", "the QMDP policy, its target and why",
    period_ms=1000, stale_ms=10_000, max_bytes=16 * _MIB, link=True, journaled=True,
)  # fmt: skip
GCP_GRAPH_REQUEST: Topic[GraphRequest] = _topic(
    GraphRequest, "gcp/graph_request", "irm", "gcp asks for the whole Global IRM", period_ms=0, keep_all=True,
    max_bytes=4 * _KIB, link=True,
)  # fmt: skip
MISSION_GRAPH_REQUEST: Topic[GraphRequest] = _topic(
    GraphRequest, "mission/graph_request", "irm", "mission asks for the whole Global IRM", period_ms=0,
    keep_all=True, max_bytes=4 * _KIB,
)  # fmt: skip
STATUS_GRAPH_REQUEST: Topic[GraphRequest] = _topic(
    GraphRequest, "status/graph_request", "irm", "status asks for the whole Global IRM", period_ms=0,
    keep_all=True, max_bytes=4 * _KIB, link=True,
)  # fmt: skip
EPISODE: Topic[EpisodeRequest] = _topic(
    EpisodeRequest, "reconciler/episode", "lcp", "opens a planning episode", period_ms=1000, stale_ms=5000, link=True,
)  # fmt: skip
LOCAL_POLICY: Topic[LocalPolicy] = _topic(
    LocalPolicy, "lcp/local_policy", "irm reconciler status", "the answer to an episode", period_ms=1000,
    stale_ms=5000, max_bytes=4 * _MIB, link=True,
)  # fmt: skip
PLAN: Topic[Plan] = _topic(
    Plan, "reconciler/plan", "sim lcp status", "the timed path: the only motion output", period_ms=200,
    stale_ms=1500, link=True,
)  # fmt: skip
MISSION: Topic[MissionState] = _topic(
    MissionState, "mission/state", "irm gcp lcp reconciler status sim", "phase, budget, finish reason",
    period_ms=500, stale_ms=3000, link=True, journaled=True,
)  # fmt: skip
FENCES: Topic[Fences] = _topic(
    Fences, "mission/fences", "irm reconciler status", "geofence, no-go and priority polygons", period_ms=2000,
    max_bytes=4 * _MIB, link=True, journaled=True,
)  # fmt: skip
ANSWER: Topic[CommandAnswer] = _topic(
    CommandAnswer, "mission/answer", "status", "what became of a command", period_ms=0, keep_all=True,
    max_bytes=16 * _KIB, link=True, journaled=True,
)  # fmt: skip
COMMAND: Topic[MissionCommand] = _topic(
    MissionCommand, "status/command", "mission", "what the operator asks", period_ms=0, keep_all=True,
    max_bytes=1024 * _KIB, link=True,
)  # fmt: skip

TOPICS: tuple[Topic[Message], ...] = (
    CLOUD, READY_GRID, ODOMETRY, POSE_GRAPH, COVERAGE_SCAN, FOLLOWER, JUDGE, WORLD_PICTURE, RISK_MAP, MOVING, LOCAL_IRM,
    GLOBAL_IRM, COVERAGE, COVERAGE_WINDOW, GLOBAL_POLICY, GCP_GRAPH_REQUEST, MISSION_GRAPH_REQUEST,
    STATUS_GRAPH_REQUEST, EPISODE, LOCAL_POLICY, PLAN, FENCES, MISSION, ANSWER, COMMAND,
)  # fmt: skip
"""All topics of the stages. Health topics come on top: `health_topic`."""


def health_topic(service: str) -> Topic[StageHealth]:
    """The health topic of a service, written by its driver."""
    return _topic(
        StageHealth, f"{service}/health", "status", f"health of {service}", period_ms=500, stale_ms=3000,
        max_bytes=16 * _KIB, link=True,
    )  # fmt: skip


def read_by(service: str) -> list[Topic[Message]]:
    """The topics that a service reads, in the order of the table."""
    health = [health_topic(name) for name in SERVICES] if service == "status" else []
    return [topic for topic in TOPICS if service in topic.readers] + health


def written_by(service: str) -> list[Topic[Message]]:
    """The topics that a service writes, in the order of the table."""
    return [topic for topic in TOPICS if topic.writer == service]


def topic_named(name: str) -> Topic[Message]:
    """The topic with this name; KeyError when there is none."""
    return next(t for t in (*TOPICS, *(health_topic(s) for s in SERVICES)) if t.name == name)
