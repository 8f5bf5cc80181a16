"""The HTTP side of the status service."""

from __future__ import annotations

import re

import httpx
import pytest
from fastapi.testclient import TestClient

from schemas.contract import SECOND_NS
from schemas.operation import StageHealth
from schemas.topics import read_by
from services.status.app import PortTakenError, SharedStatus, StatusServer, create_app
from services.status.config import Config
from services.status.report import StatusReport
from tests.schemas.examples import example


class Clock:
    """A monotonic clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.now_ns = SECOND_NS

    def __call__(self) -> int:
        return self.now_ns


def fill(shared: SharedStatus) -> None:
    for topic in read_by("status"):
        message = example(topic.message)
        if isinstance(message, StageHealth):
            message = message.model_copy(update={"service": topic.writer})
        shared.observe(topic.name, message)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def shared(clock: Clock) -> SharedStatus:
    return SharedStatus(Config(), "husky1", clock)


@pytest.fixture
def client(shared: SharedStatus) -> TestClient:
    return TestClient(create_app(shared), base_url="http://127.0.0.1:8080")


def test_alive_is_not_ready(client: TestClient) -> None:
    assert client.get("/healthz").json() == {"status": "ok"}
    answer = client.get("/readyz")
    assert answer.status_code == 503
    assert answer.json()["ready"] is False
    assert "mission: not heard of yet" in answer.json()["reasons"]


def test_ready_then_silent(client: TestClient, shared: SharedStatus, clock: Clock) -> None:
    fill(shared)
    assert client.get("/readyz").status_code == 200
    clock.now_ns += 60 * SECOND_NS
    answer = client.get("/readyz")
    assert answer.status_code == 503
    assert "lcp: silent for 60.0 s" in answer.json()["reasons"]


def test_status_is_typed(client: TestClient, shared: SharedStatus) -> None:
    assert client.get("/api/v1/status").json()["mission"] is None
    fill(shared)
    report = StatusReport.model_validate(client.get("/api/v1/status").json())
    assert report.robot == "husky1"
    assert report.mission is not None
    assert report.mission.phase == "done"
    assert {stage.service for stage in report.stages} >= {"riskmap", "irm", "gcp", "lcp", "reconciler"}


def test_map_before_and_after_data(client: TestClient, shared: SharedStatus) -> None:
    before = client.get("/map.png")
    fill(shared)
    after = client.get("/map.png")
    for answer in (before, after):
        assert answer.status_code == 200
        assert answer.headers["content-type"] == "image/png"
        assert answer.headers["cache-control"] == "no-store"
        assert answer.content.startswith(b"\x89PNG")
    assert before.content != after.content


def test_metrics(client: TestClient, shared: SharedStatus) -> None:
    fill(shared)
    text = client.get("/metrics").text
    assert "plgrim_coverage_belief 0.75" in text
    assert 'plgrim_stage_step_p99_ms{service="gcp"} 0.75' in text
    assert 'plgrim_dropped{reason="sim/cloud:bad_checksum",service="gcp"} 2.0' in text
    assert 'plgrim_link_kb_per_s{topic="sim/cloud:bad_checksum",way="down"} 0.75' in text


def test_page_loads_nothing_from_elsewhere(client: TestClient) -> None:
    page = client.get("/").text
    assert "//" not in page
    for path in re.findall(r'(?:src|href)="([^"]+)"', page):
        assert client.get(f"/{path}").status_code == 200


def test_openapi_names_the_paths(client: TestClient) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    assert set(paths) >= {"/healthz", "/readyz", "/api/v1/status", "/map.png", "/api/v1/session"}
    assert set(paths["/readyz"]["get"]["responses"]) >= {"200", "503"}


def test_serves_and_names_a_taken_port() -> None:
    shared = SharedStatus(Config(port=0), "husky1")
    server = StatusServer(shared)
    server.start()
    try:
        answer = httpx.get(f"http://127.0.0.1:{server.port}/healthz", timeout=30, trust_env=False)
        assert answer.json() == {"status": "ok"}
        with pytest.raises(PortTakenError, match=rf"127\.0\.0\.1:{server.port}.*status\.port"):
            StatusServer(SharedStatus(Config(port=server.port), "husky1"))
    finally:
        server.stop()


def test_unknown_config_keys_are_refused() -> None:
    with pytest.raises(ValueError, match="prot"):
        Config.model_validate({"prot": 1})
