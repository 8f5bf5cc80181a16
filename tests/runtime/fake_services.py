"""Tiny services for the tests of the runtime: `python fake_services.py NAME [BEHAVIOUR]` runs one over Zenoh.

They take the names of real services, since the table of topics says who may write what.
"""

from __future__ import annotations

import ctypes
import sys

import numpy as np

from plgrim.config import load_config
from plgrim.errors import PlgrimError
from plgrim.logs import configure_logs
from plgrim.runtime.live import drive
from plgrim.runtime.process import die_with_parent, stop_on_signals
from plgrim.runtime.router import run_router
from schemas.base import Pose
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSpec, Stamp
from schemas.operation import FinishReason, JudgeReport, MissionPhase, MissionState, WorldPicture
from schemas.sensing import Odometry
from schemas.topics import JUDGE, MISSION, ODOMETRY, WORLD_PICTURE

DONE_AFTER = 20


def odometry(now: Stamp, x_m: float) -> Odometry:
    """An odometry message at x."""
    return Odometry(
        stamp_ns=now,
        pose=Pose(x_m=x_m),
        map_to_odom=Pose(),
        speed_mps=1.0,
        turn_rate_radps=0.0,
        covariance=np.eye(3),
    )


def mission_state(now: Stamp, seen: int, finish: FinishReason) -> MissionState:
    """A mission state whose distance counts the odometry messages seen."""
    done = finish is not FinishReason.NONE
    return MissionState(
        stamp_ns=now,
        phase=MissionPhase.DONE if done else MissionPhase.EXPLORE,
        finish=finish,
        reason="enough odometry" if done else "",
        elapsed_s=now / SECOND_NS,
        time_budget_s=0.0,
        distance_m=float(seen),
        return_distance_m=0.0,
        home=Pose(),
        coverage=1.0,
        left=[],
    )


class _Memoryless:
    def snapshot(self) -> bytes:
        return b""

    def restore(self, snapshot: bytes) -> None:
        del snapshot


class FakeSim(_Memoryless):
    """Drives along x, judges, and sends a picture."""

    def __init__(self) -> None:
        self._steps = 0

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One metre a step."""
        inputs.latest(MISSION)
        self._steps += 1
        judge = JudgeReport(
            stamp_ns=now,
            world="fake",
            true_pose=Pose(x_m=float(self._steps)),
            coverage=0.99,
            covered_area_m2=99.0,
            reachable_area_m2=100.0,
            distance_m=float(self._steps),
            contacts=0,
            lost=False,
            lost_reason="",
        )
        picture = WorldPicture(
            stamp_ns=now, resolution_m=1.0, ix0=0, iy0=-5, cell=np.full((10, 40), 3, np.uint8)
        )
        return [
            Output(ODOMETRY, odometry(now, float(self._steps))),
            Output(JUDGE, judge),
            Output(WORLD_PICTURE, picture),
        ]


class FakeMission(_Memoryless):
    """Answers each odometry with a mission state; finished after `done_after` of them (0: never)."""

    def __init__(self, done_after: int) -> None:
        self._seen = 0
        self._done_after = done_after

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Counts what is new."""
        self._seen += len(inputs.new(ODOMETRY))
        done = 0 < self._done_after <= self._seen
        finish = FinishReason.COVERED if done else FinishReason.NONE
        return [Output(MISSION, mission_state(now, self._seen, finish))]


class Remembering(FakeMission):
    """A mission that journals its count."""

    def journal(self, outputs: Outputs) -> bytes:
        """The count."""
        return str(self._seen).encode()

    def replay(self, record: bytes) -> None:
        """The count of a record."""
        self._seen = int(record)


class Failing(_Memoryless):
    """Raises in every step."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Never gives anything."""
        raise RuntimeError("this stage always fails")


class Astray(_Memoryless):
    """Goes astray in its 20th step: turns for ever, or holds Python's lock and sleeps."""

    def __init__(self, locked: bool) -> None:
        self._steps = 0
        self._locked = locked

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Nothing, twenty times."""
        self._steps += 1
        while self._steps >= 20:
            if self._locked:
                ctypes.PyDLL(None).sleep(600)
        return []


class Idle(_Memoryless):
    """Gives nothing."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Nothing."""
        return []


def make_fake(name: str, behaviour: str) -> tuple[StageSpec, Stage]:
    """The fake for a service's name."""
    if behaviour == "failing":
        return StageSpec(name, SECOND_NS // 50), Failing()
    if behaviour in ("loops", "locks"):
        return StageSpec(name, SECOND_NS // 5), Astray(behaviour == "locks")
    if behaviour == "idle":
        return StageSpec(name, SECOND_NS), Idle()
    if behaviour == "exits":
        sys.exit(1)
    if behaviour == "remembers":
        return StageSpec("mission", SECOND_NS, triggers=(ODOMETRY.name,)), Remembering(0)
    if name == "sim":
        return StageSpec("sim", SECOND_NS // 20), FakeSim()
    done_after = DONE_AFTER if behaviour == "ends" else 0
    return StageSpec("mission", SECOND_NS, triggers=(ODOMETRY.name,)), FakeMission(done_after)


def main() -> None:
    """Run the fake until SIGTERM."""
    name, behaviour = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else ""
    die_with_parent()
    configure_logs(name)
    config = load_config()
    with stop_on_signals() as stop:
        try:
            if name == "router":
                run_router(config, stop)
            else:
                drive(name, config, lambda: make_fake(name, behaviour), stop)
        except PlgrimError as error:
            print(f"fake: {error}", file=sys.stderr)
            sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
