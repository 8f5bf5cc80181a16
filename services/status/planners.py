"""What the planners think, put together from their messages."""

from __future__ import annotations

import math

from schemas.operation import MissionState
from schemas.policy import GlobalPolicy, LocalPolicy, Plan
from services.status.core import StatusCore
from services.status.events import frontier_in_words
from services.status.report import (
    AlternativeReport,
    LeftReport,
    LocalSearch,
    MissionDetail,
    PlaceReport,
    PlannerReport,
    PolicyNode,
)

_LOG_2 = math.log(2.0)


def planner_report(core: StatusCore, now_ns: int) -> PlannerReport:
    """Target, alternatives, policy, tau and the local search, as far as they are known."""
    policy = core.latest("gcp/global_policy", GlobalPolicy)
    plan = core.latest("reconciler/plan", Plan)
    return PlannerReport(
        target=core.status(now_ns).target,
        alternatives=_alternatives(policy),
        policy=_nodes(policy),
        route=[] if policy is None else [(float(x), float(y)) for x, y, _ in policy.route_xyz_m],
        tau_s=None if plan is None else plan.tau_s,
        local=_local(core.latest("lcp/local_policy", LocalPolicy)),
    )


def _alternatives(policy: GlobalPolicy | None) -> list[AlternativeReport]:
    return [
        AlternativeReport(
            **other.model_dump(),
            cells=other.gain / _LOG_2,
            words=frontier_in_words(other.frontier, other.gain, other.distance_m, other.risk),
        )
        for other in (policy.alternatives if policy is not None else [])
    ]


def _nodes(policy: GlobalPolicy | None) -> list[PolicyNode]:
    if policy is None:
        return []
    rows = zip(
        policy.node_id.tolist(),
        policy.node_xyz_m.tolist(),
        policy.action.tolist(),
        policy.value.tolist(),
        strict=True,
    )
    return [
        PolicyNode(node=node, x_m=place[0], y_m=place[1], next=action, value=value)
        for node, place, action, value in rows
    ]


def _local(policy: LocalPolicy | None) -> LocalSearch | None:
    if policy is None:
        return None
    return LocalSearch(
        episode=policy.episode,
        phase=policy.phase.value,
        reason=policy.reason,
        simulations=policy.simulations,
        tree_nodes=policy.tree_nodes,
        root_value=policy.root_value,
        rollout_value=policy.rollout_value,
        planning_ms=policy.planning_ms,
    )


def mission_detail(core: StatusCore, now_ns: int) -> MissionDetail | None:
    """The mission with the places that are left; None before its first word."""
    state, report = core.latest("mission/state", MissionState), core.status(now_ns).mission
    if state is None or report is None:
        return None
    return MissionDetail(
        **report.model_dump(),
        home=PlaceReport(x_m=state.home.x_m, y_m=state.home.y_m, yaw_rad=state.home.yaw_rad),
        places_left=[
            LeftReport(x_m=place.x_m, y_m=place.y_m, gain=place.gain, reason=place.reason)
            for place in state.left
        ],
    )
