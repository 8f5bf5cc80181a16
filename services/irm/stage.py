"""The irm stage: risk map, pose graph and coverage scans in; Local IRM and Global IRM out (Algorithm 1)."""

from __future__ import annotations

import math
import zlib
from typing import Any

import numpy as np

from planning.fences import FenceView
from planning.frames import Planar, planar
from planning.grid import UNKNOWN
from schemas.base import Pose
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSetup, StageSpec, Stamp
from schemas.operation import MissionPhase
from schemas.policy import LocalPhase
from schemas.sensing import CoverageScan, Odometry
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import (
    COVERAGE,
    COVERAGE_SCAN,
    COVERAGE_WINDOW,
    FENCES,
    FOLLOWER,
    GCP_GRAPH_REQUEST,
    GLOBAL_IRM,
    GLOBAL_POLICY,
    LOCAL_IRM,
    LOCAL_POLICY,
    MISSION,
    MISSION_GRAPH_REQUEST,
    ODOMETRY,
    POSE_GRAPH,
    RISK_MAP,
    STATUS_GRAPH_REQUEST,
)
from schemas.world import CoverageSummary, CoverageWindow, GlobalIrm, GridHeader, RiskMap
from services.irm.areas import Areas
from services.irm.config import Config
from services.irm.footprints import FootprintStore
from services.irm.ground import GroundStore
from services.irm.keyframes import Anchor, Keyframes, OdomInMap, is_near
from services.irm.local_irm import LocalIrmBuilder
from services.irm.out_of_reach import FENCED, OutOfReach
from services.irm.rehearsal import rehearse
from services.irm.resample import moved
from services.irm.roadmap import Roadmap
from services.irm.tiles import TileLayer
from services.irm.unknown import expected_area_m2
from services.irm.window import Window, build_window, grid_of, read_layer, relief_of, window_picture

__all__ = ["Config", "IrmStage", "create", "spec", "warm_up"]

_BLOCKED_AGAIN_NS = 5 * SECOND_NS
"""Blocked at one place again after so long, it counts once more,"""
_BLOCKED_MOST = 2
"""and so often at most: a door that was touched is risky, not shut."""
_DOUBT_WINDOWS = 1.25
"""Keyframes within so many widths of the window are asked for their certainty: what they saw may lie in it."""
_HELPLESS_TIMES = 6.0
_MAX_PENDING = 50
_MOVES_MPS = 0.02
_PROGRESS_M2 = 0.3
_SAME_M = 1e-6
_SKIPPED_VERSIONS = 1000
"""More than the versions of the Local IRM that are given between two records."""


