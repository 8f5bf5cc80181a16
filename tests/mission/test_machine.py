"""The mission's state machine, by stepping time."""

from __future__ import annotations

import math
from dataclasses import replace

import msgpack
import pytest

from schemas.contract import SECOND_NS
from schemas.operation import CommandKind, FinishReason, MissionPhase
from services.mission.config import Config
from services.mission.machine import Facts, Machine


class Driver:
    """Steps a machine with facts that stay as they were last set."""

    def __init__(self, **config: float | bool) -> None:
        self.machine = Machine(Config.model_validate(config))
        self.facts = Facts(now_ns=0, localised=True, home_distance_m=50.0, return_distance_m=60.0)
        self._area = 0.0
        self._commands = 0

    def set(self, **changes: object) -> None:
        self.facts = replace(self.facts, **changes)  # type: ignore[arg-type]

    def run(self, seconds: float, growth_m2: float = 0.0) -> None:
        for _ in range(round(seconds / 0.5)):
            self._area += growth_m2
            now = self.facts.now_ns + SECOND_NS // 2
            self.set(now_ns=now, covered_area_m2=self._area)
            self.machine.step(self.facts)

    def command(self, kind: CommandKind, command_id: str = "") -> None:
        self._commands += 1
        commands = ((command_id or str(self._commands), kind),)
        self.machine.step(replace(self.facts, commands=commands))

    def phase(self) -> MissionPhase:
        return self.machine.phase


def test_waits_for_odometry_then_starts_by_itself() -> None:
    driver = Driver()
    driver.set(localised=False)
    driver.run(2.0)
    assert driver.phase() == MissionPhase.IDLE
    assert "odometry" in driver.machine.reason
    driver.set(localised=True)
    driver.run(0.5)
    assert driver.phase() == MissionPhase.EXPLORE
    driver.run(3.0)
    assert driver.machine.elapsed_s(driver.facts.now_ns) == pytest.approx(3.0)


def test_waits_for_the_start_command() -> None:
    driver = Driver(auto_start=False)
    driver.run(5.0)
    assert driver.phase() == MissionPhase.IDLE
    assert driver.machine.elapsed_s(driver.facts.now_ns) == 0.0
    driver.command(CommandKind.START)
    assert driver.phase() == MissionPhase.EXPLORE


def test_covered_needs_an_unbroken_settled_belief() -> None:
    driver = Driver(settle_s=4.0)
    driver.run(2.0, growth_m2=2.0)
    driver.set(settled=True)
    driver.run(3.5)
    driver.set(settled=False)
    driver.run(0.5)
    driver.set(settled=True)
    driver.run(4.0)
    assert driver.phase() == MissionPhase.EXPLORE
    driver.run(0.5)
    assert driver.phase() == MissionPhase.DONE
    assert driver.machine.finish == FinishReason.COVERED


def test_settled_before_anything_was_covered_is_not_covered() -> None:
    driver = Driver()
    driver.set(settled=True)
    driver.run(60.0)
    assert driver.phase() == MissionPhase.EXPLORE


def test_unknown_coverage_breaks_the_settling() -> None:
    driver = Driver(settle_s=4.0)
    driver.run(1.0, growth_m2=2.0)
    driver.set(settled=True)
    driver.run(3.5)
    driver.set(settled=None)
    driver.run(0.5)
    driver.set(settled=True)
    driver.run(4.0)
    assert driver.phase() == MissionPhase.EXPLORE


def test_covered_then_home_when_asked_for() -> None:
    driver = Driver(return_when_done=True, settle_s=1.0)
    driver.run(1.0, growth_m2=2.0)
    driver.set(settled=True)
    driver.run(2.0)
    assert driver.phase() == MissionPhase.RETURN
    driver.set(home_distance_m=0.5)
    driver.run(0.5)
    assert driver.phase() == MissionPhase.DONE
    assert driver.machine.finish == FinishReason.COVERED


def test_time_budget_turns_back_with_the_reserve() -> None:
    """60 m home at 1 m/s, 1.3 times: 78 s are kept, so that 200 s turn back 122 s after the start."""
    driver = Driver(time_budget_s=200.0, return_speed_mps=1.0, return_reserve_factor=1.3)
    driver.run(0.5)
    driver.run(121.5, growth_m2=1.0)
    assert driver.phase() == MissionPhase.EXPLORE
    driver.run(0.5, growth_m2=1.0)
    assert driver.phase() == MissionPhase.RETURN
    assert "78 s" in driver.machine.reason
    driver.run(100.0)
    assert driver.phase() == MissionPhase.RETURN
    driver.set(home_distance_m=1.0)
    driver.run(0.5)
    assert (driver.phase(), driver.machine.finish) == (MissionPhase.DONE, FinishReason.TIME_BUDGET)


def test_time_budget_without_return_is_used_up() -> None:
    driver = Driver(time_budget_s=100.0, return_on_budget=False)
    driver.run(0.5)
    driver.run(99.5, growth_m2=1.0)
    assert driver.phase() == MissionPhase.EXPLORE
    driver.run(0.5, growth_m2=1.0)
    assert (driver.phase(), driver.machine.finish) == (MissionPhase.DONE, FinishReason.TIME_BUDGET)
    driver.run(10.0)
    assert driver.machine.elapsed_s(driver.facts.now_ns) == pytest.approx(100.0)


