"""The live driver over real Zenoh: exchange, refusal, one instance only, errors, ends."""

from __future__ import annotations

import signal
import threading
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plgrim.config import Config
from plgrim.errors import AlreadyRunningError
from plgrim.runtime.health import ask_health, token_key
from plgrim.runtime.journal import Journal
from plgrim.runtime.keeper import Keeper
from plgrim.runtime.live import LiveDriver, next_due
from plgrim.runtime.mailbox import Mailbox
from plgrim.runtime.service import LiveService
from plgrim.runtime.zenoh_session import Link, connect
from schemas.base import Message
from schemas.codec import Envelope, decode, encode
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, StageSpec, Stamp, Topic
from schemas.operation import FinishReason, MissionState, StageHealth, WorldPicture
from schemas.topics import MISSION, ODOMETRY, PLAN, WORLD_PICTURE, health_topic, read_by
from tests.runtime.fake_services import FakeMission, Remembering, mission_state, odometry
from tests.runtime.helpers import FAKES, Start, eventually


class _Heard:
    """Collects the messages of topics."""

    def __init__(self, link: Link, *topics: Topic[Message]) -> None:
        self.messages: dict[str, list[Message]] = {topic.name: [] for topic in topics}
        self.envelopes: dict[str, list[Envelope]] = {topic.name: [] for topic in topics}
        for topic in topics:
            link.subscribe(topic, self._receive, every=True)

    def _receive(self, topic: Topic[Message], payload: bytes) -> None:
        message, envelope = decode(payload, topic.message, topic.max_bytes)
        self.messages[topic.name].append(message)
        self.envelopes[topic.name].append(envelope)

    def last(self, topic: Topic[Message]) -> Message | None:
        """The newest message of a topic."""
        return self.messages[topic.name][-1] if self.messages[topic.name] else None


def _health(link: Link, service: str) -> StageHealth | None:
    return ask_health(link, service, 2.0)


def _is_ready(link: Link, service: str) -> bool:
    health = _health(link, service)
    return health is not None and health.ready


def test_two_processes_exchange_messages_and_name_what_they_consumed(link: Link, start: Start) -> None:
    heard = _Heard(link, MISSION, health_topic("mission"))
    mission, _ = start(str(FAKES), "mission"), start(str(FAKES), "sim")

    def counted() -> bool:
        state = heard.last(MISSION)
        return isinstance(state, MissionState) and state.distance_m >= 5

    eventually(counted, "five odometry messages reached the mission")
    envelope = heard.envelopes[MISSION.name][-1]
    assert envelope.writer == "mission"
    assert envelope.consumed[ODOMETRY.name][1] >= 5

    def beaten() -> (
        bool
    ):  # the heartbeat has a period of its own: the last one may be older than the last message
        health = _health(link, "mission")
        return health is not None and health.steps >= 5

    eventually(beaten, "a heartbeat tells of five steps")
    health = _health(link, "mission")
    assert health is not None
    assert health.ready
    assert health.pid == mission.pid
    assert health.errors == 0
    assert health.memory_mb > 1


def _payload(sequence: int, writer: str = "sim", robot: str = "robot", epoch: int = 5) -> bytes:
    return encode(odometry(SECOND_NS, 1.0), Envelope(robot, writer, epoch, sequence, SECOND_NS))


def _mixed_payloads() -> list[bytes]:
    damaged = bytearray(_payload(4))
    damaged[-1] ^= 0xFF
    return [
        _payload(1),
        _payload(2),
        bytes(damaged),
        b"no message at all",
        b"",
        _payload(2),
        _payload(3, writer="gcp"),
        _payload(3, robot="other"),
        _payload(3, epoch=4),
        encode(mission_state(1, 0, FinishReason.NONE), Envelope("robot", "mission", 5, 9, 1)),
        _payload(3),
        _payload(1, epoch=6),
    ]


