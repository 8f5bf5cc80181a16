"""The live state in named parts, each packed once for all browsers: who is behind gets the parts that changed."""

from __future__ import annotations

import secrets
import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import msgpack

_GONE = msgpack.packb(None)
_KEPT_FRAMES = 8
_KEPT_GONE = 256
"""So many parts are remembered as gone. A browser that has not heard of an older one gets everything."""


@dataclass(slots=True)
class _Part:
    version: int
    packed: bytes


def _new_boot() -> str:
    return secrets.token_hex(6)


@dataclass(slots=True)
class Board:
    """What a browser shows, as parts by key. Drawn by one thread, read by another.

    version: grows with every change of a part. boot: of this board's life; a browser that comes back with another one
    gets everything anew.
    """

    boot: str = field(default_factory=_new_boot)
    version: int = 0
    _parts: dict[str, _Part] = field(default_factory=dict)
    _frames: dict[int, bytes] = field(default_factory=dict)
    _gone: deque[str] = field(default_factory=deque)
    _forgot: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def put(self, key: str, value: Any) -> None:
        """Set a part: numbers, text, lists, maps and bytes. Nothing changes when it is as it was."""
        self._set(key, msgpack.packb(value))

    def drop(self, key: str) -> None:
        """Take a part away; browsers that have it are told."""
        if key in self._parts:
            self._set(key, _GONE)

    def keep_only(self, prefix: str, wanted: set[str]) -> None:
        """Drop the parts whose key begins with the prefix and is not wanted."""
        for key in [key for key in self._parts if key.startswith(prefix) and key not in wanted]:
            self.drop(key)

    def _set(self, key: str, packed: bytes) -> None:
        part = self._parts.get(key)
        if part is not None and part.packed == packed:
            return
        with self._lock:
            self.version += 1
            self._parts[key] = _Part(self.version, packed)
            self._frames.clear()
            if packed == _GONE:
                self._forget(key)

    def _forget(self, key: str) -> None:
        """This part has gone; the one that went longest ago is not told any more when there are many."""
        self._gone.append(key)
        if len(self._gone) > _KEPT_GONE:
            oldest = self._gone.popleft()
            part = self._parts[oldest]
            if part.packed == _GONE and oldest not in self._gone:
                self._forgot = max(self._forgot, part.version)
                del self._parts[oldest]

    def frame(self, since: int) -> bytes:
        """One frame: {boot, version, full, parts}. since: version that the browser has; 0: everything.

        A part that is None is gone. Browsers that are as far as each other get the same bytes, put together once.
        """
        with self._lock:
            made = self._frames.get(since)
            if made is None:
                if len(self._frames) >= _KEPT_FRAMES:
                    self._frames.clear()
                made = self._frames[since] = self._make(since)
            return made

    def _make(self, since: int) -> bytes:
        full = since <= 0 or since < self._forgot
        chosen = [
            (key, part.packed)
            for key, part in self._parts.items()
            if (full or part.version > since) and not (full and part.packed == _GONE)
        ]
        packer = msgpack.Packer(autoreset=False)
        packer.pack_map_header(4)
        for key, value in (("boot", self.boot), ("version", self.version), ("full", full)):
            packer.pack(key)
            packer.pack(value)
        packer.pack("parts")
        packer.pack_map_header(len(chosen))
        pieces = [packer.bytes()]
        for key, packed in chosen:
            pieces += (msgpack.packb(key), packed)
        return b"".join(pieces)
