"""Missions in lock-step in a small world of three rooms, with an operator who sends commands at given times."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from planning.frames import in_map
from plgrim.runtime.lockstep import Lockstep
from schemas.base import Message
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, StageSpec, Stamp, Topic
from schemas.fences import Fence, FenceFrame, FenceKind, Ring
from schemas.operation import (
    CommandAnswer,
    CommandKind,
    JudgeReport,
    MissionCommand,
    MissionPhase,
    MissionState,
)
from schemas.sensing import Odometry
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import COMMAND

CELL_M = 0.1
ROOMS = ((0.5, 0.5, 7.5, 7.5), (8.5, 0.5, 14.5, 7.5), (0.5, 8.5, 7.5, 13.5))
"""West, east and north: (x low, y low, x high, y high); doors of 1.2 m lead east and north out of the west room."""
DOORS = ((7.5, 3.4, 8.5, 4.6), (3.4, 7.5, 4.6, 8.5))
START = (3.0, 3.0)


def write_map(folder: Path) -> Path:
    """The world as a map_server file."""
    cells = np.zeros((round(14.0 / CELL_M), round(15.0 / CELL_M)), np.uint8)
    for x0, y0, x1, y1 in (*ROOMS, *DOORS):
        cells[round(y0 / CELL_M) : round(y1 / CELL_M), round(x0 / CELL_M) : round(x1 / CELL_M)] = 254
    Image.fromarray(np.ascontiguousarray(cells[::-1])).save(folder / "rooms.pgm")
    path = folder / "rooms.yaml"
    path.write_text(
        "image: rooms.pgm\nresolution: 0.1\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return path


def box(x0: float, y0: float, x1: float, y1: float) -> list[Ring]:
    """A rectangle as the rings of a polygon."""
    return [Ring.of([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)])]


def fence(kind: FenceKind, rings: list[Ring], frame: FenceFrame = FenceFrame.MAP, **more: Any) -> Fence:
    """A polygon of the operator."""
    return Fence(kind=kind, frame=frame, rings=rings, **more)


def command(name: str, kind: CommandKind, **more: Any) -> MissionCommand:
    """A command of the operator."""
    return MissionCommand(stamp_ns=0, command_id=name, kind=kind, **more)


@dataclass
class Operator:
    """In the place of the status service: sends each command at its time."""

    script: Mapping[float, MissionCommand]
    sent: int = 0

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        due = [self.script[t] for t in sorted(self.script) if t * SECOND_NS <= now]
        new, self.sent = due[self.sent :], len(due)
        return [Output(COMMAND, message) for message in new]

    def snapshot(self) -> bytes:
        return pack_snapshot({"sent": self.sent})

    def restore(self, snapshot: bytes) -> None:
        self.sent = unpack_snapshot(snapshot)["sent"]


@dataclass
class Seen:
    """What an observer heard. track: (seconds, x, y) of the true poses; in_odom, in_map: of the estimated ones."""

    track: list[tuple[float, float, float]] = field(default_factory=list)
    in_odom: list[tuple[float, float, float]] = field(default_factory=list)
    in_map: list[tuple[float, float, float]] = field(default_factory=list)
    answers: list[CommandAnswer] = field(default_factory=list)
    state: MissionState | None = None
    coverage: float = 0.0

    def __call__(self, topic: Topic[Message], message: Message, now: Stamp) -> None:
        match message:
            case JudgeReport():
                at = message.true_pose
                self.track.append((now / SECOND_NS, at.x_m, at.y_m))
                self.coverage = message.coverage
            case Odometry():
                self.in_odom.append((now / SECOND_NS, message.pose.x_m, message.pose.y_m))
                place = in_map(message.map_to_odom, message.pose)
                self.in_map.append((now / SECOND_NS, place.x_m, place.y_m))
            case CommandAnswer():
                self.answers.append(message)
            case MissionState():
                self.state = message

    def drift_m(self) -> float:
        """The largest distance that the two frames have told of one pose."""
        return max(math.dist(a[1:], b[1:]) for a, b in zip(self.in_odom, self.in_map, strict=True))

    def inside(self, x0: float, y0: float, x1: float, y1: float, since_s: float = 0.0) -> int:
        """How many true poses lay in a rectangle."""
        return sum(1 for t, x, y in self.track if t >= since_s and x0 < x < x1 and y0 < y < y1)


@dataclass
class Mission:
    """A run and what was seen of it."""

    run: Lockstep
    seen: Seen

    def until(self, done: Callable[[Seen], bool], limit_s: float) -> float:
        """Run until something is so; returns the time, s."""
        while not done(self.seen) and self.run.now < limit_s * SECOND_NS:
            self.run.run_until(self.run.now + SECOND_NS)
        return self.run.now / SECOND_NS

    def to_its_end(self, limit_s: float = 400.0) -> MissionState:
        """Run until the mission is over."""
        self.until(lambda seen: seen.state is not None and seen.state.phase == MissionPhase.DONE, limit_s)
        assert self.seen.state is not None
        return self.seen.state


def mission(
    folder: Path, script: Mapping[float, MissionCommand], seed: int = 3, **options: Mapping[str, Any]
) -> Mission:
    """A mission in the three rooms."""
    seen = Seen()
    world = {
        "map_file": str(write_map(folder)),
        "seed": seed,
        "start": {"x_m": START[0], "y_m": START[1], "yaw_rad": 0.0},
        "robot": {"profile": "spot"},
    }
    settings: dict[str, Mapping[str, Any]] = {"reconciler": {"simulations": 512}, **options}
    settings["sim"] = {**world, **settings.get("sim", {})}
    operator = StageSpec("status", SECOND_NS // 10), Operator(script)
    run = Lockstep(settings, seed, observer=seen, extra={"status": operator})
    return Mission(run, seen)
