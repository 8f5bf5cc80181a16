"""What no request may be, before any route sees it: for another host, from another site's page, too large, too slow."""

from __future__ import annotations

import asyncio
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.status.problems import MEDIA_TYPE, ProblemError, problem_json

_READING = ("GET", "HEAD", "OPTIONS")
_BODY_TIMEOUT_S = 10.0
_HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
)


class RefusedError(Exception):
    """A request that is answered with an error at once."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


class Guard:
    """ASGI middleware.

    hosts: names under which the service may be asked (without port), or None for any; on loopback this keeps out pages
    whose name was made to point here (DNS rebinding). origins: of other pages that may change things, as
    `https://desk:8443`. max_body_bytes: of one request.
    """

    def __init__(
        self, app: ASGIApp, hosts: frozenset[str] | None, origins: frozenset[str], max_body_bytes: int
    ) -> None:
        self._app = app
        self._hosts = hosts
        self._origins = origins
        self._max_body_bytes = max_body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it with 400, 403, 408 or 413."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        try:
            self._check(scope, headers)
            if scope["type"] == "http":
                receive = await self._body(headers, receive)
        except RefusedError as refused:
            await _answer(scope, receive, send, refused)
            return
        await self._app(scope, receive, _with_headers(send))

    def _check(self, scope: Scope, headers: Headers) -> None:
        host = headers.get("host", "")
        if self._hosts is not None and _without_port(host) not in self._hosts:
            raise RefusedError(403, f"this service is not {host!r}: see status.allowed_hosts")
        if scope["type"] == "http" and scope["method"] in _READING:
            return
        origin = headers.get("origin")
        if origin is None:
            if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
                raise RefusedError(403, "a page of another site may not change anything here")
        elif origin not in self._origins and _netloc(origin) != host.lower():
            raise RefusedError(
                403, f"a page of {origin} may not change anything here: see status.allowed_origins"
            )

    async def _body(self, headers: Headers, receive: Receive) -> Receive:
        """The body, read in whole. Raises RefusedError."""
        length = headers.get("content-length")
        if length is None and "transfer-encoding" not in headers:
            return receive
        if length is not None and not (length.isascii() and length.isdigit()):
            raise RefusedError(400, "content-length is not a number")
        if length is not None and int(length) > self._max_body_bytes:
            raise self._too_large()
        try:
            messages = await asyncio.wait_for(self._read(receive), _BODY_TIMEOUT_S)
        except TimeoutError:
            raise RefusedError(408, f"the body did not arrive within {_BODY_TIMEOUT_S:.0f} s") from None
        return _replay(messages, receive)

    async def _read(self, receive: Receive) -> list[Message]:
        messages: list[Message] = []
        size = 0
        while True:
            message = await receive()
            messages.append(message)
            size += len(message.get("body", b""))
            if size > self._max_body_bytes:
                raise self._too_large()
            if message["type"] != "http.request" or not message.get("more_body", False):
                return messages

    def _too_large(self) -> RefusedError:
        return RefusedError(413, f"the body is larger than status.max_body_bytes, {self._max_body_bytes}")


def _replay(messages: list[Message], receive: Receive) -> Receive:
    """The messages that were read, then what still comes."""
    left = iter(messages)

    async def again() -> Message:
        for message in left:
            return message
        return await receive()

    return again


def _without_port(host: str) -> str:
    name, _, port = host.lower().rpartition(":")
    return name if name and port.isdigit() else host.lower()


def _netloc(origin: str) -> str:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS]
        await send(message)

    return sending


async def _answer(scope: Scope, receive: Receive, send: Send, refused: RefusedError) -> None:
    if scope["type"] == "websocket":
        await receive()  # websocket.connect; closing before accepting is answered with 403
        await send({"type": "websocket.close", "code": 1008, "reason": refused.reason[:120]})
        return
    body = problem_json(ProblemError(refused.code, refused.reason))
    headers = [
        (b"content-type", MEDIA_TYPE.encode()),
        (b"content-length", str(len(body)).encode()),
        (b"connection", b"close"),
        *_HEADERS,
    ]
    await send({"type": "http.response.start", "status": refused.code, "headers": headers})
    await send({"type": "http.response.body", "body": body if scope["method"] != "HEAD" else b""})
