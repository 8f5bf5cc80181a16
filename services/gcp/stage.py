"""The global coverage planner's stage: Global IRM in, QMDP policy with its target and the reasons out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.frames import Planar
from planning.graph_mirror import GraphMirror, RoadMap
from planning.randomness import stream
from planning.reward import RewardWeights
from schemas.base import Pose
from schemas.contract import SECOND_NS, Inputs, Outputs, Stage, StageSetup, StageSpec, Stamp, outputs
from schemas.operation import MissionPhase, MissionState
from schemas.policy import Alternative, GlobalPolicy
from schemas.sensing import Odometry
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import GCP_GRAPH_REQUEST, GLOBAL_IRM, GLOBAL_POLICY, MISSION, ODOMETRY
from schemas.world import GraphRequest
from services.gcp.config import Config
from services.gcp.planner import Belief, Floats, GlobalPlanner, Option, Values

__all__ = ["Config", "GcpStage", "create", "spec", "warm_up"]

_OVER = (MissionPhase.DONE, MissionPhase.STOPPED)


def spec(config: Config) -> StageSpec:
    """How to run the stage: at every message of the Global IRM, else periodically."""
    latency_ns = int(config.latency_s * SECOND_NS)
    return StageSpec("gcp", int(config.period_s * SECOND_NS), (GLOBAL_IRM.name,), latency_ns)


def create(config: Config, setup: StageSetup) -> Stage:
    """A planner that holds no graph and no target yet."""
    return GcpStage(config, setup)


class _Target(NamedTuple):
    """The frontier that the robot is sent to. id -1: none. gain: the most that it has promised since it was chosen."""

    id: int = -1
    xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gain: float = 0.0


class _Choice(NamedTuple):
    """What was decided. option None: no target; extra_xyz_m: where the path ends beyond its last node."""

    option: Option | None
    reason: str
    switched: bool = False
    alternatives: tuple[Option, ...] = ()
    extra_xyz_m: tuple[float, float, float] | None = None


class GcpStage:
    """Keeps a mirror of the graph and the target; plans anew at every step."""

    def __init__(self, config: Config, setup: StageSetup) -> None:
        self.config = config
        self._seed = setup.seed
        self._mirror = GraphMirror()
        self._target = _Target()
        self._tick = 0
        self._asked_ns = -1
        self._frame = Pose()
        """Of `odom` in the `map` that the graph is in: at a closure that of the odometry is ahead of the graph."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One step: the global policy, and a request for the graph when a difference was missed."""
        asks = self._update_graph(now, inputs)
        request = GraphRequest(stamp_ns=now, have_version=self._mirror.version)
        requests = outputs([(GCP_GRAPH_REQUEST, request)] if asks else [])
        odometry, mission = inputs.current(ODOMETRY), inputs.current(MISSION)
        if odometry is None or self._mirror.version == 0:
            return requests
        self._tick += 1
        return [*outputs([(GLOBAL_POLICY, self._plan(now, odometry, mission))]), *requests]

    def _update_graph(self, now: Stamp, inputs: Inputs) -> bool:
        """Apply what came; whether the whole graph must be asked for now."""
        fits = True
        for received in inputs.new(GLOBAL_IRM):
            fits = self._mirror.apply(received.message)
            if fits:
                self._frame = received.message.map_to_odom
        if fits or (self._asked_ns >= 0 and now - self._asked_ns < self.config.ask_again_s * SECOND_NS):
            return False
        self._asked_ns = now
        return True

    def _plan(self, now: Stamp, odometry: Odometry, mission: MissionState | None) -> GlobalPolicy:
        planner = GlobalPlanner(self._mirror.road_map(), self.config.reward)
        belief = self._belief(odometry)
        choice = self._choose(planner, belief, mission)
        robot = np.array(_robot_xyz(self._frame, odometry.pose))
        self._remember(planner, choice)
        to_go = planner.values_to_go(robot, self.config.local_range_m)
        return self._message(now, odometry, planner, choice, (planner.values(), to_go), robot)

    def _belief(self, odometry: Odometry) -> Belief:
        """Particles of the pose, from the covariance of the odometry in `map`; the same for the same seed
        and tick.
        """
        rng = stream(self._seed, "gcp", self._tick)
        mean = np.array(_robot_xyz(self._frame, odometry.pose))
        covariance = np.asarray(odometry.covariance)[:2, :2]
        variance, axes = np.linalg.eigh((covariance + covariance.T) / 2.0)
        # The breadcrumbs around drift along with the robot: its place among them is better known than that in `map`.
        variance = np.minimum(variance, self.config.max_pose_spread_m**2)
        spread = rng.standard_normal((self.config.particles, 2)) * np.sqrt(np.maximum(variance, 0.0))
        xyz = np.tile(mean, (self.config.particles, 1))
        xyz[:, :2] += spread @ axes.T
        road_map = self._mirror.road_map()
        node = road_map.index_of(self._mirror.robot_node)
        if node < 0:
            node = road_map.nearest_breadcrumb((float(mean[0]), float(mean[1]), float(mean[2])))
        return Belief(xyz, node)

    def _choose(self, planner: GlobalPlanner, belief: Belief, mission: MissionState | None) -> _Choice:
        """The target: home on the way back, else the frontier held or a clearly better one."""
        if belief.node < 0:
            return _Choice(None, "no target: the graph has no breadcrumb yet")
        if mission is not None and mission.phase in _OVER:
            return _Choice(None, f"no target: the mission is over ({mission.finish.value})")
        if mission is not None and mission.phase == MissionPhase.RETURN:
            return self._choose_home(planner, belief, mission)
        held = self._held_frontiers(planner)
        options = planner.options(belief, held, self.config.alternatives)
        if not options:
            count = planner.frontiers.size
            reason = (
                f"none of {count} frontiers can be reached over the graph" if count else "no frontier is left"
            )
            return _Choice(None, f"no target: {reason}")
        return self._keep_or_switch(planner, options, held)

    def _choose_home(self, planner: GlobalPlanner, belief: Belief, mission: MissionState) -> _Choice:
        home = (mission.home.x_m, mission.home.y_m, mission.home.z_m)
        option = planner.way_home(belief.node, planner.road_map.nearest_breadcrumb(home))
        if option is None:
            return _Choice(None, "no target: the graph has no way home")
        return _Choice(option, f"home: {option.distance_m:.0f} m, risk {option.risk:.2f}", extra_xyz_m=home)

    def _held_frontiers(self, planner: GlobalPlanner) -> list[int]:
        """The frontier that is still the target (by its id, else the nearest to its place), at most one."""
        if self._target.id < 0 or planner.frontiers.size == 0:
            return []
        same = planner.road_map.index_of(self._target.id)
        if same >= 0 and same in planner.frontiers:
            return [same]
        offset = planner.road_map.xyz_m[planner.frontiers] - np.array(self._target.xyz_m)
        gap_m = np.linalg.norm(offset, axis=1)
        nearest = int(np.argmin(gap_m))
        return [int(planner.frontiers[nearest])] if gap_m[nearest] <= self.config.same_target_m else []

    def _keep_or_switch(self, planner: GlobalPlanner, options: list[Option], held: list[int]) -> _Choice:
        """Keep the target unless the best Q is better by both margins; options: best first."""
        best = options[0]
        kept = next((option for option in options if option.node in held), None)
        shown = tuple(options[: self.config.alternatives])
        says = _describe(planner, best)
        if kept is None:
            why = (
                "first target"
                if self._target.id < 0
                else f"frontier {self._target.id} is covered or out of reach"
            )
            return _Choice(best, f"{says}; {why}", alternatives=shown)
        margin = self._margin(kept, best)
        if best.node == kept.node or best.q <= kept.q + margin:
            return _Choice(kept, f"{_describe(planner, kept)}; kept", alternatives=shown)
        why = f"switched, Q {best.q:.2f} against {kept.q:.2f} of {_describe(planner, kept)}"
        gap_m = float(np.linalg.norm(planner.road_map.xyz_m[best.node] - np.array(self._target.xyz_m)))
        return _Choice(best, f"{says}; {why}", gap_m > self.config.same_target_m, shown)

    def _margin(self, kept: Option, best: Option) -> float:
        """How much better the best must be. A crumb that is left of the target far away is no reason to pass others."""
        crumb = kept.gain < self.config.crumb_share * self._target.gain
        if crumb and kept.distance_m > 2.0 * best.distance_m:
            return self.config.crumb_margin
        return max(self.config.switch_margin, self.config.switch_margin_relative * abs(kept.q))

    def _remember(self, planner: GlobalPlanner, choice: _Choice) -> None:
        """Hold the frontier chosen; on the way home nothing is held."""
        before, self._target = self._target, _Target()
        if choice.option is not None and choice.extra_xyz_m is None:
            xyz = planner.road_map.xyz_m[choice.option.node]
            place = (float(xyz[0]), float(xyz[1]), float(xyz[2]))
            name = int(planner.road_map.node_id[choice.option.node])
            held = before.gain if name == before.id else 0.0
            self._target = _Target(name, place, max(held, choice.option.gain))

    def _message(
        self,
        now: Stamp,
        odometry: Odometry,
        planner: GlobalPlanner,
        choice: _Choice,
        values: tuple[Values, Values],
        robot: Floats,
    ) -> GlobalPolicy:
        road_map, option = planner.road_map, choice.option
        path = np.empty(0, np.int32) if option is None else option.path
        path_node, path_xyz = road_map.node_id[path], road_map.xyz_m[path]
        if choice.extra_xyz_m is not None:
            path_node = np.append(path_node, path_node[-1:])
            path_xyz = np.vstack((path_xyz, np.array(choice.extra_xyz_m)))
        place = path_xyz[-1] if option is not None else robot
        told = _nodes_to_tell(road_map, robot, path, self.config.policy_radius_m)
        return GlobalPolicy(
            stamp_ns=now,
            irm_version=self._mirror.version,
            target=-1 if option is None else int(road_map.node_id[option.node]),
            target_xyz_m=(float(place[0]), float(place[1]), float(place[2])),
            target_gain=0.0 if option is None else option.gain,
            target_q=0.0 if option is None else option.q,
            target_distance_m=0.0 if option is None else option.distance_m,
            target_risk=0.0 if option is None else option.risk,
            switched=choice.switched,
            reason=choice.reason,
            alternatives=[_alternative(planner, other) for other in choice.alternatives],
            map_to_odom=self._frame,
            node_id=road_map.node_id[told],
            node_xyz_m=road_map.xyz_m[told],
            action=values[0].action[told],
            value=values[0].value[told],
            value_to_go=values[1].value[told],
            path_node=path_node,
            path_xyz_m=path_xyz,
        )

    def snapshot(self) -> bytes:
        """Graph, target and tick."""
        return pack_snapshot(
            {
                "graph": self._mirror.snapshot(),
                "target": [self._target.id, *self._target.xyz_m, self._target.gain],
                "tick": self._tick,
                "asked_ns": self._asked_ns,
                "frame": self._frame.model_dump(),
            }
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        state = unpack_snapshot(snapshot)
        self._mirror.restore(state["graph"])
        target, x_m, y_m, z_m, gain = state["target"]
        self._target = _Target(target, (x_m, y_m, z_m), gain)
        self._tick, self._asked_ns = state["tick"], state["asked_ns"]
        self._frame = Pose(**state["frame"])

    def journal(self, outputs: Outputs) -> bytes:
        """The target held; the graph comes again from irm."""
        return pack_snapshot(
            {"target": [self._target.id, *self._target.xyz_m, self._target.gain], "tick": self._tick}
        )

    def replay(self, record: bytes) -> None:
        """Take in a record of the journal."""
        state = unpack_snapshot(record)
        target, x_m, y_m, z_m, gain = state["target"]
        self._target, self._tick = _Target(target, (x_m, y_m, z_m), gain), state["tick"]


def _nodes_to_tell(
    road_map: RoadMap, robot: Floats, path: NDArray[np.int32], radius_m: float
) -> NDArray[np.int64]:
    """Indices, ascending, of the nodes around the robot and on its path: what readers need, however large the graph."""
    near = np.square(road_map.xyz_m - robot).sum(axis=1) <= radius_m**2
    near[path] = True
    return np.flatnonzero(near)


def _robot_xyz(frame: Pose, pose: Pose) -> tuple[float, float, float]:
    """The robot's place in `map`."""
    x_m, y_m = Planar(frame.x_m, frame.y_m, frame.yaw_rad).apply(pose.x_m, pose.y_m)
    return x_m, y_m, frame.z_m + pose.z_m


def _describe(planner: GlobalPlanner, option: Option) -> str:
    """ "frontier 41: gain 3.2, 12 m, risk 0.01"."""
    node = int(planner.road_map.node_id[option.node])
    return f"frontier {node}: gain {option.gain:.1f}, {option.distance_m:.0f} m, risk {option.risk:.2f}"


def _alternative(planner: GlobalPlanner, option: Option) -> Alternative:
    x_m, y_m, _ = planner.road_map.xyz_m[option.node].tolist()
    return Alternative(
        frontier=int(planner.road_map.node_id[option.node]),
        x_m=x_m,
        y_m=y_m,
        gain=option.gain,
        distance_m=option.distance_m,
        risk=option.risk,
        q=option.q,
    )


def warm_up() -> None:
    """Compile the kernels: one breadcrumb, one frontier, one edge."""
    two, both = np.zeros(2), np.array([1, 0], np.int32)
    road_map = RoadMap(
        np.arange(2),
        np.array([0, 1], np.uint8),
        np.zeros((2, 3)),
        two,
        two.astype(np.float32),
        np.array([0, 1, 2], np.int32),
        both,
        two,
        two,
        two.astype(np.uint8),
    )
    planner = GlobalPlanner(road_map, RewardWeights())
    planner.options(Belief(np.zeros((1, 3)), 0), [], 1)
    planner.values()
    planner.values_to_go(np.zeros(3), 1.0)
    planner.way_home(0, 0)
