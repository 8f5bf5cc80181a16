"""Enough of Zenoh's receiving threads that dead connections, of which each keeps one for ten seconds, leave some."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import pytest

from plgrim.config import Config
from plgrim.runtime.zenoh_session import connect
from tests.runtime.helpers import Start, eventually


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_router_receives_on_many_threads(config: Config, start: Start) -> None:
    process = start("-m", "plgrim", "router")

    def receivers() -> int:
        tasks = Path(f"/proc/{process.pid}/task").glob("*/comm")
        return sum(task.read_text(encoding="utf-8").startswith("rx-") for task in tasks)

    with connect(config.router, config.robot, threading.Event(), 30.0):  # they come with the first connection
        eventually(lambda: receivers() >= 16, "sixteen receive")
