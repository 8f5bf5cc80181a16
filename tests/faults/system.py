"""A whole live system under the supervisor for the fault tests, with everything that is heard of it, and when."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from plgrim.config import Config
from plgrim.runtime.supervisor import Supervisor
from plgrim.runtime.zenoh_session import Link
from schemas.base import Message
from schemas.codec import Envelope, decode
from schemas.contract import Topic
from schemas.policy import Plan
from schemas.topics import PLAN

_LARGE_BYTES = 1024 * 1024
M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class Said:
    """One message as it was heard. at_s: monotonic seconds. message: None where it is large."""

    at_s: float
    envelope: Envelope
    message: Message | None = field(repr=False)


@dataclass(slots=True)
class Ear:
    """Keeps every message of some topics; of large ones (maps) only the envelope."""

    said: dict[str, list[Said]] = field(default_factory=dict, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def attach(self, link: Link, *topics: Topic[Any]) -> None:
        """Listen to these topics, every message of them."""
        for topic in topics:
            self.said[topic.name] = []
            link.subscribe(topic, self._hear, every=True)

    def _hear(self, topic: Topic[Message], payload: bytes) -> None:
        message, envelope = decode(payload, topic.message, topic.max_bytes)
        with self._lock:
            large = topic.max_bytes > _LARGE_BYTES
            self.said[topic.name].append(Said(time.monotonic(), envelope, None if large else message))

    def since(self, topic: Topic[Any], at_s: float) -> list[Said]:
        """What was heard of a topic after a moment."""
        with self._lock:
            return [one for one in self.said[topic.name] if one.at_s >= at_s]

    def last(self, topic: Topic[Any]) -> Said | None:
        """What was heard last."""
        with self._lock:
            return self.said[topic.name][-1] if self.said[topic.name] else None

    def plans(self, at_s: float) -> list[tuple[float, Plan]]:
        """The plans since a moment, with when they came."""
        return [(one.at_s, one.message) for one in self.since(PLAN, at_s) if isinstance(one.message, Plan)]


@dataclass(slots=True)
class System:
    """A supervisor with its services, and an ear. clock_offset: file of the services' wall clock, if it can be set."""

    supervisor: Supervisor
    ear: Ear
    clock_offset: Path | None = None

    def until(self, condition: Callable[[], object], what: str, within_s: float = 60.0) -> float:
        """Poll the supervisor until a condition holds; monotonic seconds of that moment. The limit keeps it from
        hanging; a bar is asserted on what this gives."""
        deadline = time.monotonic() + within_s
        while not condition():
            assert time.monotonic() < deadline, f"never happened: {what}"
            self.supervisor.poll()
            time.sleep(0.01)
        return time.monotonic()

    def run(self, seconds: float) -> None:
        """Let it run for so long."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.supervisor.poll()
            time.sleep(0.01)

    def pid(self, service: str) -> int:
        """The process of a service now."""
        process = self.supervisor.children[service].process
        assert process is not None, service
        return process.pid

    def set_clock(self, seconds: float) -> None:
        """Put the wall clock of every service off by so much."""
        assert self.clock_offset is not None
        with self.clock_offset.open("r+b") as file:
            file.write(struct.pack("=q", int(seconds * 1e9)))

    def whole(self) -> bool:
        """Whether all are ready, a spare is warm, and the robot has a plan that moves it."""
        plans = self.ear.plans(time.monotonic() - 2.0)
        return (
            not self.supervisor.waiting_for()
            and self.supervisor.spare_warm
            and bool(plans)
            and plans[-1][1].valid
        )


def start_system(config: Config, folder: Path, *topics: Topic[Any], clock: Path | None = None) -> System:
    """Start everything and wait until the robot drives. Use `supervisor` as a context manager around it."""
    supervisor = Supervisor(config, folder)
    supervisor.__enter__()
    try:
        link = supervisor.start()
        ear = Ear()
        ear.attach(link, PLAN, *topics)
        supervisor.wait_ready(threading.Event())
        system = System(supervisor, ear, clock)
        system.until(system.whole, "the robot drives", 240.0)
    except BaseException:
        supervisor.__exit__(*sys.exc_info())
        raise
    return system


def build_clock_shim(folder: Path) -> Path | None:
    """The compiled `clock_shim.c`, or None without a C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or sys.platform != "linux":
        return None
    library = folder / "clock_shim.so"
    source = Path(__file__).with_name("clock_shim.c")
    subprocess.run([compiler, "-O1", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    return library


def mount_small(place: Path, size: str) -> bool:
    """Mount a tmpfs of this size; False when that is not allowed."""
    place.mkdir(parents=True, exist_ok=True)
    if os.geteuid() != 0 or shutil.which("mount") is None:
        return False
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    return subprocess.run(command, check=False).returncode == 0
