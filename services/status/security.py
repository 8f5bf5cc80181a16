"""Who may ask the status service for what: bearer tokens with roles, and where it may listen.

Reading is open on a loopback address and in a network without strangers (`trusted_network`), unless `read_token` is
`always`, and needs a token elsewhere; every request that changes something needs the token of an operator,
everywhere. A browser hands its token in once, in the header of `POST /api/v1/session`, and then carries it in a
cookie that no script can read: pictures, event streams and WebSockets cannot send headers. What a request may look
like before anybody reads it is in `guard.py`.

A route is protected by a dependency; an application without `secure` refuses all of them:

    @app.post("/api/v1/pause", dependencies=[Depends(require_operator)])
    @app.get("/api/v1/status", dependencies=[Depends(require_viewer)])
    @app.websocket("/api/v1/stream", dependencies=[Depends(require_viewer_socket)])
"""

from __future__ import annotations

import hashlib
import hmac
import stat
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import Depends, FastAPI, HTTPException, Request, Response, WebSocket, WebSocketException
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel
from starlette.requests import HTTPConnection

from schemas.hosts import is_loopback
from services.status.config import Config
from services.status.guard import Guard

COOKIE = "plgrim_token"
SESSION_PATH = "/api/v1/session"
MIN_TOKEN_CHARS = 20
HASHED = "sha256:"
_POLICY_VIOLATION = 1008
_COOKIE_AGE_S = 12 * 3600


class Role(IntEnum):
    """What a token allows; the higher one includes the lower."""

    viewer = 1
    operator = 2


RoleName = Literal["viewer", "operator"]


class SecurityError(ValueError):
    """A file of tokens that cannot be used, or a listening address that would be open to strangers."""


@dataclass(frozen=True, slots=True)
class Token:
    """Somebody's token. digest: SHA-256 of the secret; a secret is random, so no slow hash is needed."""

    role: Role
    name: str
    digest: bytes


@dataclass(frozen=True, slots=True)
class Access:
    """The tokens of a service, and whether one may read without any."""

    tokens: tuple[Token, ...] = ()
    open_reading: bool = True

    @classmethod
    def of(cls, config: Config) -> Access:
        """The access that the configuration asks for. Raises SecurityError."""
        tokens = read_tokens(Path(config.tokens_file)) if config.tokens_file else ()
        return cls(tokens, config.read_token == "auto" and _is_private(config))

    def who(self, secret: str) -> Token | None:
        """The token with this secret. Takes as long for a wrong secret as for a right one."""
        digest, found = _digest(secret), None
        for token in self.tokens:
            if hmac.compare_digest(token.digest, digest):
                found = token
        return found


def _is_private(config: Config) -> bool:
    """Whether only this host's own programs, or a network without strangers, come to where it listens."""
    return config.trusted_network or is_loopback(config.host)


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).digest()


def read_tokens(path: Path) -> tuple[Token, ...]:
    """The tokens of a file: a line each, `ROLE NAME SECRET` or `ROLE NAME sha256:HEX`; # begins a comment.

    A file that holds a secret itself must be readable by its owner alone. Raises SecurityError.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        mode = stat.S_IMODE(path.stat().st_mode)
    except (OSError, UnicodeDecodeError) as error:
        raise SecurityError(f"{path}: the tokens cannot be read: {error}") from error
    tokens: list[Token] = []
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        tokens.append(_token(words, f"{path}: line {number}"))
        if not words[2].startswith(HASHED) and mode & 0o077:
            raise SecurityError(f"{path}: others may read the secrets in it: chmod 600 {path}")
    names = [token.name for token in tokens]
    if len(set(names)) < len(names):
        raise SecurityError(
            f"{path}: two tokens have the same name; names tell them apart when one is withdrawn"
        )
    return tuple(tokens)


def _token(words: list[str], where: str) -> Token:
    if len(words) != 3 or words[0] not in Role.__members__:
        raise SecurityError(f"{where}: expected `viewer NAME SECRET` or `operator NAME SECRET`")
    role, name, secret = words
    if not secret.startswith(HASHED):
        if len(secret) < MIN_TOKEN_CHARS:
            raise SecurityError(
                f"{where}: the token has less than {MIN_TOKEN_CHARS} characters: make a longer one"
            )
        return Token(Role[role], name, _digest(secret))
    try:
        digest = bytes.fromhex(secret.removeprefix(HASHED))
    except ValueError:
        digest = b""
    if len(digest) != hashlib.sha256().digest_size:
        raise SecurityError(f"{where}: {HASHED} is followed by 64 hexadecimal digits")
    return Token(Role[role], name, digest)


def check_binding(config: Config) -> None:
    """Refuse to listen in the open without TLS. Raises SecurityError with the mend."""
    if reason := config.exposed():
        raise SecurityError(reason)


_bearer = HTTPBearer(auto_error=False, description="A token of the role viewer or operator.")
Bearer = Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]


def _access(connection: HTTPConnection) -> Access:
    access = getattr(connection.app.state, "access", None)
    return access if isinstance(access, Access) else Access((), False)


def _identify(connection: HTTPConnection, header: str | None) -> Token | None:
    """Who asks: by the header, else by the cookie."""
    secret = header if header is not None else connection.cookies.get(COOKIE)
    return _access(connection).who(secret) if secret else None


def _refuse(role: Role, token: Token | None) -> HTTPException:
    if token is not None:
        return HTTPException(
            403, f"the token {token.name!r} is of a {token.role.name}: this needs an {role.name}"
        )
    return HTTPException(
        401,
        f"a token of the role {role.name} is needed: Authorization: Bearer TOKEN",
        {"WWW-Authenticate": "Bearer"},
    )


def require_operator(request: Request, bearer: Bearer) -> Token:
    """Dependency of every route that changes something. 401 without a token, 403 with a viewer's."""
    token = _identify(request, bearer.credentials if bearer else None)
    if token is None or token.role < Role.operator:
        raise _refuse(Role.operator, token)
    return token


