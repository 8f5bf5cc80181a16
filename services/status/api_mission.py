"""HTTP API v1: the mission and the commands to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path
from pydantic import BaseModel, ConfigDict, Field

from schemas.operation import CommandAnswer, CommandKind
from services.status.commands import CommandReport
from services.status.geojson import FeatureCollectionOut, FenceRequest
from services.status.planners import mission_detail
from services.status.problems import ProblemError
from services.status.report import MissionDetail
from services.status.security import require_operator, require_viewer
from services.status.shared import SharedStatus

Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=64,
        pattern=r"^[A-Za-z0-9._:-]+$",
        description="Of your choice, new for every command. A repeated one is answered alike, not carried out again.",
    ),
]
FenceId = Annotated[str, Path(min_length=1, max_length=64, examples=["no_go-1"])]

_SAYS: dict[int | str, dict[str, Any]] = {
    409: {"description": "The mission refused the command; `answer` is what it said."},
    503: {"description": "This service has no way to the mission."},
    504: {"description": "The mission did not answer in time; send the command again with the same key."},
}


class BudgetRequest(BaseModel):
    """Another time budget."""

    model_config = ConfigDict(
        extra="forbid", allow_inf_nan=False, json_schema_extra={"examples": [{"time_budget_s": 900.0}]}
    )

    time_budget_s: float = Field(
        ge=0, le=1e9, description="Mission time from start to end, s; 0: no limit.", examples=[900.0]
    )


def _reported(answer: CommandAnswer) -> CommandReport:
    """The answer; raises ProblemError when the mission refused."""
    report = CommandReport.of(answer)
    if not answer.accepted:
        raise ProblemError(409, answer.reason, answer=report.model_dump(mode="json"))
    return report


_SIMPLE = {
    CommandKind.START: "Start a mission that waits for it (`mission.auto_start: false`).",
    CommandKind.PAUSE: "Stop where the robot is, until `resume`. The time budget runs on.",
    CommandKind.RESUME: "Go on with what was paused.",
    CommandKind.HOME: "Return to where the mission began, and end there.",
    CommandKind.STOP: "End the mission where the robot is. There is no way back.",
}


def mission_routes(shared: SharedStatus) -> APIRouter:
    """The routes under /api/v1/mission."""
    api = APIRouter(prefix="/api/v1/mission", tags=["mission"])
    viewer, operator = [Depends(require_viewer)], [Depends(require_operator)]
    unknown: dict[int | str, dict[str, Any]] = {
        404: {"description": "The mission has not been heard of yet."}
    }

    @api.get("", dependencies=viewer, responses=unknown)
    def mission() -> MissionDetail:
        """Phase, budget, and what is left and why."""
        detail = shared.read(mission_detail)
        if detail is None:
            raise ProblemError(404, "the mission has not been heard of yet: is it running?")
        return detail

    for kind, says in _SIMPLE.items():
        api.post(f"/{kind.value}", dependencies=operator, responses=_SAYS, description=says, name=kind.value)(
            _simple(shared, kind)
        )

    @api.put("/time-budget", dependencies=operator, responses=_SAYS)
    def time_budget(body: BudgetRequest, key: Key = None) -> CommandReport:
        """Change the time budget. With more of it a robot that turned back for its time explores on."""
        return _reported(shared.desk.ask(CommandKind.BUDGET, key, time_budget_s=body.time_budget_s))

    _fence_routes(api, shared)
    return api


def _simple(shared: SharedStatus, kind: CommandKind) -> Callable[..., CommandReport]:
    def command(key: Key = None) -> CommandReport:
        return _reported(shared.desk.ask(kind, key))

    return command


def _fence_routes(api: APIRouter, shared: SharedStatus) -> None:
    viewer, operator = [Depends(require_viewer)], [Depends(require_operator)]

    @api.get("/fences", dependencies=viewer)
    def fences() -> FeatureCollectionOut:
        """Geofence, no-go and priority polygons, as GeoJSON in metres; each names its frame."""
        return shared.fences()

    @api.post("/fences", dependencies=operator, responses=_SAYS)
    def add_fences(body: FenceRequest, key: Key = None) -> CommandReport:
        """Add polygons, all or none. A geofence replaces the one before; a feature whose `id` is that of a fence
        replaces it."""
        return _reported(shared.desk.ask(CommandKind.FENCE, key, fences=body.fences()))

    @api.delete("/fences", dependencies=operator, responses=_SAYS)
    def remove_all_fences(key: Key = None) -> CommandReport:
        """Take all polygons away."""
        return _reported(shared.desk.ask(CommandKind.UNFENCE, key))

    @api.delete("/fences/{fence_id}", dependencies=operator, responses=_SAYS)
    def remove_fence(fence_id: FenceId, key: Key = None) -> CommandReport:
        """Take one polygon away."""
        return _reported(shared.desk.ask(CommandKind.UNFENCE, key, fence_ids=[fence_id]))
