"""A supervisor of fakes in a process of its own: `python fake_supervisor.py FOLDER` writes FOLDER/pids.json."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from plgrim.config import load_config
from plgrim.runtime.process import stop_on_signals
from plgrim.runtime.supervisor import Supervisor
from tests.runtime.helpers import fake_command


def main() -> None:
    """Supervise until a signal."""
    folder = Path(sys.argv[1])
    with (
        stop_on_signals() as stop,
        Supervisor(load_config(), folder, ("sim", "mission"), fake_command({})) as up,
    ):
        up.start()
        up.wait_ready(stop)
        pids = [child.process.pid for child in up.children.values() if child.process]
        (folder / "pids.tmp").write_text(json.dumps(pids), encoding="utf-8")
        (folder / "pids.tmp").rename(folder / "pids.json")
        while not stop.wait(0.1):
            up.poll()


if __name__ == "__main__":
    main()
