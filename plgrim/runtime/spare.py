"""A warm spare: one process that has imported every stage and loaded every kernel, and waits to become a service.

A service that starts from nothing needs a second or more of CPU time for that, on a busy machine several seconds of
a standing robot. The supervisor keeps one spare, hands it the name of the service that has died, and warms up another.
"""

from __future__ import annotations

import importlib
import json
import os
import select
import subprocess
import sys
from pathlib import Path
from typing import Any

from plgrim.logs import get_logger
from plgrim.registry import STAGES
from plgrim.runtime.children import SPARE, Command, spawn


class Spare:
    """The supervisor's side. `keep` begins one; `take` turns it into a service, if there is a warm one.

    environment: of the spare; what differs for the service is handed over by `take`.
    """

    def __init__(self, command: Command, folder: Path, environment: dict[str, str]) -> None:
        self._command = command
        self._log = folder / f"{SPARE}.log"
        self._flag = folder / f"{SPARE}.warm"
        self._environment = {**environment, "PLGRIM_SPARE_WARM": str(self._flag)}
        self._process: subprocess.Popen[bytes] | None = None
        self._failures = 0

    def keep(self) -> None:
        """Have a spare, or be on the way to one; gives up when it has failed three times."""
        if self._process is not None and self._process.poll() is not None:
            self._failures += 1
            self._close()
        if self._process is None and self._failures < 3:
            self._flag.unlink(missing_ok=True)
            self._process = spawn(self._command(SPARE), self._log, self._environment, subprocess.PIPE)

    @property
    def warm(self) -> bool:
        """Whether it could become a service at once."""
        return self._process is not None and self._process.poll() is None and self._flag.exists()

    def take(self, service: str, log: Path, changes: dict[str, str]) -> subprocess.Popen[bytes] | None:
        """The spare as a service that writes to `log`, or None when there is no warm one."""
        process = self._process
        if process is None or not self.warm or process.stdin is None:
            return None
        order = json.dumps({"service": service, "log": str(log), "environment": changes})
        try:
            process.stdin.write(order.encode() + b"\n")
            process.stdin.close()
        except OSError:
            return None
        self._process, self._failures = None, 0
        return process

    def close(self) -> None:
        """End it."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._close()
        self._flag.unlink(missing_ok=True)

    def _close(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
        self._process = None


def warm_up() -> None:
    """Import what any service needs, and load what their first steps use. A stage that fails is not warm, no more."""
    from plgrim.warmup import REHEARSAL_S, rehearse, warm_ups

    for module in ("plgrim.runtime.live", "plgrim.runtime.status_service"):
        importlib.import_module(module)
    try:
        for work in warm_ups().values():
            work()
    except Exception as error:
        get_logger().warning("spare: not all is warm", error=repr(error), stages=STAGES)
    rehearse(REHEARSAL_S)


def wait_for_order(stop: Any) -> str | None:
    """Say that it is warm, wait for the order, put on the service's environment and log; its name, or None to end."""
    Path(os.environ["PLGRIM_SPARE_WARM"]).touch()
    while not stop.is_set():
        if not select.select([sys.stdin], [], [], 0.5)[0]:
            continue
        line = sys.stdin.readline()
        if not line:
            return None
        order = json.loads(line)
        os.environ.update(order["environment"])
        _write_to(order["log"])
        return str(order["service"])
    return None


def _write_to(log: str) -> None:
    try:
        output = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    except OSError:
        output = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.close(output)