def test_live_and_lock_step_accept_and_refuse_the_same_messages(link: Link, start: Start) -> None:
    expected = Mailbox("robot", tuple(read_by("mission")))
    accepted = [expected.accept(ODOMETRY, payload, 0) for payload in _mixed_payloads()]
    assert accepted.count(True) == 4
    heard = _Heard(link, MISSION)
    start(str(FAKES), "mission")
    eventually(lambda: _is_ready(link, "mission"), "the fake mission is ready")
    seen = dropped = 0
    for payload, good in zip(_mixed_payloads(), accepted, strict=True):
        link.publish(ODOMETRY, payload)
        seen, dropped = seen + good, dropped + (not good)

        def caught_up(seen: int = seen, dropped: int = dropped) -> bool:
            health, state = _health(link, "mission"), heard.last(MISSION)
            distance = state.distance_m if isinstance(state, MissionState) else 0
            return health is not None and sum(health.dropped.values()) == dropped and distance == seen

        eventually(caught_up, f"{seen} accepted and {dropped} refused")
    health = _health(link, "mission")
    assert health is not None
    assert Counter(health.dropped) == expected.dropped


def test_a_second_instance_is_refused_with_a_clear_error(link: Link, start: Start) -> None:
    first = start(str(FAKES), "mission")
    eventually(lambda: _is_ready(link, "mission"), "the first instance is ready")
    second = start(str(FAKES), "mission")
    output, _ = second.communicate(timeout=60)
    assert second.returncode == AlreadyRunningError.exit_code
    assert f"mission of robot 'robot' is already running (process {first.pid})" in output
    assert first.poll() is None
    assert _is_ready(link, "mission")


def test_a_killed_instance_makes_room_for_the_next(link: Link, start: Start) -> None:
    first = start(str(FAKES), "mission")
    eventually(lambda: _is_ready(link, "mission"), "the first instance is ready")
    first.kill()
    second = start(str(FAKES), "mission")

    def taken_over() -> bool:
        health = _health(link, "mission")
        return health is not None and health.pid == second.pid

    eventually(taken_over, "the second instance answers")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_service_cleanly(link: Link, start: Start, number: signal.Signals) -> None:
    process = start(str(FAKES), "sim")
    eventually(lambda: _is_ready(link, "sim"), "the service is ready")
    process.send_signal(number)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "Traceback" not in output
    eventually(lambda: not link.tokens(token_key("robot", "sim", "*")), "its token is gone")


def test_a_stage_that_always_fails_ends_its_process(link: Link, start: Start) -> None:
    process = start(str(FAKES), "sim", "failing")
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 6
    assert "3 steps in a row failed" in output
    assert "this stage always fails" in output


