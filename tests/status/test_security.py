"""Who may do what over HTTP: tokens, roles, hosts, origins, bodies."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from fastapi import Depends, FastAPI, WebSocket
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from services.status.app import SharedStatus, StatusServer, create_app
from services.status.config import Config
from services.status.security import (
    COOKIE,
    SESSION_PATH,
    SecurityError,
    check_binding,
    read_tokens,
    require_operator,
    require_viewer,
    require_viewer_socket,
    secure,
)

ANNA, VICTOR = "anna-0123456789-abcdefgh", "victor-0123456789-abcdefgh"
BASE = "http://127.0.0.1:8080"


def bearer(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


@pytest.fixture
def tokens_file(tmp_path: Path) -> Path:
    path = tmp_path / "tokens"
    hashed = hashlib.sha256(VICTOR.encode()).hexdigest()
    path.write_text(f"# role name secret\noperator anna {ANNA}\nviewer victor sha256:{hashed}\n")
    path.chmod(0o600)
    return path


def application(config: Config) -> FastAPI:
    app = FastAPI()
    secure(app, config)

    @app.post("/change", dependencies=[Depends(require_operator)])
    def change(body: dict[str, int]) -> int:
        return len(body)

    @app.get("/show", dependencies=[Depends(require_viewer)])
    def show() -> str:
        return "shown"

    @app.websocket("/stream", dependencies=[Depends(require_viewer_socket)])
    async def stream(socket: WebSocket) -> None:
        await socket.accept()
        await socket.send_text("hello")
        await socket.close()

    return app


def client(tokens_file: Path, **options: object) -> TestClient:
    config = Config.model_validate({"tokens_file": str(tokens_file), **options})
    return TestClient(application(config), base_url=BASE)


def test_who_may_change(tokens_file: Path) -> None:
    asking = client(tokens_file)
    refused = asking.post("/change", json={})
    assert refused.status_code == 401
    assert refused.headers["www-authenticate"] == "Bearer"
    assert asking.post("/change", json={}, headers=bearer("wrong")).status_code == 401
    assert asking.post("/change", json={}, headers=bearer(VICTOR)).status_code == 403
    assert asking.post("/change", json={}, headers=bearer(ANNA)).status_code == 200


def test_who_may_read_on_loopback_and_elsewhere(tokens_file: Path) -> None:
    assert client(tokens_file).get("/show").status_code == 200
    for options in ({"read_token": "always"}, {"host": "192.0.2.1"}):
        asking = client(tokens_file, **options)
        assert asking.get("/show").status_code == 401
        assert asking.get("/show", headers=bearer(VICTOR)).status_code == 200
        with pytest.raises(WebSocketDisconnect), asking.websocket_connect("/stream"):
            pass
        with asking.websocket_connect(
            "/stream", headers={**bearer(VICTOR), "host": "127.0.0.1:8080"}
        ) as socket:
            assert socket.receive_text() == "hello"


def test_without_tokens_or_without_being_secured_nothing_may_be_changed(tokens_file: Path) -> None:
    no_tokens = TestClient(application(Config()), base_url=BASE)
    assert no_tokens.post("/change", json={}, headers=bearer(ANNA)).status_code == 401
    assert no_tokens.post("/change", json={}, headers=bearer("")).status_code == 401
    forgotten = FastAPI()
    forgotten.post("/change", dependencies=[Depends(require_operator)])(lambda: 1)
    forgotten.get("/show", dependencies=[Depends(require_viewer)])(lambda: 1)
    asking = TestClient(forgotten, base_url=BASE)
    assert asking.post("/change", headers=bearer(ANNA)).status_code == 401
    assert asking.get("/show").status_code == 401


def test_a_browser_keeps_its_token_in_a_cookie(tokens_file: Path) -> None:
    asking = client(tokens_file, read_token="always")
    assert asking.get(SESSION_PATH).json() == {"role": None, "name": "", "open_reading": False}
    assert asking.post(SESSION_PATH).status_code == 401
    opened = asking.post(SESSION_PATH, headers=bearer(ANNA))
    assert opened.json()["role"] == "operator"
    cookie = opened.headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=strict" in cookie
    assert asking.post("/change", json={}).status_code == 200
    assert asking.get(SESSION_PATH).json()["name"] == "anna"
    assert asking.delete(SESSION_PATH).status_code == 200
    assert COOKIE not in asking.cookies
    assert asking.post("/change", json={}).status_code == 401


@pytest.mark.parametrize(
    ("headers", "code"),
    [
        ({}, 200),
        ({"Origin": BASE}, 200),
        ({"Origin": "https://desk.example"}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "http://127.0.0.1:9999"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://[evil"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({"Host": "evil.example:8080"}, 403),
        ({"Host": ""}, 403),
        ({"Host": "robot.example"}, 200),
    ],
)
def test_other_sites_and_other_names_are_refused(
    tokens_file: Path, headers: dict[str, str], code: int
) -> None:
    asking = client(tokens_file, allowed_origins=["https://desk.example"], allowed_hosts=["robot.example"])
    assert asking.post("/change", json={}, headers={**bearer(ANNA), **headers}).status_code == code


def test_a_page_of_another_site_gets_no_stream(tokens_file: Path) -> None:
    asking = client(tokens_file)
    with (
        pytest.raises(WebSocketDisconnect),
        asking.websocket_connect("/stream", headers={"origin": "http://evil"}),
    ):
        pass


def test_large_bodies_are_refused_announced_or_not(tokens_file: Path) -> None:
    asking = client(tokens_file, max_body_bytes=1024)
    json_headers = {**bearer(ANNA), "Content-Type": "application/json"}
    body = b'{"a": ' + b" " * 2000 + b"1}"
    assert asking.post("/change", content=body, headers=bearer(ANNA)).status_code == 413
    assert (
        asking.post("/change", content=iter([body[:1000], body[1000:]]), headers=bearer(ANNA)).status_code
        == 413
    )
    chunked = asking.post("/change", content=iter([b'{"a":', b"1}"]), headers=json_headers)
    assert (chunked.status_code, chunked.json()) == (200, 1)
    assert (
        asking.post("/change", content=body, headers={"Content-Length": "-5", **bearer(ANNA)}).status_code
        == 400
    )


@pytest.mark.parametrize(
    ("text", "mode", "reason"),
    [
        (f"operator anna {ANNA}", 0o644, "chmod 600"),
        ("operator anna short", 0o600, "characters"),
        (f"admin anna {ANNA}", 0o600, "line 1"),
        (f"operator {ANNA}", 0o600, "line 1"),
        ("viewer v sha256:12", 0o600, "hexadecimal"),
        (f"operator anna {ANNA}\nviewer anna {VICTOR}", 0o600, "same name"),
    ],
)
def test_files_of_tokens_that_are_refused(tmp_path: Path, text: str, mode: int, reason: str) -> None:
    path = tmp_path / "tokens"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(SecurityError, match=reason):
        read_tokens(path)
    with pytest.raises(SecurityError, match="cannot be read"):
        read_tokens(tmp_path / "none")


def test_an_open_address_without_tls_is_refused() -> None:
    for host in ("127.0.0.1", "::1", "localhost", "127.8.8.8"):
        check_binding(Config(host=host))
    for host in ("0.0.0.0", "::", "192.0.2.1", "robot.local"):
        with pytest.raises(SecurityError, match=r"no TLS.*status\.tls_certificate_file"):
            StatusServer(SharedStatus(Config(host=host, port=0), "robot"))
        check_binding(Config(host=host, trusted_network=True))
    with pytest.raises(SecurityError, match="both"):
        check_binding(Config(tls_certificate_file="a.crt"))


def test_answers_tell_browsers_to_keep_to_what_was_said(tokens_file: Path) -> None:
    answer = TestClient(create_app(SharedStatus(Config(), "robot")), base_url=BASE).get("/healthz")
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["x-frame-options"] == "DENY"


def test_a_network_without_strangers_reads_openly_under_the_names_of_loopback() -> None:
    """In docker-compose.yml the page listens on every interface of a container and is published on loopback: it must
    be readable there without a token, and no page whose name was made to point here may read it."""

    def ask(host: str, path: str = "/show", **config: object) -> int:
        settings = Config.model_validate({"trusted_network": True, "host": "0.0.0.0", **config})
        return TestClient(application(settings), base_url=f"http://{host}:8080").get(path).status_code

    for host in ("127.0.0.1", "localhost", "[::1]"):
        assert ask(host) == 200
        assert ask(host, read_token="always") == 401
        assert ask(host, allowed_hosts=["robot.example"]) == 200
    assert ask("robot.example", allowed_hosts=["robot.example"]) == 200
    assert ask("evil.example", allowed_hosts=["robot.example"]) == 403
    assert ask("anything.example") == 403


def test_elsewhere_any_name_will_do_and_a_token_is_needed() -> None:
    settings = Config(host="0.0.0.0", tls_certificate_file="a.crt", tls_key_file="a.key")
    asking = TestClient(application(settings), base_url="http://anything.example:8080")
    assert asking.get("/show").status_code == 401


def test_what_the_guard_refuses_is_a_problem_as_every_other_error(tokens_file: Path) -> None:
    asking = client(tokens_file, max_body_bytes=1024)
    large = asking.post("/change", content=b" " * 2000, headers=bearer(ANNA))
    foreign = asking.get("/show", headers={"Host": "evil.example"})
    for answer, status in ((large, 413), (foreign, 403)):
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["status"] == status
        assert answer.json()["title"]
        assert "status." in answer.json()["detail"]
