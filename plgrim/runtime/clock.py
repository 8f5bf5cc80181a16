"""The live mission clock: the one place where the runtime reads the machine's clock."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from plgrim.config import ClockConfig
from plgrim.logs import get_logger
from plgrim.runtime.durable import make_folder, sync_folder
from schemas.contract import SECOND_NS, Stamp

_BOOT = Path("/proc/sys/kernel/random/boot_id")
_ANCHOR = "wall_clock"
_AFTER_LAST_NS = 10 * SECOND_NS
"""After a reboot the mission clock goes on at least so much after the newest snapshot, later than all that was said."""


@dataclass(frozen=True, slots=True)
class MissionClock:
    """Mission time from the machine's clock: `(CLOCK_MONOTONIC - origin_ns) * speed`.

    CLOCK_MONOTONIC is system wide on Linux, so that all processes of a host share it, and no step of the wall clock
    moves it. Ages of messages are differences of this clock: stale limits are in mission time.
    """

    speed: float = 1.0
    origin_ns: int = 0

    @classmethod
    def of(cls, config: ClockConfig, state_dir: str = "") -> MissionClock:
        """The clock of a configuration. state_dir: of the services of this host, which share the offset kept there.

        `realtime` reads the wall clock once: at the first start of a boot. A step of it afterwards (NTP, an operator)
        would else make every message stale, end time budgets, or have a stage wait for an hour.
        """
        if config.source != "realtime":
            return cls(config.speed, config.origin_ns)
        return cls(config.speed, config.origin_ns - wall_offset_ns(config, state_dir))

    def now_ns(self) -> Stamp:
        """Mission clock, ns; 0 before the origin."""
        passed_ns = time.monotonic_ns() - self.origin_ns
        # Since 1970 so many ns have passed that a float is off by 100.
        return max(0, passed_ns if self.speed == 1.0 else int(passed_ns * self.speed))

    def wall_seconds(self, mission_ns: int) -> float:
        """Wall seconds that a span of mission time takes."""
        return mission_ns / self.speed / SECOND_NS


def boot_id() -> str:
    """Which boot of the machine this is; empty where that is not known."""
    try:
        return _BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def wall_offset_ns(config: ClockConfig, state_dir: str) -> int:
    """CLOCK_REALTIME - CLOCK_MONOTONIC as it was at the first start in this boot; of this moment without a folder.

    After a power cut the wall clock may be behind (no battery): never so far that the journals would be of the future.
    """
    mine = time.time_ns() - time.monotonic_ns()
    if not state_dir:
        return mine
    folder = Path(state_dir)
    path = folder / f"{_ANCHOR}.{boot_id()}"
    try:
        if (kept := _read(path)) is not None:
            return kept
        last = _last_saved_ns(folder)
        if last is not None:
            earliest_ns = int(last / config.speed) + config.origin_ns + _AFTER_LAST_NS
            mine = max(mine, earliest_ns - time.monotonic_ns())
        return _keep_first(path, mine)
    except OSError as error:
        get_logger().warning("the clock's offset is not kept", file=str(path), error=str(error))
        return mine


def _read(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii"))
    except (FileNotFoundError, ValueError):
        return None


def _keep_first(path: Path, offset_ns: int) -> int:
    """Write the file, unless another process was faster; what it says. It appears whole or not at all."""
    make_folder(path.parent)
    descriptor, fresh = tempfile.mkstemp(dir=path.parent, prefix=f"{path.name}.")
    try:
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(str(offset_ns))
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(FileExistsError):
            os.link(fresh, path)
    finally:
        os.unlink(fresh)
    for old in path.parent.glob(f"{_ANCHOR}.*"):  # of boots before
        if not old.name.startswith(path.name):
            old.unlink(missing_ok=True)
    sync_folder(path.parent)
    kept = _read(path)
    return offset_ns if kept is None else kept


def _last_saved_ns(folder: Path) -> int | None:
    """Mission clock of the newest snapshot in the journals below a folder; None without any."""
    found: list[int] = []
    for path in folder.glob("*/*.sqlite"):
        with contextlib.suppress(sqlite3.Error):
            with contextlib.closing(sqlite3.connect(path)) as connection:
                rows = connection.execute("SELECT saved_ns FROM generation").fetchall()
            found += [row[0] for row in rows if isinstance(row[0], int)]
    return max(found, default=None)
