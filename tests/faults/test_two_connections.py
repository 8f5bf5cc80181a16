"""A process whose connections to another host die goes on hearing its own host: the link, in a cut."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from tests.faults.network import BASE, ROBOT, Network, require_network

SECONDS, CUT_AFTER_S = 26.0, 8.0
GAP_S = 1.0
"""A message comes every 0.05 s. With two receiving threads, connections that died full kept both for ten seconds."""


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_dead_connections_do_not_stop_the_living(tmp_path: Path) -> None:
    require_network()
    with Network(tmp_path) as network:
        network.rate(2.0)
        far = f"tcp/{network.address(BASE)}:7447"
        shared = {"PLGRIM_DEPLOYMENT__PUBLISHED_ON": "none"}
        network.start(BASE, {**shared, "PLGRIM_ROUTER": far}, "-m", "plgrim", "router")
        here = {**shared, "PLGRIM_ROUTER": "tcp/127.0.0.1:7457"}
        network.start(ROBOT, here, "-m", "plgrim", "router")
        program = ("-m", "tests.faults.two_connections")
        network.start(ROBOT, here, *program, "tick")
        both = network.start(ROBOT, here, *program, far, str(SECONDS))
        time.sleep(CUT_AFTER_S)
        network.cut()
        assert both.wait(90.0) == 0
        found = json.loads((tmp_path / f"{ROBOT}-3.log").read_text(encoding="utf-8").splitlines()[-1])
        print(f"\n{found}")
        assert found["heard"] > 0.8 * SECONDS / 0.05
        assert found["gap_s"] < GAP_S
