"""What watches a process that no supervisor of ours watches: in a container nobody does, under systemd systemd.

The heartbeat's thread looks at the pulse as a supervisor would. As long as the process makes progress it tells systemd
(the protocol of sd_notify: a datagram to $NOTIFY_SOCKET), and winds up a timer that ends the process when it runs out.
The timer is faulthandler's: it needs no lock of Python, which a step that never ends may hold, and says where it hung.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import socket
import time

from plgrim.runtime.pulse import Pulse
from plgrim.runtime.watch import Watched

NOTIFY_SOCKET = "NOTIFY_SOCKET"


class Watchdog:
    """Watches the pulse of its own process; `beat` is called from the heartbeat's thread.

    ends_after_s: the process ends itself (exit code 1) so long after progress was last seen, wall s; 0: never. For a
    process with one service: there is one such timer in it.
    """

    def __init__(self, pulse: Pulse, ends_after_s: float) -> None:
        self._pulse = pulse
        self._ends_after_s = ends_after_s
        self._watched = Watched(pulse.reading())
        self._looked_s = time.monotonic()
        self._told = False

    def beat(self, ready: bool) -> None:
        """Look; when all is well say so and wind up the timer. ready: the service has begun to step."""
        now = time.monotonic()
        self._watched.look(self._pulse.reading(), now - self._looked_s, now)
        self._looked_s = now
        if self._watched.flagged_s is not None:
            return
        if self._ends_after_s > 0:
            faulthandler.dump_traceback_later(self._ends_after_s, exit=True)
        if ready:
            notify("WATCHDOG=1" if self._told else "READY=1\nWATCHDOG=1")
            self._told = True

    def stop(self) -> None:
        """The service ends in good order: nobody need wait for it."""
        if self._ends_after_s > 0:
            faulthandler.cancel_dump_traceback_later()
        if self._told:
            notify("STOPPING=1")


def notify(state: str) -> None:
    """Tell systemd, when it has started this process and wants to know; nothing else hangs on it."""
    place = os.environ.get(NOTIFY_SOCKET, "")
    if not place:
        return
    address = f"\0{place[1:]}" if place.startswith("@") else place
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as there:
        there.setblocking(False)
        there.sendto(state.encode("ascii"), address)