def test_energy_budget_counts_from_the_start() -> None:
    driver = Driver(energy_budget_m=200.0, return_reserve_factor=1.5, auto_start=False)
    driver.set(distance_m=500.0)
    driver.run(1.0)
    driver.command(CommandKind.START)
    driver.set(distance_m=609.0)
    driver.run(0.5, growth_m2=5.0)
    assert driver.phase() == MissionPhase.EXPLORE
    driver.set(distance_m=610.0)
    driver.run(0.5, growth_m2=5.0)
    assert driver.phase() == MissionPhase.RETURN
    assert driver.machine.pending == FinishReason.ENERGY_BUDGET


def test_new_ground_is_progress_though_more_was_cut_off() -> None:
    driver = Driver(no_progress_s=30.0)
    driver.run(60.0, growth_m2=1.0)
    driver._area -= 60.0
    driver.run(20.0)
    driver.run(40.0, growth_m2=0.5)  # not yet what it was
    assert driver.phase() == MissionPhase.EXPLORE


def test_ground_that_comes_and_goes_is_no_progress_for_ever() -> None:
    driver = Driver(no_progress_s=30.0)
    driver.run(60.0, growth_m2=1.0)
    for _ in range(20):
        driver._area -= 40.0
        driver.run(10.0)
        driver._area += 40.0
        driver.run(10.0)
    assert driver.machine.finish == FinishReason.NO_PROGRESS


def test_no_progress_does_not_count_pauses() -> None:
    driver = Driver(no_progress_s=30.0)
    driver.run(0.5)
    driver.run(20.0)
    driver.command(CommandKind.PAUSE)
    driver.run(600.0)
    assert driver.phase() == MissionPhase.PAUSED
    driver.command(CommandKind.RESUME)
    driver.run(9.5)
    assert driver.phase() == MissionPhase.EXPLORE
    driver.set(left=3)
    driver.run(1.0)
    assert (driver.phase(), driver.machine.finish) == (MissionPhase.DONE, FinishReason.NO_PROGRESS)
    assert "3 places left" in driver.machine.reason


def test_progress_restarts_the_clock() -> None:
    driver = Driver(no_progress_s=30.0)
    for _ in range(5):
        driver.run(25.0)
        driver.run(0.5, growth_m2=2.0)
    assert driver.phase() == MissionPhase.EXPLORE


def test_a_way_home_that_is_blocked_ends_the_mission() -> None:
    driver = Driver(no_progress_s=30.0)
    driver.run(1.0)
    driver.command(CommandKind.HOME)
    driver.run(20.0)
    driver.set(return_distance_m=50.0)
    driver.run(20.0)
    assert driver.phase() == MissionPhase.RETURN
    driver.run(15.0)
    assert (driver.phase(), driver.machine.finish) == (MissionPhase.DONE, FinishReason.NO_PROGRESS)
    assert "50 m left" in driver.machine.reason


def test_pause_resume_home_and_stop() -> None:
    driver = Driver()
    driver.run(1.0)
    driver.command(CommandKind.HOME)
    driver.command(CommandKind.PAUSE)
    assert driver.phase() == MissionPhase.PAUSED
    driver.command(CommandKind.RESUME)
    assert driver.phase() == MissionPhase.RETURN
    driver.command(CommandKind.STOP)
    assert (driver.phase(), driver.machine.finish) == (MissionPhase.STOPPED, FinishReason.STOPPED)
    driver.command(CommandKind.START)
    driver.command(CommandKind.RESUME)
    assert driver.phase() == MissionPhase.STOPPED


def test_home_keeps_the_reason_of_a_return_that_has_begun() -> None:
    driver = Driver(time_budget_s=50.0)
    driver.run(2.0)
    assert driver.machine.pending == FinishReason.TIME_BUDGET
    driver.command(CommandKind.PAUSE)
    driver.command(CommandKind.HOME)
    assert driver.phase() == MissionPhase.RETURN
    assert driver.machine.pending == FinishReason.TIME_BUDGET


def test_a_command_is_carried_out_once() -> None:
    driver = Driver()
    driver.run(1.0)
    driver.command(CommandKind.PAUSE, "a")
    driver.command(CommandKind.RESUME, "b")
    driver.command(CommandKind.PAUSE, "a")
    assert driver.phase() == MissionPhase.EXPLORE
    driver.command(CommandKind.PAUSE, "c")
    assert driver.phase() == MissionPhase.PAUSED


def test_commands_that_do_not_fit_change_nothing() -> None:
    driver = Driver(auto_start=False)
    driver.run(1.0)
    for kind in (CommandKind.PAUSE, CommandKind.RESUME, CommandKind.HOME):
        driver.command(kind)
        assert driver.phase() == MissionPhase.IDLE


def test_snapshot_goes_on_where_it_was() -> None:
    driver = Driver(no_progress_s=30.0)
    driver.run(20.0)
    driver.command(CommandKind.PAUSE, "a")
    raw = msgpack.packb(driver.machine.snapshot())
    other = Driver(no_progress_s=30.0)
    other.machine.restore(msgpack.unpackb(raw))
    other.facts = driver.facts
    assert other.machine == driver.machine
    for twin in (driver, other):
        twin.command(CommandKind.RESUME, "b")
        twin.command(CommandKind.STOP, "a")  # an id that was used already
        twin.run(9.5)
        assert twin.phase() == MissionPhase.EXPLORE
        twin.run(2.0)
        assert twin.machine.finish == FinishReason.NO_PROGRESS
    assert other.machine == driver.machine


def test_unlocalised_home_is_never_near() -> None:
    driver = Driver()
    driver.set(home_distance_m=math.inf)
    driver.run(1.0)
    driver.command(CommandKind.HOME)
    driver.run(1.0)
    assert driver.phase() == MissionPhase.RETURN
