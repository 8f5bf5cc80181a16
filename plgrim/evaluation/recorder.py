"""Records a mission from its messages and writes the result folder. Works the same live and in lock-step."""

from __future__ import annotations

import csv
import importlib.metadata
import json
import platform
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from planning import frames
from plgrim.evaluation.events import EventLog
from plgrim.evaluation.plan_changes import PlanChanges
from schemas.base import Message, Pose
from schemas.contract import SECOND_NS, Stamp, Topic
from schemas.operation import FinishReason, JudgeReport, MissionState, StageHealth, WorldPicture
from schemas.policy import GlobalPolicy, Plan
from schemas.sensing import Odometry
from schemas.topics import (
    COVERAGE,
    GLOBAL_POLICY,
    JUDGE,
    MISSION,
    ODOMETRY,
    PLAN,
    SERVICES,
    WORLD_PICTURE,
    health_topic,
)
from schemas.world import CoverageSummary

RECORDED: tuple[Topic[Any], ...] = (
    JUDGE, COVERAGE, MISSION, ODOMETRY, GLOBAL_POLICY, PLAN, WORLD_PICTURE, *(health_topic(s) for s in SERVICES),
)  # fmt: skip
"""What a recorder must be given."""

TRAJECTORY_COLUMNS = (
    "t_s", "true_x_m", "true_y_m", "true_yaw_rad", "x_m", "y_m", "yaw_rad", "distance_m", "coverage",
)  # fmt: skip
"""Of trajectory.csv: true and estimated pose, driven distance and the judge's coverage over mission time."""

_PACKAGES = ("plgrim", "eclipse-zenoh", "numpy", "numba", "pydantic", "scipy")


def quantile(values: Sequence[float], share: float) -> float | None:
    """The value at a share (0..1) of the sorted values, nearest rank; None when there are none."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else None


def in_map(odometry: Odometry) -> Pose:
    """The robot's pose in `map`: map_to_odom after the pose in `odom`."""
    frame, pose = odometry.map_to_odom, odometry.pose
    x, y, yaw = frames.in_map(frame, pose)
    return Pose(x_m=x, y_m=y, z_m=frame.z_m + pose.z_m, yaw_rad=yaw)


