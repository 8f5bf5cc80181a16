"""The folder of a run: one supervisor at a time, the journals of its services, and the mission clock to go on with."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path
from typing import Any

from plgrim.config import Config, load_config
from plgrim.errors import ConfigError
from plgrim.runtime.clock import boot_id
from plgrim.runtime.durable import write_whole
from plgrim.runtime.lock import Lock
from schemas.contract import SECOND_NS

_CLOCK = "clock.json"
_CLOCK_PERIOD_S = 1.0
_MARGIN_S = 3.0
"""After a reboot the mission clock goes on so much after its last entry: never before what was said meanwhile."""


def lock_run_folder(folder: Path) -> Lock:
    """Raises AlreadyRunningError when a supervisor is at work in this folder."""
    return Lock(
        folder / "supervisor.lock",
        "a supervisor is at work in this folder",
        "end it first, or name another folder with --out",
    )


def with_fresh_state(config: Config, run_folder: Path) -> Config:
    """The configuration with an empty folder for the journals of this run: a new mission knows nothing of the last.

    `state` in the run folder, which is emptied; where the user names a folder, a new one inside.
    """
    if config.runtime.state_dir:
        state = Path(config.runtime.state_dir) / f"{time.strftime('%Y%m%dT%H%M%S')}-{os.getpid()}"
    else:
        state = run_folder / "state"
        shutil.rmtree(state, ignore_errors=True)
    return _changed(config, "runtime", state_dir=str(state.resolve()))


def refuse_unfinished(folder: Path) -> None:
    """A mission that has not ended is not written over. Raises ConfigError when its journals are in this run folder,
    AlreadyRunningError when a supervisor is at work in it. A folder that is not there is not made.
    """
    if not folder.exists():
        return
    lock = lock_run_folder(folder)
    try:
        if state := _journals(folder):
            raise ConfigError(
                f"{folder}: holds a mission that has not ended (journals in {state}): go on with it by `plgrim recover "
                f"{folder}`, begin another one by --new, or name another folder with --out"
            )
    finally:
        lock.close()


def _journals(folder: Path) -> Path | None:
    """The folder of the journals that the last run in a run folder has left; None when there are none."""
    file = folder / "config.yaml"
    if not file.exists():
        return None
    try:
        named = load_config(file).runtime.state_dir
    except ConfigError:  # of another version: where its journals are is not known, but for the usual place
        named = str(folder / "state")
    state = Path(named) if named else None
    return state if state is not None and any(state.glob("*/*.sqlite")) else None


def with_kept_state(folder: Path) -> Config:
    """The configuration of the run in this folder whose mission has not ended, its mission clock going on.

    In the same boot the clock has run on; after a reboot it goes on where it stopped. Raises ConfigError when there is
    nothing to go on from.
    """
    file = folder / "config.yaml"
    if not file.exists():
        raise ConfigError(f"{file}: there is none: name the result folder of a run that was cut off")
    config = load_config(file)
    if not config.runtime.state_dir or not Path(config.runtime.state_dir).is_dir():
        raise ConfigError(
            f"{file}: runtime.state_dir: {config.runtime.state_dir or 'empty'}: no journals there; a mission "
            "that has ended keeps none: start a new one"
        )
    saved = _read_clock(Path(config.runtime.state_dir) / _CLOCK)
    if config.clock.source != "monotonic" or saved.get("boot") == boot_id():
        return config
    stamp_ns = int(saved.get("stamp_ns", 0)) + int(_MARGIN_S * SECOND_NS)
    origin_ns = time.monotonic_ns() - int(stamp_ns / config.clock.speed)
    return _changed(config, "clock", origin_ns=origin_ns)


def _changed(config: Config, section: str, **values: Any) -> Config:
    return config.model_copy(update={section: getattr(config, section).model_copy(update=values)})


def _read_clock(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


class ClockFile:
    """Writes the mission clock down once a second, for `plgrim recover` after a reboot."""

    def __init__(self, state: Path) -> None:
        self._path = state / _CLOCK
        self._due_s = 0.0
        self._boot = boot_id()

    def write(self, stamp_ns: int) -> None:
        """Write it when it is time; a disk that takes nothing is not this file's to report."""
        now = time.monotonic()
        if now < self._due_s:
            return
        self._due_s = now + _CLOCK_PERIOD_S
        try:
            write_whole(self._path, json.dumps({"boot": self._boot, "stamp_ns": stamp_ns}))
        except OSError:
            return