def require_viewer(request: Request, bearer: Bearer) -> Token | None:
    """Dependency of every route that shows something; None: reading is open here. 401 without a token."""
    token = _identify(request, bearer.credentials if bearer else None)
    if token is None and not _access(request).open_reading:
        raise _refuse(Role.viewer, None)
    return token


def require_viewer_socket(socket: WebSocket) -> Token | None:
    """Dependency of a WebSocket that shows something: refused before it is accepted."""
    kind, _, secret = socket.headers.get("authorization", "").partition(" ")
    token = _identify(socket, secret.strip() if kind.lower() == "bearer" else None)
    if token is None and not _access(socket).open_reading:
        raise WebSocketException(_POLICY_VIOLATION, "a token is needed")
    return token


class SessionReport(BaseModel):
    """Who one is to the service."""

    role: RoleName | None
    """None: no token was given, or none that is known."""
    name: str = ""
    """The name of the token."""
    open_reading: bool
    """Whether one may read here without a token."""


def _session(request: Request, bearer: Bearer) -> Token:
    token = _identify(request, bearer.credentials if bearer else None)
    if token is None:
        raise _refuse(Role.viewer, None)
    return token


def _report(token: Token | None, request: Request) -> SessionReport:
    role: RoleName | None = (
        None if token is None else ("operator" if token.role is Role.operator else "viewer")
    )
    return SessionReport(
        role=role, name=token.name if token else "", open_reading=_access(request).open_reading
    )


def session(request: Request, bearer: Bearer) -> SessionReport:
    """The role of the token that comes with this request; open to all."""
    return _report(_identify(request, bearer.credentials if bearer else None), request)


def open_session(
    request: Request, response: Response, bearer: Bearer, token: Annotated[Token, Depends(_session)]
) -> SessionReport:
    """Keep the token of the header in a cookie of this browser."""
    if bearer is not None:
        response.set_cookie(
            COOKIE,
            bearer.credentials,
            max_age=_COOKIE_AGE_S,
            httponly=True,
            samesite="strict",
            secure=request.url.scheme == "https",
        )
    return _report(token, request)


def close_session(
    request: Request, response: Response, token: Annotated[Token, Depends(_session)]
) -> SessionReport:
    """Have the browser forget the token."""
    response.delete_cookie(COOKIE)
    return _report(None, request)


def secure(app: FastAPI, config: Config, access: Access | None = None) -> None:
    """Guard an application: its tokens, its session routes, limits of host, origin and body. Raises SecurityError."""
    app.state.access = Access.of(config) if access is None else access
    refused: dict[int | str, dict[str, Any]] = {401: {"description": "no token, or none that is known"}}
    app.get(SESSION_PATH, tags=["access"])(session)
    app.post(SESSION_PATH, tags=["access"], responses=refused)(open_session)
    app.delete(SESSION_PATH, tags=["access"], responses=refused)(close_session)
    # Where one reads without a token, a browser must not be led here by a foreign name (DNS rebinding).
    named = _is_private(config) or config.allowed_hosts
    # This host's own programs ask by these names wherever it listens, and no foreign name can be made to be one.
    hosts = ("127.0.0.1", "localhost", "[::1]") if named else ()
    app.add_middleware(
        Guard,
        hosts=frozenset((*hosts, *config.allowed_hosts)) if named else None,
        origins=frozenset(config.allowed_origins),
        max_body_bytes=config.max_body_bytes,
    )
