"""Compose files and systemd units say what `plgrim.deployment` says, and open nothing."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from fastapi.testclient import TestClient

from plgrim.config import Config, check_service, environment_overrides, load_config
from plgrim.deployment import Role, services_of, started_by_up
from plgrim.errors import ConfigError
from plgrim.security.access import RECORDER
from schemas.hosts import is_loopback
from schemas.topics import LINK, SERVICES
from services.status.app import SharedStatus, create_app
from services.status.config import Config as StatusConfig

ROOT = Path(__file__).resolve().parents[2]
COMPOSE: dict[Role, Path] = {
    "all": ROOT / "docker-compose.yml",
    "robot": ROOT / "deploy" / "robot.yml",
    "base": ROOT / "deploy" / "base.yml",
}
_BESIDE = {"all": {"router", "explore"}, "robot": {"router", LINK}, "base": {"router", RECORDER}}


def composed(role: Role) -> dict[str, dict[str, Any]]:
    services = yaml.safe_load(COMPOSE[role].read_text(encoding="utf-8"))["services"]
    assert isinstance(services, dict)
    return services


def default(value: str) -> str:
    """A value as it is when no variable is set."""
    return re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", value)


@pytest.mark.parametrize("role", ["all", "robot", "base"])
def test_compose_files_have_the_services_of_their_role(role: Role) -> None:
    services = composed(role)
    assert set(services) == set(services_of(role)) | _BESIDE[role]
    for name, service in services.items():
        if name in SERVICES:
            assert service["command"] == f"run {name}"


@pytest.mark.parametrize("role", ["robot", "base"])
def test_each_container_has_its_own_certificate_read_only(role: Role) -> None:
    for name, service in composed(role).items():
        mounts = [mount for mount in service["volumes"] if mount.endswith(":/etc/plgrim/certs:ro")]
        assert len(mounts) == 1 and default(mounts[0]).startswith(f"../certs/{role}/{name}:"), name


@pytest.mark.parametrize("role", ["robot", "base"])
def test_whatever_has_an_epoch_keeps_it(role: Role) -> None:
    """Without the volume a link that restarts with a clock set back is refused by all who heard its last life."""
    for name, service in composed(role).items():
        assert name in ("router", RECORDER) or "state:/var/lib/plgrim" in service["volumes"], name


@pytest.mark.parametrize("role", ["all", "robot", "base"])
def test_health_checks_ask_about_the_service_of_their_container(role: Role) -> None:
    checks = {
        name: service.get("healthcheck", {}).get("test", []) for name, service in composed(role).items()
    }
    for name, check in checks.items():
        if name not in ("router", "explore"):
            assert check == ["CMD", "plgrim", "healthcheck", name]


def test_the_base_records_onto_a_volume_that_does_not_grow_for_ever() -> None:
    recorder = composed("base")[RECORDER]
    assert default(recorder["command"]) == "record --out /recordings --max-mb 4000"
    assert "recordings:/recordings" in [default(mount) for mount in recorder["volumes"]]
    image = (ROOT / "deploy" / "Dockerfile").read_text(encoding="utf-8")
    assert re.search(r"install -d -o plgrim -g plgrim .*/recordings\b", image), (
        "a volume has its folder's owner"
    )


def test_a_router_that_dies_does_not_end_the_services() -> None:
    """systemd restarts whatever `Requires` a unit along with it."""
    for unit in (ROOT / "deploy" / "systemd").glob("*.service"):
        assert not re.search(r"^(Requires|BindsTo)=", unit.read_text(encoding="utf-8"), re.MULTILINE), (
            unit.name
        )


@pytest.mark.parametrize("role", ["all", "robot", "base"])
def test_what_is_published_has_tls_or_is_for_this_host_alone(role: Role) -> None:
    for name, service in composed(role).items():
        tls = str(service["environment"].get("PLGRIM_ROUTER", "")).startswith("tls/")
        for port in service.get("ports", ()):
            address = default(port).rpartition(":")[0].rpartition(":")[0]
            assert (name == "router" and tls) or is_loopback(address), f"{name}: {port}"


@pytest.mark.parametrize("role", ["all", "robot", "base"])
def test_the_environment_of_each_container_is_a_valid_configuration(
    role: Role, monkeypatch: pytest.MonkeyPatch
) -> None:
    for service in composed(role).values():
        with monkeypatch.context() as patch:
            environment = {k: default(str(v)) for k, v in service["environment"].items()}
            for variable, value in environment.items():
                patch.setenv(variable, re.sub(r"\$\{PLGRIM_BASE:\?[^}]*\}", "base.local", value))
            assert environment_overrides(environment)
            assert load_config().link.host == ("" if role == "all" else role)


@pytest.mark.parametrize("path", ["/api/v1/status", "/metrics", "/map.png"])
def test_the_page_of_the_compose_file_can_be_read_where_it_is_published(
    path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the environment of its container, as a browser of the host asks: no token, and not by another name."""
    for variable, value in composed("all")["status"]["environment"].items():
        monkeypatch.setenv(variable, default(str(value)))
    options = check_service(load_config(), "status")
    assert isinstance(options, StatusConfig) and options.exposed() == ""
    page = create_app(SharedStatus(options, "robot"))
    for host, refused in (("127.0.0.1", False), ("localhost", False), ("evil.example", True)):
        answer = TestClient(page, base_url=f"http://{host}:8080").get(path)
        assert (answer.status_code == 403) is refused and answer.status_code != 401, (host, answer.text)


