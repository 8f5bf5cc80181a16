"""The WebSocket of the live page: the newest state only, and never more than a few frames on their way.

A browser says what it has (`{"boot", "version"}`, or `{}`), and then acknowledges every frame with its version. While
`_UNDERWAY` frames are not acknowledged nothing is sent to it; what changes meanwhile is in the next frame, once. So a
slow browser skips, nothing piles up, and it holds up neither the others nor the robot.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections import deque
from typing import Any, Protocol

from fastapi import FastAPI, WebSocket, WebSocketDisconnect

from services.status.board import Board

_LOG = logging.getLogger(__name__)
LIVE_PATH = "/api/v1/live"
TICK_S = 0.1
_UNDERWAY = 2
_SILENT_S = 15.0
_KEEP_ALIVE_S = 0.5


class LiveSource(Protocol):
    """Whatever draws the board."""

    @property
    def board(self) -> Board: ...

    def tick(self) -> None:
        """Draw what has changed; called from a worker thread, never twice at a time."""


class Ticker:
    """Draws while somebody looks, and wakes those who do. Nobody looks: nothing is drawn."""

    def __init__(self, source: LiveSource, tick_s: float = TICK_S) -> None:
        self.source = source
        self._tick_s = tick_s
        self._looking = 0
        self._task: asyncio.Task[None] | None = None
        self._drawn = asyncio.Event()

    async def __aenter__(self) -> Ticker:
        self._looking += 1
        if self._task is None:
            self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._looking -= 1
        if self._looking == 0 and self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
            self._task = None

    async def _run(self) -> None:
        while True:
            began = time.monotonic()
            try:
                await asyncio.to_thread(self.source.tick)
            except Exception:  # one state that cannot be drawn must not end the page
                _LOG.exception("the live state was not drawn")
            self._drawn.set()
            self._drawn = asyncio.Event()
            await asyncio.sleep(max(self._tick_s - (time.monotonic() - began), 0.01))

    async def next(self) -> None:
        """Wait for the next drawing."""
        await self._drawn.wait()


class Watcher:
    """One browser: what it was sent and what it has acknowledged."""

    def __init__(self, socket: WebSocket, board: Board) -> None:
        self._socket = socket
        self._board = board
        self._underway: deque[int] = deque()
        self._sent = 0
        self._sent_s = time.monotonic()
        self._room = asyncio.Event()

    async def greet(self) -> None:
        """What the browser has of this board's life, if anything."""
        hello = _object(await asyncio.wait_for(self._socket.receive_text(), _SILENT_S))
        if hello.get("boot") == self._board.boot and isinstance(hello.get("version"), int):
            self._sent = min(hello["version"], self._board.version)

    async def listen(self) -> None:
        """Take acknowledgements until the browser goes."""
        while True:
            version = _object(await self._socket.receive_text()).get("version")
            if not isinstance(version, int):
                continue
            while self._underway and self._underway[0] <= version:
                self._underway.popleft()
            self._room.set()

    async def tell(self, ticker: Ticker) -> None:
        """Send what is new after every drawing, as far as the browser keeps up."""
        while True:
            await self._wait_for_room()
            version = self._board.version
            if version != self._sent or time.monotonic() - self._sent_s > _KEEP_ALIVE_S or not self._sent:
                frame = self._board.frame(self._sent)
                self._underway.append(version)
                self._sent, self._sent_s = version, time.monotonic()
                await self._socket.send_bytes(frame)
            await ticker.next()

    async def _wait_for_room(self) -> None:
        """Raises TimeoutError when the browser has not been heard of for long."""
        while len(self._underway) >= _UNDERWAY:
            self._room.clear()
            await asyncio.wait_for(self._room.wait(), _SILENT_S)


def _object(text: str) -> dict[str, Any]:
    try:
        value = json.loads(text) if len(text) < 1000 else None
    except ValueError:
        value = None
    return value if isinstance(value, dict) else {}


def add_live(app: FastAPI, source: LiveSource, dependencies: list[Any] | None = None) -> None:
    """Serve the live state at `LIVE_PATH`. dependencies: who may look, as FastAPI dependencies."""
    ticker = Ticker(source)

    @app.websocket(LIVE_PATH, dependencies=dependencies)
    async def live(socket: WebSocket) -> None:
        await socket.accept()
        watcher = Watcher(socket, source.board)
        with contextlib.suppress(WebSocketDisconnect, TimeoutError):
            async with ticker:
                await watcher.greet()
                await _first(watcher.listen(), watcher.tell(ticker))
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # it has gone by itself
            await socket.close(1001)


async def _first(*works: Any) -> None:
    """Until the first of them ends; the others are ended, and its error is raised."""
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
