"""What the base alone writes, as the robot's readers get it: commands of an operator above all."""

from __future__ import annotations

from plgrim.link.config import LinkConfig
from plgrim.link.relay import Relay
from plgrim.link.routes import up_plain
from plgrim.runtime.mailbox import Mailbox
from schemas.codec import Envelope, decode, encode
from schemas.contract import SECOND_NS
from schemas.operation import CommandKind, MissionCommand
from schemas.topics import COMMAND, read_by

CONFIG = LinkConfig(host="robot", endpoint="tcp/base:1", at_base=("gcp", "status"))
SILENT_NS = CONFIG.ns("silent_after_s")


def _relay(epoch: int = 1000) -> Relay:
    return Relay("robot", tuple(up_plain(CONFIG)), epoch, SILENT_NS)


def _command(name: str, epoch: int, sequence: int, robot: str = "robot") -> bytes:
    message = MissionCommand(stamp_ns=0, command_id=name, kind=CommandKind.STOP)
    return encode(message, Envelope(robot, "status", epoch, sequence, 0))


def _name(payload: bytes) -> str:
    return decode(payload, MissionCommand, COMMAND.max_bytes)[0].command_id


def test_a_base_with_an_earlier_clock_is_heard_by_the_link_and_by_the_mission() -> None:
    """It was replaced, or wiped: its lives are earlier than those that the robot has heard of."""
    relay, mission = _relay(), Mailbox("robot", tuple(read_by("mission")))
    first = relay.receive(COMMAND, _command("a", 5_000_000, 1), 0)
    assert first is not None and mission.accept(COMMAND, first, 0)
    assert relay.receive(COMMAND, _command("old", 4_000, 9), SILENT_NS) is None, (
        "two that speak: the later life"
    )
    assert relay.dropped == {"status/command:wrong_sender": 1}
    found = relay.receive(COMMAND, _command("b", 4_000, 10), SILENT_NS + 1)
    assert found is not None and _name(found) == "b"
    assert mission.accept(COMMAND, found, 0), mission.last_refusal


def test_its_messages_keep_their_order_and_come_once() -> None:
    relay, mission = _relay(), Mailbox("robot", tuple(read_by("mission")))
    for number, (epoch, sequence) in enumerate([(7, 1), (7, 2), (7, 2), (8, 1), (7, 3)]):
        found = relay.receive(COMMAND, _command(str(number), epoch, sequence), number * SECOND_NS)
        if found is not None:
            assert mission.accept(COMMAND, found, 0), mission.last_refusal
    got = [received.message for received in mission.inputs(0).messages[COMMAND.name]]
    assert [m.command_id for m in got if isinstance(m, MissionCommand)] == ["0", "1", "3"]
    assert relay.dropped == {"status/command:wrong_sender": 2}


def test_the_next_life_of_the_link_follows_the_last() -> None:
    mission = Mailbox("robot", tuple(read_by("mission")))
    for epoch in (1000, 2000):
        found = _relay(epoch).receive(COMMAND, _command("a", 7, 1), 0)
        assert found is not None and mission.accept(COMMAND, found, 0), mission.last_refusal


def test_what_is_foreign_or_damaged_is_refused_and_counted() -> None:
    relay = _relay()
    assert relay.receive(COMMAND, _command("a", 1, 1, robot="other"), 0) is None
    assert relay.receive(COMMAND, b"\xc1Zdamaged", 0) is None
    assert relay.dropped == {"status/command:wrong_sender": 1, "status/command:malformed": 1}
