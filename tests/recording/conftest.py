"""What the tests of recordings share: the runtime's router and links, and a recording of some seconds in lock-step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from plgrim.recording.envelope import Raw
from plgrim.recording.recorder import raw_of
from plgrim.recording.well_known import Translator
from plgrim.recording.writer import Ring, about
from plgrim.runtime.lockstep import Lockstep
from schemas.base import Message
from schemas.codec import Envelope, encode
from schemas.contract import SECOND_NS, Stamp, Topic
from schemas.operation import StageHealth
from schemas.topics import health_topic
from tests.runtime.conftest import _own_environment, config, endpoint, free_port, link, router, start

__all__ = ["_own_environment", "config", "endpoint", "free_port", "link", "router", "start"]


class Short:
    """A recording of some seconds of a simulated mission, and the messages in it."""

    def __init__(self, folder: Path, seconds: int) -> None:
        self.folder = folder
        self.raws: list[Raw] = []
        self._ring = Ring(folder, about("robot", 3, "subway_1x"))
        self._translator = Translator()
        self._count: dict[str, int] = {}
        options: dict[str, dict[str, Any]] = {
            "sim": {"world": "subway_1x", "seed": 3},
            "reconciler": {"simulations": 256},
        }
        Lockstep(options, seed=3, observer=self.add).run_until(seconds * SECOND_NS)
        health = StageHealth(
            stamp_ns=1, service="gcp", ready=True, steps=1, step_p50_ms=1.0, step_p99_ms=2.0, rate_hz=1.0,
            memory_mb=9.0, pid=7, errors=0, last_error="", dropped={}, waiting_for=["irm/global_irm"],
        )  # fmt: skip
        self.add(health_topic("gcp"), health, 1)
        self._ring.close()

    def add(self, topic: Topic[Message], message: Message, now: Stamp) -> None:
        """Record a message."""
        self._count[topic.name] = self._count.get(topic.name, 0) + 1
        envelope = Envelope("robot", topic.writer, 1, self._count[topic.name], now)
        raw = raw_of(topic, envelope, encode(message, envelope))
        self.raws.append(raw)
        self._ring.add(raw, self._translator(message), message.stamp_ns)


@pytest.fixture(scope="session")
def short(tmp_path_factory: pytest.TempPathFactory) -> Short:
    """Four seconds in a subway station."""
    return Short(tmp_path_factory.mktemp("short"), 4)
