"""The doctor names what is wrong and what mends it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from plgrim.cli import application
from plgrim.config import Config
from plgrim.doctor import machine
from plgrim.doctor.certificates import certificates
from plgrim.doctor.system import service_finding
from plgrim.runtime.zenoh_session import Link
from schemas.operation import StageHealth
from tests.runtime.helpers import FAKES, Start, eventually


def _health(service: str, **other: Any) -> StageHealth:
    values: dict[str, Any] = {
        "stamp_ns": 1, "service": service, "ready": True, "steps": 1, "step_p50_ms": 1.0, "step_p99_ms": 2.0,
        "rate_hz": 5.0, "memory_mb": 9.0, "pid": 7, "errors": 0, "last_error": "", "dropped": {}, "waiting_for": [],
    }  # fmt: skip
    return StageHealth(**{**values, **other})


def test_a_service_that_waits_is_told_with_the_topic_and_who_should_have_sent_it() -> None:
    health = {"irm": _health("irm", waiting_for=["riskmap/risk_map"])}
    found = service_finding("irm", health)
    assert found.level == "warning"
    assert "riskmap/risk_map" in found.says
    assert "riskmap, which is not heard: start it" in found.mend
    health["riskmap"] = _health("riskmap", waiting_for=["sim/cloud"])
    assert "riskmap, which itself waits for sim/cloud" in service_finding("irm", health).mend
    assert service_finding("gcp", health).level == "error"
    assert service_finding("sim", {"sim": _health("sim")}).level == "ok"
    assert "boom" in service_finding("sim", {"sim": _health("sim", errors=2, last_error="boom")}).says


def test_a_running_system_is_examined_over_the_wire(link: Link, start: Start, config: Config) -> None:
    start(str(FAKES), "mission")
    eventually(lambda: link.tokens("plgrim/@v1/robot/mission/alive/*"), "the fake lives")
    result = CliRunner().invoke(application, ["doctor", "--json", "--listen", "5"])
    answer = json.loads(result.stdout)
    findings = {f["name"]: f for f in answer["findings"]}
    assert result.exit_code == 1  # most services are not there
    assert not answer["healthy"]
    assert findings["router"]["level"] == "ok"
    assert "sim/odometry" in findings["mission"]["says"]
    assert findings["sim"]["level"] == "error"
    assert findings["router port"]["level"] == "ok"


def test_without_a_system_it_says_how_to_start_one(config: Config) -> None:
    result = CliRunner().invoke(application, ["doctor", "--listen", "0"])
    assert "plgrim up" in result.output
    assert "status port" in result.output


def test_a_taken_port_is_named_with_the_key_that_mends_it(link: Link, config: Config) -> None:
    number = int(config.router.endpoint.rpartition(":")[2])
    found = machine.port("status port", "127.0.0.1", number, "", "PLGRIM_STATUS__PORT")
    assert found.level == "error"
    assert "PLGRIM_STATUS__PORT" in found.mend


def test_a_full_or_locked_disk_and_a_cold_cache_are_named(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("U", (), {"free": 1e6})())
    assert machine.disk(config).level == "error"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "empty"))
    found = machine.kernels()
    assert (found.level, "plgrim.warmup" in found.mend) == ("warning", True)
    monkeypatch.setattr("time.time", lambda: 3600.0)
    assert machine.clock(config).level == "error"


def _certificate(folder: Path, days: int) -> Path:
    folder.mkdir()
    command = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:prime256v1",
        "-nodes",
    ]
    files = ["-keyout", str(folder / "key.pem"), "-out", str(folder / "cert.pem")]
    try:
        subprocess.run(
            [*command, *files, "-days", str(days), "-subj", "/CN=x"], check=True, capture_output=True
        )
    except FileNotFoundError:
        pytest.skip("no openssl program")
    (folder / "key.pem").chmod(0o600)
    (folder / "trusted.pem").write_bytes((folder / "cert.pem").read_bytes())
    return folder


def test_certificates_that_end_are_open_or_missing_are_named(tmp_path: Path) -> None:
    assert [f.level for f in certificates(tmp_path)] == ["error"]
    good = _certificate(tmp_path / "gcp", 365)
    assert [f.level for f in certificates(tmp_path)] == ["ok"]
    (good / "key.pem").chmod(0o644)
    (found,) = certificates(tmp_path)
    assert (found.level, found.mend) == ("error", f"chmod 600 {good / 'key.pem'}")
    (good / "key.pem").chmod(0o600)
    _certificate(tmp_path / "irm", 3)
    (found,) = certificates(tmp_path)
    assert (found.level, found.name) == ("warning", "certificate irm")
    (good / "trusted.pem").unlink()
    assert {f.level for f in certificates(tmp_path)} == {"warning", "error"}


def test_the_doctor_takes_a_moment_only(config: Config) -> None:
    command = [sys.executable, "-m", "plgrim", "doctor", "--listen", "0"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert "Traceback" not in answer.stderr
    assert "cores" in answer.stdout
