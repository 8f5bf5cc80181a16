"""The mailbox of a stage and the way out: order, freshness, refusals, staleness, and what outputs name as consumed."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plgrim.runtime import mailbox as mailbox_module
from plgrim.runtime.mailbox import Mailbox, Outbox
from schemas.codec import Envelope, decode, encode
from schemas.contract import Output
from schemas.operation import CommandKind, MissionCommand
from schemas.topics import COMMAND, LOCAL_POLICY, MISSION, ODOMETRY, POSE_GRAPH
from tests.runtime.fake_services import odometry

TOPICS = (ODOMETRY, COMMAND, MISSION)


def envelope(writer: str = "sim", epoch: int = 1, sequence: int = 1, robot: str = "robot") -> Envelope:
    return Envelope(robot, writer, epoch, sequence, 5)


def pose(x_m: float, **sender: object) -> bytes:
    return encode(odometry(7, x_m), replace(envelope(), **sender))  # type: ignore[arg-type]


def command(number: int) -> bytes:
    message = MissionCommand(stamp_ns=number, command_id=str(number), kind=CommandKind.PAUSE)
    return encode(message, envelope("status", sequence=number))


def box() -> Mailbox:
    return Mailbox("robot", TOPICS)


# --- queues -------------------------------------------------------------------------------------------------------


def test_only_the_latest_is_kept_where_the_table_says_so() -> None:
    inbox = box()
    for sequence, x in ((1, 1.0), (2, 2.0), (3, 3.0)):
        assert inbox.accept(ODOMETRY, pose(x, sequence=sequence), 0)
    inputs = inbox.inputs(0)
    assert [r.message.pose.x_m for r in inputs.new(ODOMETRY)] == [3.0]
    newest = inputs.latest(ODOMETRY)
    assert newest is not None and newest.sequence == 3


@given(st.lists(st.integers(0, 3), max_size=8))
def test_all_are_kept_in_order_and_handed_out_once(arrivals: list[int]) -> None:
    """arrivals: how many commands come before each step."""
    inbox, number = box(), 0
    for count in arrivals:
        expected = []
        for _ in range(count):
            number += 1
            expected.append(str(number))
            assert inbox.accept(COMMAND, command(number), number)
        inputs = inbox.inputs(number)
        assert [r.message.command_id for r in inputs.new(COMMAND)] == expected
        newest = inputs.latest(COMMAND)
        assert (newest.message.command_id if newest else None) == (str(number) if number else None)
        inbox.stepped()


def test_what_a_step_has_seen_stays_readable_and_is_no_longer_fresh() -> None:
    inbox = box()
    inbox.accept(ODOMETRY, pose(1.0), 0)
    first = inbox.inputs(0)
    assert first.new(ODOMETRY) and first.current(ODOMETRY) is not None
    inbox.stepped()
    second = inbox.inputs(1)
    assert second.new(ODOMETRY) == []
    again = second.latest(ODOMETRY)
    assert again is not None and not again.fresh and again.message.pose.x_m == 1.0
    inbox.accept(ODOMETRY, pose(2.0, sequence=2), 2)
    assert [r.fresh for r in inbox.inputs(2).new(ODOMETRY)] == [True]


def test_a_queue_that_nobody_empties_loses_its_oldest_and_counts_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mailbox_module, "_KEEP_ALL_LIMIT", 4)
    inbox = box()
    for number in range(1, 8):
        assert inbox.accept(COMMAND, command(number), 0)
    assert [r.message.command_id for r in inbox.inputs(0).new(COMMAND)] == ["4", "5", "6", "7"]
    assert inbox.dropped == {"status/command:queue_full": 3}


# --- refusals -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sender", "says"),
    [
        ({"robot": "other"}, "other"),
        ({"writer": "gcp"}, "gcp"),
        ({"epoch": 1, "sequence": 9}, "epoch 1 is over"),
        ({"epoch": 2, "sequence": 3}, "sequence 3 is not newer"),
        ({"epoch": 2, "sequence": 2}, "sequence 2 is not newer"),
    ],
)
def test_a_wrong_sender_is_refused_counted_and_changes_nothing(sender: dict[str, object], says: str) -> None:
    inbox = box()
    assert inbox.accept(ODOMETRY, pose(1.0, epoch=2, sequence=3), 0)
    assert not inbox.accept(ODOMETRY, pose(99.0, **sender), 1)
    assert inbox.dropped == {"sim/odometry:wrong_sender": 1}
    assert says in inbox.last_refusal
    held = inbox.inputs(1).latest(ODOMETRY)
    assert held is not None and held.message.pose.x_m == 1.0


def test_a_new_life_of_the_writer_begins_its_sequence_anew() -> None:
    inbox = box()
    assert inbox.accept(ODOMETRY, pose(1.0, epoch=1, sequence=500), 0)
    assert inbox.accept(ODOMETRY, pose(2.0, epoch=2, sequence=1), 0)
    assert not inbox.accept(ODOMETRY, pose(3.0, epoch=1, sequence=501), 0)
    assert inbox.accept(ODOMETRY, pose(4.0, epoch=2, sequence=7), 0), (
        "gaps are allowed: latest-only links drop"
    )


def test_the_order_is_remembered_over_a_step() -> None:
    inbox = box()
    assert inbox.accept(COMMAND, command(3), 0)
    inbox.stepped()
    assert not inbox.accept(COMMAND, command(3), 1)
    assert not inbox.accept(COMMAND, command(2), 1)
    assert inbox.accept(COMMAND, command(4), 1)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda b: b[:-1] + bytes([b[-1] ^ 1]), "bad_checksum"),
        (lambda b: b"", "malformed"),
        (lambda b: b * 10_000, "too_large"),
        (lambda b: command(1), "unknown_schema"),
    ],
)
def test_damaged_messages_are_counted_by_reason(damage: object, reason: str) -> None:
    inbox = box()
    assert callable(damage)
    for _ in range(2):
        assert not inbox.accept(ODOMETRY, damage(pose(1.0)), 0)
    assert inbox.dropped == {f"sim/odometry:{reason}": 2}
    assert inbox.inputs(0).latest(ODOMETRY) is None


# --- staleness ----------------------------------------------------------------------------------------------------


def test_age_is_counted_from_receipt_on_the_receivers_clock() -> None:
    """Whatever stamps a message carries: clocks of two machines need not agree."""
    inbox, limit = box(), ODOMETRY.stale_after_ns
    inbox.accept(ODOMETRY, pose(1.0), 1_000)
    for age, stale in ((0, False), (limit, False), (limit + 1, True)):
        inputs = inbox.inputs(1_000 + age)
        newest = inputs.latest(ODOMETRY)
        assert newest is not None
        assert (newest.age_ns, newest.stale) == (age, stale)
        assert (inputs.current(ODOMETRY) is None) == stale


def test_topics_without_a_limit_never_go_stale() -> None:
    inbox = box()
    assert COMMAND.stale_after_ns == 0
    inbox.accept(COMMAND, command(1), 0)
    assert inbox.inputs(10**15).current(COMMAND) is not None


def test_what_is_missing_is_named() -> None:
    inbox = box()
    assert inbox.missing(0) == [ODOMETRY.name, MISSION.name], "commands come when they come"
    inbox.accept(ODOMETRY, pose(1.0), 0)
    assert inbox.missing(ODOMETRY.stale_after_ns) == [MISSION.name]
    assert inbox.missing(ODOMETRY.stale_after_ns + 1) == [ODOMETRY.name, MISSION.name]


# --- the way out --------------------------------------------------------------------------------------------------


def test_outputs_name_exactly_the_inputs_that_were_looked_at() -> None:
    inbox = box()
    inbox.accept(ODOMETRY, pose(1.0, epoch=4, sequence=9), 0)
    inbox.accept(COMMAND, command(1), 0)
    inbox.accept(COMMAND, command(2), 0)
    inputs = inbox.inputs(0)
    assert inputs.consumed == {}
    inputs.current(ODOMETRY)
    inputs.latest(MISSION)
    out = Outbox("robot", "sim", 3)
    _, named = decode(
        out.pack(Output(ODOMETRY, odometry(1, 0.0)), 1, inputs.consumed), ODOMETRY.message, 10**6
    )
    assert named.consumed == {ODOMETRY.name: (4, 9)}, "not what nobody looked at, nor what never came"
    inputs.new(COMMAND)
    _, named = decode(
        out.pack(Output(ODOMETRY, odometry(1, 0.0)), 1, inputs.consumed), ODOMETRY.message, 10**6
    )
    assert named.consumed == {ODOMETRY.name: (4, 9), COMMAND.name: (1, 2)}


def test_sequences_count_by_topic_from_one() -> None:
    out = Outbox("robot", "sim", 3)
    sequences = []
    for topic, message in ((ODOMETRY, odometry(1, 0.0)), (ODOMETRY, odometry(2, 0.0))):
        _, named = decode(out.pack(Output(topic, message), 77, {}), topic.message, 10**6)
        sequences.append(named.sequence)
        assert (named.robot, named.writer, named.epoch, named.sent_ns) == ("robot", "sim", 3, 77)
    assert sequences == [1, 2]


def test_nobody_writes_what_is_not_theirs_nor_more_than_the_table_allows() -> None:
    with pytest.raises(ValueError, match="belongs to sim"):
        Outbox("robot", "lcp", 1).pack(Output(ODOMETRY, odometry(1, 0.0)), 0, {})
    narrow = replace(ODOMETRY, max_bytes=50)
    with pytest.raises(ValueError, match="50"):
        Outbox("robot", "sim", 1).pack(Output(narrow, odometry(1, 0.0)), 0, {})
    assert LOCAL_POLICY.writer == "lcp" and POSE_GRAPH.writer == "sim"
