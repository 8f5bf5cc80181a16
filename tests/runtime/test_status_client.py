"""The programs of the status service's own host reach it over HTTPS, with the token where reading needs one."""

from __future__ import annotations

import hashlib
import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from plgrim import cli
from plgrim.cli import application
from plgrim.config import Config, load_config
from plgrim.doctor.certificates import page_certificate
from plgrim.doctor.examine import examine
from plgrim.missions import status_page
from plgrim.runtime.router import page_address
from services.status.app import SharedStatus, StatusServer
from services.status.config import Config as StatusConfig

SECRET = "operator-secret-0123456789"
Serve = Callable[..., StatusServer]


def _issue(folder: Path, name: str = "base.local") -> Path:
    """A certificate of its own making, with its key beside it."""
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"]
    files = ["-keyout", str(folder / f"{name}.key"), "-out", str(folder / f"{name}.crt")]
    try:
        subprocess.run(
            [*command, "-nodes", "-days", "30", *files, "-subj", f"/CN={name}"],
            check=True,
            capture_output=True,
        )
    except FileNotFoundError:
        pytest.skip("no openssl program")
    (folder / f"{name}.key").chmod(0o600)
    return folder / f"{name}.crt"


@pytest.fixture
def serve(config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Serve]:
    """Serves HTTPS with a certificate, and configures this process as that host."""
    servers: list[StatusServer] = []

    def begin(certificate: Path, **options: object) -> StatusServer:
        files = {
            "tls_certificate_file": str(certificate),
            "tls_key_file": str(certificate.with_suffix(".key")),
        }
        settings = {"port": 0, **files, **options}
        server = StatusServer(SharedStatus(StatusConfig.model_validate(settings), "robot"))
        server.start()
        servers.append(server)
        for key, value in {**settings, "port": server.port}.items():
            text = value if isinstance(value, str | int) else json.dumps(value)
            monkeypatch.setenv(f"PLGRIM_STATUS__{key.upper()}", str(text))
        return server

    yield begin
    for server in servers:
        server.stop()


def test_the_page_of_a_service_with_a_certificate_is_https(serve: Serve, tmp_path: Path) -> None:
    server = serve(_issue(tmp_path))
    assert status_page(load_config()) == f"https://127.0.0.1:{server.port}/"
    assert page_address("::1", 8443, secure=True) == "https://[::1]:8443/"


def test_healthcheck_and_doctor_trust_the_configured_certificate_and_no_other(
    serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As in a container that is published under names of its own.
    serve(_issue(tmp_path), host="0.0.0.0", allowed_hosts=["base.local"])
    answer = CliRunner().invoke(application, ["healthcheck", "status"])
    assert (answer.exit_code, answer.output) == (0, "status: healthy\n")
    port = next(f for f in examine(load_config(), 0.0) if f.name == "status port")
    assert (port.level, "serves the page" in port.says) == ("ok", True)
    other = _issue(tmp_path, "other.local")
    monkeypatch.setenv("PLGRIM_STATUS__TLS_CERTIFICATE_FILE", str(other))
    answer = CliRunner().invoke(application, ["healthcheck", "status"])
    assert answer.exit_code == 1
    assert "CERTIFICATE_VERIFY_FAILED" in answer.output


def test_status_gives_a_token_where_reading_needs_one(
    serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tokens, hashed, own = tmp_path / "tokens", tmp_path / "hashed", tmp_path / "own"
    tokens.write_text(f"operator anna {SECRET}\n", encoding="utf-8")
    hashed.write_text(f"viewer v sha256:{hashlib.sha256(SECRET.encode()).hexdigest()}\n", encoding="utf-8")
    own.write_text(f"{SECRET}\n", encoding="utf-8")
    tokens.chmod(0o600)
    serve(_issue(tmp_path), tokens_file=str(tokens), read_token="always")
    answer = CliRunner().invoke(application, ["status"])
    assert answer.exit_code == 0
    assert json.loads(answer.stdout)["robot"] == "robot"
    monkeypatch.setenv("PLGRIM_STATUS__TOKENS_FILE", str(hashed))
    monkeypatch.setattr("sys.argv", ["plgrim", "status"])
    with pytest.raises(SystemExit):
        cli.app()
    said = capsys.readouterr().err
    assert "a token of the role viewer is needed" in said
    assert "--token-file" in said
    assert CliRunner().invoke(application, ["status", "--token-file", str(own)]).exit_code == 0


def test_the_doctor_looks_at_the_pages_certificate(tmp_path: Path) -> None:
    certificate = _issue(tmp_path)
    key = certificate.with_suffix(".key")
    assert [f.level for f in page_certificate(certificate, key)] == ["ok"]
    key.chmod(0o644)
    assert [f.mend for f in page_certificate(certificate, key) if f.level == "error"] == [f"chmod 600 {key}"]
    (missing,) = (f for f in page_certificate(certificate, tmp_path / "none") if f.level == "error")
    assert "tls_key_file" in missing.says
    (broken,) = (f for f in page_certificate(key, certificate) if "no certificate" in f.says)
    assert "status.tls_certificate_file" in broken.mend
