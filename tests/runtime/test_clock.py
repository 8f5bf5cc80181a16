"""The live mission clock."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from plgrim.config import ClockConfig
from plgrim.runtime.clock import MissionClock, wall_offset_ns
from plgrim.runtime.journal import Journal
from schemas.contract import SECOND_NS


def test_mission_time_runs_at_its_speed_from_its_origin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "monotonic_ns", lambda: 100 * SECOND_NS)
    clock = MissionClock.of(ClockConfig(speed=2.0, origin_ns=90 * SECOND_NS))
    assert clock.now_ns() == 20 * SECOND_NS
    assert clock.wall_seconds(20 * SECOND_NS) == 10.0


def test_before_the_origin_it_stands_at_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "monotonic_ns", lambda: 5)
    assert MissionClock(1.0, 10).now_ns() == 0


REALTIME = ClockConfig(source="realtime", origin_ns=50)


class _Machine:
    """A machine's two clocks, ns."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.up, self.wall, self.boot = 100, 70, "one"
        patch.setattr(time, "monotonic_ns", lambda: self.up)
        patch.setattr(time, "time_ns", lambda: self.wall)
        patch.setattr("plgrim.runtime.clock.boot_id", lambda: self.boot)

    def passes(self, span_ns: int) -> None:
        self.up, self.wall = self.up + span_ns, self.wall + span_ns


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> _Machine:
    return _Machine(monkeypatch)


def test_synchronised_hosts_may_use_the_wall_clock(machine: _Machine) -> None:
    clock = MissionClock.of(REALTIME)
    assert clock.now_ns() == 20
    machine.passes(5)
    assert clock.now_ns() == 25


@pytest.mark.parametrize("step_s", [3600, -3600])
def test_a_step_of_the_wall_clock_moves_no_process_and_none_that_restarts(
    machine: _Machine, tmp_path: Path, step_s: int
) -> None:
    machine.wall = 10**18
    clock = MissionClock.of(REALTIME, str(tmp_path / "state"))
    before = clock.now_ns()
    machine.wall += step_s * SECOND_NS
    machine.passes(5)
    assert clock.now_ns() == before + 5
    assert MissionClock.of(REALTIME, str(tmp_path / "state")).now_ns() == before + 5


def test_after_a_reboot_the_wall_clock_counts_again(machine: _Machine, tmp_path: Path) -> None:
    MissionClock.of(REALTIME, str(tmp_path))
    machine.boot, machine.up, machine.wall = "two", 3, 500
    assert MissionClock.of(REALTIME, str(tmp_path)).now_ns() == 450
    assert [path.name for path in tmp_path.iterdir()] == ["wall_clock.two"]


def test_a_clock_without_a_battery_does_not_make_journals_of_the_future(
    machine: _Machine, tmp_path: Path
) -> None:
    machine.wall = 10**18
    saved_ns = MissionClock.of(REALTIME, str(tmp_path)).now_ns()
    journal = Journal(tmp_path / "robot", "mission")
    journal.begin(b"state", saved_ns)
    journal.close()
    machine.boot, machine.up, machine.wall = "two", 3, 5
    resumed = MissionClock.of(REALTIME, str(tmp_path)).now_ns()
    assert saved_ns < resumed < saved_ns + 11 * SECOND_NS


def test_processes_that_start_together_agree(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        found = set(pool.map(lambda _: wall_offset_ns(REALTIME, str(tmp_path / "state")), range(64)))
    assert len(found) == 1


def test_a_folder_that_cannot_be_written_stops_nobody(machine: _Machine, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert MissionClock.of(REALTIME, str(tmp_path / "file")).now_ns() == 20


def test_stamps_stay_exact_for_days_of_uptime() -> None:
    now = MissionClock(2.0, 0)
    before, after = time.monotonic_ns() * 2, 0
    stamp = now.now_ns()
    after = time.monotonic_ns() * 2
    assert before - 1000 <= stamp <= after + 1000
