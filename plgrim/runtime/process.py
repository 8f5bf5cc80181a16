"""What every process of the program does first: end with its parent, end on signals, keep to one core."""

from __future__ import annotations

import ctypes
import os
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

_PR_SET_PDEATHSIG = 1
PARENT_VARIABLE = "PLGRIM_PARENT_PID"
THREAD_LIMITS = {
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""A service computes on one thread: the services share the cores."""


def die_with_parent() -> None:
    """Have the kernel kill this process when the supervisor dies, by whatever cause: no orphans.

    Only when a supervisor has started it. Linux; elsewhere the supervisor's own clean-up must do.
    """
    parent = os.environ.get(PARENT_VARIABLE, "")
    if not parent:
        return
    try:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    except (OSError, AttributeError):
        return
    if os.getppid() != int(parent):  # it died before the call above
        os.kill(os.getpid(), signal.SIGKILL)


def child_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment of a child: thread limits that are not set yet, and whose child it is."""
    return {**THREAD_LIMITS, **environment, PARENT_VARIABLE: str(os.getpid())}


class Interrupted(BaseException):
    """A signal came while the main thread was in code that does not look at the stop event."""


class Stop(threading.Event):
    """The stop event of a process. interrupt: signals also raise Interrupted in the main thread."""

    interrupt: bool = False


@contextmanager
def interruptible(stop: threading.Event) -> Iterator[None]:
    """Let signals break off long work (compiling, loading) that does not look at the stop event.

    Raises Interrupted at once when `stop` is already set.
    """
    if not isinstance(stop, Stop):
        yield
        return
    if stop.is_set():
        raise Interrupted
    stop.interrupt = True
    try:
        yield
    finally:
        stop.interrupt = False


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """An event that SIGINT and SIGTERM set; the handlers from before come back at the end. Main thread only."""
    stop = Stop()

    def handler(number: int, frame: FrameType | None) -> None:
        del number, frame
        stop.set()
        if stop.interrupt:
            raise Interrupted

    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, old in before.items():
            signal.signal(number, old)
