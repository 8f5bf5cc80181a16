"""A process with a connection to its own router and two to another host's, as the link has.

`python -m tests.faults.two_connections FAR SECONDS` sends all it can to the other host, and listens on its own; it
prints one JSON object: `heard`, how many messages, and `gap_s`, the longest time between two. `... tick` is what it
listens to.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from itertools import pairwise

import zenoh

from plgrim.config import RouterConfig, load_config
from plgrim.runtime.process import die_with_parent
from plgrim.runtime.zenoh_session import many_receivers, open_session

TOPIC = "plgrim/test/tick"
_PIECE_BYTES = 60_000
_TICK_S = 0.05


def _send(far: str) -> None:
    """BLOCK: there is always something unsent."""
    session = open_session(RouterConfig(endpoint=far), "client", threading.Event(), 30.0)
    publisher = session.declare_publisher("plgrim/test/map", congestion_control=zenoh.CongestionControl.BLOCK)
    while True:
        try:
            publisher.put(os.urandom(_PIECE_BYTES))
        except zenoh.ZError:
            time.sleep(0.05)


def main() -> None:
    """Send and listen for so long."""
    die_with_parent()
    many_receivers()
    session = open_session(load_config().router, "client", threading.Event(), 30.0)
    while sys.argv[1] == "tick":
        session.put(TOPIC, b"tick")
        time.sleep(_TICK_S)
    far, seconds = sys.argv[1], float(sys.argv[2])
    subscriber = session.declare_subscriber(TOPIC, zenoh.handlers.FifoChannel(1024))
    handler, came_s = subscriber.handler, [time.monotonic()]

    def listen() -> None:
        while True:
            handler.recv()
            came_s.append(time.monotonic())

    for endpoint in (far, f"{far}#so_sndbuf=8192"):
        threading.Thread(target=_send, args=(endpoint,), daemon=True).start()
    threading.Thread(target=listen, daemon=True).start()
    time.sleep(seconds)
    gap_s = max(b - a for a, b in pairwise([*came_s, time.monotonic()]))
    print(json.dumps({"heard": len(came_s), "gap_s": gap_s}), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