def test_a_restarted_container_finds_its_journal_and_a_new_run_finds_none() -> None:
    """`docker-compose.yml` is run again and again: its journals last as long as its containers."""
    for name, service in composed("all").items():
        kept = "state:/var/lib/plgrim" in service.get("volumes", ())
        assert kept == (name in SERVICES), name
        assert service["environment"]["PLGRIM_RUNTIME__STATE_DIR"] == "/var/lib/plgrim"
    volumes = yaml.safe_load(COMPOSE["all"].read_text(encoding="utf-8"))["volumes"]
    assert volumes["state"]["driver_opts"]["type"] == "tmpfs"


@pytest.mark.parametrize("role", ["robot", "base"])
def test_systemd_targets_want_the_services_of_their_role(role: Role) -> None:
    text = (ROOT / "deploy" / "systemd" / f"plgrim-{role}.target").read_text(encoding="utf-8")
    wanted = re.search(r"^Wants=(.*)$", text, re.MULTILINE)
    assert wanted is not None
    units = {unit for unit in wanted[1].split() if unit.startswith("plgrim@")}
    assert units == {f"plgrim@{name}.service" for name in services_of(role, simulated=False)}
    beside = {"plgrim-router.service", f"plgrim-{'link' if role == 'robot' else 'recorder'}.service"}
    assert set(wanted[1].split()) - units == beside


def _unit_environment(unit: Path) -> dict[str, str]:
    lines = re.findall(r"^Environment=(.*)$", unit.read_text(encoding="utf-8"), re.MULTILINE)
    return dict(pair.split("=", 1) for line in lines for pair in line.split())


def test_journals_outlive_a_boot_wherever_they_are_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The monotonic clock begins anew at each boot: what was journaled before then seems to be of the future."""
    found = [(unit.name, _unit_environment(unit)) for unit in (ROOT / "deploy" / "systemd").glob("*.service")]
    for role in ("robot", "base"):
        found += [(f"{role}.yml {n}", s["environment"]) for n, s in composed(role).items()]
    config_file = tmp_path / "plgrim.yaml"
    config_file.write_text("{}\n", encoding="utf-8")
    for name, environment in found:
        with monkeypatch.context() as patch:
            for variable in ("PLGRIM_RUNTIME__STATE_DIR", "PLGRIM_CLOCK__SOURCE"):
                if variable in environment:
                    patch.setenv(variable, environment[variable])
            config = load_config(config_file)
            assert config.runtime.state_dir and config.clock.source == "realtime", name


def test_what_hangs_is_replaced_where_no_supervisor_watches() -> None:
    for unit in ("plgrim@.service", "plgrim-link.service"):
        text = (ROOT / "deploy" / "systemd" / unit).read_text(encoding="utf-8")
        assert "Type=notify\n" in text and "WatchdogSec=8\n" in text and "StartLimitBurst=6\n" in text, unit
    for file in COMPOSE.values():
        for name, service in yaml.safe_load(file.read_text(encoding="utf-8"))["services"].items():
            assert service["environment"]["PLGRIM_RUNTIME__WATCHDOG"] == "true", f"{file.name}: {name}"


def test_systemd_units_are_confined() -> None:
    for unit in (ROOT / "deploy" / "systemd").glob("*.service"):
        text = unit.read_text(encoding="utf-8")
        for line in (
            "NoNewPrivileges=yes",
            "ProtectSystem=strict",
            "CapabilityBoundingSet=\n",
            "User=plgrim",
        ):
            assert line in text, f"{unit.name}: {line}"


def test_what_up_starts() -> None:
    robot = {"host": "robot", "endpoint": "tls/base:7447"}
    started = started_by_up(Config.model_validate({"link": robot}))
    assert set(started) == set(SERVICES) - {"status"} | {LINK}
    assert started_by_up(Config.model_validate({"link": {"host": "base"}})) == ("gcp", "status")
    assert started_by_up(Config()) == SERVICES
    real = Config.model_validate({"link": robot, "deployment": {"simulated": False}})
    assert "sim" not in started_by_up(real)
    with pytest.raises(ConfigError, match=r"link\.endpoint"):
        started_by_up(Config.model_validate({"link": {"host": "robot"}}))
