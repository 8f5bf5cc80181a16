"""The status of the mission, put together from messages: no HTTP, no transport, no clock of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeVar

import numpy as np

from planning.frames import in_map, planar
from planning.graph_mirror import FRONTIER, GraphMirror, RoadMap
from planning.grid import GridSpec
from schemas.base import Message
from schemas.contract import SECOND_NS
from schemas.fences import Fences
from schemas.operation import JudgeReport, LinkReport, MissionState
from schemas.policy import GlobalPolicy, Plan
from schemas.sensing import Odometry
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.world import CoverageSummary, CoverageWindow, GlobalIrm, GraphRequest, LocalIrm, RiskMap
from services.status.canvas import TileCanvas
from services.status.config import Config
from services.status.events import EventLog
from services.status.heard import Heard
from services.status.history import Curve, CurvePoint
from services.status.memory import LiveMemory
from services.status.picture import Picture
from services.status.report import (
    CoverageReport,
    MissionReport,
    PlaceReport,
    PlanReport,
    StatusReport,
    TargetReport,
)
from services.status.view import SlowView, View

_M = TypeVar("_M", bound=Message)


class StatusCore:
    """Takes in messages and answers what the mission does. Not thread safe: the adapter locks around it."""

    def __init__(self, config: Config, robot: str) -> None:
        self.config = config
        self.robot = robot
        self.canvas = TileCanvas()
        self.target_switches = 0
        self.events = EventLog()
        self.curve = Curve()
        self.memory = LiveMemory()
        self._heard = Heard(config)
        self._trajectory: list[tuple[float, float]] = []
        self._mirror = GraphMirror()
        self._graph_fits = True
        self._asked_ns = -1

    def observe(self, topic_name: str, message: Message, now_ns: int) -> None:
        """Take in one message. now_ns: local monotonic clock, the same one that the other calls are given."""
        self._heard.note(topic_name, message, now_ns)
        self.events.observe(message)
        self.memory.observe(message)
        if isinstance(message, Odometry):
            self._follow(message)
        elif isinstance(message, CoverageWindow):
            grid = message.grid
            spec = GridSpec(grid.resolution_m, grid.ix0, grid.iy0, grid.width, grid.height)
            self.canvas.paste(spec, message.cell)
        elif isinstance(message, GlobalPolicy):
            self.target_switches += message.switched
        elif isinstance(message, GlobalIrm):
            self._graph_fits = self._mirror.apply(message)
        elif isinstance(message, CoverageSummary):
            self._note_coverage(message)

    def _note_coverage(self, summary: CoverageSummary) -> None:
        state, judge = self.latest("mission/state", MissionState), self.latest("sim/judge", JudgeReport)
        if state is not None:
            seen = math.nan if judge is None else judge.coverage
            self.curve.add(
                CurvePoint(
                    state.elapsed_s,
                    summary.covered_fraction,
                    summary.covered_area_m2,
                    state.distance_m,
                    seen,
                )
            )

    def _follow(self, odometry: Odometry) -> None:
        at = in_map(odometry.map_to_odom, odometry.pose)
        if self._trajectory and math.dist(self._trajectory[-1], at[:2]) < self.config.trajectory_spacing_m:
            return
        self._trajectory.append((at.x_m, at.y_m))
        if len(self._trajectory) > self.config.max_trajectory_points:
            self._trajectory = self._trajectory[::2]

    def graph_request(self, now_ns: int, stamp_ns: int) -> GraphRequest | None:
        """A request for the whole Global IRM when a difference was missed, at most every `ask_again_s`."""
        waited = self._asked_ns < 0 or now_ns - self._asked_ns >= self.config.ask_again_s * SECOND_NS
        if self._graph_fits or not waited:
            return None
        self._asked_ns = now_ns
        return GraphRequest(stamp_ns=stamp_ns, have_version=self._mirror.version)

    def not_ready(self, now_ns: int) -> list[str]:
        """Why the robot is not ready, in plain words; empty when it is."""
        return self._heard.not_ready(now_ns)

    def status(self, now_ns: int) -> StatusReport:
        """Everything known now."""
        reasons = self.not_ready(now_ns)
        odometry = self.latest("sim/odometry", Odometry)
        judge = self.latest("sim/judge", JudgeReport)
        return StatusReport(
            robot=self.robot,
            silent_s=self._heard.silent_s(now_ns),
            ready=not reasons,
            not_ready_because=reasons,
            mission=self._mission(),
            pose=self._pose(),
            speed_mps=None if odometry is None else odometry.speed_mps,
            coverage=self._coverage(judge),
            target=self._target(),
            target_switches=self.target_switches,
            plan=self._plan(now_ns),
            lost=None if judge is None else judge.lost,
            stages=self._heard.stages(now_ns),
            topics=self._heard.topics(now_ns),
        )

    def link(self) -> LinkReport | None:
        """The newest report of the link to the base; None when there is no link."""
        return self.latest("link/report", LinkReport)

    @property
    def graph(self) -> tuple[int, RoadMap]:
        """Version and content of the Global IRM as far as it is known here; version 0: nothing yet."""
        return self._mirror.version, self._mirror.road_map()

    def latest(self, topic_name: str, kind: type[_M]) -> _M | None:
        """The newest message of a topic, or None when none has come."""
        return self._heard.latest(topic_name, kind)

    def _pose(self) -> PlaceReport | None:
        odometry = self.latest("sim/odometry", Odometry)
        if odometry is None:
            return None
        at = in_map(odometry.map_to_odom, odometry.pose)
        return PlaceReport(x_m=at.x_m, y_m=at.y_m, yaw_rad=at.yaw_rad)

    def _mission(self) -> MissionReport | None:
        state = self.latest("mission/state", MissionState)
        if state is None:
            return None
        return MissionReport(
            phase=state.phase.value,
            finish=state.finish.value,
            reason=state.reason,
            elapsed_s=state.elapsed_s,
            time_budget_s=state.time_budget_s,
            distance_m=state.distance_m,
            return_distance_m=state.return_distance_m,
            left=len(state.left),
            fences_version=state.fences_version,
        )

    def _coverage(self, judge: JudgeReport | None) -> CoverageReport | None:
        summary = self.latest("irm/coverage", CoverageSummary)
        if summary is None:
            return None
        return CoverageReport(
            belief=summary.covered_fraction,
            covered_area_m2=summary.covered_area_m2,
            reachable_area_m2=summary.reachable_area_m2,
            frontiers=summary.frontiers,
            judge=None if judge is None else judge.coverage,
        )

    def _target(self) -> TargetReport | None:
        policy = self.latest("gcp/global_policy", GlobalPolicy)
        if policy is None:
            return None
        return TargetReport(
            id=policy.target,
            x_m=policy.target_xyz_m[0],
            y_m=policy.target_xyz_m[1],
            gain=policy.target_gain,
            distance_m=policy.target_distance_m,
            risk=policy.target_risk,
            q=policy.target_q,
            reason=policy.reason,
        )

    def _plan(self, now_ns: int) -> PlanReport | None:
        plan, age_s = self.latest("reconciler/plan", Plan), self._heard.age_s("reconciler/plan", now_ns)
        if plan is None or age_s is None:
            return None
        return PlanReport(
            safety=plan.safety.value,
            valid=plan.valid,
            reason=plan.reason,
            tau_s=plan.tau_s,
            age_s=age_s,
            length_m=float(np.hypot(np.diff(plan.x_m), np.diff(plan.y_m)).sum()),
        )

    def picture(self) -> Picture:
        """What the picture of the map shows: coverage, trajectory, robot, plan, frontiers and target."""
        place, policy = self._pose(), self.latest("gcp/global_policy", GlobalPolicy)
        road_map = self._mirror.road_map()
        frontiers = road_map.xyz_m[road_map.kind == FRONTIER, :2]
        return Picture(
            canvas=self.canvas.whole(),
            trajectory=tuple(self._trajectory),
            robot=None if place is None else (place.x_m, place.y_m, place.yaw_rad),
            plan=self._plan_in_map(),
            frontiers=tuple((float(x), float(y)) for x, y in frontiers),
            target=None if policy is None or policy.target < 0 else policy.target_xyz_m[:2],
            route=() if policy is None else tuple((float(x), float(y)) for x, y, _ in policy.route_xyz_m),
            title=self._title(),
        )

    def view(self, now_ns: int, tiles_since: int, with_report: bool) -> View:
        """What the live page shows, to be drawn outside the lock: nothing in it changes any more.

        tiles_since: tiles of the canvas that changed after this number are copied. with_report: tell what is told
        more slowly, too.
        """
        place, (pastes, tiles) = self._pose(), self.canvas.changed(tiles_since)
        return View(
            odometry=self.latest("sim/odometry", Odometry),
            place=None if place is None else (place.x_m, place.y_m, place.yaw_rad),
            risk=self.latest("riskmap/risk_map", RiskMap),
            local=self.latest("irm/local_irm", LocalIrm),
            policy=self.latest("gcp/global_policy", GlobalPolicy),
            plan=self.latest("reconciler/plan", Plan),
            fences=self.latest("mission/fences", Fences),
            old_path=self.memory.old_path,
            graph=self._mirror.road_map(),
            pastes=pastes,
            tiles=tiles,
            tile_names=self.canvas.tiles(),
            resolution_m=self.canvas.resolution_m,
            trajectory=self._trajectory.copy(),
            slow=self._slow(now_ns) if with_report else None,
        )

    def _slow(self, now_ns: int) -> SlowView:
        state = self.latest("mission/state", MissionState)
        return SlowView(
            report=self.status(now_ns),
            began_s=None if state is None else state.stamp_ns / SECOND_NS - state.elapsed_s,
            restarts=dict(self.memory.restarts),
            curve=tuple(self.curve.points),
            step_times=self.memory.step_times.rows(),
            events=tuple(self.events.events),
        )

    def _plan_in_map(self) -> tuple[tuple[float, float], ...]:
        plan, odometry = self.latest("reconciler/plan", Plan), self.latest("sim/odometry", Odometry)
        if plan is None or odometry is None or not plan.valid:
            return ()
        frame = planar(odometry.map_to_odom)
        return tuple(frame.apply(float(x), float(y)) for x, y in zip(plan.x_m, plan.y_m, strict=True))

    def _title(self) -> str:
        mission, coverage = self._mission(), self._coverage(None)
        phase = "no mission yet" if mission is None else f"{mission.phase} {mission.elapsed_s:.0f} s"
        return phase if coverage is None else f"{phase}, {100 * coverage.belief:.1f} % covered"

    def snapshot(self) -> bytes:
        """What messages will not tell again: the map, the trajectory, how often the target was switched."""
        trajectory = np.array(self._trajectory, dtype=np.float64).reshape(-1, 2)
        return pack_snapshot(
            {
                "canvas": self.canvas.state(),
                "trajectory": trajectory,
                "target_switches": self.target_switches,
                "events": self.events.state(),
                "curve": [list(point) for point in self.curve.points],
                "curve_spacing_s": self.curve.spacing_s,
                "memory": self.memory.state(),
            }
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        state = unpack_snapshot(snapshot)
        self.canvas.set_state(state["canvas"])
        self._trajectory = [(float(x), float(y)) for x, y in state["trajectory"]]
        self.target_switches = int(state["target_switches"])
        if "events" in state:  # older snapshots have none
            self.events.set_state(state["events"])
            self.curve.points = [CurvePoint(*point) for point in state["curve"]]
            self.curve.spacing_s = state["curve_spacing_s"]
        if "memory" in state:
            self.memory.set_state(state["memory"])

    def numbers(self, now_ns: int) -> Mapping[str, float]:
        """The numbers of the status by name, for metrics; only what is known."""
        report = self.status(now_ns)
        found: dict[str, float | None] = {
            "ready": float(report.ready),
            "target_switches": float(report.target_switches),
            "events_total": float(self.events.last_id),
        }
        if report.coverage is not None:
            found |= {
                "coverage_belief": report.coverage.belief,
                "coverage_judge": report.coverage.judge,
                "frontiers": float(report.coverage.frontiers),
            }
        if report.mission is not None:
            found |= {
                "elapsed_seconds": report.mission.elapsed_s,
                "distance_meters": report.mission.distance_m,
            }
        if report.plan is not None:
            found |= {"plan_tau_seconds": report.plan.tau_s}
        return {name: value for name, value in found.items() if value is not None}
