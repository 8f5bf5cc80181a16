"""The lock-step driver with tiny stages: who steps when, when outputs arrive, and the digest."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from plgrim.runtime import lockstep as lockstep_module
from plgrim.runtime.lockstep import Lockstep
from schemas.base import Message
from schemas.contract import Inputs, Output, Outputs, Stage, StageSetup, StageSpec, Stamp, Topic
from schemas.operation import FinishReason, MissionState
from schemas.topics import MISSION, ODOMETRY, PLAN
from tests.runtime.fake_services import mission_state, odometry
from tests.runtime.helpers import REPOSITORY

MS = 1_000_000


@dataclass
class Scripted:
    """A stage that notes when it stepped and what was new, and gives what its script says."""

    reads: Topic[Message]
    script: Callable[[Stamp, int], Outputs] = lambda now, count: []
    seen: list[tuple[Stamp, list[Stamp]]] = field(default_factory=list)

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        fresh = inputs.new(self.reads)
        self.seen.append((now, [r.message.stamp_ns for r in fresh]))
        return self.script(now, len(self.seen))

    def snapshot(self) -> bytes:
        return b""

    def restore(self, snapshot: bytes) -> None:
        del snapshot


def sends_odometry(now: Stamp, count: int) -> Outputs:
    return [Output(ODOMETRY, odometry(now, float(count)))]


def sends_mission(now: Stamp, count: int) -> Outputs:
    return [Output(MISSION, mission_state(now, count, FinishReason.NONE))]


Fakes = dict[str, tuple[StageSpec, Stage]]


@pytest.fixture
def lockstep(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Lockstep]:
    """Makes a driver over fakes that take the names of real services."""

    def make(fakes: Fakes, observer: lockstep_module.Observer | None = None, seed: int = 1) -> Lockstep:
        def fake(name: str, options: object, setup: StageSetup) -> tuple[StageSpec, Stage]:
            del options, setup
            return fakes[name]

        monkeypatch.setattr(lockstep_module, "make_stage", fake)
        return Lockstep({}, seed, observer=observer, stages=tuple(fakes))

    return make


def test_stages_step_at_their_period_from_zero_on(lockstep: Callable[..., Lockstep]) -> None:
    sim, mission = Scripted(MISSION), Scripted(ODOMETRY)
    driver = lockstep(
        {"sim": (StageSpec("sim", 40 * MS), sim), "mission": (StageSpec("mission", 100 * MS), mission)}
    )
    driver.run_until(200 * MS)
    assert [now for now, _ in sim.seen] == [0, 40 * MS, 80 * MS, 120 * MS, 160 * MS, 200 * MS]
    assert [now for now, _ in mission.seen] == [0, 100 * MS, 200 * MS]
    assert driver.now == 200 * MS
    driver.run_until(239 * MS)
    assert len(sim.seen) == 6 and driver.now == 239 * MS
    assert {name: len(steps) for name, steps in driver.step_seconds().items()} == {"sim": 6, "mission": 3}


@pytest.mark.parametrize("latency", [0, 1 * MS, 30 * MS, 250 * MS])
def test_an_output_arrives_after_the_latency_of_its_stage_and_not_before(
    lockstep: Callable[..., Lockstep], latency: int
) -> None:
    sim, mission = Scripted(MISSION, sends_odometry), Scripted(ODOMETRY)
    driver = lockstep(
        {
            "sim": (StageSpec("sim", 1000 * MS, latency_ns=latency), sim),
            "mission": (StageSpec("mission", 1 * MS), mission),
        }
    )
    if latency:
        driver.run_until(latency - 1)
        assert all(new == [] for _, new in mission.seen)
    driver.run_until(1000 * MS - 1)
    # Without latency it arrives at 0 all the same, but the mission has had its step of that millisecond.
    assert [(now, new) for now, new in mission.seen if new] == [(latency or 1 * MS, [0])]


def test_a_trigger_causes_a_step_at_once_and_restarts_the_period(lockstep: Callable[..., Lockstep]) -> None:
    sim = Scripted(MISSION, lambda now, count: sends_odometry(now, count) if count == 2 else [])
    mission = Scripted(ODOMETRY)
    driver = lockstep(
        {
            "sim": (StageSpec("sim", 50 * MS, latency_ns=7 * MS), sim),
            "mission": (StageSpec("mission", 1000 * MS, triggers=(ODOMETRY.name,)), mission),
        }
    )
    driver.run_until(1100 * MS)
    assert mission.seen == [(0, []), (57 * MS, [50 * MS]), (1057 * MS, [])]


def test_messages_go_to_the_readers_of_the_table_and_to_nobody_else(
    lockstep: Callable[..., Lockstep],
) -> None:
    sim = Scripted(MISSION, sends_odometry)
    gcp, lcp = Scripted(ODOMETRY), Scripted(PLAN)
    driver = lockstep(
        {
            "gcp": (StageSpec("gcp", 10 * MS), gcp),
            "lcp": (StageSpec("lcp", 10 * MS, triggers=(PLAN.name,)), lcp),
            "sim": (StageSpec("sim", 10 * MS, latency_ns=1 * MS), sim),
        }
    )
    driver.run_until(30 * MS)
    assert [new for _, new in gcp.seen] == [[], [0], [10 * MS], [20 * MS]]
    assert all(new == [] for _, new in lcp.seen)
    assert driver.dropped() == {}


def test_a_stage_that_writes_what_is_not_its_own_is_an_error(lockstep: Callable[..., Lockstep]) -> None:
    driver = lockstep({"mission": (StageSpec("mission", 10 * MS), Scripted(ODOMETRY, sends_odometry))})
    with pytest.raises(ValueError, match="mission may not write sim/odometry"):
        driver.run_until(0)


def test_readers_get_what_was_decoded_not_the_object_itself(lockstep: Callable[..., Lockstep]) -> None:
    sent: list[Message] = []
    got: list[Message] = []

    def send(now: Stamp, count: int) -> Outputs:
        sent.append(odometry(now, float(count)))
        return [Output(ODOMETRY, sent[-1])]

    class Reader(Scripted):
        def step(self, now: Stamp, inputs: Inputs) -> Outputs:
            got.extend(r.message for r in inputs.new(ODOMETRY))
            return []

    driver = lockstep(
        {
            "sim": (StageSpec("sim", 10 * MS), Scripted(MISSION, send)),
            "mission": (StageSpec("mission", 10 * MS), Reader(ODOMETRY)),
        }
    )
    driver.run_until(20 * MS)
    assert got and all(all(g is not s for s in sent) for g in got)
    assert not got[0].covariance.flags.writeable  # type: ignore[attr-defined]


def test_the_observer_sees_every_message_once(lockstep: Callable[..., Lockstep]) -> None:
    noted: list[tuple[str, Stamp]] = []
    driver = lockstep(
        {
            "sim": (StageSpec("sim", 10 * MS), Scripted(MISSION, sends_odometry)),
            "mission": (StageSpec("mission", 20 * MS), Scripted(ODOMETRY, sends_mission)),
        },
        observer=lambda topic, message, now: noted.append((topic.name, message.stamp_ns)),
    )
    driver.run_until(20 * MS)
    assert sorted(noted) == [
        (MISSION.name, 0), (MISSION.name, 20 * MS),
        (ODOMETRY.name, 0), (ODOMETRY.name, 10 * MS), (ODOMETRY.name, 20 * MS),
    ]  # fmt: skip


def answering(after: int = 0) -> Fakes:
    """Two stages that answer each other; the mission counts what it saw."""

    class Counting(Scripted):
        def step(self, now: Stamp, inputs: Inputs) -> Outputs:
            newest = inputs.latest(ODOMETRY)
            seen = int(newest.message.pose.x_m) if newest else 0
            return [Output(MISSION, mission_state(now, seen + after, FinishReason.NONE))]

    return {
        "mission": (StageSpec("mission", 20 * MS, (ODOMETRY.name,), 3 * MS), Counting(ODOMETRY)),
        "sim": (StageSpec("sim", 7 * MS, latency_ns=5 * MS), Scripted(MISSION, sends_odometry)),
    }


def digest(lockstep: Callable[..., Lockstep], fakes: Fakes, end: int = 500 * MS) -> str:
    driver = lockstep(fakes)
    driver.run_until(end)
    return driver.digest()


def test_the_digest_is_the_same_for_the_same_run_and_not_for_another(
    lockstep: Callable[..., Lockstep],
) -> None:
    first = digest(lockstep, answering())
    assert first == digest(lockstep, answering())
    assert first != digest(lockstep, answering(after=1))
    assert first != digest(lockstep, answering(), end=480 * MS)


def test_the_digest_does_not_depend_on_how_far_each_call_runs(lockstep: Callable[..., Lockstep]) -> None:
    whole = digest(lockstep, answering())
    driver = lockstep(answering())
    for end in (1, 3 * MS, 7 * MS, 100 * MS, 333 * MS, 500 * MS):
        driver.run_until(end)
    assert driver.digest() == whole


def test_the_digest_does_not_depend_on_the_hash_seed() -> None:
    """In processes of their own: PYTHONHASHSEED is read at the start."""
    program = (
        "from plgrim.runtime import lockstep as module\n"
        "from tests.runtime.test_lockstep import MS, answering\n"
        "fakes = answering()\n"
        "module.make_stage = lambda name, options, setup: fakes[name]\n"
        "driver = module.Lockstep({}, 1, stages=tuple(fakes))\n"
        "driver.run_until(300 * MS)\n"
        "print(driver.digest())\n"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", program],
            cwd=REPOSITORY,
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": str(REPOSITORY), "PATH": ""},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("0", "1", "12345")
    }
    assert len(found) == 1 and found.pop().strip()


def test_outputs_name_what_their_step_consumed(lockstep: Callable[..., Lockstep]) -> None:
    """The envelope of a mission state names the odometry that it was made from."""
    named: list[tuple[str, object]] = []

    class Watching(Scripted):
        def step(self, now: Stamp, inputs: Inputs) -> Outputs:
            named.extend(("seen", r.sequence) for r in inputs.new(MISSION))
            return sends_odometry(now, 1)

    fakes = answering()
    fakes["sim"] = (fakes["sim"][0], Watching(MISSION))
    driver = lockstep(fakes)
    packed: list[dict[str, tuple[int, int]]] = []
    runner = driver._runners["mission"]
    original = type(runner.outbox).pack

    def pack(outbox: object, output: Output, now: Stamp, consumed: dict[str, tuple[int, int]]) -> bytes:
        if isinstance(output.message, MissionState):
            packed.append(dict(consumed))
        return original(outbox, output, now, consumed)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(runner.outbox), "pack", pack)
        driver.run_until(30 * MS)
    assert packed[0] == {}, "at 0 nothing had come"
    assert packed[1] == {ODOMETRY.name: (1, 1)}
    assert packed[2] == {ODOMETRY.name: (1, 2)}
    assert [sequence for _, sequence in named] == sorted({int(str(s)) for _, s in named})
