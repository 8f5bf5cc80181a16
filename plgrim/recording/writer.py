"""Writes recordings: MCAP files of the profile ros2, chunked and compressed, in segments that form a ring on disk."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from plgrim.logs import get_logger
from plgrim.recording.describe import describe_schemas
from plgrim.recording.envelope import (
    ENVELOPE_TYPE,
    RAW_PREFIX,
    Raw,
    definition,
    pack_raw,
    to_cdr,
)
from plgrim.recording.well_known import Shown

_CHUNK_BYTES = 1024 * 1024
PART = ".part"
"""Of the name of the segment that is being written."""


class SegmentWriter:
    """One MCAP file. Not thread safe. Raises OSError."""

    def __init__(self, path: Path, about: dict[str, str]) -> None:
        self.path = path
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="plgrim")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[int, int] = {}
        # Written first: a file that is cut off still says what it is.
        self._writer.add_metadata("plgrim", about)
        schemas = json.dumps(describe_schemas(), indent=1).encode()
        self._writer.add_attachment(0, 0, "schemas.json", "application/json", schemas)

    @property
    def size_bytes(self) -> int:
        """On disk so far; up to a chunk waits in memory."""
        return self._file.tell()

    def _channel(self, topic: str, message_type: str) -> int:
        if topic not in self._channels:
            if message_type not in self._schemas:
                text = definition(message_type).encode()
                self._schemas[message_type] = self._writer.register_schema(message_type, "ros2msg", text)
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", self._schemas[message_type], {"offered_qos_profiles": ""}
            )
        return self._channels[topic]

    def add_raw(self, raw: Raw) -> None:
        """A message as it was on the wire, on a channel of its own."""
        self._add(RAW_PREFIX + raw.topic, ENVELOPE_TYPE, pack_raw(raw), raw.sent_ns)

    def add_shown(self, shown: Shown, stamp_ns: int) -> None:
        """A ROS message that shows one."""
        topic, message = shown
        self._add(topic, message.__msgtype__, to_cdr(message), stamp_ns)

    def _add(self, topic: str, message_type: str, data: bytes, stamp_ns: int) -> None:
        channel = self._channel(topic, message_type)
        sequence = self._counts[channel] = self._counts.get(channel, 0) + 1
        self._writer.add_message(channel, stamp_ns, data, stamp_ns, sequence)

    def close(self) -> None:
        """Write the index and wait for the disk."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is, after an error."""
        with contextlib.suppress(OSError):
            self._file.close()


class Ring:
    """Segments in a folder, named by start and number; the oldest go when they are too many bytes together.

    segment_s: wall seconds of a segment. max_bytes: of all of them; 0 keeps all. about: written into each. A full
    disk ends a segment: nothing is recorded until there is room again, and `trouble` says so.
    """

    def __init__(
        self,
        folder: Path,
        about: dict[str, str],
        segment_s: float = 60.0,
        max_bytes: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.folder, self.trouble = folder, ""
        self._about, self._segment_s, self._max_bytes, self._clock = about, segment_s, max_bytes, clock
        folder.mkdir(parents=True, exist_ok=True)
        self._writer: SegmentWriter | None = None
        self._next = 1 + max((_number(path) for path in folder.glob("*.mcap*")), default=0)
        self._ends_s = 0.0
        self._retry_s = 0.0
        self.lost = 0
        for left in folder.glob(
            f"*.mcap{PART}"
        ):  # of a life that was killed: what is whole in it can be read
            left.rename(left.with_suffix(""))

    def add(self, raw: Raw, shown: list[Shown], stamp_ns: int) -> None:
        """A message and what shows it."""
        now = self._clock()
        if self._writer is not None and now >= self._ends_s:
            self._end()
        if self._writer is None:
            if now < self._retry_s:
                self.lost += 1
                return
            self._begin(now)
        if self._writer is None:
            self.lost += 1
            return
        try:
            self._writer.add_raw(raw)
            for one in shown:
                self._writer.add_shown(one, stamp_ns)
        except OSError as error:
            self._fail(error)

    def _begin(self, now: float) -> None:
        path = self.folder / f"{time.strftime('%Y%m%dT%H%M%S')}-{self._next:06d}.mcap{PART}"
        try:
            self._make_room()
            self._writer = SegmentWriter(path, {**self._about, "segment": str(self._next)})
        except OSError as error:
            self._fail(error)
            return
        self._next += 1
        self._ends_s = now + self._segment_s
        self.trouble = ""

    def _fail(self, error: OSError) -> None:
        if not self.trouble:
            get_logger().error("nothing is recorded", reason=str(error), folder=str(self.folder))
        if self._writer is not None:
            self._writer.abandon()
        self.trouble, self._writer, self._retry_s = str(error), None, self._clock() + 5.0

    def _end(self) -> None:
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.close()
            writer.path.rename(writer.path.with_suffix(""))
        except OSError as error:
            writer.abandon()
            self._fail(error)

    def _make_room(self) -> None:
        """Oldest first, until what is left and one segment more of their mean size have room."""
        if not self._max_bytes:
            return
        held = sorted(self.folder.glob("*.mcap"), key=_number)
        sizes = [path.stat().st_size for path in held]
        while sizes and sum(sizes) + max(sizes) > self._max_bytes:
            held.pop(0).unlink(missing_ok=True)
            sizes.pop(0)

    def close(self) -> None:
        """End the segment that is being written."""
        self._end()


def _number(path: Path) -> int:
    """Number of a segment, 0 when the name is none."""
    digits = path.name.split(".")[0].rpartition("-")[2]
    return int(digits) if digits.isdigit() else 0


def segments(path: Path) -> list[Path]:
    """The files of a recording in order: a file, or a folder of segments (one being written is the last)."""
    if path.is_dir():
        return sorted((p for p in path.iterdir() if ".mcap" in p.name and _number(p)), key=_number) or sorted(
            path.glob("*.mcap")
        )
    return [path]


def about(robot: str, seed: int, world: str, extra: dict[str, Any] | None = None) -> dict[str, str]:
    """The metadata record `plgrim` of a recording."""
    found = {
        "robot": robot, "seed": str(seed), "world": world, "format": "1",
        "wall_time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "stamps": "mission clock, ns",
    }  # fmt: skip
    return {**found, **{key: str(value) for key, value in (extra or {}).items()}}
