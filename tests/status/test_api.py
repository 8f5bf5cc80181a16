"""HTTP API v1 with a real mission behind it: commands, fences, layers, graph, curve, events."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
from fastapi.testclient import TestClient

from planning.grid import FREE
from schemas.operation import JudgeReport, MissionPhase, MissionState
from schemas.policy import GlobalPolicy, Plan, SafetyState
from schemas.world import CoverageSummary, CoverageWindow, GridHeader, RiskMap
from services.sim.map_server import load_map_server
from services.status.app import SharedStatus, create_app
from services.status.config import Config
from services.status.problems import finite
from services.status.security import Access, Role, Token, _digest
from tests.mission.test_stage import corridor, coverage
from tests.schemas.examples import example
from tests.status.mission_behind import MissionBehind

SECRET = "a-token-of-an-operator-in-a-test"
OPERATOR = {"Authorization": f"Bearer {SECRET}"}
BOX = [[2.0, -1.0], [5.0, -1.0], [5.0, 1.0], [2.0, 1.0], [2.0, -1.0]]
POLYGON = {"type": "Polygon", "coordinates": [BOX]}


@pytest.fixture
def shared() -> SharedStatus:
    return SharedStatus(Config(command_timeout_s=0.2), "husky1")


@pytest.fixture
def client(shared: SharedStatus) -> TestClient:
    app = create_app(shared)
    app.state.access = Access((Token(Role.operator, "test", _digest(SECRET)),))
    return TestClient(app, base_url="http://127.0.0.1:8080", headers=OPERATOR)


@pytest.fixture
def behind(shared: SharedStatus) -> MissionBehind:
    return MissionBehind(shared)


def draw(client: TestClient, geojson: Any = POLYGON, **more: Any) -> Any:
    return client.post(
        "/api/v1/mission/fences", json={"kind": "no_go", "frame": "map", "geojson": geojson, **more}
    )


def test_commands_say_what_happened(client: TestClient, behind: MissionBehind) -> None:
    paused = client.post("/api/v1/mission/pause")
    assert paused.status_code == 200
    assert paused.json()["phase"] == "paused"
    refused = client.post("/api/v1/mission/pause")
    assert refused.status_code == 409
    assert refused.headers["content-type"] == "application/problem+json"
    assert refused.json()["answer"]["accepted"] is False
    assert "nothing to pause" in refused.json()["detail"]
    assert client.post("/api/v1/mission/resume").json()["phase"] == "explore"
    budget = client.put("/api/v1/mission/time-budget", json={"time_budget_s": 900})
    assert "900 s" in budget.json()["reason"]
    assert client.get("/api/v1/mission").json()["time_budget_s"] == 900
    assert client.post("/api/v1/mission/stop").json()["phase"] == "stopped"


def test_commands_need_an_operator(shared: SharedStatus, behind: MissionBehind) -> None:
    stranger = TestClient(create_app(shared), base_url="http://127.0.0.1:8080")
    for method, path in (("POST", "stop"), ("PUT", "time-budget"), ("POST", "fences"), ("DELETE", "fences")):
        answer = stranger.request(method, f"/api/v1/mission/{path}")
        assert answer.status_code == 401
        assert answer.headers["content-type"] == "application/problem+json"
    assert behind.carried_out == []


def test_a_key_is_carried_out_once(client: TestClient, behind: MissionBehind) -> None:
    key = {"Idempotency-Key": "pause-1"}
    first = client.post("/api/v1/mission/pause", headers=key)
    client.post("/api/v1/mission/resume")
    again = client.post("/api/v1/mission/pause", headers=key)
    assert again.json() == first.json()
    assert client.get("/api/v1/mission").json()["phase"] == "explore"
    other = client.post("/api/v1/mission/stop", headers=key)
    assert other.status_code == 409
    assert "another command" in other.json()["detail"]


def test_without_a_mission_one_is_told_so(client: TestClient, shared: SharedStatus) -> None:
    assert client.post("/api/v1/mission/pause").status_code == 503
    assert client.get("/api/v1/mission").status_code == 404
    shared.desk.send = lambda command: None
    silent = client.post("/api/v1/mission/pause", headers={"Idempotency-Key": "k1"})
    assert silent.status_code == 504
    assert "k1" in silent.json()["detail"]


def test_fences_come_back_as_they_were_drawn(client: TestClient, behind: MissionBehind) -> None:
    feature = {"type": "Feature", "id": "pit", "geometry": POLYGON, "properties": {"name": "the pit"}}
    made = draw(client, {"type": "FeatureCollection", "features": [feature]}, frame="odom")
    assert made.json()["fence_ids"] == ["pit"]
    held = client.get("/api/v1/mission/fences").json()
    assert held["version"] == 1
    (found,) = held["features"]
    assert found["geometry"] == POLYGON
    assert found["properties"] == {"kind": "no_go", "frame": "odom", "name": "the pit", "weight": 1.0}
    assert client.delete("/api/v1/mission/fences/pot").status_code == 409
    assert client.delete("/api/v1/mission/fences/pit").json()["fence_ids"] == ["pit"]
    assert client.get("/api/v1/mission/fences").json()["features"] == []


@pytest.mark.parametrize(
    ("geojson", "field", "says"),
    [
        ({"type": "Polygon", "coordinates": [BOX[:-1]]}, "body.geojson.coordinates[0]", "not closed"),
        (
            {"type": "MultiPolygon", "coordinates": [[BOX], [[[0, 9], [4, 13], [4, 9], [0, 13], [0, 9]]]]},
            "body.geojson.coordinates[1][0]",
            "crosses itself",
        ),
        ({"type": "Point", "coordinates": [1, 2]}, "body.geojson", "Point"),
        (
            {"type": "Polygon", "coordinates": [[[0, 0], [1, 1]]]},
            "body.geojson.Polygon.coordinates[0]",
            "at least 4",
        ),
    ],
)
def test_a_wrong_polygon_is_named_with_its_field(
    client: TestClient, behind: MissionBehind, geojson: Any, field: str, says: str
) -> None:
    answer = draw(client, geojson)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == field
    assert says in answer.json()["detail"]
    assert behind.carried_out == []


def test_the_frame_must_be_said(client: TestClient, behind: MissionBehind) -> None:
    answer = client.post("/api/v1/mission/fences", json={"kind": "no_go", "geojson": POLYGON})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "body.frame"


def small_map(shared: SharedStatus) -> np.ndarray[Any, Any]:
    """30 x 20 cells of 0.1 m from (-1, 2) on: a walled room with a pillar, beside unknown ground."""
    cell = np.zeros((20, 30), np.uint8)
    cell[2:18, 2:28] = 3
    cell[3:17, 3:27] = 2
    cell[8:10, 12:14] = 3
    cell[4:6, 4:20] = 1
    grid = GridHeader(resolution_m=0.1, ix0=-10, iy0=20, width=30, height=20)
    shared.observe("irm/coverage_window", CoverageWindow(stamp_ns=1, grid=grid, cell=cell))
    return cell


def test_the_map_server_export_loads_back_to_the_same_cells(
    client: TestClient, shared: SharedStatus, tmp_path: Path
) -> None:
    cell = small_map(shared)
    for name in ("coverage.yaml", "coverage.pgm"):
        (tmp_path / name).write_bytes(client.get(f"/api/v1/layers/{name}").content)
    world = load_map_server(tmp_path / "coverage.yaml")
    wanted = cell[2:18, 2:28]  # the known part
    assert world.spec.shape == wanted.shape
    assert (world.spec.ix0, world.spec.iy0) == (-8, 22)
    assert np.array_equal(world.occupied, ~np.isin(wanted, (1, 2, 4)))


def test_layers_are_pictures_of_a_pixel_a_cell(client: TestClient, shared: SharedStatus) -> None:
    from PIL import Image

    assert client.get("/api/v1/layers/coverage.png").status_code == 404
    small_map(shared)
    risk = example(RiskMap)
    shared.observe("riskmap/risk_map", risk)
    coverage_png = Image.open(io.BytesIO(client.get("/api/v1/layers/coverage.png").content))
    assert coverage_png.size == (26, 16)
    risk_png = np.asarray(Image.open(io.BytesIO(client.get("/api/v1/layers/risk.png").content)))[::-1]
    assert np.array_equal(risk_png[..., 3] > 0, risk.state != 0)
    grey = np.asarray(Image.open(io.BytesIO(client.get("/api/v1/layers/risk.pgm").content)))[::-1]
    assert np.array_equal(grey == 254, risk.state == FREE)


def test_the_graph_reads_with_plain_json_and_networkx(client: TestClient, shared: SharedStatus) -> None:
    shared.observe("irm/global_irm", corridor(1))
    geojson = json.loads(client.get("/api/v1/graph.geojson").content)
    kinds = [f["properties"].get("kind", "edge") for f in geojson["features"]]
    assert kinds == ["breadcrumb"] * 3 + ["frontier"] + ["edge"] * 3
    assert geojson["frame"] == "map"
    graph = nx.read_graphml(io.BytesIO(client.get("/api/v1/graph.graphml").content), node_type=int)
    assert dict(graph.nodes(data="kind")) == {
        1: "breadcrumb",
        2: "breadcrumb",
        3: "breadcrumb",
        4: "frontier",
    }
    assert graph.edges[1, 2]["distance_m"] == 15.0
    assert graph.edges[1, 2]["driven"] is True


def test_coverage_over_time(client: TestClient, shared: SharedStatus) -> None:
    state = example(MissionState)
    for second in range(5):
        shared.observe("mission/state", state.model_copy(update={"elapsed_s": float(second)}))
        shared.observe("irm/coverage", coverage(False, 10.0 + second))
    shared.observe("sim/judge", example(JudgeReport))
    points = client.get("/api/v1/coverage").json()["points"]
    assert [p["elapsed_s"] for p in points] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert points[0]["judge"] is None
    assert points[-1]["covered_area_m2"] == 14.0


def policy(target: int, **more: Any) -> GlobalPolicy:
    told = example(GlobalPolicy)
    values = {"target": target, "target_gain": 26.3, "target_distance_m": 12.1, "target_risk": 0.02, **more}
    return told.model_copy(update=values)  # type: ignore[no-any-return]


def test_events_say_why_in_plain_words(client: TestClient, shared: SharedStatus) -> None:
    shared.observe("gcp/global_policy", policy(41, reason="frontier 41; first target"))
    shared.observe("gcp/global_policy", policy(41, reason="frontier 41; kept"))
    shared.observe("irm/coverage", coverage(False))
    shared.observe("irm/coverage", coverage(False))
    listed = client.get("/api/v1/events").json()
    assert [event["text"] for event in listed["events"]] == [
        "chose frontier 41: 38 cells expected, 12 m, low risk; first target",
        "gave up the frontier at (7.0, 8.0): behind rubble",
    ]
    assert client.get("/api/v1/events", params={"after": 1}).json()["events"][0]["id"] == 2


def test_the_stream_goes_on_after_the_last_event_seen(client: TestClient, shared: SharedStatus) -> None:
    for target in (1, 2, 3):
        shared.observe("gcp/global_policy", policy(target))
    path = "/api/v1/events/stream?once=true"
    whole, rest = client.get(path), client.get(path, headers={"Last-Event-ID": "2"})
    assert whole.headers["content-type"].startswith("text/event-stream")
    ids = [line[4:] for line in whole.text.splitlines() if line.startswith("id: ")]
    assert ids == ["1", "2", "3"]
    lines = [line for line in rest.text.splitlines() if line.startswith(("id", "event", "data"))]
    assert lines[:2] == ["id: 3", "event: target"]
    assert json.loads(lines[2].removeprefix("data: "))["data"]["frontier"] == 3


def test_event_numbers_go_on_after_a_restart(shared: SharedStatus) -> None:
    shared.observe("gcp/global_policy", policy(1))
    twin = SharedStatus(Config(), "husky1")
    twin.restore(shared.snapshot())
    twin.observe("gcp/global_policy", policy(2))
    ids = twin.read(lambda core, now_ns: [event.id for event in core.events.after(0)])
    assert ids[0] == 1
    assert ids[1] > 1


def test_the_planners_tell_their_alternatives(client: TestClient, shared: SharedStatus) -> None:
    shared.observe("gcp/global_policy", policy(41))
    report = client.get("/api/v1/planner").json()
    (other,) = report["alternatives"]
    assert set(other) >= {"gain", "distance_m", "risk", "q", "words"}
    assert report["target"]["id"] == 41
    assert len(report["policy"]) == 3


def test_no_number_that_is_not_finite_gets_into_json(client: TestClient, shared: SharedStatus) -> None:
    assert finite({"a": [math.nan, (math.inf, 1.0)]}) == {"a": [None, [None, 1.0]]}
    shared.configuration = {"limit": math.inf}
    assert client.get("/api/v1/configuration").json() == {"limit": None}


def test_summary_with_more_reasons_than_places_is_no_fault(shared: SharedStatus) -> None:
    shared.observe("irm/coverage", example(CoverageSummary))


def test_a_reader_of_a_life_whose_numbers_were_lost_is_told_everything(
    client: TestClient, shared: SharedStatus
) -> None:
    shared.observe("gcp/global_policy", policy(1))
    assert client.get("/api/v1/events", params={"after": 1}).json()["events"] == []
    assert [e["id"] for e in client.get("/api/v1/events", params={"after": 900}).json()["events"]] == [1]
    stream = client.get("/api/v1/events/stream?once=true", headers={"Last-Event-ID": "900"})
    assert "id: 1\n" in stream.text


@pytest.mark.parametrize(("key", "said"), [("kind", "geofence"), ("frame", "odom")])
def test_a_feature_that_says_another_kind_or_frame_is_not_turned_into_this_one(
    client: TestClient, behind: MissionBehind, key: str, said: str
) -> None:
    """As when fences that were listed are sent back, all as one kind."""
    fine = {"type": "Feature", "geometry": POLYGON, "properties": {"kind": "no_go", "frame": "map"}}
    wrong = {"type": "Feature", "geometry": POLYGON, "properties": {key: said}}
    answer = draw(client, {"type": "FeatureCollection", "features": [fine, wrong]})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == f"body.geojson.features[1].properties.{key}"
    assert said in answer.json()["detail"]
    assert behind.carried_out == []
    assert draw(client, {"type": "FeatureCollection", "features": [fine]}).status_code == 200


def test_every_layer_of_every_kind_is_missing_in_the_same_words(client: TestClient) -> None:
    for name in ("risk", "coverage"):
        for kind in ("png", "pgm", "yaml"):
            answer = client.get(f"/api/v1/layers/{name}.{kind}")
            assert (answer.status_code, name in answer.json()["detail"]) == (404, True)
    assert client.get("/api/v1/layers/gravity.png").status_code == 422


def test_what_the_robot_does_is_said_in_plain_words_and_a_wanted_stop_is_no_warning(
    client: TestClient, shared: SharedStatus
) -> None:
    told: Plan = example(Plan)

    def plan(safety: SafetyState, reason: str) -> None:
        shared.observe("reconciler/plan", told.model_copy(update={"safety": safety, "reason": reason}))

    plan(SafetyState.RUN, "covers: value 1.8 by 4096 simulations")
    state = example(MissionState)
    shared.observe("mission/state", state.model_copy(update={"phase": MissionPhase.PAUSED, "reason": "so"}))
    plan(SafetyState.HOLD, "mission paused")
    shared.observe("mission/state", state.model_copy(update={"phase": MissionPhase.EXPLORE, "reason": "on"}))
    plan(SafetyState.HOLD, "risk map is 1.6 s old")
    plan(SafetyState.HOLD, "risk map is 2.1 s old")
    plan(SafetyState.RUN, "guides to target 4")
    said = [
        (event["severity"], event["text"])
        for event in client.get("/api/v1/events").json()["events"]
        if event["kind"] == "safety"
    ]
    assert said == [
        ("info", "drives on"),
        ("info", "stands still: mission paused"),
        ("warning", "stands still: risk map is 1.6 s old"),
        ("info", "drives on"),
    ]


def test_why_a_target_was_switched_needs_no_symbol(client: TestClient, shared: SharedStatus) -> None:
    reason = "frontier 41; switched, Q 6.29 against -0.52 of frontier 12: gain 0.5, 6 m, risk 0.12"
    shared.observe("gcp/global_policy", policy(41, reason=reason))
    (event,) = client.get("/api/v1/events").json()["events"]
    assert event["text"].endswith(
        "switched, value 6.29 against -0.52 of frontier 12: gain 0.5, 6 m, risk 0.12"
    )
