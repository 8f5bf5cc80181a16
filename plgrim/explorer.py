"""The planner as a library: the stages of a mission in lock-step, fed by a caller who has a simulator of their own.

No Zenoh, no processes, no clock: `Explorer(config).step(grid_or_cloud, pose)` gives the plan that answers this grid.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from planning.robot_profile import PROFILES
from plgrim.config_keys import check_keys, describe
from plgrim.errors import ConfigError, ExplorerInputError
from plgrim.explorer_inputs import (
    FEED_SPEC,
    NEVER_NS,
    Cloud,
    GivenSensors,
    Grid,
    Look,
    Pose,
    checked_pose,
)
from plgrim.registry import make_stage, stage_module
from plgrim.runtime.lockstep import Lockstep
from schemas.base import Message
from schemas.contract import SECOND_NS, Stage, StageSetup, StageSpec, Stamp, Topic
from schemas.operation import FinishReason, MissionState
from schemas.policy import Alternative, GlobalPolicy, LocalPhase, LocalPolicy
from schemas.policy import Plan as WirePlan
from schemas.snapshot import pack_message, pack_snapshot, unpack_message, unpack_snapshot
from schemas.topics import (
    CLOUD,
    COVERAGE,
    EPISODE,
    GLOBAL_IRM,
    LOCAL_IRM,
    LOCAL_POLICY,
    ODOMETRY,
    READY_GRID,
    RISK_MAP,
)
from schemas.world import CoverageSummary

__all__ = ["Cloud", "Explorer", "ExplorerConfig", "Grid", "Plan", "Pose"]

_TRIGGERS = {
    "riskmap": (READY_GRID.name, CLOUD.name),
    "irm": (RISK_MAP.name,),
    "gcp": (GLOBAL_IRM.name,),
    "lcp": (EPISODE.name,),
    "reconciler": (LOCAL_IRM.name, LOCAL_POLICY.name),
    "mission": (ODOMETRY.name, COVERAGE.name),
}
"""What each stage steps on: one grid runs through all of them, each with what the one before has made of it."""
_FINEST_M, _COARSEST_M = 0.1, 0.5
_REACH_NODES = 15.0
"""Nodes of the Local IRM that the coverage sensor may look ahead."""
_FASTEST_MPS = 20.0


class ExplorerConfig(BaseModel):
    """What the planner is told once. The sections are those of the stages' own configurations."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    seconds_per_step: float = Field(
        1.0, ge=0.2, le=10, description="Mission time between two steps, unless a step says otherwise, s."
    )
    coverage: Literal["sensor", "known"] = Field(
        "sensor",
        description="sensor: ground counts as covered when the coverage sensor has seen it; known: when it is known.",
    )
    sensor_range_m: float = Field(6.0, gt=0, le=45, description="Range of the coverage sensor, m.")
    sensor_fov_deg: float = Field(120.0, gt=0, le=360, description="Field of view of the coverage sensor.")
    detection_probability: float = Field(0.95, gt=0.5, lt=1, description="Of what lies in its view.")
    keyframe_spacing_m: float = Field(
        1.0, gt=0, le=20, description="Looks hang on keyframes so far apart, m."
    )
    profile: Literal["husky", "spot"] = Field("spot", description="The robot's body; riskmap may differ.")
    seed: int = Field(1, ge=0, lt=2**63, description="Of every random stream.")
    riskmap: dict[str, Any] = Field(default_factory=dict, description="resolution_m: default, the grid's.")
    irm: dict[str, Any] = Field(default_factory=dict)
    gcp: dict[str, Any] = Field(default_factory=dict)
    lcp: dict[str, Any] = Field(default_factory=dict)
    reconciler: dict[str, Any] = Field(default_factory=dict)
    mission: dict[str, Any] = Field(default_factory=dict)

    @classmethod
    def of(cls, given: ExplorerConfig | Mapping[str, Any] | Path | str | None) -> ExplorerConfig:
        """From a configuration, plain values, a YAML file, or nothing (defaults). Raises ConfigError."""
        if isinstance(given, ExplorerConfig):
            return given
        source, content = "Explorer", given or {}
        if isinstance(given, Path | str):
            source = str(given)
            try:
                content = yaml.safe_load(Path(given).read_text(encoding="utf-8")) or {}
            except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
                raise ConfigError(f"{source}: cannot be read: {error}") from error
        if not isinstance(content, Mapping):
            raise ConfigError(f"{source}: keys and sections are wanted, found {type(content).__name__}")
        check_keys(content, cls, source, "")
        try:
            return cls.model_validate(dict(content))
        except ValidationError as error:
            raise ConfigError(describe(error, source)) from error

    def options(self, service: str, resolution_m: float) -> dict[str, Any]:
        """The section of a stage with what follows from the rest; what the section says itself stays."""
        body_m = float(self.riskmap.get("footprint_radius_m", PROFILES[self.profile].footprint_radius_m))
        derived: dict[str, dict[str, Any]] = {
            "riskmap": {
                "profile": self.profile,
                "resolution_m": min(max(resolution_m, _FINEST_M), _COARSEST_M),
                "publish_period_s": 0.05,
                "odometry_memory_m": 0.0,
            },
            "irm": {
                "coverage": self.coverage,
                "sensor_range_m": self.sensor_range_m,
                "sensor_fov_deg": self.sensor_fov_deg,
                "spacing_m": max(1.0, math.ceil(10.0 * self.sensor_range_m / _REACH_NODES) / 10.0),
                "global_period_s": min(self.seconds_per_step, 10.0),
            },
            "reconciler": {
                "footprint_radius_m": body_m,
                "planning_latency_s": 0.0,
                "episode_period_s": 0.2,
            },
        }
        return {**derived.get(service, {}), **getattr(self, service)}


