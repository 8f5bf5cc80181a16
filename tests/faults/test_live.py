"""Faults in one live system, every service a process of its own over Zenoh, while it explores.

Timed bars are asserted here, each with its margin: what is measured holds the pauses of the machine as well. They are
for a machine that is not overloaded; `make faults` runs them.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from plgrim.runtime.children import ROUTER, environment_of
from schemas.base import Message
from schemas.contract import SECOND_NS, Topic
from schemas.operation import StageHealth, SupervisorReport
from schemas.policy import SafetyState
from schemas.topics import (
    GLOBAL_POLICY,
    LOCAL_IRM,
    LOCAL_POLICY,
    MISSION,
    ODOMETRY,
    PLAN,
    RISK_MAP,
    SERVICES,
    SUPERVISOR,
    health_topic,
)
from tests.faults.kill import fault_config
from tests.faults.system import Said, System, build_clock_shim, mount_small, start_system
from tests.runtime.helpers import REPOSITORY

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

FLAGGED_WITHIN_S, REPLACED_WITHIN_S = 3.0, 8.0
MARGIN_S, SLOW_S = 0.3, 12.0
"""Of the observer: its own threads share the two cores with all services."""
WATCHED: dict[str, Topic[Message]] = {
    "riskmap": RISK_MAP,
    "irm": LOCAL_IRM,
    "lcp": health_topic("lcp"),
    "mission": MISSION,
}


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """The system; its journals on a small disk, its wall clock under our control, where that is possible."""
    folder = tmp_path_factory.mktemp("live")
    disk = folder / "disk"
    mounted = mount_small(disk, "24m")
    shim, offset = build_clock_shim(folder), folder / "offset"
    offset.write_bytes(bytes(8))
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in os.environ if name.startswith("PLGRIM_")]:
            if name not in ("PLGRIM_CACHE_DIR", "PLGRIM_DATA_DIR"):
                patch.delenv(name)
        patch.setenv("PYTHONPATH", str(REPOSITORY))
        if shim is not None:
            patch.setenv("LD_PRELOAD", str(shim))
            patch.setenv("CLOCK_OFFSET", str(offset))
        config = fault_config(
            {"world": "subway_1x"}, 1, 1.0, {"state_dir": str(disk), "snapshot_period_s": 2.0}
        )
        topics = (RISK_MAP, LOCAL_IRM, LOCAL_POLICY, GLOBAL_POLICY, MISSION, ODOMETRY, SUPERVISOR)
        health = [health_topic(service) for service in SERVICES]
        system = start_system(config, folder / "run", *topics, *health, clock=offset if shim else None)
        try:
            yield system
        finally:
            system.supervisor.__exit__(None)
            if mounted:
                os.system(f"umount -l {disk}")


@pytest.fixture(autouse=True)
def _whole(system: System) -> None:
    """Each test begins with a robot that drives."""
    system.until(system.whole, "the system is whole again", 120.0)


@pytest.mark.parametrize("service", sorted(WATCHED))
def test_a_stopped_stage_is_flagged_and_replaced(system: System, service: str) -> None:
    topic, watch = WATCHED[service], system.supervisor.watch
    pid, epoch = system.pid(service), system.ear.said[topic.name][-1].envelope.epoch
    os.kill(pid, signal.SIGSTOP)
    stopped = time.monotonic()
    flagged = system.until(lambda: service in watch.flagged(), "it is flagged") - stopped
    back = (
        system.until(
            lambda: any(s.envelope.epoch > epoch for s in system.ear.since(topic, stopped)), "it is replaced"
        )
        - stopped
    )
    print(f"\n{service}: flagged after {flagged:.2f} s, first valid output of the next after {back:.2f} s")
    assert flagged < FLAGGED_WITHIN_S
    assert back < REPLACED_WITHIN_S


def test_a_risk_map_that_freezes_holds_the_robot(system: System) -> None:
    """HOLD, and `valid = false`, within one period of the stale limit after the last risk map."""
    os.kill(system.pid("riskmap"), signal.SIGSTOP)
    stopped = time.monotonic()

    def holds() -> list[float]:
        plans = system.ear.plans(stopped)
        return [
            t for t, p in plans if p.safety == SafetyState.HOLD and "risk map" in p.reason and not p.valid
        ]

    system.until(holds, "the plan says HOLD")
    at_s = holds()[0]
    last = max(s.at_s for s in system.ear.said[RISK_MAP.name] if s.at_s <= at_s)
    limit_s = 1.5 + PLAN.period_ns / SECOND_NS
    print(f"\nHOLD {at_s - last:.2f} s after the last risk map")
    assert at_s - last < limit_s + MARGIN_S


def test_a_slow_consumer_is_its_own_trouble(system: System) -> None:
    """It sleeps in every message: publishers keep their rate, what it gets is fresh, and it does not grow.

    A process of its own: what this one keeps of every message, and its own threads, are not what is measured.
    """
    nominal, topics = _calm(system), (ODOMETRY, RISK_MAP)
    run_folder = system.supervisor.children["sim"].log.parent.parent
    environment = environment_of(run_folder / "config.yaml", None)
    names = ",".join(topic.name for topic in topics)
    command = [sys.executable, "-m", "tests.faults.slow_consumer", str(SLOW_S), names]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as consumer:
        began = time.monotonic()
        system.until(lambda: consumer.poll() is not None, "it ends", SLOW_S + 60.0)
        spent_s = time.monotonic() - began
        assert consumer.stdout is not None
        found = json.loads(consumer.stdout.read().splitlines()[-1])
    busy = len(system.ear.since(ODOMETRY, began)) / spent_s
    print(
        f"\nodometry {busy:.1f} Hz of {nominal:.1f}; ages {found['ages']}, grown {found['grown_mib']:.1f} MiB"
    )
    assert busy > 0.9 * nominal
    for topic in topics:
        heard, said = found["heard"][topic.name], system.ear.since(topic, began - 2.0)
        assert len(heard) > SLOW_S / 2
        behind = [_newest(said, came_s - MARGIN_S) - sequence for came_s, sequence in heard]
        assert max(behind) <= 0, f"{topic.name}: it was given what had been replaced by then"
        # The newest is as old as its writer is slow: up to a period, or what a busy machine makes of it.
        gap_s = max(b.at_s - a.at_s for a, b in pairwise(said))
        print(
            f"{topic.name}: oldest {found['ages'][topic.name]:.2f} s, longest gap of its writer {gap_s:.2f} s"
        )
        assert found["ages"][topic.name] < max(gap_s, topic.period_ns / SECOND_NS) + MARGIN_S
    assert found["grown_mib"] < 10.0


def test_an_hour_on_the_wall_clock_changes_nothing(system: System) -> None:
    """Forward, back, and back again: no service restarts, no message is refused, the robot keeps driving."""
    if system.clock_offset is None:
        pytest.skip("needs Linux and a C compiler")
    _calm(system)
    restarted = {name: child.restarted for name, child in system.supervisor.children.items()}
    refused = _refused(system)
    began = time.monotonic()
    for offset_s in (3600.0, -3600.0, 0.0):
        system.set_clock(offset_s)
        system.run(5.0)
    assert {name: child.restarted for name, child in system.supervisor.children.items()} == restarted
    assert _refused(system) == refused
    plans = system.ear.plans(began)
    states = {plan.safety for _, plan in plans}
    print(f"\n{len(plans)} plans, {states}")
    assert not states & {SafetyState.HOLD, SafetyState.DONE}


def test_a_service_that_restarts_an_hour_in_the_past_is_heard(system: System) -> None:
    """Epochs are wall-clock milliseconds, but never below the last one."""
    if system.clock_offset is None:
        pytest.skip("needs Linux and a C compiler")
    epoch = system.ear.said[MISSION.name][-1].envelope.epoch
    system.set_clock(-3600.0)
    os.kill(system.pid("mission"), signal.SIGKILL)
    killed = time.monotonic()
    system.until(
        lambda: any(s.envelope.epoch > epoch for s in system.ear.since(MISSION, killed)), "mission is back"
    )
    assert system.ear.said[MISSION.name][-1].envelope.epoch < epoch + 60_000
    system.set_clock(0.0)
    system.until(system.whole, "the robot drives on")


def _newest(said: list[Said], at_s: float) -> int:
    """The newest sequence that was said until a moment."""
    return max((one.envelope.sequence for one in said if one.at_s <= at_s), default=0)


def _calm(system: System) -> float:
    """Odometry's nominal rate, Hz. Skips, visibly, on a machine that cannot keep it with no fault at all."""
    system.run(2.0)
    began, nominal = time.monotonic(), SECOND_NS / ODOMETRY.period_ns
    system.run(5.0)
    rate = len(system.ear.since(ODOMETRY, began)) / 5.0
    if rate < 0.95 * nominal or any(p.safety == SafetyState.HOLD for _, p in system.ear.plans(began)):
        pytest.skip(f"the machine is too busy: odometry at {rate:.1f} of {nominal:.1f} Hz without a fault")
    return nominal


