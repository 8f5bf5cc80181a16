"""A recorded stage says the same again, byte for byte; what differs or is missing is named."""

from __future__ import annotations

import threading
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from plgrim.config import Config
from plgrim.recording import life
from plgrim.recording.reader import read_raw
from plgrim.recording.recorder import Recorder
from plgrim.recording.replay import Replay, ReplayReport
from plgrim.recording.writer import Ring
from plgrim.runtime.live import drive
from plgrim.runtime.step_log import NotedStopwatch, StepLog
from plgrim.runtime.zenoh_session import Link, connect
from schemas.codec import Envelope, decode, encode
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSetup, StageSpec, Stamp
from schemas.operation import FinishReason
from schemas.recording import StageSnapshot, StepRecord
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import MISSION, ODOMETRY
from tests.runtime.fake_services import mission_state, odometry
from tests.runtime.helpers import eventually


class Options(BaseModel):
    """Of the fake."""

    scale: float = 1.0


class Hurried:
    """A mission whose distance hangs on all it has ever heard, when, in what order, and on its stopwatch."""

    def __init__(self, setup: StageSetup, scale: float = 1.0) -> None:
        assert setup.stopwatch is not None
        self._watch = setup.stopwatch
        self._scale = scale
        self._sum = 0.0

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Fails now and then, in the middle."""
        for received in inputs.new(ODOMETRY):
            self._sum += received.message.pose.x_m * (1.0 + received.age_ns % 1000)
        for _ in range(3):
            self._sum += self._watch() % 1.0
        if int(self._sum) % 7 == 3:
            raise ValueError(f"no luck at {self._sum}")
        state = mission_state(now, 1, FinishReason.NONE)
        return [Output(MISSION, state.model_copy(update={"distance_m": self._scale * self._sum}))]

    def snapshot(self) -> bytes:
        """The sum."""
        return pack_snapshot({"sum": self._sum})

    def restore(self, snapshot: bytes) -> None:
        """The sum."""
        self._sum = unpack_snapshot(snapshot)["sum"]


@pytest.fixture
def fake_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replays make the fake in the place of the mission."""

    def create(config: Options, setup: StageSetup) -> Stage:
        return Hurried(setup, config.scale)

    module = types.SimpleNamespace(Config=Options, create=create)
    monkeypatch.setattr(life, "stage_module", lambda name: module)