@dataclass(frozen=True, slots=True)
class Plan:
    """What one step gives.

    path: (k, 4) x, y, yaw, seconds from now on; empty when the robot is to stand. target_m: (x, y) of the frontier
    that the global planner sends the robot to, None without one; alternatives: what it weighed. phase: cover (the
    local planner covers), guide (leads to the target) or none. reason: of the motion; target_reason: of the target.
    finished, finish: whether the mission is over, and why. coverage: share of the ground believed reachable that is
    covered. planning_s: wall time of the step, by stage.
    """

    path: NDArray[np.float64]
    target_m: tuple[float, float] | None
    target_gain: float
    phase: LocalPhase
    reason: str
    target_reason: str
    finished: bool
    finish: FinishReason
    finish_text: str
    coverage: float
    covered_area_m2: float
    alternatives: list[Alternative] = field(default_factory=list)
    planning_s: dict[str, float] = field(default_factory=dict)

    @property
    def moves(self) -> bool:
        """Whether there is somewhere to drive."""
        return len(self.path) > 1

    def after(self, seconds: float) -> Pose:
        """The pose on the path after so many seconds, at its end when it is shorter. Raises ValueError when empty."""
        if not len(self.path):
            raise ValueError("the plan has no path: the robot is to stand")
        at = min(int(np.searchsorted(self.path[:, 3], seconds)), len(self.path) - 1)
        x_m, y_m, yaw_rad, _ = self.path[at].tolist()
        return Pose(x_m, y_m, yaw_rad)


class _Heard:
    """The newest message of each kind that a plan is made of."""

    def __init__(self) -> None:
        self.plan: WirePlan | None = None
        self.policy: GlobalPolicy | None = None
        self.local: LocalPolicy | None = None
        self.mission: MissionState | None = None
        self.coverage: CoverageSummary | None = None

    def state(self) -> dict[str, bytes]:
        """For a snapshot."""
        return {name: pack_message(held) for name, held in vars(self).items() if held is not None}

    def load(self, state: Mapping[str, bytes]) -> None:
        """Go on from `state`."""
        kinds: dict[str, type[Message]] = {
            "plan": WirePlan, "policy": GlobalPolicy, "local": LocalPolicy, "mission": MissionState,
            "coverage": CoverageSummary,
        }  # fmt: skip
        for name, packed in state.items():
            setattr(self, name, unpack_message(packed, kinds[name]))

    def __call__(self, topic: Topic[Message], message: Message, now: Stamp) -> None:
        match message:
            case WirePlan():
                self.plan = message
            case GlobalPolicy():
                self.policy = message
            case LocalPolicy():
                self.local = message
            case MissionState():
                self.mission = message
            case CoverageSummary():
                self.coverage = message


