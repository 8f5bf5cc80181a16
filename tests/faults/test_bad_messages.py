"""100,000 messages that must not be used: none accepted, none fatal, all counted, and memory stays as it was."""

from __future__ import annotations

import itertools
from typing import Any

import psutil
import pytest
import zenoh

from plgrim.config import Config
from plgrim.runtime.health import ask_health
from plgrim.runtime.mailbox import Mailbox
from plgrim.runtime.zenoh_session import Link
from schemas.base import Message
from schemas.contract import Topic
from schemas.topics import COMMAND, MISSION, ODOMETRY, PLAN, RISK_MAP
from tests.faults.bad_messages import KINDS, bad_messages, good
from tests.runtime.conftest import config, endpoint, link, router, start  # noqa: F401
from tests.runtime.helpers import FAKES, Start, eventually

COUNT = 100_000
_MIB = 2**20


@pytest.mark.parametrize("topic", [ODOMETRY, COMMAND, RISK_MAP, PLAN], ids=lambda topic: topic.name)
def test_a_mailbox_refuses_and_counts_them_all(topic: Topic[Message]) -> None:
    """A quarter of them on each of four topics, in this process."""
    box = Mailbox("robot", (topic,))
    assert box.accept(topic, good(topic, "robot", 3, 7), 0)
    seen: set[str] = set()
    process, warm = psutil.Process(), 0
    for number, (kind, payload) in enumerate(
        itertools.islice(bad_messages(topic, "robot", 3, 7, 1), COUNT // 4)
    ):
        seen.add(kind)
        assert not box.accept(topic, payload, 0), kind
        if number == COUNT // 20:
            warm = process.memory_info().rss
    assert sum(box.dropped.values()) == COUNT // 4
    assert seen == set(KINDS)
    assert (process.memory_info().rss - warm) / _MIB < 8.0
    assert box.accept(topic, good(topic, "robot", 3, 8), 0)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_live_service_refuses_and_counts_them_all(
    config: Config,  # noqa: F811
    link: Link,  # noqa: F811
    start: Start,  # noqa: F811
) -> None:
    """Over Zenoh, to a process: the next few hundred follow when it has counted the last; it steps on all the while."""
    process = start(str(FAKES), "mission")
    eventually(lambda: _count(link) is not None, "it is ready")
    writer: Any = link.session.declare_publisher(
        COMMAND.key("robot"), congestion_control=zenoh.CongestionControl.BLOCK
    )
    eventually(lambda: writer.matching_status.matching, "the service's subscription is known here")
    for sequence in (1, 2):
        writer.put(good(COMMAND, "robot", 3, sequence))
    sent, memory = 0, psutil.Process(process.pid)
    warm, source = 0, bad_messages(COMMAND, "robot", 3, 2, 1)
    while sent < COUNT:
        for _, payload in itertools.islice(source, 400):
            writer.put(payload)
        sent += 400
        eventually(lambda: _count(link) == sent, f"all {sent} are counted")  # noqa: B023
        if sent == COUNT // 5:
            warm = memory.memory_info().rss
    health = ask_health(link, "mission")
    assert health is not None and health.ready and health.errors == 0
    grown = (memory.memory_info().rss - warm) / _MIB
    print(f"\n{sent} sent, {sum(health.dropped.values())} counted: {health.dropped}; memory {grown:+.1f} MiB")
    assert grown < 10.0
    heard: list[bytes] = []
    link.subscribe(MISSION, lambda _, payload: heard.append(payload))
    eventually(lambda: len(heard) > 1, "it still says something")


def _count(link: Link) -> int | None:  # noqa: F811
    health = ask_health(link, "mission")
    if health is None:
        return None
    return sum(n for reason, n in health.dropped.items() if reason.startswith(COMMAND.name))
