"""One host of a split mission, in a process of its own: `python -m tests.faults.split_site FOLDER SERVICE ...`.

The real services under the real supervisor, configured by the environment (`link.host` says which host it is).
"""

from __future__ import annotations

import sys
from pathlib import Path

from plgrim.config import load_config
from plgrim.logs import configure_logs
from plgrim.runtime.process import die_with_parent, stop_on_signals
from plgrim.runtime.supervisor import Supervisor


def main() -> None:
    """Supervise until SIGTERM."""
    folder, services = Path(sys.argv[1]), tuple(sys.argv[2:])
    die_with_parent()
    configure_logs("site")
    with stop_on_signals() as stop, Supervisor(load_config(), folder, services) as supervisor:
        supervisor.start()
        supervisor.wait_ready(stop)
        (folder / "ready").touch()
        while not stop.wait(0.1):
            supervisor.poll()


if __name__ == "__main__":
    main()