def test_no_router_is_a_clear_error(start: Start, config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLGRIM_RUNTIME__ROUTER_TIMEOUT_S", "0.1")
    process = start(str(FAKES), "sim")
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 5
    assert config.router.endpoint in output


def _picture(sequence: int) -> bytes:
    message = WorldPicture(stamp_ns=1, resolution_m=1.0, ix0=0, iy0=0, cell=np.zeros((2, 2), np.uint8))
    return encode(message, Envelope("robot", "sim", 5, sequence, 1))


def test_a_late_joiner_gets_what_is_rare_and_nothing_that_goes_stale(link: Link, config: Config) -> None:
    link.publish(WORLD_PICTURE, _picture(1))
    link.publish(ODOMETRY, _payload(1))
    with connect(config.router, config.robot, threading.Event(), 20.0) as late:
        heard = _Heard(late, WORLD_PICTURE, ODOMETRY)
        eventually(lambda: heard.last(WORLD_PICTURE), "the picture from before came")
        eventually(
            lambda: heard.last(ODOMETRY), "new odometry comes", lambda: link.publish(ODOMETRY, _payload(2))
        )
        assert {envelope.sequence for envelope in heard.envelopes[ODOMETRY.name]} == {2}


class _Recorder(FakeMission):
    """Blocks in its first step until it is let go, and keeps what each step saw."""

    def __init__(self) -> None:
        super().__init__(0)
        self.entered, self.go = threading.Event(), threading.Event()
        self.seen: list[list[int]] = []

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Note the sequences that are new."""
        self.seen.append([one.sequence for one in inputs.new(ODOMETRY)])
        if self.seen[-1]:
            self.entered.set()
            self.go.wait(30)
        return []


def test_what_arrives_during_a_step_is_fresh_in_the_next(link: Link, config: Config) -> None:
    stage, stop = _Recorder(), threading.Event()
    with LiveService("mission", config, stop) as service:
        driver = LiveDriver(service, StageSpec("mission", SECOND_NS // 100), stage)
        thread = threading.Thread(target=driver.run, args=(stop,))
        thread.start()
        try:
            eventually(lambda: service.monitor.ready, "the driver is ready")
            eventually(stage.entered.is_set, "the first step", lambda: link.publish(ODOMETRY, _payload(1)))
            link.publish(ODOMETRY, _payload(2))
            eventually(lambda: driver._mailbox._held[ODOMETRY.name][-1].envelope.sequence == 2, "it is there")
            stage.go.set()
            eventually(lambda: [2] in stage.seen, "the next step sees it as new")
        finally:
            stage.go.set()
            stop.set()
            thread.join()


def test_a_stage_cannot_write_what_belongs_to_another(config: Config, router: None) -> None:
    class Thief(FakeMission):
        def step(self, now: Stamp, inputs: Inputs) -> Outputs:
            return [Output(ODOMETRY, odometry(now, 0.0))]

    with LiveService("mission", config, threading.Event()) as service:
        driver = LiveDriver(service, StageSpec("mission", SECOND_NS), Thief(0))
        driver._step(1)
        assert service.monitor.errors == 1
        assert "mission may not write sim/odometry" in service.monitor.last_error
        assert PLAN.writer == "reconciler"


def test_what_is_acknowledged_is_on_the_disk_before_it_is_said(
    config: Config, router: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Read by another connection, as a restarted process would, at the very moment of publishing."""
    on_disk: list[list[bytes]] = []

    def publish(link: Link, topic: Topic[Message], payload: bytes) -> None:
        del link, payload
        if topic.name == MISSION.name:
            on_disk.append([*Journal(tmp_path, "mission").recover()[0].records])

    class Numbered(Remembering):
        def step(self, now: Stamp, inputs: Inputs) -> Outputs:
            self._seen += 1
            return super().step(now, inputs)

    stage, stop = Numbered(0), threading.Event()
    with LiveService("mission", config, stop) as service:
        keeper = Keeper(Journal(tmp_path, "mission"), 5.0)
        keeper.recover(lambda: stage, 0)
        driver = LiveDriver(service, StageSpec("mission", SECOND_NS), stage, keeper)
        monkeypatch.setattr(Link, "publish", publish)
        for now in (1, 2, 3):
            driver._step(now)
        assert service.monitor.errors == 0
    assert on_disk == [[b"1"], [b"1", b"2"], [b"1", b"2", b"3"]]


def test_a_flood_of_queries_is_answered_a_few_at_a_time(config: Config, link: Link) -> None:
    """Whoever may ask could else have any number of threads wait in the service."""
    go_on, lock = threading.Event(), threading.Lock()
    now = most = 0

    def reply(payload: bytes) -> bytes:
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        go_on.wait(20.0)
        with lock:
            now -= 1
        return payload

    link.serve("plgrim/test/question", reply)
    with connect(config.router, config.robot, threading.Event(), 20.0) as other:
        answers: list[bytes | None] = []

        def ask() -> None:
            answers.append(other.ask("plgrim/test/question", 20.0, b"?"))

        threads = [threading.Thread(target=ask) for _ in range(40)]
        for thread in threads:
            thread.start()
        eventually(lambda: len(answers) == 32, "most are sent away")
        assert answers == [None] * 32
        go_on.set()
        for thread in threads:
            thread.join()
        assert most == 8
        assert answers.count(b"?") == 8
        eventually(lambda: other.ask("plgrim/test/question", 5.0, b"again") == b"again", "it answers again")


@given(
    period=st.integers(1, 10**10),
    due=st.integers(0, 10**12),
    late=st.integers(0, 10**11),
    took=st.integers(0, 10**11),
    triggered=st.booleans(),
)
def test_the_next_step_is_ahead_by_at_most_a_period_and_keeps_the_phase(
    period: int, due: int, late: int, took: int, triggered: bool
) -> None:
    began = due + late
    ended = began + took
    following = next_due(period, due, began, ended, triggered)
    assert ended < following <= ended + period
    assert (following - (began if triggered else due)) % period == 0
