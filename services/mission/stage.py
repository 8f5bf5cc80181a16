"""The mission stage: the only writer of the mission's state."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.coverage import LOG_2
from planning.frames import Planar, in_map, planar
from planning.graph_mirror import FRONTIER, GraphMirror, RoadMap
from schemas.base import Message, Pose
from schemas.contract import SECOND_NS, Inputs, Outputs, Stage, StageSetup, StageSpec, Stamp, Topic, outputs
from schemas.operation import (
    CommandAnswer,
    CommandKind,
    LeftOver,
    MissionCommand,
    MissionPhase,
    MissionState,
)
from schemas.sensing import Odometry
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import (
    ANSWER,
    COMMAND,
    COVERAGE,
    FENCES,
    GLOBAL_IRM,
    MISSION,
    MISSION_GRAPH_REQUEST,
    ODOMETRY,
)
from schemas.world import CoverageSummary, GraphRequest
from services.mission.config import Config
from services.mission.fences import FenceBook, Whereabouts
from services.mission.machine import Facts, Machine
from services.mission.orders import OrderBook

__all__ = ["Config", "MissionStage", "create", "spec", "warm_up"]

_MAX_JUMP_M = 2.0  # between two steps; more is an odometry fault, not travel
_STANDS_M = 0.1  # nearer to the last place that was counted: noise of a standing robot's pose, not travel


class _Ways(NamedTuple):
    """Travel over one version of the graph from the robot's node: home, m; and what is left to go to.

    near: whether some frontier is worth its way. promised: what all frontiers promise, nats.
    """

    version: int
    node: int
    home_m: float
    near: bool
    promised: float


_NO_WAYS = _Ways(-1, -1, 0.0, True, 0.0)


def spec(config: Config) -> StageSpec:
    """How to run the stage: periodically, and at once when a command comes."""
    return StageSpec("mission", int(config.period_s * SECOND_NS), (COMMAND.name,))


def create(config: Config, setup: StageSetup) -> Stage:
    """A mission that has not begun."""
    return MissionStage(config)


class MissionStage:
    """Holds the state machine, the way home by the graph, and what is left."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.machine = Machine(config)
        self.fences = FenceBook()
        self._orders = OrderBook()
        self._fences_told: tuple[int, Stamp] = (-1, 0)
        self._mirror = GraphMirror()
        self._home: Pose | None = None
        self._frame = Planar(0.0, 0.0, 0.0)
        self._at: Pose | None = None
        self._last_xy: tuple[float, float] | None = None
        self._distance_m = 0.0
        self._coverage = 0.0
        self._asked_ns = -1
        self._unreachable: list[LeftOver] = []
        self._ways = _NO_WAYS

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One step: the mission's state, its fences now and then, an answer to each command, and a request for the
        graph when a difference was missed."""
        odometry = inputs.current(ODOMETRY)
        if odometry is not None:
            self._track(odometry)
        asks = self._update_graph(now, inputs)
        coverage = inputs.current(COVERAGE)
        if coverage is not None:
            self._coverage = coverage.covered_fraction
            self._unreachable = _unreachable(coverage)
        left = self._left()
        return_m = self._return_distance_m()
        facts = self._facts(now, coverage, return_m, len(left))
        answers = [self._obey(now, received.message, facts) for received in inputs.new(COMMAND)]
        self.machine.step(facts)
        found: list[tuple[Topic[Message], Message]] = []
        if self._fences_due(now):  # before the state that names their version
            found.append((FENCES, self.fences.message(now)))
        found.append((MISSION, self._state(now, return_m, left)))
        found += [(ANSWER, answer) for answer in answers]
        if asks:
            found.append(
                (MISSION_GRAPH_REQUEST, GraphRequest(stamp_ns=now, have_version=self._mirror.version))
            )
        return outputs(found)

    def _obey(self, now: Stamp, command: MissionCommand, facts: Facts) -> CommandAnswer:
        """Carry out a command, once, and say what became of it."""
        known = self._orders.before(command, now, self.machine.phase, self.fences.version)
        if known is not None:
            return known
        ids: list[str] = []
        if command.kind == CommandKind.BUDGET:
            outcome = self.machine.set_time_budget(command.time_budget_s, facts)
        elif command.kind == CommandKind.FENCE:
            outcome, ids = self.fences.add(command.fences, self._whereabouts())
        elif command.kind == CommandKind.UNFENCE:
            outcome, ids = self.fences.remove(command.fence_ids)
        else:
            outcome = self.machine.command(command.command_id, command.kind, facts)
        answer = CommandAnswer(
            stamp_ns=now,
            command_id=command.command_id,
            kind=command.kind,
            accepted=outcome.accepted,
            reason=outcome.reason,
            phase=self.machine.phase,
            fence_ids=ids,
            fences_version=self.fences.version,
        )
        self._orders.keep(command, answer)
        return answer

    def _whereabouts(self) -> Whereabouts:
        robot = None if self._at is None else _xy(self._at)
        return Whereabouts(robot, self._home, self._frame)

    def _fences_due(self, now: Stamp) -> bool:
        version, told_ns = self._fences_told
        if version == self.fences.version and now - told_ns < self.config.fences_period_s * SECOND_NS:
            return False
        self._fences_told = (self.fences.version, now)
        return True

    def _track(self, odometry: Odometry) -> None:
        """Follow the robot: distance in `odom`, where nothing jumps; place and home in `map`."""
        pose, frame = odometry.pose, odometry.map_to_odom
        self._frame = planar(frame)
        self._at = _in_map(odometry)
        if self._home is None:
            self._home = self._at
        if self._last_xy is not None:
            moved = math.hypot(pose.x_m - self._last_xy[0], pose.y_m - self._last_xy[1])
            if moved < _STANDS_M:
                return
            self._distance_m += moved if moved < _MAX_JUMP_M else 0.0
        self._last_xy = (pose.x_m, pose.y_m)

    def _update_graph(self, now: Stamp, inputs: Inputs) -> bool:
        """Apply what came; whether the whole graph must be asked for now."""
        fits = True
        for received in inputs.new(GLOBAL_IRM):
            fits = self._mirror.apply(received.message)
        if fits or (self._asked_ns >= 0 and now - self._asked_ns < self.config.ask_again_s * SECOND_NS):
            return False
        self._asked_ns = now
        return True

    def _facts(self, now: Stamp, coverage: CoverageSummary | None, return_m: float, left: int) -> Facts:
        return Facts(
            now_ns=now,
            localised=self._home is not None,
            distance_m=self._distance_m,
            return_distance_m=return_m,
            home_distance_m=self._home_distance_m(),
            settled=None if coverage is None else self._settled(coverage),
            covered_area_m2=None if coverage is None else coverage.covered_area_m2,
            left=left,
        )

    def _home_distance_m(self) -> float:
        if self._home is None or self._at is None:
            return math.inf
        return math.dist(_xy(self._home), _xy(self._at))

    def _return_distance_m(self) -> float:
        """Travel home: over the graph with the straight ends; the way that was driven where the graph has
        none.
        """
        if self._home is None or self._at is None:
            return 0.0
        straight = self._home_distance_m()
        ways = self._ways_now()
        robot = self._mirror.road_map().index_of(self._mirror.robot_node)
        if robot < 0 or not math.isfinite(ways.home_m):
            return max(straight, self._distance_m)
        to_node = math.dist(self._mirror.road_map().xyz_m[robot, :2], _xy(self._at))
        return max(straight, to_node + ways.home_m)

    def _ways_now(self) -> _Ways:
        """The ways over the graph as it is, computed once a version."""
        version, node = self._mirror.version, self._mirror.robot_node
        if (self._ways.version, self._ways.node) == (version, node):
            return self._ways
        road_map = self._mirror.road_map()
        robot, frontiers = road_map.index_of(node), np.flatnonzero(road_map.kind == FRONTIER)
        promised = float(road_map.gain[frontiers].sum())
        home_m, near = math.inf, True
        if robot >= 0:
            travel, _ = road_map.travel_from(robot)
            home_m = self._graph_travel_m(road_map, travel)
            worth_m = self.config.worth_m_per_nat * road_map.gain[frontiers]
            reached = np.isfinite(travel[frontiers])
            near = not reached.any() or bool((travel[frontiers] <= worth_m)[reached].any())
        self._ways = _Ways(version, node, home_m, near or self.config.worth_m_per_nat == 0.0, promised)
        return self._ways

    def _graph_travel_m(self, road_map: RoadMap, travel: NDArray[np.float64]) -> float:
        """From the robot's breadcrumb over the graph to the one nearest to home, and from there home."""
        if self._home is None:
            return math.inf
        end = road_map.nearest_breadcrumb((self._home.x_m, self._home.y_m, self._home.z_m))
        if end < 0:
            return math.inf
        return float(travel[end]) + math.dist(road_map.xyz_m[end, :2], _xy(self._home))

    def _settled(self, coverage: CoverageSummary) -> bool:
        """Nothing is left to go to, or only little that is far away for what it promises."""
        if coverage.settled:
            return True
        ways = self._ways_now()
        little = ways.promised <= self.config.worth_share * LOG_2 * coverage.covered_area_m2
        return not ways.near and little

    def _left(self) -> list[LeftOver]:
        """What is not covered and why: unreachable frontiers, and those still to be visited; best first."""
        road_map = self._mirror.road_map()
        open_reason = "not visited yet"
        if self.machine.phase in (MissionPhase.DONE, MissionPhase.STOPPED):
            open_reason = f"the mission ended first ({self.machine.finish.value})"
        elif self.machine.phase == MissionPhase.RETURN:
            open_reason = f"turned back first ({self.machine.pending.value})"
        left = list(self._unreachable)
        for index in np.flatnonzero(road_map.kind == FRONTIER):
            x_m, y_m, _ = road_map.xyz_m[index].tolist()
            left.append(LeftOver(x_m=x_m, y_m=y_m, gain=float(road_map.gain[index]), reason=open_reason))
        left.sort(key=lambda place: (-place.gain, place.x_m, place.y_m))
        return left[: self.config.max_left]

    def _state(self, now: Stamp, return_m: float, left: list[LeftOver]) -> MissionState:
        started_m = self.machine.start_m if self.machine.started_ns >= 0 else self._distance_m
        return MissionState(
            stamp_ns=now,
            phase=self.machine.phase,
            finish=self.machine.finish,
            reason=self.machine.reason,
            elapsed_s=self.machine.elapsed_s(now),
            time_budget_s=self.machine.time_budget_s,
            distance_m=self._distance_m - started_m,
            return_distance_m=return_m,
            home=self._home or Pose(),
            coverage=self._coverage,
            left=left,
            fences_version=self.fences.version,
        )

    def snapshot(self) -> bytes:
        """Machine, graph, home, distance and what is left."""
        return pack_snapshot({**self._beside_graph(), "graph": self._mirror.snapshot()})

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        state = unpack_snapshot(snapshot)
        self._mirror.restore(state["graph"])
        self._set_beside_graph(state)

    def journal(self, outputs: Outputs) -> bytes:
        """All but the graph, which comes again from irm."""
        return pack_snapshot(self._beside_graph())

    def replay(self, record: bytes) -> None:
        """Take in a record of the journal."""
        self._set_beside_graph(unpack_snapshot(record))

    def _beside_graph(self) -> dict[str, Any]:
        return {
            "machine": self.machine.snapshot(),
            "fences": self.fences.state(),
            "fences_told": list(self._fences_told),
            "orders": self._orders.state(),
            "frame": list(self._frame),
            "home": None if self._home is None else self._home.model_dump(),
            "at": None if self._at is None else self._at.model_dump(),
            "last_xy": self._last_xy,
            "distance_m": self._distance_m,
            "coverage": self._coverage,
            "asked_ns": self._asked_ns,
            "unreachable": [place.model_dump() for place in self._unreachable],
        }

    def _set_beside_graph(self, state: dict[str, Any]) -> None:
        self.machine.restore(state["machine"])
        if "fences" in state:  # older journals have none
            self.fences.set_state(state["fences"])
            self._fences_told = (state["fences_told"][0], state["fences_told"][1])
            self._orders.set_state(state["orders"])
            self._frame = Planar(*state["frame"])
        self._home = Pose(**state["home"]) if state["home"] else None
        self._at = Pose(**state["at"]) if state["at"] else None
        self._last_xy = (state["last_xy"][0], state["last_xy"][1]) if state["last_xy"] else None
        self._distance_m, self._coverage = state["distance_m"], state["coverage"]
        self._asked_ns = state["asked_ns"]
        self._unreachable = [LeftOver(**place) for place in state["unreachable"]]
        self._ways = _NO_WAYS


