"""What would be open to strangers does not start, and says why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from plgrim.cli import application
from plgrim.config import Config, load_config
from plgrim.errors import ConfigError
from plgrim.security.exposure import (
    ExposedError,
    check_client,
    check_host,
    check_link,
    check_listen,
    check_router,
)

OPEN = ["tcp/0.0.0.0:7457", "tcp/[::]:7457", "tcp/192.0.2.1:7457", "tcp/base.local:7457", "ws/0.0.0.0:7457"]


@pytest.mark.parametrize("endpoint", OPEN)
def test_an_open_router_is_refused(endpoint: str) -> None:
    with pytest.raises(ExposedError, match=r"router\.endpoint: .* has no TLS.*plgrim certs issue"):
        check_router(load_config(overrides={"router": {"endpoint": endpoint}}))
    with pytest.raises(ExposedError, match=r"router\.listen"):
        check_router(load_config(overrides={"router": {"listen": [endpoint]}}))


def test_what_stays_on_the_host_needs_no_tls() -> None:
    for endpoint in (
        "tcp/127.0.0.1:7457",
        "tcp/[::1]:7457",
        "tcp/localhost:7457",
        "unixsock-stream//run/router",
    ):
        check_router(load_config(overrides={"router": {"endpoint": endpoint}}))


def test_connections_to_other_hosts_need_tls() -> None:
    with pytest.raises(ExposedError, match=r"router\.connect"):
        check_client(load_config(overrides={"router": {"connect": "tcp/base:7457"}}), "gcp")
    with pytest.raises(ExposedError, match=r"link\.endpoint"):
        check_link(load_config(overrides={"link": {"endpoint": "tcp/base:7447", "host": "robot"}}))
    with pytest.raises(ConfigError, match=r"router\.certificates"):
        check_link(load_config(overrides={"link": {"endpoint": "tls/base:7447", "host": "robot"}}))


@pytest.mark.parametrize(
    "option", ["enable_mtls=false", "so_sndbuf=8192;root_ca_certificate_file=/tmp/mine.pem"]
)
def test_options_behind_an_endpoint_cannot_take_tls_away(option: str) -> None:
    """Zenoh prefers them to its configuration: with the first, a stranger without a certificate was let in."""
    open_to_all = f"tls/0.0.0.0:7447#{option}"
    for router in ({"endpoint": open_to_all}, {"listen": [open_to_all]}):
        with pytest.raises(ExposedError, match="could take the protection away"):
            check_router(load_config(overrides={"router": router}))
    with pytest.raises(ExposedError, match=r"router\.connect"):
        check_client(load_config(overrides={"router": {"connect": f"tls/base:7457#{option}"}}), "gcp")
    with pytest.raises(ExposedError, match=r"link\.endpoint"):
        check_link(load_config(overrides={"link": {"endpoint": f"tls/base:7447#{option}", "host": "robot"}}))
    check_router(load_config(overrides={"router": {"endpoint": "tcp/127.0.0.1:7457#so_sndbuf=8192"}}))


@pytest.mark.parametrize(
    ("published", "refused"), [("none", False), ("127.0.0.1", False), ("0.0.0.0", True), ("", True)]
)
def test_a_container_is_as_open_as_it_is_published(published: str, refused: bool) -> None:
    overrides: dict[str, Any] = {
        "router": {"endpoint": OPEN[0]},
        "status": {"host": "0.0.0.0"},
        "deployment": {"published_on": published},
    }
    config = load_config(overrides=overrides)
    if refused:
        with pytest.raises(ExposedError):
            check_host(config)
    else:
        check_host(config)


def test_an_open_status_page_is_refused() -> None:
    with pytest.raises(ExposedError, match=r"status\.host: 0\.0\.0\.0 .*no TLS"):
        check_host(load_config(overrides={"status": {"host": "0.0.0.0"}}))


@pytest.mark.parametrize(
    "command",
    [["pause"], ["fences"], ["watch"], ["healthcheck", "gcp"], ["record"], ["fetch"]],
    ids=" ".join,
)
def test_tools_do_not_talk_to_another_host_in_the_clear(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PLGRIM_ROUTER", "tcp/192.0.2.1:7457")
    result = CliRunner().invoke(application, command)
    assert isinstance(result.exception, ExposedError), result.output


def test_a_recorder_does_not_offer_its_segments_in_the_clear(tmp_path: Path) -> None:
    arguments = ["record", "--out", str(tmp_path), "--base", "tcp/192.0.2.1:7447"]
    result = CliRunner().invoke(application, arguments)
    assert isinstance(result.exception, ExposedError), result.output


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "robot.local"])
def test_foxglove_is_shown_to_this_host_alone(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its WebSocket has neither TLS nor tokens."""
    result = CliRunner().invoke(application, ["foxglove", "--host", host, "--port", "0"])
    assert isinstance(result.exception, ExposedError), result.output
    assert host in str(result.exception)
    for published_on in ("none", "127.0.0.1"):
        check_listen(host, Config.model_validate({"deployment": {"published_on": published_on}}))
    check_listen("127.0.0.1", Config())


@pytest.mark.parametrize("command", [["router"], ["up"], ["run", "gcp"]])
def test_the_commands_refuse_to_start(command: list[str], tmp_path: Path) -> None:
    """The deployment file as a user would write it."""
    file = tmp_path / "open.yaml"
    file.write_text("router: {endpoint: 'tcp/0.0.0.0:7457', connect: 'tcp/192.0.2.1:7457'}\n")
    out = ["--out", str(tmp_path / "out")] if command == ["up"] else []
    result = CliRunner().invoke(application, [*command, "--config", str(file), *out])
    assert isinstance(result.exception, ExposedError), result.output
    assert not (tmp_path / "out").exists()
