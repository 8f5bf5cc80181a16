"""A consumer that sleeps in every message, as a process: `python -m tests.faults.slow_consumer SECONDS TOPIC,...`.

Prints one JSON object: `ages`: the oldest sample of each topic as it came in (s, by the mission clock), `heard`: when
each came (s, monotonic) and its sequence, `grown_mib`: resident memory at the end over that after the first third.
"""

from __future__ import annotations

import json
import sys
import threading
import time

import psutil

from plgrim.config import load_config
from plgrim.runtime.clock import MissionClock
from plgrim.runtime.process import die_with_parent
from plgrim.runtime.zenoh_session import connect
from schemas.base import Message
from schemas.codec import decode
from schemas.contract import SECOND_NS, Topic
from schemas.topics import topic_named

_SLEEP_S = 1.0


def main() -> None:
    """Listen slowly for so long; the configuration is that of the running system."""
    die_with_parent()
    seconds, names = float(sys.argv[1]), sys.argv[2].split(",")
    config = load_config()
    clock = MissionClock.of(config.clock, config.runtime.state_dir)
    ages: dict[str, list[float]] = {name: [] for name in names}
    heard: dict[str, list[tuple[float, int]]] = {name: [] for name in names}

    def slowly(topic: Topic[Message], payload: bytes) -> None:
        came_s, came_ns = (
            time.monotonic(),
            clock.now_ns(),
        )  # before it is decoded: that takes this process's time, not the sample's
        _, envelope = decode(payload, topic.message, topic.max_bytes)
        ages[topic.name].append((came_ns - envelope.sent_ns) / SECOND_NS)
        heard[topic.name].append((came_s, envelope.sequence))
        time.sleep(_SLEEP_S)

    memory = psutil.Process()
    with connect(config.router, config.robot, threading.Event(), 20.0) as link:
        for name in names:
            link.subscribe(topic_named(name), slowly)
        time.sleep(seconds / 3)
        warm = memory.memory_info().rss
        time.sleep(seconds * 2 / 3)
        grown = memory.memory_info().rss - warm
    worst = {name: max(found, default=-1.0) for name, found in ages.items()}
    print(json.dumps({"ages": worst, "heard": heard, "grown_mib": grown / 2**20}))


if __name__ == "__main__":
    main()
