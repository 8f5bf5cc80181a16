"""Recordings over a link that drops: the robot's recorder offers its segments, the base fetches what it has not got.

Segments are offered once they are whole, and fetched in pieces, a few at a time, so that a slow link carries commands
beside them. What was fetched of a segment stays over a cut: fetching goes on where it was.
"""

from __future__ import annotations

import json
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import xxhash
import zenoh

from plgrim.logs import get_logger
from plgrim.recording.errors import RecordingError
from plgrim.recording.writer import PART, segments
from plgrim.runtime.zenoh_session import Link
from plgrim.security.access import SEGMENTS_QUERY
from schemas.contract import root_of

_PIECE_BYTES = 64 * 1024


def segments_key(robot: str) -> str:
    """Key on which a recorder answers with its segments, and with a piece of one: `?name=...;offset=...`."""
    return f"{root_of(robot)}/{SEGMENTS_QUERY}"


@dataclass(slots=True)
class Offer:
    """Answers for a folder of segments, on one session or several (of this host's router, of the base's)."""

    folder: Path
    _checksums: dict[tuple[str, int], str] = field(default_factory=dict)
    _queryables: list[Any] = field(default_factory=list)

    def on(self, session: zenoh.Session, robot: str) -> None:
        """Offer on a session until it ends."""
        queryable = session.declare_queryable(segments_key(robot), zenoh.handlers.FifoChannel(32))
        self._queryables.append(queryable)
        handler = queryable.handler
        threading.Thread(target=self._serve, args=(handler,), name="offer", daemon=True).start()

    def _serve(self, handler: Any) -> None:
        while True:
            try:
                query = handler.recv()
            except zenoh.ZError:  # the session has ended
                return
            try:
                asked = {name: str(query.parameters.get(name) or "") for name in ("name", "offset")}
                query.reply(query.key_expr, self.answer(asked))
            except (OSError, ValueError, zenoh.ZError) as error:
                get_logger().warning("segment not given", error=str(error)[:200])
            del query  # finished when it is dropped

    def answer(self, parameters: dict[str, str]) -> bytes:
        """The list of whole segments as JSON, or a piece of one. ValueError for a name that is none of them."""
        whole = {path.name: path for path in segments(self.folder) if path.suffix != PART}
        name = parameters.get("name", "")
        if not name:
            listed = [
                {"name": path.name, "bytes": path.stat().st_size, "xxh3": self._checksum(path)}
                for path in whole.values()
            ]
            return json.dumps(listed).encode()
        if name not in whole:
            raise ValueError(f"no segment {name!r}")
        with whole[name].open("rb") as file:
            file.seek(max(0, int(parameters.get("offset") or 0)))
            return file.read(_PIECE_BYTES)

    def _checksum(self, path: Path) -> str:
        key = (path.name, path.stat().st_size)
        if key not in self._checksums:
            digest = xxhash.xxh3_64()
            with path.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
            self._checksums[key] = digest.hexdigest()
        return self._checksums[key]


@dataclass(slots=True)
class Fetcher:
    """Fetches the segments that a folder has not got.

    kilobytes_per_s: at most so much. timeout_s: for one answer; a link that is cut costs one timeout a round.
    """

    link: Link
    folder: Path
    kilobytes_per_s: float = 100.0
    timeout_s: float = 2.0
    fetched: int = 0
    damaged: int = 0

    def round(self, stop: threading.Event) -> int:
        """Fetch until all is there, the link is gone or `stop`; how many are still missing, -1: no answer."""
        offered = self._ask("")
        if offered is None:
            return -1
        missing = [one for one in json.loads(offered) if not self._has(one)]
        for done, one in enumerate(missing):
            if stop.is_set() or not self._fetch(one, stop):
                return len(missing) - done
        return 0

    def _has(self, one: dict[str, Any]) -> bool:
        path = self.folder / _safe(one["name"])
        return path.exists() and path.stat().st_size == one["bytes"]

    def _ask(self, parameters: str) -> bytes | None:
        key = segments_key(self.link.robot)
        try:
            return self.link.ask(f"{key}?{parameters}" if parameters else key, self.timeout_s)
        except zenoh.ZError:
            return None

    def _fetch(self, one: dict[str, Any], stop: threading.Event) -> bool:
        part = self.folder / f"{_safe(one['name'])}{PART}"
        part.parent.mkdir(parents=True, exist_ok=True)
        with part.open("ab") as file:
            while file.tell() < one["bytes"]:
                began = time.monotonic()
                piece = self._ask(f"name={one['name']};offset={file.tell()}")
                if not piece or stop.is_set():
                    return False
                file.write(piece)
                spent = time.monotonic() - began
                stop.wait(max(0.0, len(piece) / 1000.0 / self.kilobytes_per_s - spent))
        if xxhash.xxh3_64_hexdigest(part.read_bytes()) != one["xxh3"]:
            part.unlink()
            self.damaged += 1
            return True  # the next round fetches it anew
        part.rename(part.with_suffix(""))
        self.fetched += 1
        return True


def _safe(name: str) -> str:
    """A file name from the wire, refused when it is a path. Raises RecordingError."""
    if Path(name).name != name or not name.endswith(".mcap"):
        raise RecordingError(f"segment {name!r}: not the name of a segment")
    return name