def _in_map(odometry: Odometry) -> Pose:
    """The robot's pose in `map`."""
    frame, pose = odometry.map_to_odom, odometry.pose
    at = in_map(frame, pose)
    return Pose(x_m=at.x_m, y_m=at.y_m, z_m=frame.z_m + pose.z_m, yaw_rad=at.yaw_rad)


def _xy(pose: Pose) -> tuple[float, float]:
    return pose.x_m, pose.y_m


def _unreachable(coverage: CoverageSummary) -> list[LeftOver]:
    """The frontiers that were given up; rows without a reason say so."""
    reasons = [*coverage.unreachable_reason, *["unreachable"] * coverage.unreachable_xy_m.shape[0]]
    return [
        LeftOver(x_m=float(xy[0]), y_m=float(xy[1]), gain=float(gain), reason=reason)
        for xy, gain, reason in zip(
            coverage.unreachable_xy_m, coverage.unreachable_gain, reasons, strict=False
        )
    ]


def warm_up() -> None:
    """Compile the kernels."""
    one = np.zeros(1)
    RoadMap(
        np.zeros(1, np.int64),
        np.zeros(1, np.uint8),
        np.zeros((1, 3)),
        one,
        np.zeros(1, np.float32),
        np.zeros(2, np.int32),
        np.zeros(0, np.int32),
        one[:0],
        one[:0],
        np.zeros(0, np.uint8),
    ).travel_from(0)
