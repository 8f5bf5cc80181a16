"""The certificate authority, and what real Zenoh sessions make of its certificates."""

from __future__ import annotations

import datetime as dt
import json
import os
import stat
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zenoh
from typer.testing import CliRunner

from plgrim.cli import application
from plgrim.config import RouterConfig
from plgrim.errors import NoRouterError
from plgrim.security.certificates import (
    CERTIFICATE,
    KEY,
    TRUSTED,
    Authority,
    CertificateError,
    common_name,
    utc_now,
)
from tests.faults.system import build_clock_shim
from tests.runtime.helpers import REPOSITORY, eventually
from tests.security.conftest import ROBOT
from tests.security.helpers import joined, routing, secured

_REFUSED_AFTER_S = 0.5
"""A refused handshake shows as a timeout of one try (2 s); then no other try is made."""


def test_files_and_their_modes(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "ca")
    authority.issue("gcp.base.husky1", tmp_path / "out", ["base.local", "10.0.0.2"])
    modes = {p.name: stat.S_IMODE(p.stat().st_mode) for p in (tmp_path / "out").iterdir()}
    assert modes == {CERTIFICATE: 0o644, KEY: 0o600, TRUSTED: 0o644}
    assert stat.S_IMODE((tmp_path / "ca" / "ca.key").stat().st_mode) == 0o600
    assert common_name(tmp_path / "out" / CERTIFICATE) == "gcp.base.husky1"
    text = subprocess.run(
        ["openssl", "x509", "-noout", "-text", "-in", str(tmp_path / "out" / CERTIFICATE)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "DNS:base.local, IP Address:10.0.0.2" in text
    assert "ASN1 OID: prime256v1" in text
    chain = str(tmp_path / "out" / CERTIFICATE)
    verified = subprocess.run(
        ["openssl", "verify", "-CAfile", str(tmp_path / "ca" / "ca.pem"), "-untrusted", chain, chain],
        capture_output=True,
        text=True,
        check=False,
    )
    assert verified.returncode == 0, verified.stderr


@pytest.mark.parametrize("issued", [utc_now(), dt.datetime(2040, 2, 29, tzinfo=dt.UTC)], ids=["now", "later"])
def test_a_clock_that_starts_at_zero_refuses_no_certificate(issued: dt.datetime, tmp_path: Path) -> None:
    """As of a robot without a battery after a power cut; the end is judged all the same."""
    authority = Authority.create(tmp_path / "ca", now=issued)
    authority.issue("gcp.robot.husky1", tmp_path / "out", now=issued)
    chain, year_s = str(tmp_path / "out" / CERTIFICATE), 365 * 86400

    def verifies(at_s: int, *trust: str) -> bool:
        command = ["openssl", "verify", "-attime", str(at_s), *trust, "-untrusted", chain, chain]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0

    trusted = ("-partial_chain", "-CAfile", str(tmp_path / "out" / TRUSTED))
    root = ("-CAfile", str(tmp_path / "ca" / "ca.pem"))
    now_s = int(issued.timestamp())
    for trust in (trusted, root):
        assert [verifies(at_s, *trust) for at_s in (60, 20 * year_s, now_s, now_s + 364 * 86400)] == [
            True
        ] * 4
        assert not verifies(now_s + year_s + 86400, *trust)


_AT_ZERO = """
import sys, threading, time
from pathlib import Path
from plgrim.runtime.zenoh_session import connect
from tests.security.helpers import joined, routing, secured
assert time.time() < 1e6, time.time()
config = secured("husky1", Path(sys.argv[1]))
with routing(config):
    joined(config, "gcp", 10.0).close()
print("joined")
"""


def test_processes_find_one_another_over_tls_when_the_clock_starts_at_zero(
    certificates: Path, tmp_path: Path
) -> None:
    """Zenoh's own judgement: a router and a client in a process whose wall clock was never set."""
    shim = build_clock_shim(tmp_path)
    if shim is None:
        pytest.skip("no C compiler for the clock's shim")
    offset = tmp_path / "offset"
    offset.write_bytes(struct.pack("q", -time.time_ns() + 60 * 10**9))
    environment = {**os.environ, "LD_PRELOAD": str(shim), "CLOCK_OFFSET": str(offset)}
    found = subprocess.run(
        [sys.executable, "-c", _AT_ZERO, str(certificates)],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
        cwd=REPOSITORY,
    )
    assert found.stdout.endswith("joined\n"), found.stdout + found.stderr


def test_what_is_refused(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "ca")
    with pytest.raises(CertificateError, match="already"):
        Authority.create(tmp_path / "ca")
    with pytest.raises(CertificateError, match="plgrim certs init"):
        Authority(tmp_path / "none")
    authority.issue("gcp.base.husky1", tmp_path / "out")
    with pytest.raises(CertificateError, match="--renew"):
        authority.issue("gcp.base.husky1", tmp_path / "again")
    for name in ("", "a b", "a..b", "../x", "x" * 33):
        with pytest.raises(CertificateError, match="no name"):
            authority.issue(name, tmp_path / "out")
    with pytest.raises(CertificateError, match="neither"):
        authority.issue("router.base.husky1", tmp_path / "out", ["base local"])
    with pytest.raises(CertificateError, match="no valid certificate"):
        authority.revoke("lcp.base.husky1")


def test_states(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "ca")
    long_ago = utc_now() - dt.timedelta(days=60)
    authority.issue("old", tmp_path / "old", days=30, now=long_ago)
    authority.issue("kept", tmp_path / "kept")
    authority.issue("renewed", tmp_path / "renewed")
    authority.issue("renewed", tmp_path / "renewed", renew=True)
    authority.issue("gone", tmp_path / "gone")
    authority.revoke("gone")
    states = [(record.name, record.state(utc_now())) for record in Authority(tmp_path / "ca").records()]
    assert states == [
        ("old", "expired"),
        ("kept", "valid"),
        ("renewed", "revoked"),
        ("renewed", "valid"),
        ("gone", "revoked"),
    ]
    assert authority.trusted().count(b"BEGIN CERTIFICATE") == 2


def test_only_certificates_that_are_valid_come_in(
    authority: Authority, certificates: Path, tmp_path: Path
) -> None:
    """No, foreign, expired and revoked certificates, beside a good one that comes in before and after."""
    trusted = (certificates / "router" / TRUSTED).read_bytes()
    name = f"gcp.all.{ROBOT}"
    foreign = Authority.create(tmp_path / "foreign-ca")
    foreign.issue(name, tmp_path / "foreign")
    authority.issue("expired", tmp_path / "expired", days=1, now=utc_now() - dt.timedelta(days=2))
    issuer = authority.folder / "issuers" / f"{authority.records()[-1].serial}.pem"
    authority.issue("revoked", tmp_path / "revoked")
    authority.revoke("revoked")
    own = tmp_path / "own"
    for process in ("router", "gcp"):
        (own / process).mkdir(parents=True)
        for file in (CERTIFICATE, KEY):
            (own / process / file).write_bytes((certificates / process / file).read_bytes())
        (own / process / KEY).chmod(0o600)
        # The issuer of the expired one is trusted here, so that it is the date that is judged.
        (own / process / TRUSTED).write_bytes(trusted + issuer.read_bytes())
    config = secured(ROBOT, own)
    with routing(config):
        joined(config, "gcp").close()
        for folder in ("foreign", "expired", "revoked"):
            (tmp_path / folder / TRUSTED).write_bytes(
                trusted
            )  # the router's is good: only the client's is judged
            stranger = config.router.model_copy(update={"certificates": str(tmp_path / folder)})
            with pytest.raises(NoRouterError, match="one of the certificates was refused"):
                joined(config.model_copy(update={"router": stranger}), "gcp", _REFUSED_AFTER_S)
        plain = RouterConfig(endpoint=config.router.endpoint.replace("tls/", "tcp/"))
        with pytest.raises(NoRouterError):
            joined(config.model_copy(update={"router": plain}), "gcp", _REFUSED_AFTER_S)
        joined(config, "gcp").close()


def test_a_client_without_a_certificate_is_refused(certificates: Path, tmp_path: Path) -> None:
    """One that knows whom to trust but has nothing to show."""
    config = secured(ROBOT, certificates)
    tls = {"root_ca_certificate": str(certificates / "gcp" / TRUSTED)}
    settings = {
        "mode": "client",
        "scouting": {"multicast": {"enabled": False}},
        "connect": {"endpoints": [config.router.endpoint], "timeout_ms": 1500},
        "transport": {"link": {"tls": tls}},
    }
    with routing(config), pytest.raises(zenoh.ZError):
        zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


def test_a_router_with_another_hosts_certificate_is_refused(authority: Authority, tmp_path: Path) -> None:
    """Wrong name on the listening side: a stolen certificate of another host does not make a router."""
    authority.issue("router.all.other", tmp_path / "router", ["other.example"])
    authority.issue("gcp.all.other", tmp_path / "gcp")
    authority.trust(tmp_path)
    config = secured("other", tmp_path)
    with routing(config), pytest.raises(NoRouterError, match="for another host name"):
        joined(config, "gcp", _REFUSED_AFTER_S)


def test_a_running_router_heeds_a_revocation(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "ca")
    for process in ("router", "gcp", "lcp"):
        hosts = ["127.0.0.1"] if process == "router" else []
        authority.issue(f"{process}.all.{ROBOT}", tmp_path / "certs" / process, hosts)
    authority.trust(tmp_path / "certs")
    config = secured(ROBOT, tmp_path / "certs")
    with routing(config):
        kept, gone = joined(config, "lcp"), joined(config, "gcp")
        authority.revoke(f"gcp.all.{ROBOT}")
        authority.trust(tmp_path / "certs")
        eventually(lambda: not list(gone.session.info.routers_zid()), "the revoked one loses its router")
        eventually(lambda: list(kept.session.info.routers_zid()), "the others come back")
        with pytest.raises(NoRouterError):
            joined(config, "gcp", _REFUSED_AFTER_S)
        assert not list(gone.session.info.routers_zid())
        kept.close()
        gone.close()


def test_a_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    Authority.create(tmp_path / "ca").issue("router.all.robot", tmp_path / "router", ["127.0.0.1"])
    (tmp_path / "router" / KEY).chmod(0o640)
    config = secured("robot", tmp_path)
    with pytest.raises(CertificateError, match="chmod 600"):
        joined(config, "router", _REFUSED_AFTER_S)


def test_the_commands(tmp_path: Path) -> None:
    def run(*arguments: str) -> str:
        result = CliRunner().invoke(application, ["certs", *arguments], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.output

    ca, out = str(tmp_path / "ca"), str(tmp_path / "certs")
    run("init", "--ca", ca)
    run("issue", "--ca", ca, "--role", "base", "--robot", "husky1", "--host", "base.local", "--out", out)
    assert {p.name for p in (tmp_path / "certs").iterdir()} == {
        "router",
        "gcp",
        "recorder",
        "status",
        "supervisor",
        "tools",
        "operator",
    }
    run("revoke", "gcp.base.husky1", "--ca", ca)
    assert "renewed" in run("trust", "--ca", ca, "--out", out)
    listed = run("list", "--ca", ca)
    assert "revoked  gcp.base.husky1" in listed
    assert "valid    router.base.husky1" in listed