class MissionRecorder:
    """Collects what the result needs. Thread safe.

    seed, world: for the result only. speed: mission seconds a wall second, to give latencies in wall time too.
    changes: what is to be learnt of how plans change.
    """

    def __init__(
        self, seed: int, world: str, mode: str, speed: float = 1.0, changes: PlanChanges | None = None
    ) -> None:
        self._lock = threading.Lock()
        self._about = {"seed": seed, "world": world, "mode": mode, "speed": speed}
        self._speed = speed
        self.changes = changes or PlanChanges()
        self.mission: MissionState | None = None
        self.judge: JudgeReport | None = None
        self.coverage: CoverageSummary | None = None
        self.odometry: Odometry | None = None
        self.policy: GlobalPolicy | None = None
        self.plan: Plan | None = None
        self.picture: WorldPicture | None = None
        self.health: dict[str, StageHealth] = {}
        self.restarts: dict[str, int] = {}
        self._errors: dict[tuple[str, int], int] = {}
        self._dropped: dict[tuple[str, int], dict[str, int]] = {}
        self._memory_mb: dict[str, float] = {}
        self.switches = 0
        self._latency_s: list[float] = []
        self._risk_stamp_ns = 0
        self._belief: list[tuple[float, float]] = []
        self._track: list[tuple[float, ...]] = []
        self._zero_ns: Stamp | None = None
        self._events = EventLog()

    def observe(self, topic: Topic[Any], message: Message, now: Stamp, epoch: int = 0) -> None:
        """Take in a message. now: mission clock when it was sent, ns. epoch: which life of its writer."""
        with self._lock:
            self._observe(message, now, epoch)

    def _observe(self, message: Message, now: Stamp, epoch: int) -> None:
        self._events.observe(message, now)
        match message:
            case JudgeReport():
                self.judge = message
                self._add_track(message, now)
            case CoverageSummary():
                self.coverage = message
                self._belief.append((self._elapsed_s(now), message.covered_fraction))
            case MissionState():
                if self.mission is None:
                    self._zero_ns = message.stamp_ns - int(message.elapsed_s * SECOND_NS)
                self.mission = message
            case Odometry():
                self.odometry = message
                self.changes.see_pose(message)
            case GlobalPolicy():
                self.policy = message
                self.switches += message.switched
            case Plan():
                self.plan = message
                self._add_latency(message, now)
                self.changes.see_plan(message, now)
            case WorldPicture():
                self.picture = message
            case StageHealth():
                self._add_health(message, epoch)

    def _elapsed_s(self, now: Stamp) -> float:
        """Time since the mission's start; before its state has come, since the first message that counts."""
        if self._zero_ns is None:
            self._zero_ns = now
        return (now - self._zero_ns) / SECOND_NS

    def _add_track(self, judge: JudgeReport, now: Stamp) -> None:
        true = judge.true_pose
        estimate = in_map(self.odometry) if self.odometry else true
        self._track.append(
            (
                self._elapsed_s(now),
                true.x_m,
                true.y_m,
                true.yaw_rad,
                estimate.x_m,
                estimate.y_m,
                estimate.yaw_rad,
                judge.distance_m,
                judge.coverage,
            )
        )

    def _add_latency(self, plan: Plan, now: Stamp) -> None:
        """From the newest cloud that a plan knows of to the plan, once a cloud (its first plan)."""
        if plan.risk_stamp_ns > self._risk_stamp_ns:
            self._risk_stamp_ns = plan.risk_stamp_ns
            self._latency_s.append((now - plan.risk_stamp_ns) / SECOND_NS)

    def _add_health(self, health: StageHealth, epoch: int) -> None:
        """Counters are those of one life; by its epoch, since in containers every process has the same id."""
        self.health[health.service] = health
        self._errors[health.service, epoch] = health.errors
        self._dropped[health.service, epoch] = health.dropped
        self._memory_mb[health.service] = max(self._memory_mb.get(health.service, 0.0), health.memory_mb)

    @property
    def finished(self) -> bool:
        """Whether the mission has ended."""
        return self.mission is not None and self.mission.finish is not FinishReason.NONE

    @property
    def succeeded(self) -> bool:
        """Whether it ended because all was covered, with the robot whole."""
        covered = self.mission is not None and self.mission.finish is FinishReason.COVERED
        return covered and self.judge is not None and not self.judge.lost

    @property
    def lost(self) -> bool:
        """Whether the judge says that the robot is lost."""
        return self.judge is not None and self.judge.lost

    def switches_per_100_m(self) -> float | None:
        """Target switches per 100 m driven; None before the first 5 metres."""
        distance = self.judge.distance_m if self.judge else self.mission.distance_m if self.mission else 0.0
        return 100.0 * self.switches / distance if distance > 5.0 else None

    def result(
        self,
        step_seconds: Mapping[str, Sequence[float]] | None = None,
        extra: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """The result as plain values. step_seconds: wall seconds of the steps where no health is sent."""
        with self._lock:
            mission, judge, coverage = self.mission, self.judge, self.coverage
            return {
                **self._about,
                **({"world": judge.world} if judge else {}),
                "finish": mission.finish.value if mission else "",
                "finish_text": mission.reason if mission else "no mission state was seen",
                "succeeded": self.succeeded,
                "coverage_judge": judge.coverage if judge else None,
                "coverage_belief": coverage.covered_fraction if coverage else None,
                "covered_area_m2": judge.covered_area_m2 if judge else None,
                "reachable_area_m2": judge.reachable_area_m2 if judge else None,
                "distance_m": judge.distance_m if judge else mission.distance_m if mission else None,
                "elapsed_s": mission.elapsed_s if mission else None,
                "target_switches": self.switches,
                "target_switches_per_100m": self.switches_per_100_m(),
                "lost": judge.lost if judge else None,
                "lost_reason": judge.lost_reason if judge else "",
                "contacts": judge.contacts if judge else None,
                "left": [place.model_dump() for place in mission.left] if mission else [],
                "cloud_to_plan": self._latency(),
                "plan_changes": self.changes.result(),
                "stages": self._stages(step_seconds or {}),
                "restarts": dict(self.restarts),
                "coverage_by_belief": [[round(t, 1), round(share, 4)] for t, share in _thinned(self._belief)],
                "events": self._events.since(self._zero_ns or 0),
                "events_dropped": self._events.dropped,
                "versions": _versions(),
                **dict(extra or {}),
            }

    def _latency(self) -> dict[str, float | int | None]:
        p50, p95 = quantile(self._latency_s, 0.5), quantile(self._latency_s, 0.95)
        return {
            "plans": len(self._latency_s),
            "p50_mission_s": p50,
            "p95_mission_s": p95,
            "p50_wall_s": None if p50 is None else p50 / self._speed,
            "p95_wall_s": None if p95 is None else p95 / self._speed,
        }

    def _stages(self, step_seconds: Mapping[str, Sequence[float]]) -> dict[str, dict[str, Any]]:
        found: dict[str, dict[str, Any]] = {}
        for name, health in sorted(self.health.items()):
            drops: dict[str, int] = {}
            for (service, _), counts in self._dropped.items():
                if service == name:
                    for reason, count in counts.items():
                        drops[reason] = drops.get(reason, 0) + count
            found[name] = {
                "steps": health.steps,
                "step_p50_ms": round(health.step_p50_ms, 3),
                "step_p99_ms": round(health.step_p99_ms, 3),
                "rate_hz": round(health.rate_hz, 2),
                "memory_mb": round(self._memory_mb[name], 1),
                "errors": sum(count for (service, _), count in self._errors.items() if service == name),
                "dropped": drops,
            }
        for name, seconds in step_seconds.items():
            found[name] = {
                "steps": len(seconds),
                "step_p50_ms": round(1e3 * (quantile(seconds, 0.5) or 0.0), 3),
                "step_p99_ms": round(1e3 * (quantile(seconds, 0.99) or 0.0), 3),
                "total_s": round(sum(seconds), 3),
            }
        return found

    def write(
        self,
        out_dir: Path,
        step_seconds: Mapping[str, Sequence[float]] | None = None,
        extra: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Write result.json, trajectory.csv, coverage.png and map.png into the folder; gives the result."""
        from plgrim.evaluation.pictures import (
            coverage_plot,
            map_picture,
        )  # matplotlib: only when it is needed

        out_dir.mkdir(parents=True, exist_ok=True)
        result = self.result(step_seconds, extra)
        (out_dir / "result.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        with self._lock:
            track, belief, picture = list(self._track), list(self._belief), self.picture
        with (out_dir / "trajectory.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(TRAJECTORY_COLUMNS)
            writer.writerows([[f"{value:.4f}" for value in row] for row in track])
        coverage_plot(out_dir / "coverage.png", [(row[0], row[-1]) for row in track], belief)
        if picture is not None:
            map_picture(out_dir / "map.png", picture, [(row[1], row[2]) for row in track], _title(result))
        return result


def _thinned(series: list[tuple[float, float]], most: int = 500) -> list[tuple[float, float]]:
    """At most about so many of a series, the last one always among them."""
    every = max(1, -(-len(series) // most))
    return [*series[::every], *series[-1:]] if every > 1 else series


def _title(result: Mapping[str, Any]) -> str:
    coverage, distance = result["coverage_judge"], result["distance_m"]
    if coverage is None or distance is None:
        return str(result["world"])
    return f"{result['world']}: {100 * coverage:.1f} % covered, {distance:.0f} m driven"


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
