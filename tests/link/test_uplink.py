"""What becomes of messages that nobody at the base listens to yet."""

from __future__ import annotations

import time

import pytest

from plgrim.config import load_config
from plgrim.link.budget import Meter
from plgrim.link.routes import COMMANDS, MAPS
from plgrim.link.uplink import Meters, Uplink
from schemas.base import Message
from schemas.contract import Topic
from schemas.operation import CommandAnswer, CommandKind, MissionPhase
from schemas.topics import ANSWER, GLOBAL_IRM, ODOMETRY
from tests.link.fakes import global_irm
from tests.runtime.fake_services import odometry


def _uplink(lane: str) -> Uplink:
    config = load_config(overrides={"link": {"host": "robot", "endpoint": "tcp/127.0.0.1:1"}})
    return Uplink(lane, config, [], lambda *_: None, Meters(Meter(), Meter()))


def _answer(number: int) -> CommandAnswer:
    return CommandAnswer(
        stamp_ns=0, command_id=str(number), kind=CommandKind.STOP, accepted=True, reason="",
        phase=MissionPhase.EXPLORE, fence_ids=[], fences_version=0,
    )  # fmt: skip


def _take(uplink: Uplink, within_s: float = 2.0) -> bytes:
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        if (parcel := uplink._next()) is not None:
            return parcel.payload
    raise AssertionError("nothing to send")


def test_answers_of_one_step_all_go() -> None:
    uplink = _uplink(COMMANDS)
    for number in range(3):
        uplink.offer(ANSWER, b"%d" % number, _answer(number))
    assert [_take(uplink) for _ in range(3)] == [b"0", b"1", b"2"]


def test_an_answer_waits_for_its_reader_and_is_counted_when_none_comes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    uplink = _uplink(COMMANDS)
    uplink.offer(ANSWER, b"a", _answer(0))
    parcel = uplink._next()
    assert parcel is not None
    uplink._nobody_listens(parcel)
    assert _take(uplink) == b"a"
    assert uplink.counts()[1] == {}
    monkeypatch.setattr("plgrim.link.uplink._UNHEARD_NS", 0)
    uplink._nobody_listens(parcel)
    assert uplink.counts() == (0.0, {"mission/answer:link_queue_full": 1})


@pytest.mark.parametrize(
    ("topic", "message"), [(ODOMETRY, odometry(0, 0.0)), (GLOBAL_IRM, global_irm(0, 2, 1))]
)
def test_what_is_said_anew_is_not_kept_for_nobody(topic: Topic[Message], message: Message) -> None:
    uplink = _uplink(MAPS if topic is GLOBAL_IRM else COMMANDS)
    uplink.offer(topic, b"x", message)
    parcel = uplink._next()
    assert parcel is not None and not parcel.whole
    uplink._nobody_listens(parcel)
    assert uplink.counts() == (0.0, {})


def test_a_whole_graph_is_known_as_one() -> None:
    uplink = _uplink(MAPS)
    uplink.offer(GLOBAL_IRM, b"w", global_irm(0, 2, 0))
    parcel = uplink._next()
    assert parcel is not None and parcel.whole