class Explorer:
    """Plans for a robot in somebody else's world.

    config: an `ExplorerConfig`, its values as a mapping, or a YAML file. The stages are made at the first step, when
    the resolution of the map is known. Raises ConfigError.
    """

    def __init__(self, config: ExplorerConfig | Mapping[str, Any] | Path | str | None = None) -> None:
        self.config = ExplorerConfig.of(config)
        self._heard = _Heard()
        self._lockstep: Lockstep | None = None
        self._sensors = self._make_sensors()
        self._resolution_m = 0.0
        self._last: Pose | None = None
        for service in _TRIGGERS:
            self._check(service, _FINEST_M)

    def step(
        self,
        seen: Grid | Cloud,
        pose: Sequence[float] | Pose,
        seconds: float | None = None,
        speed_mps: float | None = None,
        blocked: bool = False,
    ) -> Plan:
        """The plan that answers what is known now.

        seen: the map as far as it is known (all of it, each time), or a LiDAR sweep. pose: (x, y, yaw) or (x, y, yaw,
        z), m and rad. seconds: since the last step. speed_mps: of the robot; by default, from how far it came. blocked:
        something has stopped it on the path. The stages have no latency here: risk map, roadmaps, global and local
        policy and path are all of this very map. Raises ExplorerInputError (a ValueError) with the field's name.
        """
        at = checked_pose(pose)
        took_s = self.config.seconds_per_step if seconds is None else seconds
        if not 0.2 <= took_s <= 3600.0:
            raise ExplorerInputError(f"seconds: {took_s!r} is not in [0.2, 3600]")
        run = self._started(seen)
        if speed_mps is None:
            moved_m = 0.0 if self._last is None else math.dist(self._last[:2], at[:2])
            speed_mps = min(moved_m / took_s, self._max_speed_mps())
        if not abs(speed_mps) <= _FASTEST_MPS:
            raise ExplorerInputError(f"speed_mps: {speed_mps!r} is not within {_FASTEST_MPS:g} m/s")
        plan_id = self._heard.plan.plan_id if self._heard.plan else 0
        self._sensors.give(seen, at, speed_mps, plan_id, blocked)
        self._last = at
        before = {name: len(steps) for name, steps in run.step_seconds().items()}
        now = run.now + int(took_s * SECOND_NS)
        run.wake("sim", now)
        run.run_until(now)
        return self._plan({n: sum(s[before[n] :]) for n, s in run.step_seconds().items() if n != "sim"})

    def _max_speed_mps(self) -> float:
        return float(self.config.reconciler.get("max_speed_mps", 1.0))

    def _started(self, seen: Grid | Cloud) -> Lockstep:
        if not isinstance(seen, Grid | Cloud):
            raise ExplorerInputError(f"seen: a Grid or a Cloud is wanted, got {type(seen).__name__}")
        if self._lockstep is None:
            return self._start(seen.resolution_m if isinstance(seen, Grid) else _FINEST_M)
        return self._lockstep

    def _start(self, resolution_m: float) -> Lockstep:
        self._resolution_m = resolution_m
        stages: dict[str, tuple[StageSpec, Stage]] = {}
        for service, triggers in _TRIGGERS.items():
            options = self._check(service, resolution_m)
            spec, stage = make_stage(service, options, StageSetup("robot", self.config.seed))
            stages[service] = replace(spec, period_ns=NEVER_NS, triggers=triggers, latency_ns=0), stage
        stages["sim"] = FEED_SPEC, self._sensors
        self._lockstep = Lockstep({}, self.config.seed, observer=self._heard, stages=(), extra=stages)
        self._lockstep.run_until(0)
        return self._lockstep

    def _check(self, service: str, resolution_m: float) -> dict[str, Any]:
        options, model = self.config.options(service, resolution_m), stage_module(service).Config
        check_keys(options, model, "Explorer", service)
        try:
            model.model_validate(options)
        except ValidationError as error:
            raise ConfigError(describe(error, "Explorer", service)) from error
        return options

    def _make_sensors(self) -> GivenSensors:
        c = self.config
        look = Look(c.sensor_range_m, math.radians(c.sensor_fov_deg), c.detection_probability)
        return GivenSensors(look if c.coverage == "sensor" else None, c.keyframe_spacing_m)

    def _plan(self, planning_s: dict[str, float]) -> Plan:
        heard = self._heard
        wire, policy, local, mission = heard.plan, heard.policy, heard.local, heard.mission
        path = np.zeros((0, 4))
        if wire is not None and wire.valid:
            path = np.stack([wire.x_m, wire.y_m, wire.yaw_rad, wire.time_s], axis=1)
        has_target = policy is not None and policy.target >= 0
        return Plan(
            path=path,
            target_m=policy.target_xyz_m[:2] if policy is not None and has_target else None,
            target_gain=policy.target_gain if policy is not None else 0.0,
            phase=local.phase if local is not None else LocalPhase.NONE,
            reason=wire.reason if wire is not None else "nothing is known of the ground around the robot",
            target_reason=policy.reason if policy is not None else "",
            finished=mission is not None and mission.finish is not FinishReason.NONE,
            finish=mission.finish if mission is not None else FinishReason.NONE,
            finish_text=mission.reason if mission is not None else "",
            coverage=heard.coverage.covered_fraction if heard.coverage is not None else 0.0,
            covered_area_m2=heard.coverage.covered_area_m2 if heard.coverage is not None else 0.0,
            alternatives=list(policy.alternatives) if policy is not None else [],
            planning_s=planning_s,
        )

    def digest(self) -> str:
        """Hash of all that the stages have said: the same for the same inputs and seed."""
        return self._lockstep.digest() if self._lockstep is not None else ""

    def snapshot(self) -> bytes:
        """Everything that is needed to go on, in this or another process."""
        run = b"" if self._lockstep is None else self._lockstep.snapshot()
        last = None if self._last is None else list(self._last)
        held = {"run": run, "resolution_m": self._resolution_m, "last": last, "heard": self._heard.state()}
        return pack_snapshot(held)

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot of an explorer with the same configuration. Raises MalformedError, KeyError."""
        state = unpack_snapshot(snapshot)
        self._heard = _Heard()
        self._sensors = self._make_sensors()
        self._lockstep = None
        self._last = None if state["last"] is None else Pose(*state["last"])
        if state["run"]:
            self._start(state["resolution_m"]).restore(state["run"])
        self._heard.load(state["heard"])
