"""Damaged and foreign messages at the link process, over real routers: none crosses, none ends a lane, all count."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator

import pytest
from typer.testing import CliRunner

from plgrim.cli import application
from plgrim.config import Config, load_config
from plgrim.link.process import run_link
from plgrim.runtime.health import ask_health
from plgrim.runtime.router import run_router
from plgrim.runtime.zenoh_session import Link, connect
from schemas.base import Message
from schemas.codec import decode
from schemas.contract import Topic
from schemas.topics import GLOBAL_IRM, LINK, ODOMETRY, RISK_MAP
from tests.faults.bad_messages import bad_messages, good
from tests.runtime.conftest import _own_environment, config, endpoint, free_port, link, router  # noqa: F401
from tests.runtime.helpers import eventually

COUNT = 1200
_BATCH = 200


@pytest.fixture
def base(config: Config, free_port: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Link]:  # noqa: F811
    """A client of the base's router; the link process runs between it and the robot's."""
    place = f"tcp/127.0.0.1:{free_port}"
    monkeypatch.setenv("PLGRIM_LINK__HOST", "robot")
    monkeypatch.setenv("PLGRIM_LINK__ENDPOINT", place)
    robot, stop = load_config(), threading.Event()
    there = config.model_copy(update={"router": config.router.model_copy(update={"endpoint": place})})
    threads = [
        threading.Thread(target=run_router, args=(there, stop)),
        threading.Thread(target=run_link, args=(robot, stop)),
    ]
    for thread in threads:
        thread.start()
    with connect(there.router, "robot", threading.Event(), 20.0) as connected:
        yield connected
    stop.set()
    for thread in threads:
        thread.join()


def _counted(link: Link, topic: Topic[Message]) -> int:  # noqa: F811
    health = ask_health(link, LINK)
    assert health is not None
    return sum(n for reason, n in health.dropped.items() if reason.startswith(topic.name))


@pytest.mark.timeout(120)
def test_what_no_reader_would_take_does_not_cross_and_stops_nothing(link: Link, base: Link) -> None:  # noqa: F811
    heard: list[tuple[str, int]] = []

    def hear(topic: Topic[Message], payload: bytes) -> None:
        heard.append((topic.name, decode(payload, topic.message, topic.max_bytes)[1].sequence))

    topics = (GLOBAL_IRM, RISK_MAP, ODOMETRY)
    for topic in topics:
        base.subscribe(topic, hear, every=True)
    sequence = 0

    def crosses() -> bool:
        nonlocal sequence
        sequence += 1
        for topic in topics:
            link.session.put(topic.key("robot"), good(topic, "robot", 3, sequence))
        return {name for name, _ in heard} == {topic.name for topic in topics}

    eventually(lambda: ask_health(link, LINK), "the link process is there")
    eventually(crosses, "good messages cross")
    assert CliRunner().invoke(application, ["healthcheck", LINK, "--timeout", "20"]).exit_code == 0
    refused = _counted(link, GLOBAL_IRM)
    sources = {topic.name: bad_messages(topic, "robot", 3, sequence, 1) for topic in topics}
    for sent in range(_BATCH, COUNT + 1, _BATCH):
        for topic in topics:
            for _, payload in itertools.islice(sources[topic.name], _BATCH):
                if (
                    len(payload) <= 2**20
                ):  # what is oversized for a map takes the machine's time, and shows no more
                    link.session.put(topic.key("robot"), payload)
                else:
                    link.session.put(topic.key("robot"), b"")
        eventually(lambda: _counted(link, GLOBAL_IRM) == refused + sent, f"all {sent} are counted")  # noqa: B023
    good_before = sequence
    assert all(number <= good_before for _, number in heard), "a bad message has crossed"
    heard.clear()
    eventually(crosses, "good messages still cross on both lanes")
    report = ask_health(link, LINK)
    assert report is not None and report.ready and report.errors == 0


def test_an_envelope_that_counts_is_one_that_was_checked(link: Link, base: Link) -> None:  # noqa: F811
    """A mark from far ahead under a broken checksum must not make everything after it look old."""
    payload = bytearray(good(ODOMETRY, "robot", 2**40, 2**40))
    payload[-1] ^= 1
    eventually(lambda: ask_health(link, LINK), "the link process is there")
    heard: list[int] = []
    base.subscribe(ODOMETRY, lambda t, p: heard.append(decode(p, t.message, t.max_bytes)[1].epoch))
    eventually(
        lambda: _counted(link, ODOMETRY),
        "it is counted",
        doing=lambda: link.session.put(ODOMETRY.key("robot"), bytes(payload)),
    )
    sequences = itertools.count(1)
    eventually(
        lambda: heard,
        "later ones cross",
        doing=lambda: link.session.put(ODOMETRY.key("robot"), good(ODOMETRY, "robot", 3, next(sequences))),
    )
    assert heard[0] == 3
