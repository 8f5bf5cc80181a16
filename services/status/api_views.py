"""HTTP API v1: what can be seen: status, planners, graph, layers, coverage, configuration, events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from enum import StrEnum
from typing import Annotated, Any, NamedTuple

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import PlainTextResponse, StreamingResponse
from pydantic import BaseModel

from planning.graph_mirror import RoadMap
from schemas.world import RiskMap
from services.status.events import Event
from services.status.geojson import FeatureCollectionOut, graph_graphml, graph_json
from services.status.history import CoverageCurve, CoveragePoint
from services.status.layers import Layer, coverage_layer, layer_pgm, layer_png, layer_yaml, risk_layer
from services.status.once import Once
from services.status.planners import planner_report
from services.status.problems import ProblemError, finite
from services.status.report import PlannerReport, StatusReport
from services.status.security import require_viewer
from services.status.shared import SharedStatus

NO_STORE = {"Cache-Control": "no-store"}
_POLL_S, _SILENT_S = 0.2, 10.0
_LAST_ID = 2**53


class LayerName(StrEnum):
    """risk: hazard around the robot, in `odom`. coverage: what is covered so far, in `map`."""

    RISK = "risk"
    COVERAGE = "coverage"


class EventList(BaseModel):
    """Events, oldest first. last_id: of the newest event there is."""

    events: list[Event]
    last_id: int


class _Drawn(NamedTuple):
    """A layer as a file, with the frame it lies in."""

    frame: str
    resolution_m: float
    content: bytes | str


def _content(
    kind: str, says: str, more: dict[int | str, dict[str, Any]] | None = None
) -> dict[int | str, Any]:
    binary: dict[str, Any] = {"type": "string", "format": "binary"}
    schema = {"type": "string"} if kind.startswith("text/") else binary if kind.startswith("image/") else {}
    return {200: {"content": {kind: {"schema": schema}}, "description": says}, **(more or {})}


def view_routes(shared: SharedStatus, once: Once) -> APIRouter:
    """The routes under /api/v1 that change nothing."""
    api = APIRouter(prefix="/api/v1", dependencies=[Depends(require_viewer)])

    @api.get("/status", tags=["status"])
    def status() -> StatusReport:
        """Phase, pose, coverage, target and why, plan, and how every service is."""
        return shared.status()

    @api.get("/configuration", tags=["status"])
    def configuration() -> dict[str, Any]:
        """The configuration that the robot runs with. Restart it to change it."""
        return finite(shared.configuration)

    @api.get("/coverage", tags=["status"])
    def coverage() -> CoverageCurve:
        """Coverage over time."""
        points = shared.read(lambda core, now_ns: list(core.curve.points))
        return CoverageCurve(points=[CoveragePoint(**finite(point._asdict())) for point in points])

    @api.get("/planner", tags=["planners"])
    def planner() -> PlannerReport:
        """Target and the best alternatives with gain, distance, risk and Q; the policy; tau; the local search."""
        return shared.read(planner_report)

    _graph_routes(api, shared, once)
    _layer_routes(api, shared, once)
    _event_routes(api, shared)
    return api


def _graph_routes(api: APIRouter, shared: SharedStatus, once: Once) -> None:
    def graph_as(write: Callable[[int, RoadMap], bytes]) -> bytes:
        return write(*shared.read(lambda core, now_ns: core.graph))

    @api.get("/graph.geojson", tags=["map"], response_model=FeatureCollectionOut)
    async def graph_as_geojson() -> Response:
        """The Global IRM as GeoJSON, in metres of `map`."""
        text = await once.get("geojson", lambda: graph_as(graph_json))
        return Response(text, media_type="application/json")

    @api.get(
        "/graph.graphml",
        tags=["map"],
        response_class=Response,
        responses=_content("application/graphml+xml", "GraphML"),
    )
    async def graph_as_graphml() -> Response:
        """The Global IRM as GraphML: `networkx.read_graphml` and Gephi open it."""
        text = await once.get("graphml", lambda: graph_as(graph_graphml))
        return Response(text, media_type="application/graphml+xml", headers=NO_STORE)


def _layer(shared: SharedStatus, name: LayerName) -> Layer:
    """A layer as it is now. Raises ProblemError."""
    if name is LayerName.RISK:
        risk = shared.read(lambda core, now_ns: core.latest("riskmap/risk_map", RiskMap))
        if risk is not None:
            return risk_layer(risk)
    else:
        whole = shared.read(lambda core, now_ns: core.canvas.whole())
        if whole is not None:
            return coverage_layer(*whole)
    raise ProblemError(404, f"there is no {name.value} layer yet: nothing has been seen")


def _layer_routes(api: APIRouter, shared: SharedStatus, once: Once) -> None:
    missing: dict[int | str, dict[str, Any]] = {404: {"description": "Nothing has been seen yet."}}

    async def made(name: LayerName, ending: str, draw: Callable[[Layer], bytes | str]) -> _Drawn:
        def make() -> _Drawn:
            found = _layer(shared, name)
            return _Drawn(found.frame, found.spec.resolution_m, draw(found))

        return await once.get(f"{name.value}.{ending}", make)

    @api.get(
        "/layers/{layer}.png",
        tags=["map"],
        response_class=Response,
        responses=_content("image/png", "A pixel a cell", missing),
    )
    async def layer_as_png(layer: LayerName) -> Response:
        """A layer as a picture, a pixel a cell, the highest y at the top; unknown cells are transparent."""
        drawn = await made(layer, "png", layer_png)
        headers = {**NO_STORE, "X-Frame": drawn.frame, "X-Resolution-M": f"{drawn.resolution_m:.9g}"}
        return Response(drawn.content, media_type="image/png", headers=headers)

    @api.get(
        "/layers/{layer}.pgm",
        tags=["map"],
        response_class=Response,
        responses=_content("image/x-portable-graymap", "The image", missing),
    )
    async def layer_as_pgm(layer: LayerName) -> Response:
        """The image of the map_server file."""
        drawn = await made(layer, "pgm", layer_pgm)
        return Response(drawn.content, media_type="image/x-portable-graymap", headers=NO_STORE)

    @api.get(
        "/layers/{layer}.yaml",
        tags=["map"],
        response_class=PlainTextResponse,
        responses=_content("application/yaml", "The map_server file", missing),
    )
    async def layer_as_yaml(layer: LayerName) -> Response:
        """The map_server file (YAML) of a layer; its image is the same name with .pgm."""
        drawn = await made(layer, "yaml", layer_yaml)
        return Response(drawn.content, media_type="application/yaml", headers=NO_STORE)


def _event_routes(api: APIRouter, shared: SharedStatus) -> None:
    @api.get("/events", tags=["events"])
    def events(
        after: Annotated[
            int, Query(ge=0, le=_LAST_ID, description="Only those later than this id; one never given: all.")
        ] = 0,
        limit: Annotated[int, Query(ge=1, le=2000, description="The newest so many.")] = 200,
    ) -> EventList:
        """What happened and why: targets chosen and dropped, frontiers given up, commands, safety, faults."""
        found, last_id = shared.read(lambda core, now_ns: (core.events.after(after), core.events.last_id))
        return EventList(events=found[-limit:], last_id=last_id)

    @api.get(
        "/events/stream",
        tags=["events"],
        response_class=StreamingResponse,
        responses=_content("text/event-stream", "Server-Sent Events; `id` is the event's, `event` its kind"),
    )
    async def event_stream(
        request: Request,
        last_event_id: Annotated[
            int | None,
            Header(alias="Last-Event-ID", ge=0, le=_LAST_ID, description="Go on after this event."),
        ] = None,
        once: Annotated[
            bool, Query(description="End when all there is was sent, instead of waiting.")
        ] = False,
    ) -> StreamingResponse:
        """Events as Server-Sent Events, from the beginning or after `Last-Event-ID`; a comment every 10 s."""
        stream = _stream(shared, request, last_event_id or 0, once)
        return StreamingResponse(stream, media_type="text/event-stream", headers=NO_STORE)


def _later(shared: SharedStatus, last_id: int) -> list[Event]:
    return shared.read(lambda core, now_ns: core.events.after(last_id))


async def _stream(shared: SharedStatus, request: Request, last_id: int, once: bool) -> AsyncIterator[str]:
    yield "retry: 1000\n\n"
    silent_s = 0.0
    while True:
        for event in _later(shared, last_id):
            last_id, silent_s = event.id, 0.0
            yield f"id: {event.id}\nevent: {event.kind}\ndata: {event.model_dump_json()}\n\n"
        if once or await request.is_disconnected():
            return
        await asyncio.sleep(_POLL_S)
        silent_s += _POLL_S
        if silent_s >= _SILENT_S:
            silent_s = 0.0
            yield ": still here\n\n"
