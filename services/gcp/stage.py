"""The global coverage planner's stage: Global IRM in, QMDP policy with its target and the reasons out."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.frames import planar
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
from services.gcp.hfe import frontier_options, scope_of
from services.gcp.net import empty_net, move_pool
from services.gcp.orienteering import Outlook, Visits
from services.gcp.planner import Belief, Floats, GlobalPlanner, Option, Slots
from services.gcp.roadnet import Graph, RoadNet

__all__ = ["Config", "GcpStage", "create", "spec", "warm_up"]

_OVER = (MissionPhase.DONE, MissionPhase.STOPPED)
_ROUTE_PLACES = 16


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
    """Keeps the graph, what was computed on it, and the target; decides anew at every step."""

    def __init__(self, config: Config, setup: StageSetup) -> None:
        self.config = config
        self._seed = setup.seed
        self._roads = RoadNet(config.reward)
        self._planner = GlobalPlanner(self._roads)
        self._visits = (
            Visits(self._roads, config.tour_gamma_per_m, config.group_m, config.groups, config.near_worth)
            if config.solver == "orienteering"
            else None
        )
        self._target = _Target()
        self._tick = 0
        self._asked_ns = -1
        self._frame = Pose()
        """Of `odom` in the `map` that the graph is in: at a closure that of the odometry is ahead of the graph."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One step: the global policy, and a request for the graph when a difference was missed."""
        asks = self._update_graph(now, inputs)
        request = GraphRequest(stamp_ns=now, have_version=self._roads.version)
        requests = outputs([(GCP_GRAPH_REQUEST, request)] if asks else [])
        odometry, mission = inputs.current(ODOMETRY), inputs.current(MISSION)
        if odometry is None or self._roads.version == 0:
            return requests
        self._tick += 1
        return [*outputs([(GLOBAL_POLICY, self._plan(now, odometry, mission))]), *requests]

    def _update_graph(self, now: Stamp, inputs: Inputs) -> bool:
        """Apply what came; whether the whole graph must be asked for now."""
        fits = True
        for received in inputs.new(GLOBAL_IRM):
            fits = self._roads.apply(received.message)
            if fits:
                self._frame = received.message.map_to_odom
        if fits or (self._asked_ns >= 0 and now - self._asked_ns < self.config.ask_again_s * SECOND_NS):
            return False
        self._asked_ns = now
        return True

    def _plan(self, now: Stamp, odometry: Odometry, mission: MissionState | None) -> GlobalPolicy:
        self._planner.follow()
        belief = self._belief(odometry)
        choice = self._choose(belief, mission)
        self._remember(choice)
        return self._message(now, choice, np.array(_robot_xyz(self._frame, odometry.pose)))

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
        node = self._roads.slot_of(self._roads.robot_node)
        return Belief(xyz, node if node >= 0 else self._roads.nearest_breadcrumb(mean))

    def _choose(self, belief: Belief, mission: MissionState | None) -> _Choice:
        """The target: home on the way back, else the frontier held or a clearly better one."""
        if belief.node < 0:
            return _Choice(None, "no target: the graph has no breadcrumb yet")
        if mission is not None and mission.phase in _OVER:
            return _Choice(None, f"no target: the mission is over ({mission.finish.value})")
        if mission is not None and mission.phase == MissionPhase.RETURN:
            return self._choose_home(belief, mission)
        held = self._held_frontiers()
        tour = self._visits.first(belief.node, held[0] if held else -1) if self._visits else None
        wanted = [*held, tour.first] if tour is not None and tour.first >= 0 else held
        options = self._options(belief, wanted)
        if not options:
            count = len(self._roads.frontiers)
            reason = (
                f"none of {count} frontiers can be reached over the graph" if count else "no frontier is left"
            )
            return _Choice(None, f"no target: {reason}")
        if tour is not None:
            return self._keep_or_switch_tour(options, held, tour)
        return self._keep_or_switch(options, held)

    def _options(self, belief: Belief, held: list[int]) -> list[Option]:
        """The best frontiers, best first, and those held."""
        c, top = self.config, self.config.alternatives
        if c.solver != "hfe":
            return self._planner.options(belief, held, top)
        h = c.hfe
        return frontier_options(
            self._roads, belief.node, h.scopes_m, h.gain_weight, h.risk_weight_m, top, held
        )

    def _choose_home(self, belief: Belief, mission: MissionState) -> _Choice:
        home = (mission.home.x_m, mission.home.y_m, mission.home.z_m)
        option = self._planner.way_home(belief.node, self._roads.nearest_breadcrumb(np.array(home)))
        if option is None:
            return _Choice(None, "no target: the graph has no way home")
        return _Choice(option, f"home: {option.distance_m:.0f} m, risk {option.risk:.2f}", extra_xyz_m=home)

    def _held_frontiers(self) -> list[int]:
        """The frontier that is still the target (by its id, else the nearest to its place), at most one."""
        if self._target.id < 0 or not self._roads.frontiers:
            return []
        if self._target.id in self._roads.frontiers:
            return [self._roads.frontiers[self._target.id]]
        frontiers = self._roads.frontier_slots()
        gap_m = np.linalg.norm(self._roads.xyz_m[frontiers] - np.array(self._target.xyz_m), axis=1)
        nearest = int(np.argmin(gap_m))
        return [int(frontiers[nearest])] if gap_m[nearest] <= self.config.same_target_m else []

    def _keep_or_switch(self, options: list[Option], held: list[int]) -> _Choice:
        """Keep the target unless the best Q is better by both margins; options: best first."""
        best = options[0]
        kept = next((option for option in options if option.node in held), None)
        shown = tuple(options[: self.config.alternatives])
        says = _describe(self._roads, best)
        if kept is None:
            why = (
                "first target"
                if self._target.id < 0
                else f"frontier {self._target.id} is covered or out of reach"
            )
            return _Choice(best, f"{says}; {why}", alternatives=shown)
        margin = self._margin(kept, best)
        if best.node == kept.node or best.q <= kept.q + margin:
            return _Choice(kept, f"{_describe(self._roads, kept)}; kept", alternatives=shown)
        why = f"switched, Q {best.q:.2f} against {kept.q:.2f} of {_describe(self._roads, kept)}"
        gap_m = float(np.linalg.norm(self._roads.xyz_m[best.node] - np.array(self._target.xyz_m)))
        return _Choice(best, f"{says}; {why}", gap_m > self.config.same_target_m, shown)

    def _keep_or_switch_tour(self, options: list[Option], held: list[int], tour: Outlook) -> _Choice:
        """Keep the target unless a tour that begins elsewhere is better by both margins."""
        shown = tuple(options[: self.config.alternatives])
        best = next((option for option in options if option.node == tour.first), options[0])
        kept = next((option for option in options if option.node in held), None)
        says = f"{_describe(self._roads, best)}; begins a tour worth {tour.value:.1f}"
        if kept is None:
            return _Choice(best, says, alternatives=shown)
        c = self.config
        margin = max(c.tour_margin, c.tour_margin_relative * abs(tour.kept_value))
        if best.node == kept.node or tour.value <= tour.kept_value + margin:
            return _Choice(kept, f"{_describe(self._roads, kept)}; kept", alternatives=shown)
        why = f"switched, against {tour.kept_value:.1f} by {_describe(self._roads, kept)} first"
        gap_m = float(np.linalg.norm(self._roads.xyz_m[best.node] - np.array(self._target.xyz_m)))
        return _Choice(best, f"{says}; {why}", gap_m > c.same_target_m, shown)

    def _margin(self, kept: Option, best: Option) -> float:
        """How much better the best must be. For a crumb, whole ground is not left unseen, nor what lies before it."""
        c = self.config
        if c.solver == "hfe":
            scopes = [scope_of(option.distance_m, c.hfe.scopes_m) for option in (kept, best)]
            return c.hfe.switch_margin if scopes[0] == scopes[1] else -math.inf
        crumb = kept.gain < max(c.crumb_share * self._target.gain, c.crumb_gain)
        times = c.crumb_times if c.crumb_times > 0.0 else math.inf
        much_more = best.gain >= times * kept.gain and best.distance_m <= 2.0 * kept.distance_m
        if crumb and (kept.distance_m > 2.0 * best.distance_m or much_more):
            return c.crumb_margin
        return max(self.config.switch_margin, self.config.switch_margin_relative * abs(kept.q))

    def _remember(self, choice: _Choice) -> None:
        """Hold the frontier chosen; on the way home nothing is held."""
        before, self._target = self._target, _Target()
        if choice.option is not None and choice.extra_xyz_m is None:
            x_m, y_m, z_m = self._roads.xyz_m[choice.option.node].tolist()
            name = int(self._roads.net.node_id[choice.option.node])
            held = before.gain if name == before.id else 0.0
            self._target = _Target(name, (x_m, y_m, z_m), max(held, choice.option.gain))

    def _message(self, now: Stamp, choice: _Choice, robot: Floats) -> GlobalPolicy:
        roads, option, radius_m = self._roads, choice.option, self.config.policy_radius_m
        path = np.empty(0, np.int32) if option is None else option.path
        path_node, path_xyz = roads.net.node_id[path], roads.xyz_m[path]
        if choice.extra_xyz_m is not None and option is not None:
            path_node = np.append(path_node, path_node[-1:])
            path_xyz = np.vstack((path_xyz, np.array(choice.extra_xyz_m)))
        place = path_xyz[-1] if option is not None else robot
        asked = self.config.solver != "hfe"  # its local planner asks for no values
        near = roads.near(robot, radius_m) if asked else np.empty(0, np.int32)
        policy = self._planner.policy(near, robot, self.config.local_range_m)
        worth = np.flatnonzero((policy.value > 0.0) | (policy.value_to_go > 0.0))
        told, piece = _pieces_around(path_xyz, robot, radius_m)
        route = np.unique(np.linspace(0, max(0, len(path_xyz) - 1), _ROUTE_PLACES).astype(np.int64))
        return GlobalPolicy(
            stamp_ns=now,
            irm_version=roads.version,
            target=-1 if option is None else int(roads.net.node_id[option.node]),
            target_xyz_m=(float(place[0]), float(place[1]), float(place[2])),
            target_gain=0.0 if option is None else option.gain,
            target_q=0.0 if option is None else option.q,
            target_distance_m=0.0 if option is None else option.distance_m,
            target_risk=0.0 if option is None else option.risk,
            switched=choice.switched,
            reason=choice.reason,
            alternatives=[_alternative(roads, other) for other in choice.alternatives],
            map_to_odom=self._frame,
            node_id=roads.net.node_id[near][worth],
            node_xyz_m=roads.xyz_m[near][worth],
            action=policy.action[worth],
            value=policy.value[worth],
            value_to_go=policy.value_to_go[worth],
            path_node=path_node[told],
            path_xyz_m=path_xyz[told],
            path_piece=piece,
            route_xyz_m=path_xyz[route] if len(path_xyz) else path_xyz,
        )

    def snapshot(self) -> bytes:
        """Graph, target and tick."""
        return pack_snapshot(
            {
                "graph": self._roads.snapshot(),
                "target": [self._target.id, *self._target.xyz_m, self._target.gain],
                "tick": self._tick,
                "asked_ns": self._asked_ns,
                "frame": self._frame.model_dump(),
            }
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        state = unpack_snapshot(snapshot)
        self._roads.restore(state["graph"])
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


def _pieces_around(path_xyz_m: Floats, robot: Floats, radius_m: float) -> tuple[NDArray[np.int64], Slots]:
    """The places of a path around the robot with the next ones outside, and the number of the piece of each.

    A way may leave the robot's surroundings and come back: what readers need of it stays small, however long it is.
    The first place is always among them.
    """
    near = np.square(path_xyz_m - robot).sum(axis=1) <= radius_m**2
    near[:1] = True
    told = near.copy()
    told[1:] |= near[:-1]
    told[:-1] |= near[1:]
    places = np.flatnonzero(told)
    apart = np.diff(places, prepend=places[:1]) > 1
    return places, np.cumsum(apart).astype(np.int32)


def _robot_xyz(frame: Pose, pose: Pose) -> tuple[float, float, float]:
    """The robot's place in `map`."""
    x_m, y_m = planar(frame).apply(pose.x_m, pose.y_m)
    return x_m, y_m, frame.z_m + pose.z_m


def _describe(roads: RoadNet, option: Option) -> str:
    """ "frontier 41: gain 3.2, 12 m, risk 0.01"."""
    node = int(roads.net.node_id[option.node])
    return f"frontier {node}: gain {option.gain:.1f}, {option.distance_m:.0f} m, risk {option.risk:.2f}"


def _alternative(roads: RoadNet, option: Option) -> Alternative:
    x_m, y_m, _ = roads.xyz_m[option.node].tolist()
    return Alternative(
        frontier=int(roads.net.node_id[option.node]),
        x_m=x_m,
        y_m=y_m,
        gain=option.gain,
        distance_m=option.distance_m,
        risk=option.risk,
        q=option.q,
    )


def warm_up() -> None:
    """Compile the kernels: a breadcrumb between two frontiers; one of these and an edge are gone; all is back."""
    nodes, edges = np.array([1, 2, 3]), np.array([[1, 2], [2, 3]])
    nothing = np.empty(0, np.int64)
    xyz = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    kind, gain = np.array([1, 0, 1], np.uint8), np.array([1.0, 0.0, 1.0])
    ones = np.ones(2)
    graph = Graph(
        1, 0, 2, nodes, kind, xyz, gain, edges[:, 0], edges[:, 1], ones, ones * 0.1, nothing, edges[:0]
    )
    smaller = graph._replace(
        irm_version=2, base_version=1, node_id=nodes[:0], node_kind=kind[:0], node_xyz_m=xyz[:0], node_gain=gain[:0],
        edge_a=nothing, edge_b=nothing, edge_distance_m=ones[:0], edge_risk=ones[:0], removed_node=nodes[2:],
        removed_edge=edges[:1],
    )  # fmt: skip
    roads = RoadNet(RewardWeights())
    planner = GlobalPlanner(roads)
    for message in (graph, smaller, graph._replace(irm_version=3, base_version=2)):
        roads.apply(message)
        planner.follow()
        middle = roads.slot_of(2)
        planner.options(Belief(np.zeros((1, 3)), middle), [], 1)
        planner.policy(roads.near(np.zeros(3), 2.0), np.zeros(3), 0.5)
        planner.way_home(middle, roads.slot_of(1))
        frontier_options(roads, middle, (), 1.0, 1.0, 1, ())
        Visits(roads, 0.99, 1.0, 2, 0.0).first(middle, -1)
    move_pool(roads.net, empty_net(0, 2 * roads.net.other.size))  # what a graph does that outgrows its pool
