"""kill -9 of the services in mid-mission, every one a process of its own: nothing acknowledged is lost, all is covered.

How long each took is printed, not asserted: see `python -m tests.faults.kill`, which judges that too.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from schemas.topics import SERVICES
from tests.faults.kill import Killer, Mission, fault_config, report, schedule
from tests.faults.small_map import START, write_small_map
from tests.runtime.helpers import REPOSITORY


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("PLGRIM_")]:
        if name not in ("PLGRIM_CACHE_DIR", "PLGRIM_DATA_DIR"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))


def _faults(missions: list[Mission]) -> list[str]:
    report(missions)
    return [fault for mission in missions for fault in mission.faults(within_s=60.0)]


def test_irm_killed_once_in_a_small_world(tmp_path: Path) -> None:
    sim = {"map_file": str(write_small_map(tmp_path)), "start": START}
    killer = Killer(fault_config(sim, 1, 3.0), tmp_path / "run", gap_s=(2.0, 3.0), spare_wait_s=0.0)
    mission = killer.run(["irm"], 90.0)
    assert _faults([mission]) == []
    assert [kill.service for kill in mission.kills] == ["irm"]
    (handover,) = mission.handovers
    assert handover.nodes > 1
    assert not (tmp_path / "run" / "state").exists()


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_every_service_killed_five_times_at_random(tmp_path: Path) -> None:
    left = schedule(SERVICES, 5, seed=1)
    missions: list[Mission] = []
    while left:
        config = fault_config({"world": "subway_1x"}, 1 + len(missions), 2.0)
        missions.append(Killer(config, tmp_path / f"mission{len(missions)}").run(left, 1800.0))
        assert missions[-1].kills
    assert _faults(missions) == []
    assert sum(len(mission.kills) for mission in missions) >= 5 * len(SERVICES) - 2
