"""Compose files and systemd units say what `plgrim.deployment` says, and open nothing."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from plgrim.config import Config, environment_overrides, load_config
from plgrim.deployment import Role, services_of, started_by_up
from plgrim.errors import ConfigError
from plgrim.security.access import RECORDER
from schemas.hosts import is_loopback
from schemas.topics import LINK, SERVICES

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


@pytest.mark.parametrize("role", ["robot", "base"])
def test_systemd_targets_want_the_services_of_their_role(role: Role) -> None:
    text = (ROOT / "deploy" / "systemd" / f"plgrim-{role}.target").read_text(encoding="utf-8")
    wanted = re.search(r"^Wants=(.*)$", text, re.MULTILINE)
    assert wanted is not None
    units = {unit for unit in wanted[1].split() if unit.startswith("plgrim@")}
    assert units == {f"plgrim@{name}.service" for name in services_of(role, simulated=False)}
    beside = {"plgrim-router.service", f"plgrim-{'link' if role == 'robot' else 'recorder'}.service"}
    assert set(wanted[1].split()) - units == beside


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