@pytest.fixture
def recorded(
    config: Config, link: Link, tmp_path: Path, fake_stage: None, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A recording of the fake, which ran before the recorder came."""
    stop = threading.Event()
    stopwatch = NotedStopwatch()
    log = StepLog("mission", 1, "{}", stopwatch, period_s=0.7)

    def make() -> tuple[StageSpec, Stage]:
        return StageSpec("mission", SECOND_NS // 50), Hurried(StageSetup("robot", 1, stopwatch))

    errors = config.runtime.model_copy(update={"max_consecutive_errors": 1000})
    lenient = config.model_copy(update={"runtime": errors})
    thread = threading.Thread(target=drive, args=("mission", lenient, make, stop, log))
    thread.start()
    sent = [0]

    def feed() -> None:
        sent[0] += 1
        link.publish(ODOMETRY, encode(odometry(1, 1.0), Envelope("robot", "sim", 5, sent[0], 1)))

    said: list[bytes] = []
    link.subscribe(MISSION, lambda _, payload: said.append(payload), every=True)
    eventually(lambda: len(said) > 10, "the fake runs", feed)
    with connect(config.router, "robot", threading.Event(), 20.0) as own:
        recorder = Recorder(own, Ring(tmp_path / "r", {}))
        recorder.start()
        eventually(lambda: recorder.counts["mission/snapshot"] >= 3, "snapshots came", feed, 90.0)
        eventually(lambda: recorder.counts["mission/steps"] >= 25, "steps came", feed, 90.0)
    recorder.close()
    stop.set()
    thread.join()
    assert not recorder.lost, "this machine is too busy for the test"
    return tmp_path / "r"


def _replay(path: Path, **options: Any) -> ReplayReport:
    return Replay(("mission",), **options).run(path)


def test_a_live_stage_says_the_same_again(recorded: Path) -> None:
    report = _replay(recorded)
    assert report.same, report.summary()
    steps, (first, *_) = _records(recorded)
    assert report.steps["mission"] == sum(s.step >= first for s in steps.values()) > 10
    assert 5 < report.outputs["mission"] < report.steps["mission"]  # some steps failed, again


def test_a_stage_that_has_changed_is_told_by_topic_sequence_and_field(recorded: Path) -> None:
    report = _replay(recorded, overrides={"mission": {"scale": 1.5}})
    (difference,) = report.differences
    assert not report.same
    assert (difference.topic, difference.field) == ("mission/state", "distance_m")
    assert difference.sequence >= 1
    assert "recorded " in difference.says


def _without(path: Path, out: Path, unwanted: Callable[[str, int], bool]) -> Path:
    ring = Ring(out, {})
    for raw in read_raw(path, lambda _: None):
        if not unwanted(raw.topic, raw.sequence):
            ring.add(raw, [], raw.sent_ns)
    ring.close()
    return out


def _records(path: Path) -> tuple[dict[int, StepRecord], list[int]]:
    """The step records by their sequence on the wire, and the steps that a snapshot was taken before."""
    steps, snapshots = {}, []
    for raw in read_raw(path, lambda _: None):
        if raw.topic == "mission/steps":
            steps[raw.sequence] = decode(raw.payload, StepRecord, 1 << 20)[0]
        elif raw.topic == "mission/snapshot":
            snapshots.append(decode(raw.payload, StageSnapshot, 1 << 20)[0].step)
    return steps, sorted(snapshots)


@pytest.mark.parametrize("topic", ["sim/odometry", "mission/steps"])
def test_what_was_not_recorded_is_named_and_the_rest_goes_on_from_the_next_snapshot(
    recorded: Path, tmp_path: Path, topic: str
) -> None:
    steps, (first, second, *_) = _records(recorded)
    between = {n: s for n, s in steps.items() if first < s.step < second and len(s.arrived_topic)}
    assert between
    sequence, at = min(between.items())
    lost = sequence if topic == "mission/steps" else int(at.arrived_sequence[0])
    report = _replay(_without(recorded, tmp_path / "holes", lambda t, n: t == topic and n == lost))
    assert not report.same
    assert not report.differences
    assert any("not recorded" in gap for gap in report.gaps)
    done = sum(first <= s.step < at.step or s.step >= second for s in steps.values())
    assert report.steps["mission"] == done


def test_an_output_that_was_not_recorded_is_compared_all_the_same(recorded: Path, tmp_path: Path) -> None:
    report = _replay(_without(recorded, tmp_path / "holes", lambda topic, _: topic == "mission/state"))
    assert report.same


def test_other_recorded_bytes_are_a_difference(recorded: Path, tmp_path: Path) -> None:
    """The checksum in the step record decides, not the message beside it."""
    ring = Ring(tmp_path / "forged", {})
    for raw in read_raw(recorded, lambda _: None):
        if raw.topic == "sim/odometry":
            other = encode(odometry(1, 2.0), Envelope("robot", "sim", 5, raw.sequence, 1))
            raw = replace_payload(raw, other)
        ring.add(raw, [], raw.sent_ns)
    ring.close()
    report = _replay(tmp_path / "forged")
    assert report.differences
    assert report.differences[0].service == "mission"


def replace_payload(raw: Any, payload: bytes) -> Any:
    """The same message with other bytes."""
    return raw._replace(payload=payload)


def test_a_replay_keeps_to_its_speed(recorded: Path) -> None:
    full = _replay(recorded)
    paced = _replay(recorded, speed=2.0)
    assert paced.same
    assert paced.wall_s >= (full.ended_ns - full.began_ns) / SECOND_NS / 2.0


def test_a_recording_without_steps_is_not_the_same(recorded: Path, tmp_path: Path) -> None:
    report = _replay(_without(recorded, tmp_path / "none", lambda topic, _: topic == "mission/steps"))
    assert not report.same
    assert list(report.gaps) == ["no steps are recorded of mission"]
