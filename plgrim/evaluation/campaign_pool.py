"""Child processes side by side, some at a time; started, watched and ended from one thread."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from plgrim.config import environment_overrides
from plgrim.evaluation.campaign_child import LOG_FILE, PROGRESS_FILE
from plgrim.runtime.process import THREAD_LIMITS, child_environment

_POLL_S = 0.2
_GRACE_S = 3.0
Command = Callable[[Path], list[str]]


def child_command(folder: Path) -> list[str]:
    """The command line of one mission."""
    return [sys.executable, "-m", "plgrim.evaluation.campaign_child", str(folder)]


def mission_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Of a child: one thread for numba and BLAS; no variable that would change the configuration it is given."""
    own = {**child_environment(environment), **THREAD_LIMITS}
    for variable in (*environment_overrides(environment), "PLGRIM_CONFIG"):
        own.pop(variable, None)
    return own


@dataclass(slots=True)
class Child:
    """One process and the folder it works in. started_s: monotonic."""

    folder: Path
    process: subprocess.Popen[bytes]
    started_s: float = field(default_factory=time.monotonic)


class Runner(Protocol):
    """What runs the missions of a campaign: processes here, or a cluster."""

    @property
    def folders(self) -> list[Path]:
        """Of the missions that run now."""
        ...

    def run(
        self,
        folders: Sequence[Path],
        stop: threading.Event,
        ended: Callable[[Path, int], None],
        poll: Callable[[], None] = lambda: None,
    ) -> None:
        """Until all have ended or `stop`. ended: told each folder and exit code as it comes. poll: now and then."""
        ...


class Pool:
    """Runs a child for each folder, at most `jobs` at once, in the given order.

    The first child runs alone until it reports progress: it compiles the kernels that all others then load.
    """

    def __init__(self, jobs: int, command: Command = child_command) -> None:
        self._jobs = jobs
        self._command = command
        self._is_warm = False
        self.running: list[Child] = []

    @property
    def folders(self) -> list[Path]:
        """Of the missions that run now."""
        return [child.folder for child in self.running]

    def run(
        self,
        folders: Sequence[Path],
        stop: threading.Event,
        ended: Callable[[Path, int], None],
        poll: Callable[[], None] = lambda: None,
    ) -> None:
        """Until all have ended or `stop`. ended: told each folder and exit code as it comes.

        On `stop`, and whatever is raised, the children are ended: SIGTERM, then SIGKILL; they are not told to `ended`.
        """
        waiting = deque(folders)
        try:
            while (waiting or self.running) and not stop.is_set():
                for child in [c for c in self.running if c.process.poll() is not None]:
                    self.running.remove(child)
                    self._is_warm = True
                    ended(child.folder, child.process.returncode)
                while waiting and len(self.running) < self._allowed():
                    self.running.append(self._start(waiting.popleft()))
                poll()
                if self.running:
                    stop.wait(_POLL_S)
        finally:
            self._end_all()

    def _allowed(self) -> int:
        self._is_warm = self._is_warm or any((c.folder / PROGRESS_FILE).exists() for c in self.running)
        return self._jobs if self._is_warm else 1

    def _start(self, folder: Path) -> Child:
        with (folder / LOG_FILE).open("wb") as log:
            process = subprocess.Popen(
                self._command(folder),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=mission_environment(os.environ),
                start_new_session=True,  # Ctrl-C is for the parent, which ends its children in order
            )
        return Child(folder, process)

    def _end_all(self) -> None:
        for child in self.running:
            child.process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + _GRACE_S
        for child in self.running:
            try:
                child.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
        self.running.clear()
