"""What the fault tests start ends with them, also when they are killed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.faults.network import remove_left_behind, require_network
from tests.runtime.helpers import REPOSITORY, eventually

_RUN = """
import sys, time
from pathlib import Path
from tests.faults.network import BASE, Network
with Network(Path(sys.argv[1])) as network:
    fake = network.start(BASE, {"PLGRIM_ROUTER": "tcp/127.0.0.1:7447"}, "-m", "tests.link.fakes", "router")
    print(fake.pid, network.command(BASE)[3], flush=True)
    time.sleep(600)
"""


def _spaces() -> str:
    return subprocess.run(["ip", "netns", "list"], check=True, capture_output=True, text=True).stdout


@pytest.mark.timeout(120)
def test_a_killed_run_leaves_no_process_and_no_namespace_for_long(tmp_path: Path) -> None:
    require_network()
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    run = subprocess.Popen(
        [sys.executable, "-c", _RUN, str(tmp_path)], env=environment, stdout=subprocess.PIPE, text=True
    )
    assert run.stdout is not None
    pid, space = run.stdout.readline().split()
    log = tmp_path / "base-0.log"
    eventually(lambda: "router listens" in log.read_text(), "the fake runs")
    run.kill()
    run.wait()
    run.stdout.close()
    eventually(lambda: not psutil.pid_exists(int(pid)) or _is_zombie(int(pid)), "the fake has ended")
    assert space in _spaces()
    remove_left_behind()
    assert space not in _spaces()


def _is_zombie(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
