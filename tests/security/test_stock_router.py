"""The printed configuration in a process that has Zenoh and nothing of ours, as a stock zenohd is.

There is no zenohd where these tests run. What stands in does with the file what zenohd's `main` does: read it, switch
the admin space and the loading of plugins on (zenohd always does), open a session, and wait.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh
from typer.testing import CliRunner

from plgrim.cli import application
from plgrim.config import Config
from plgrim.errors import NoRouterError
from plgrim.runtime.zenoh_session import Link
from schemas.contract import root_of
from schemas.topics import GLOBAL_POLICY, MISSION
from tests.runtime.helpers import eventually
from tests.security.conftest import ROBOT
from tests.security.helpers import free_port, joined, secured

_STOCK = """
import sys, zenoh
config = zenoh.Config.from_file(sys.argv[1])
config.insert_json5("adminspace/enabled", "true")
config.insert_json5("plugins_loading/enabled", "true")
session = zenoh.open(config)
assert not [name for name in sys.modules if name.split(".")[0] in ("plgrim", "schemas", "services", "planning")]
print("listens", flush=True)
sys.stdin.read()
session.close()
"""


def printed(monkeypatch: pytest.MonkeyPatch, config: Config, folder: Path) -> Path:
    """What `plgrim router --print-config` prints, in a file."""
    monkeypatch.setenv("PLGRIM_ROBOT", config.robot)
    monkeypatch.setenv("PLGRIM_ROUTER", config.router.endpoint)
    monkeypatch.setenv("PLGRIM_ROUTER__CERTIFICATES", config.router.certificates or "''")
    answer = CliRunner().invoke(application, ["router", "--print-config"])
    assert answer.exit_code == 0, answer.output
    file = folder / "router.json5"
    file.write_text(answer.stdout, encoding="utf-8")
    return file


@contextmanager
def stock(file: Path) -> Iterator[None]:
    """A router from the file, in a bare process."""
    command = [sys.executable, "-I", "-c", _STOCK, str(file)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd="/"
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "listens\n"
            yield
        finally:
            process.communicate(timeout=60)
            assert process.returncode == 0


def told_of_itself(link: Link) -> list[str]:
    """What the router's admin space answers; the session's own is no secret to it."""
    mine = f"@/{link.session.info.zid()}/"
    keys = [str(reply.ok.key_expr) for reply in link.session.get("@/**", timeout=2.0) if reply.ok]
    return [key for key in keys if not key.startswith(mine)]


def test_a_stock_router_with_the_printed_file_guards_as_ours_does(
    certificates: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = secured(ROBOT, certificates)
    with stock(printed(monkeypatch, config, tmp_path)):
        with joined(config, "gcp") as gcp, joined(config, "mission") as mission, joined(config, "lcp") as lcp:
            heard: list[tuple[str, bytes]] = []
            lcp.session.declare_subscriber(
                f"{root_of(ROBOT)}/**", lambda s: heard.append((str(s.key_expr), s.payload.to_bytes()))
            )
            lcp.session.declare_subscriber(
                GLOBAL_POLICY.key(ROBOT), lambda s: heard.append((str(s.key_expr), s.payload.to_bytes()))
            )
            eventually(lambda: heard, "gcp is heard", lambda: gcp.publish(GLOBAL_POLICY, b"go there"))
            mission.session.put(GLOBAL_POLICY.key(ROBOT), b"forged")
            gcp.session.put(MISSION.key(ROBOT), b"forged")
            gcp.publish(GLOBAL_POLICY, b"and there")
            eventually(lambda: heard[-1][1] == b"and there", "heard to the end")
            assert b"forged" not in {payload for _, payload in heard}
            assert told_of_itself(lcp) == []
        plain = config.router.model_copy(update={"endpoint": config.router.endpoint.replace("tls/", "tcp/")})
        with pytest.raises(NoRouterError):
            joined(config.model_copy(update={"router": plain}), "gcp", 1.0)


def test_its_admin_space_is_closed_also_where_no_access_control_stands_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = Config.model_validate({"robot": ROBOT, "router": {"endpoint": f"tcp/127.0.0.1:{free_port()}"}})
    file = printed(monkeypatch, config, tmp_path)
    settings = json.loads(file.read_text(encoding="utf-8"))
    with stock(file), joined(config, "gcp") as link:
        assert told_of_itself(link) == []
    del settings["adminspace"]["permissions"]  # so that the question above can be answered
    file.write_text(json.dumps(settings), encoding="utf-8")
    with stock(file), joined(config, "gcp") as link:
        assert told_of_itself(link) != []


def test_zenoh_refuses_a_key_that_it_does_not_know(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So the file that it reads has none: no protection is lost to a name that a version has changed."""
    config = Config.model_validate({"robot": ROBOT, "router": {"endpoint": f"tcp/127.0.0.1:{free_port()}"}})
    file = printed(monkeypatch, config, tmp_path)
    zenoh.Config.from_file(str(file))
    file.write_text(json.dumps({**json.loads(file.read_text()), "acess_control": {}}), encoding="utf-8")
    with pytest.raises(zenoh.ZError):
        zenoh.Config.from_file(str(file))
