"""The pulse of a service: a few numbers in a small shared file, written by the service, watched by its supervisor.

Progress, not life: how many steps have ended, and how many heartbeats. A file rather than a message, since it must tell
the truth when the service holds Python's lock in an endless loop, is stopped, or has lost its router.
"""

from __future__ import annotations

import mmap
import os
import struct
import sys
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "PLGRIM_PULSE"
_WORDS = struct.Struct("<5q")


@dataclass(frozen=True, slots=True)
class Reading:
    """What a pulse says. pid: of the service (0: not begun). period_ns: wall time between two steps, 0 before the first
    step may be expected. steps, beats: so many have ended since the process began. compiling: so many kernels are being
    compiled, which happens once for a version of the program and takes long: no fault."""

    pid: int = 0
    period_ns: int = 0
    steps: int = 0
    beats: int = 0
    compiling: int = 0


class Pulse:
    """The writing side; without a file only the process itself can read it."""

    def __init__(self, path: Path | None) -> None:
        """path: made if need be. OSError when it cannot be written."""
        self.supervised = path is not None
        if path is None:
            self._words = memoryview(bytearray(_WORDS.size)).cast("q")
            self._words[0] = os.getpid()
            return
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            os.ftruncate(descriptor, _WORDS.size)
            self._words = memoryview(mmap.mmap(descriptor, _WORDS.size)).cast("q")
        finally:
            os.close(descriptor)
        for index in (1, 2, 3, 4):
            self._words[index] = 0
        self._words[0] = os.getpid()  # last: until then nothing is believed

    @classmethod
    def of_environment(cls) -> Pulse:
        """The pulse that the supervisor has asked for; none when nobody has, or the file cannot be written."""
        path = os.environ.get(VARIABLE, "")
        try:
            return cls(Path(path) if path else None)
        except OSError:
            return cls(None)

    def reading(self) -> Reading:
        """What it says now."""
        return Reading(*self._words)

    def expect(self, period_s: float) -> None:
        """From now on a step ends at least once in `period_s` wall seconds."""
        self._words[1] = max(1, round(period_s * 1e9))

    def stepped(self) -> None:
        """A step has ended."""
        self._words[2] += 1

    def beat(self) -> None:
        """The heartbeat's thread was here."""
        self._words[3] += 1

    def compiling(self, more: int) -> None:
        """One more kernel (1) or one less (-1) is being compiled now; they nest."""
        self._words[4] += more

    def listen_to_numba(self) -> None:
        """Note when numba compiles; not when it loads what was compiled before. For a stage that uses it."""
        if "numba" not in sys.modules:
            return
        from numba.core import event

        count = self.compiling

        class Listener(event.Listener):  # type: ignore[misc]
            """Counts what has begun and not ended."""

            def on_start(self, found: object) -> None:
                count(1)

            def on_end(self, found: object) -> None:
                count(-1)

        event.register("numba:compile", Listener())


def clear_pulse(path: Path) -> None:
    """A new file for a new process: the old one may still be written. OSError when it cannot be made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    path.write_bytes(bytes(_WORDS.size))


def read_pulse(path: Path) -> Reading:
    """What the file says now; all zero when there is none."""
    try:
        content = path.read_bytes()
    except OSError:
        return Reading()
    return Reading(*_WORDS.unpack(content)) if len(content) == _WORDS.size else Reading()
