"""The live mission clock."""

from __future__ import annotations

import time

import pytest

from plgrim.config import ClockConfig
from plgrim.runtime.clock import MissionClock
from schemas.contract import SECOND_NS


def test_mission_time_runs_at_its_speed_from_its_origin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "monotonic_ns", lambda: 100 * SECOND_NS)
    clock = MissionClock.of(ClockConfig(speed=2.0, origin_ns=90 * SECOND_NS))
    assert clock.now_ns() == 20 * SECOND_NS
    assert clock.wall_seconds(20 * SECOND_NS) == 10.0


def test_before_the_origin_it_stands_at_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "monotonic_ns", lambda: 5)
    assert MissionClock(1.0, 10).now_ns() == 0


def test_synchronised_hosts_may_use_the_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time_ns", lambda: 70)
    assert MissionClock.of(ClockConfig(source="realtime", origin_ns=50)).now_ns() == 20


def test_stamps_stay_exact_for_days_of_uptime() -> None:
    now = MissionClock(2.0, 0)
    before, after = time.monotonic_ns() * 2, 0
    stamp = now.now_ns()
    after = time.monotonic_ns() * 2
    assert before - 1000 <= stamp <= after + 1000