def spec(config: Config) -> StageSpec:
    """How to run the stage: at the period of the Local IRM."""
    return StageSpec("irm", int(config.local_period_s * SECOND_NS), latency_ns=SECOND_NS // 10)


def create(config: Config, setup: StageSetup) -> Stage:
    """An irm stage."""
    return IrmStage(config)


def warm_up() -> None:
    """Compile the kernels, or load them: before the stage is ready, not in its first steps."""
    rehearse(IrmStage(Config(size=11, sensor_range_m=3.0)))


class IrmStage:
    """Keeps the hierarchical belief."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._ground: TileLayer | None = None
        self._coverage: TileLayer | None = None
        self._store: FootprintStore | None = None
        self._ground_store: GroundStore | None = None
        self._areas: Areas | None = None
        self._local: LocalIrmBuilder | None = None
        self._roadmap = Roadmap(config)
        self._out_of_reach = OutOfReach(config.spacing_m)
        self._fences = FenceView()
        self._fenced_version = -1
        self._keyframes = Keyframes()
        self._odom = OdomInMap()
        self._doubtful: frozenset[int] = frozenset()
        self._resumed = False
        self._pending: list[CoverageScan] = []
        self._penalties: list[tuple[int, float, float]] = []
        self._backwards = False
        self._global_ns = -(10**18)
        self._covered_m2 = 0.0

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One round of Algorithm 1; nothing while the risk map or the pose is missing or stale."""
        self._pending += [r.message for r in inputs.new(COVERAGE_SCAN)]
        self._pending = self._pending[-_MAX_PENDING:]
        risk, odometry = inputs.current(RISK_MAP), inputs.current(ODOMETRY)
        if self._resumed and odometry is not None:
            # Before anything is changed: readers hear that what was acknowledged still stands.
            self._resumed = False
            whole = self._roadmap.message(odometry.pose, self._frame_pose(odometry), now, True)
            self._read_pose_graph(inputs)
            return [Output(GLOBAL_IRM, whole)]
        self._read_pose_graph(inputs)
        told = inputs.latest(FENCES)
        if told is not None:
            self._fences.update(told.message.version, told.message.fences)
        if risk is None or odometry is None:
            return []
        self._allocate(risk)
        self._odom.update(planar(odometry.map_to_odom), now, len(self._keyframes) > 0)
        self._read_follower(now, inputs, odometry)
        self._add_scans(risk, odometry)
        window = self._window(risk, odometry, now)
        assert self._local is not None
        local = self._local.build(window, odometry.pose, odometry.map_to_odom, risk.stamp_ns)
        found: Outputs = [Output(LOCAL_IRM, local)]
        asked = [
            r for t in (GCP_GRAPH_REQUEST, MISSION_GRAPH_REQUEST, STATUS_GRAPH_REQUEST) for r in inputs.new(t)
        ]
        due = now - self._global_ns >= self._config.global_period_s * SECOND_NS - SECOND_NS // 100
        if due or asked:
            found += self._global(now, window, odometry, bool(asked), inputs)
        return found

    def _allocate(self, risk: RiskMap) -> None:
        if self._ground is None:
            self._make_layers(risk.grid.resolution_m, risk.footprint_radius_m, 0)

    def _make_layers(self, resolution_m: float, radius_m: float, version: int) -> None:
        p = self._config.covered_probability
        self._ground = TileLayer("uint8", 0, resolution_m)
        self._coverage = TileLayer("float32", 0.0, resolution_m)
        self._store = FootprintStore(self._coverage)
        self._ground_store = GroundStore(self._ground)
        bound = -math.inf if self._config.coverage == "known" else math.log(p / (1.0 - p))
        self._areas = Areas(self._ground, self._coverage, bound)
        self._local = LocalIrmBuilder(self._config, radius_m, version)

    def _read_pose_graph(self, inputs: Inputs) -> None:
        received = inputs.latest(POSE_GRAPH)
        if received is None or not received.fresh:
            return
        changed, motion = self._keyframes.read(received.message)
        if not changed:
            return
        before_m2 = self._areas.update()[1] if self._areas else 0.0
        self._odom.follow(motion)
        self._roadmap.follow(changed)
        self._out_of_reach.follow(changed)
        if self._store is not None and self._ground_store is not None:
            self._store.follow(changed)
            self._ground_store.follow(changed)
        # What a closure changes of the area is neither progress nor the lack of it.
        self._covered_m2 += (self._areas.update()[1] if self._areas else 0.0) - before_m2

    def _read_follower(self, now: Stamp, inputs: Inputs, odometry: Odometry) -> None:
        """Where the robot was blocked or stuck, the ground ahead is riskier than it looks."""
        memory = int(self._config.blocked_memory_s * SECOND_NS)
        self._penalties = [p for p in self._penalties if now - p[0] < memory]
        if abs(odometry.speed_mps) > _MOVES_MPS:
            self._backwards = odometry.speed_mps < 0.0
        follower = inputs.current(FOLLOWER)
        if follower is None or not (follower.blocked or follower.stuck):
            return
        ahead = planar(odometry.pose).apply(-0.5 if self._backwards else 0.5, 0.0)
        here = [p for p in self._penalties if math.dist(ahead, p[1:]) <= 0.3]
        if len(here) < _BLOCKED_MOST and all(now - p[0] >= _BLOCKED_AGAIN_NS for p in here):
            self._penalties.append((now, *ahead))

    def _add_scans(self, risk: RiskMap, odometry: Odometry) -> None:
        assert self._store is not None
        waiting = []
        for scan in self._pending:
            keyframe = self._keyframes.pose(scan.keyframe_id)
            if keyframe is None:
                waiting.append(scan)
                continue
            seen_by = self._frame_of(scan, keyframe)
            self._store.add(scan, keyframe, risk.state, grid_of(risk), seen_by, relief_of(risk))
        self._pending = waiting

    def _frame_of(self, scan: CoverageScan, keyframe: Planar) -> Planar:
        """Pose of `odom` in `map` by the keyframe of a scan: right also when a closure came in between."""
        in_map = keyframe.compose(planar(scan.pose_in_keyframe))
        frame = in_map.compose(planar(scan.pose_in_odom).inverse())
        return self._odom.pose if is_near(frame, self._odom.pose, _SAME_M, _SAME_M) else frame

    def _window(self, risk: RiskMap, odometry: Odometry, now: Stamp) -> Window:
        assert self._ground and self._coverage and self._ground_store and self._store
        frame, spec = self._odom.pose, grid_of(risk)
        anchor = self._keyframes.reference(*self._place(odometry)[:2])
        self._doubt(anchor, _DOUBT_WINDOWS * spec.width * spec.resolution_m)
        if self._ground_store.has(self._doubtful):
            known = self._ground_store.window(spec, frame, self._doubtful)
        else:
            known = read_layer(self._ground, spec, frame)
        window = build_window(
            risk, odometry.pose.x_m, odometry.pose.y_m, self._config, known,
            read_layer(self._coverage, spec, frame), [(x, y) for _, x, y in self._penalties], frame,
            odometry.map_to_odom.z_m, self._fences.shut(spec, frame), self._fences.weights(spec, frame),
        )  # fmt: skip
        self._ground_store.write(spec, np.where(risk.state != UNKNOWN, known, np.uint8(0)), frame, anchor)
        return window

    def _doubt(self, anchor: Anchor, reach_m: float) -> None:
        """Which keyframes around the robot are not certainly where they seem to be, relative to its own."""
        assert self._store
        config = self._config
        least_m = (
            min(config.doubt_from_m, config.blur_from_m) if config.blur_from_m > 0 else config.doubt_from_m
        )
        deviations_m = self._keyframes.deviations_m(anchor, reach_m, least_m, config.odometry_drift)
        self._doubtful = frozenset(k for k, d in deviations_m.items() if d > config.doubt_from_m)
        if config.blur_from_m > 0.0:
            self._store.blur(deviations_m, config.blur_from_m)

    def _place(self, odometry: Odometry) -> Planar:
        """The robot in `map`."""
        return self._odom.pose.compose(planar(odometry.pose))

    def _global(
        self,
        now: Stamp,
        window: Window,
        odometry: Odometry,
        whole: bool,
        inputs: Inputs,
    ) -> Outputs:
        # Neither the first round, nor a gap in the inputs, nor a pause is time that the robot stood beside a frontier.
        since = (now - self._global_ns) / SECOND_NS
        elapsed = (
            min(since, 2.0 * self._config.global_period_s)
            if self._global_ns >= 0 and _exploring(inputs)
            else 0.0
        )
        self._global_ns = now
        place = self._place(odometry)
        anchor = self._keyframes.reference(place.x_m, place.y_m)
        assert self._areas is not None and self._local is not None
        radius_m = self._local.footprint_radius_m
        self._out_of_reach.update(window, radius_m + self._config.clearance_margin_m, radius_m, anchor)
        ground_m2, covered_m2 = self._areas.update()
        if covered_m2 >= self._covered_m2 + _PROGRESS_M2:
            self._covered_m2 = covered_m2
            self._roadmap.manager.progressed()
        self._pursue(now, inputs, elapsed)
        self._fence()
        self._roadmap.update(window, place.x_m, place.y_m, now, elapsed, ground_m2, anchor, self._doubtful)
        first = self._roadmap.version == 0
        message = self._roadmap.message(odometry.pose, self._frame_pose(odometry), now, whole or first)
        s, picture = moved(window.spec, window_picture(window), window.frame)
        header = GridHeader(**s._asdict())
        return [
            Output(GLOBAL_IRM, message),
            Output(COVERAGE, self._summary(now, ground_m2, covered_m2)),
            Output(COVERAGE_WINDOW, CoverageWindow(stamp_ns=now, grid=header, cell=picture)),
        ]

    def _fence(self) -> None:
        """The fences as they lie in `map` now, and what comes back when they have changed."""
        placed = self._fences.placed(self._odom.pose, False)
        changed = self._fenced_version != self._fences.version
        if self._fenced_version < 0 and self._fences.is_empty:
            changed = False  # the first word is that there are none
        self._fenced_version = self._fences.version
        self._roadmap.fence(placed, changed, self._out_of_reach.reopened(placed) if changed else [])

    def _pursue(self, now: Stamp, inputs: Inputs, elapsed_s: float) -> None:
        """The time that the robot has been after its target; where the local planner finds no way there, it goes on
        several times as fast: the robot would only go to and fro."""
        policy, local = inputs.current(GLOBAL_POLICY), inputs.current(LOCAL_POLICY)
        if policy is None:
            return
        helpless = local is not None and local.phase == LocalPhase.NONE and local.target == policy.target
        times = _HELPLESS_TIMES if helpless and policy.target >= 0 else 1.0
        self._roadmap.manager.pursue(policy.target, policy.target_distance_m, now, times * elapsed_s)

    def _frame_pose(self, odometry: Odometry) -> Pose:
        """Pose of `odom` in `map` that the graph goes by."""
        frame, told = self._odom.pose, odometry.map_to_odom
        return told.model_copy(update={"x_m": frame.x_m, "y_m": frame.y_m, "yaw_rad": frame.yaw_rad})

    def _summary(self, now: Stamp, reachable: float, covered: float) -> CoverageSummary:
        given_up = [(g.x_m, g.y_m, g.gain, g.reason) for g in self._roadmap.manager.given_up]
        given_up += [(g.x_m, g.y_m, g.gain, FENCED) for g in self._roadmap.manager.aside]
        given_up += [(p.x_m, p.y_m, p.gain, p.reason) for p in self._out_of_reach.places]
        frontiers = self._roadmap.manager.frontiers
        left = float(sum(f.gain for f in frontiers.values()))
        if self._config.coverage == "known":  # what is known is covered; what is expected behind it is not
            reachable += expected_area_m2(left, self._config.spacing_m)
        return CoverageSummary(
            stamp_ns=now,
            irm_version=max(self._roadmap.version, 1),
            reachable_area_m2=reachable,
            covered_area_m2=covered,
            covered_fraction=covered / reachable if reachable else 0.0,
            entropy_left=left + self._roadmap.manager.dropped_gain,
            frontiers=len(frontiers),
            frontier_gain=left,
            breadcrumbs=self._roadmap.breadcrumbs(),
            settled=not frontiers and reachable > 0.0,
            unreachable_xy_m=np.array([place[:2] for place in given_up], dtype=np.float64).reshape(-1, 2),
            unreachable_gain=np.array([place[2] for place in given_up], dtype=np.float64),
            unreachable_reason=[place[3] for place in given_up],
        )

    def snapshot(self) -> bytes:
        """The whole belief."""
        state = {
            "roadmap": self._roadmap.state(),
            "keyframes": self._keyframes.state(),
            "odom": self._odom.state(),
            "out_of_reach": self._out_of_reach.state(),
            "fences": self._fences.state(),
            "fenced_version": self._fenced_version,
            "penalties": self._penalties,
            "backwards": self._backwards,
            "pending": [scan.model_dump() for scan in self._pending],
            "anchors": self._local.state() if self._local else [],
            "global_ns": self._global_ns,
            "covered_m2": self._covered_m2,
            "resolution": self._ground.resolution_m if self._ground else 0.0,
            "radius": self._local.footprint_radius_m if self._local else 0.0,
            "version": self._local.version if self._local else 0,
            "ground": self._ground.state() if self._ground else {},
            "coverage": self._coverage.state() if self._coverage else {},
            "footprints": self._store.state() if self._store else {},
            "patches": self._ground_store.state() if self._ground_store else {},
        }
        return pack_snapshot(state)

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        state = unpack_snapshot(snapshot)
        self._roadmap.set_state(state["roadmap"])
        self._keyframes.set_state(state["keyframes"])
        self._odom.set_state(state["odom"])
        self._out_of_reach.set_state(state["out_of_reach"])
        self._set_fences(state)
        self._penalties = [(int(t), x, y) for t, x, y in state["penalties"]]
        self._backwards = bool(state["backwards"])
        self._pending = [CoverageScan(**scan) for scan in state["pending"]]
        self._global_ns = state["global_ns"]
        self._covered_m2 = state["covered_m2"]
        if state["resolution"]:
            self._make_layers(state["resolution"], state["radius"], state["version"])
            assert self._ground and self._coverage and self._store and self._ground_store and self._local
            self._ground.set_state(state["ground"])
            self._coverage.set_state(state["coverage"])
            self._store.set_state(state["footprints"])
            self._ground_store.set_state(state["patches"])
            self._local.set_state(state["anchors"])

    def journal(self, outputs: Outputs) -> bytes:
        """What the Global IRM and the coverage in `outputs` tell: the graph's difference, footprints and ground."""
        assert self._ground_store and self._ground and self._store and self._local
        record: dict[str, Any] = {
            "graph": [
                self._roadmap.difference(output.message)
                for output in outputs
                if isinstance(output.message, GlobalIrm)
            ],
            "footprints": self._store.take_changes(),
            "ground": self._ground_store.take_changes(),
            "keyframes": self._keyframes.take_changes(),
            "odom": self._odom.state(),
            "out_of_reach": self._out_of_reach.state(),
            "fences": self._fences.state(),
            "fenced_version": self._fenced_version,
            "resolution": self._ground.resolution_m,
            "radius": self._local.footprint_radius_m,
            "version": self._local.version,
            "global_ns": self._global_ns,
            "covered_m2": self._covered_m2,
            "penalties": self._penalties,
        }
        return zlib.compress(pack_snapshot(record), 1)

    def replay(self, record: bytes) -> None:
        """Take in a record of the journal."""
        state = unpack_snapshot(zlib.decompress(record))
        if self._ground is None:
            self._make_layers(state["resolution"], state["radius"], state["version"])
        assert self._ground_store and self._store and self._local
        for difference in state["graph"]:
            self._roadmap.apply_difference(difference)
        self._store.apply_changes(state["footprints"])
        self._ground_store.apply_changes(state["ground"])
        self._keyframes.apply_changes(state["keyframes"])
        self._odom.set_state(state["odom"])
        self._out_of_reach.set_state(state["out_of_reach"])
        self._set_fences(state)
        self._local.version = state["version"]
        self._global_ns, self._covered_m2 = state["global_ns"], state["covered_m2"]
        self._penalties = [(int(t), x, y) for t, x, y in state["penalties"]]

    def _set_fences(self, state: dict[str, Any]) -> None:
        if "fences" not in state:  # older journals have none
            return
        self._fences.set_state(state["fences"])
        self._fenced_version = state["fenced_version"]
        self._roadmap.fences = self._fences.placed(self._odom.pose, False)

    def resumed(self) -> None:
        """Versions of the Local IRM that were given since the last record are not given again."""
        self._resumed = self._roadmap.version > 0
        if self._local is not None:
            self._local.version += _SKIPPED_VERSIONS


def _exploring(inputs: Inputs) -> bool:
    """Whether the robot is sent to frontiers now; without a word from the mission it is taken to be."""
    mission = inputs.latest(MISSION)
    return mission is None or mission.message.phase == MissionPhase.EXPLORE
