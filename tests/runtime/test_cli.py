"""The command line: exit codes, one-line errors, and the status service as `plgrim run status` runs it."""

from __future__ import annotations

import json
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from plgrim import cli
from plgrim.cli import application
from plgrim.config import Config, load_config
from plgrim.missions import run_lockstep
from plgrim.runtime import lockstep
from plgrim.runtime.health import ask_health
from plgrim.runtime.router import page_address
from plgrim.runtime.zenoh_session import Link
from plgrim.warmup import warm_ups
from schemas.contract import Stage, StageSpec
from schemas.topics import TOPICS
from tests.runtime.fake_services import make_fake
from tests.runtime.helpers import FAKES, REPOSITORY, Start, eventually


def test_the_table_of_topics_names_every_topic() -> None:
    output = CliRunner().invoke(application, ["topics"]).output
    assert all(f"`{topic.name}`" in output for topic in TOPICS)
    assert len({line.count("|") for line in output.splitlines()}) == 1


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["run", "nothing"], 2, "no service 'nothing'"),
        (["explore", "--world", "maze", "--map", "x.yaml"], 2, "exclude each other"),
        (["explore", "--config", "no/such/file.yaml"], 2, "no/such/file.yaml"),
        (["explore", "--map", "no/such/map.yaml"], 2, "no/such/map.yaml"),
        (["explore", "--world", "nowhere"], 2, "'nowhere' is not one of"),
        (["explore", "--world", "maze", "--start", "1000", "1000", "--lockstep"], 2, "sim: "),
        (["healthcheck", "sim", "--timeout", "0.1"], 1, "no Zenoh router"),
        (["status", "--url", "http://127.0.0.1:9"], 1, "no status at"),
    ],
)
def test_errors_are_one_line_and_have_their_code(
    config: Config, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    arguments: list[str], code: int, text: str,
) -> None:  # fmt: skip
    monkeypatch.setattr("sys.argv", ["plgrim", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.app()
    assert ended.value.code == code
    captured = capsys.readouterr()
    assert text in captured.out + captured.err
    assert "Traceback" not in captured.err


def test_an_unknown_key_ends_a_mission_before_it_starts(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("mission: {time_budgets: 3}\n", encoding="utf-8")
    monkeypatch.setattr("sys.argv", ["plgrim", "up", "-c", str(file), "-o", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ended:
        cli.app()
    assert ended.value.code == 2
    assert "'mission.time_budgets': did you mean 'time_budget_s'?" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def _json(address: str) -> dict[str, object]:
    try:
        with urllib.request.urlopen(address, timeout=10.0) as response:
            content: dict[str, object] = json.load(response)
    except urllib.error.HTTPError as error:
        content = json.load(error)
        error.close()
    return content


def test_the_status_service_answers_over_http_and_over_zenoh(
    link: Link, start: Start, free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLGRIM_STATUS__PORT", str(free_port))
    status = start("-m", "plgrim", "run", "status")
    start(str(FAKES), "sim")
    start(str(FAKES), "mission")

    def is_ready() -> bool:
        health = ask_health(link, "status", 1.0)
        return health is not None and health.ready and health.pid == status.pid

    eventually(is_ready, "the status service is ready")
    page = f"http://127.0.0.1:{free_port}"
    assert _json(f"{page}/healthz") == {"status": "ok"}

    def phase() -> object:
        mission = _json(f"{page}/api/v1/status").get("mission")
        return mission.get("phase") if isinstance(mission, dict) else None

    eventually(lambda: phase() == "explore", "the mission's state has come through")
    reasons = _json(f"{page}/readyz")["reasons"]
    assert isinstance(reasons, list)
    assert any("gcp" in reason for reason in reasons)
    health = ask_health(link, "status", 5.0)
    assert health is not None
    assert "irm/coverage" in health.waiting_for
    assert "link/report" not in health.waiting_for, "there is one host only"
    assert CliRunner().invoke(application, ["healthcheck", "status"]).exit_code == 0
    assert CliRunner().invoke(application, ["healthcheck", "mission"]).exit_code == 0
    assert CliRunner().invoke(application, ["healthcheck", "router"]).exit_code == 0
    assert CliRunner().invoke(application, ["healthcheck", "gcp"]).exit_code == 1
    second = start("-m", "plgrim", "run", "status")
    output, _ = second.communicate(timeout=60)
    assert second.returncode == 4
    assert f"{free_port}" in output
    assert "PLGRIM_STATUS__PORT" in output
    status.terminate()
    status.wait(timeout=60)
    assert status.returncode == 0


def test_the_router_refuses_a_taken_port(router: None, start: Start) -> None:
    process = start("-m", "plgrim", "router")
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 4
    assert "PLGRIM_ROUTER" in output


def test_a_watcher_follows_a_mission_to_its_end_and_writes_the_result(
    router: None, start: Start, tmp_path: Path
) -> None:
    watcher = start("-m", "plgrim", "watch", "--out", str(tmp_path))
    start(str(FAKES), "sim")
    start(str(FAKES), "mission", "ends")
    output, _ = watcher.communicate(timeout=60)
    assert watcher.returncode == 0, output
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert (result["finish"], result["world"], result["succeeded"]) == ("covered", "fake", True)
    assert (tmp_path / "map.png").exists()


def test_lock_step_writes_a_result_and_its_speed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def make(name: str, options: object, setup: object) -> tuple[StageSpec, Stage]:
        del options, setup
        return make_fake(name, "ends" if name in ("sim", "mission") else "idle")

    monkeypatch.setattr(lockstep, "make_stage", make)
    result = run_lockstep(load_config(), tmp_path, Console(quiet=True))
    assert result["succeeded"] is True
    assert (result["world"], result["finish"], result["mode"]) == ("fake", "covered", "lockstep")
    assert result["times_real_time"] > 1
    assert result["stages"]["sim"]["steps"] > 20
    assert result["dropped"] == {}
    assert result["digest"] == run_lockstep(load_config(), tmp_path, Console(quiet=True))["digest"]


def test_stages_know_how_to_compile_their_kernels() -> None:
    assert {"riskmap", "gcp", "sim"} <= set(warm_ups())


def test_a_reader_that_has_seen_enough_is_no_error() -> None:
    """As in `plgrim status | head`."""
    script = "from plgrim.commands.inspect import _print; _print('line\\n' * 200_000)"
    process = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=REPOSITORY
    )
    assert process.stdout is not None and process.stderr is not None
    assert process.stdout.readline() == b"line\n"
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait() == 0


@pytest.mark.parametrize(
    ("host", "address"),
    [
        ("0.0.0.0", "http://127.0.0.1:8080/"),
        ("::", "http://127.0.0.1:8080/"),
        ("10.0.0.7", "http://10.0.0.7:8080/"),
        ("::1", "http://[::1]:8080/"),
    ],
)
def test_the_address_of_the_status_page_can_be_opened(host: str, address: str) -> None:
    assert page_address(host, 8080) == address