def _refused(system: System) -> int:
    found = 0
    for service in SERVICES:
        said = system.ear.last(health_topic(service))
        assert said is not None and isinstance(said.message, StageHealth)
        found += sum(said.message.dropped.values())
    return found


def test_a_full_disk_degrades_and_what_was_safe_stays(system: System) -> None:
    """Full: DEGRADED, and the mission goes on; a service that dies meanwhile comes back; with space again: RUN."""
    disk = Path(system.supervisor.config.runtime.state_dir).parent
    if not os.path.ismount(disk):
        pytest.skip("needs root, to mount a small tmpfs")
    began = time.monotonic()
    with (disk / "filler").open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            pass
    try:

        def degraded() -> bool:
            return any(p.safety == SafetyState.DEGRADED and p.valid for _, p in system.ear.plans(began))

        system.until(degraded, "the plan says DEGRADED, and moves", 90.0)
        reason = next(p.reason for _, p in system.ear.plans(began) if p.safety == SafetyState.DEGRADED)
        assert "journal" in reason, reason
        epoch = system.ear.said[LOCAL_IRM.name][-1].envelope.epoch
        os.kill(system.pid("irm"), signal.SIGKILL)
        system.until(
            lambda: any(s.envelope.epoch > epoch for s in system.ear.since(LOCAL_IRM, began)), "irm is back"
        )
        assert (
            "resumed"
            in system.supervisor.children["irm"].log.read_text(encoding="utf-8").rpartition("ready")[0]
        )
        assert not system.supervisor.failed()
    finally:
        (disk / "filler").unlink()
    freed = time.monotonic()
    system.until(
        lambda: any(p.safety == SafetyState.RUN for _, p in system.ear.plans(freed + 1.0)), "RUN again", 120.0
    )


def test_a_stage_that_cannot_be_kept_alive_is_failed_and_the_robot_holds(system: System) -> None:
    """The last test of this system: a FAILED stage is not started again."""
    lcp = system.supervisor.children["lcp"]
    lcp.restarts.extend([time.monotonic()] * system.supervisor.config.runtime.restarts)
    os.kill(system.pid("lcp"), signal.SIGKILL)
    killed = time.monotonic()
    system.until(lambda: "lcp" in system.supervisor.failed(), "lcp is FAILED")
    held = system.until(
        lambda: any(p.safety == SafetyState.HOLD and "lcp" in p.reason for _, p in system.ear.plans(killed)),
        "the robot holds",
    )
    print(f"\nHOLD {held - killed:.2f} s after the death")
    assert held - killed < 2.0
    report = system.ear.last(SUPERVISOR)
    assert report is not None and isinstance(report.message, SupervisorReport)
    assert "lcp" in report.message.failed
    system.run(3.0)
    assert all(not p.valid for _, p in system.ear.plans(held + 0.1))
    assert system.supervisor.children[ROUTER].process is not None
    lcp.failed = ""
    lcp.restart_at_s = 0.0
