"""Whole missions through the named regression worlds: each ends well, and the complaint that it is named for is gone.

In lock-step; `make worlds` runs them all. What a mission took is in the table that it prints (pytest -s).
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from plgrim.config import load_config
from plgrim.evaluation.recorder import MissionRecorder
from plgrim.registry import STAGES
from plgrim.runtime.lockstep import Lockstep
from schemas.base import Message
from schemas.contract import SECOND_NS, Stamp, Topic
from schemas.operation import JudgeReport
from schemas.policy import Plan, SafetyState
from schemas.sensing import Odometry, PoseGraph
from schemas.world import FRONTIER, GlobalIrm

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

NARROW = {"sim": {"coverage_sensor": {"fov_deg": 90.0}}, "irm": {"sensor_fov_deg": 90.0}}
DRIFT = {"sim": {"slam": {"drift_fraction": 0.01, "drift_yaw_deg_per_10m": 1.0}}}
"""Rms. Where the loop closes the estimate is 0.9 m off with seed 4, 1.4 m with seed 6, 1.9 m and 10 degrees with 9."""


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("PLGRIM_") and name != "PLGRIM_CACHE_DIR"]:
        monkeypatch.delenv(name)


@dataclass
class Mission:
    """A mission in a world, to its end. Watchers see every message."""

    world: str
    seed: int = 1
    options: dict[str, Any] = field(default_factory=dict)
    watchers: list[Callable[[Message, Stamp], None]] = field(default_factory=list)

    def run(self, limit_s: float) -> dict[str, Any]:
        """Its result; it has to end by itself."""
        sim = {"world": self.world, **self.options.get("sim", {})}
        config = load_config(None, {**self.options, "seed": self.seed, "sim": sim})
        recorder = MissionRecorder(self.seed, self.world, "lockstep")

        def observe(topic: Topic[Any], message: Message, now: Stamp) -> None:
            recorder.observe(topic, message, now)
            for watcher in self.watchers:
                watcher(message, now)

        self.lockstep = Lockstep({name: config.options(name) for name in STAGES}, self.seed, observer=observe)
        while not (recorder.finished or recorder.lost or self.lockstep.now > limit_s * SECOND_NS):
            self.lockstep.run_until(self.lockstep.now + SECOND_NS)
        self.lockstep.run_until(self.lockstep.now + SECOND_NS)
        result = recorder.result()
        print(
            f"\n{self.world} seed {self.seed}: {result['finish'] or 'no end'}, {100 * result['coverage_judge']:.1f} %, "
            f"{result['distance_m']:.0f} m, {result['elapsed_s']:.0f} s, contacts {result['contacts']}"
        )
        assert not result["lost"], result["lost_reason"]
        assert result["finish"] == "covered", (result["elapsed_s"], result["left"])
        return result


def test_a_room_behind_a_slit_is_given_up_with_its_reason() -> None:
    result = Mission("unreachable_slit").run(300.0)
    assert result["coverage_judge"] >= 0.99
    assert result["contacts"] == 0
    assert result["distance_m"] < 60.0
    (slit,) = [place for place in result["left"] if "out of reach" in place["reason"]]
    assert math.dist((slit["x_m"], slit["y_m"]), (12.3, 5.0)) < 0.8
    assert "places are left" in result["finish_text"]


def test_a_robot_that_starts_in_unknown_ground_starts() -> None:
    result = Mission("unknown_start").run(300.0)
    assert result["coverage_judge"] >= 0.99
    assert result["contacts"] == 0
    assert result["distance_m"] < 60.0


def test_sharp_bends_do_not_turn_it_back() -> None:
    """The corridor is 40 m long; each bend is passed once on the way there, and nothing is driven three times."""
    result = Mission("maze_bend").run(600.0)
    assert result["coverage_judge"] >= 0.99
    assert result["contacts"] == 0
    assert result["distance_m"] < 150.0


def test_a_long_dead_end_is_driven_in_once_and_out_once() -> None:
    visits: list[tuple[float, float]] = []

    def watch(message: Message, now: Stamp) -> None:
        if isinstance(message, JudgeReport):
            visits.append((message.true_pose.x_m, message.true_pose.y_m))

    result = Mission("dead_end", watchers=[watch]).run(900.0)
    assert result["coverage_judge"] >= 0.99
    assert result["contacts"] == 0
    assert result["distance_m"] < 200.0
    deep = [x > 30.0 for x, _ in visits]
    assert sum(1 for a, b in itertools.pairwise(deep) if b and not a) == 1, "its far half is entered once"


def test_a_sensor_of_90_degrees_leaves_nothing_beside_its_path() -> None:
    result = Mission("narrow_sensor", options=NARROW).run(900.0)
    assert result["coverage_judge"] >= 0.99
    assert result["contacts"] == 0
    assert result["distance_m"] < 250.0


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_people_who_walk_through_are_not_driven_into_and_leave_no_ghosts(seed: int) -> None:
    """Somebody may walk into the robot while it stands: these people see nothing."""
    faults: list[str] = []
    stood = [0.0, 0]

    def watch(message: Message, now: Stamp) -> None:
        if isinstance(message, Odometry):
            stood[0] = message.speed_mps
        elif isinstance(message, JudgeReport):
            if message.contacts > stood[1] and abs(stood[0]) > 0.05:
                faults.append(f"touched at {stood[0]:.2f} m/s at {now / SECOND_NS:.1f} s")
            stood[1] = message.contacts

    holds: list[bool] = []

    def hold(message: Message, now: Stamp) -> None:
        if isinstance(message, Plan):
            holds.append(message.safety is SafetyState.HOLD and "somebody" in message.reason)

    result = Mission("moving_person", seed, watchers=[watch, hold]).run(300.0)
    assert result["coverage_judge"] >= 0.98
    assert faults == []
    assert result["contacts"] <= 1
    assert np.mean(holds) < 0.3, "it waits for people, but not for ghosts"


def test_a_door_that_closes_is_gone_round() -> None:
    result = Mission("closing_door").run(600.0)
    assert result["coverage_judge"] >= 0.98
    assert result["contacts"] == 0
    assert result["distance_m"] < 200.0


def test_the_edge_of_the_map_ends_the_mission_and_not_the_robot() -> None:
    result = Mission("map_edge").run(600.0)
    assert result["coverage_judge"] >= 0.99
    assert result["contacts"] == 0
    assert result["distance_m"] < 200.0


class Closure:
    """Watches a loop being closed: what jumps, and what must not."""

    def __init__(self) -> None:
        self.jump_m = self.path_jump_m = self.pose_jump_m = 0.0
        self.breadcrumbs: set[int] = set()
        self.lost_breadcrumbs: set[int] = set()
        self.revisions = 0
        self._odometry: Odometry | None = None
        self._plan: Plan | None = None

    def __call__(self, message: Message, now: Stamp) -> None:
        match message:
            case Odometry():
                if self._odometry is not None:
                    self._compare(self._odometry, message)
                self._odometry = message
            case PoseGraph():
                self.revisions = message.revision
            case Plan():
                if message.valid and self._plan is not None and self._plan.valid:
                    self.path_jump_m = max(self.path_jump_m, self._gap_m(message))
                self._plan = message
            case GlobalIrm():
                new = set(message.node_id[message.node_kind != FRONTIER].tolist())
                self.breadcrumbs |= new
                self.lost_breadcrumbs |= set(message.removed_node.tolist()) & self.breadcrumbs

    def _compare(self, before: Odometry, after: Odometry) -> None:
        a, b = before.map_to_odom, after.map_to_odom
        at = np.array([after.pose.x_m, after.pose.y_m])
        self.jump_m = max(self.jump_m, float(np.hypot(*(moved(b, at) - moved(a, at)))))
        step = math.hypot(after.pose.x_m - before.pose.x_m, after.pose.y_m - before.pose.y_m)
        self.pose_jump_m = max(self.pose_jump_m, step)

    def _gap_m(self, plan: Plan) -> float:
        """How far from the robot the plan begins, both in odom."""
        assert self._odometry is not None
        pose = self._odometry.pose
        return float(np.hypot(plan.x_m - pose.x_m, plan.y_m - pose.y_m).min())


def moved(frame: Any, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """A point of `odom` in `map`."""
    c, s = math.cos(frame.yaw_rad), math.sin(frame.yaw_rad)
    return np.array([frame.x_m + c * at[0] - s * at[1], frame.y_m + s * at[0] + c * at[1]])


@pytest.fixture
def closure() -> Closure:
    """A fresh watcher."""
    return Closure()


@pytest.mark.parametrize(("seed", "jump_m"), [(4, 0.3), (6, 0.3), (9, 1.5)])
def test_a_loop_that_closes_moves_the_graph_and_not_the_path(
    closure: Closure, seed: int, jump_m: float
) -> None:
    result = Mission("loop", seed, DRIFT, watchers=[closure]).run(600.0)
    assert result["coverage_judge"] >= 0.99
    assert result["contacts"] <= 2, "it may touch a wall that seemed to stand elsewhere"
    assert result["distance_m"] < 250.0
    print(f"closures {closure.revisions}, largest jump in map {closure.jump_m:.2f} m")
    assert closure.revisions >= 1
    assert closure.jump_m > jump_m
    assert closure.pose_jump_m < 0.2, "odom is continuous"
    assert closure.path_jump_m < 0.7, "the path begins at the robot, before and after"
    assert not closure.lost_breadcrumbs
    assert len(closure.breadcrumbs) > 20
