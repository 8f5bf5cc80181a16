"""The lcp stage: answers planning episodes with a local policy (paper, Local Coverage Planner)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

import numpy as np

from planning.coverage_model import ACTIONS, BITS, CoverageModel, rollout_value, search_coverage
from planning.coverage_tiles import tile_count
from planning.frames import planar
from planning.lattice_graph import spread_values, travel_costs
from planning.pomcp import PolicyTree, Pomcp, random_stream
from planning.randomness import stream
from planning.reward import leftover_entropy, parameters
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSetup, StageSpec, Stamp
from schemas.operation import MissionPhase
from schemas.policy import EpisodeRequest, GlobalPolicy, LocalPhase, LocalPolicy
from schemas.snapshot import pack_message, pack_snapshot, unpack_message, unpack_snapshot
from schemas.topics import EPISODE, GLOBAL_POLICY, LOCAL_IRM, LOCAL_POLICY, MISSION
from schemas.world import LocalIrm
from services.lcp.baselines import FrontierLook, NextBestView
from services.lcp.config import Config
from services.lcp.guide import way_along
from services.lcp.policy_path import covered_by, likely_moves, line_of, moves_to, step_terms
from services.lcp.problem import (
    Junction,
    coverage_model,
    junction_of,
    leaf_values,
    local_entropy,
    node_at,
)
from services.lcp.promises import Index, Promises
from services.lcp.tour import plan_tour
from services.lcp.viewpoints import warm_up_viewpoints

__all__ = ["Config", "LcpStage", "create", "spec", "warm_up"]

_KEPT_IRMS = 8
_MAX_RISK = 0.9
_EMPTY_TREE = PolicyTree(
    np.array([-1], np.int32), np.zeros(1), np.zeros(1, np.int32), np.zeros(1, np.int32), np.zeros(1, np.int32),
    np.zeros(2, np.int32), np.zeros(0, np.int32), np.zeros(0, np.int32),
)  # fmt: skip


def spec(config: Config) -> StageSpec:
    """How to run the stage: on every episode request."""
    return StageSpec("lcp", SECOND_NS // 5, (EPISODE.name,), latency_ns=SECOND_NS // 4)


def create(config: Config, setup: StageSetup) -> Stage:
    """An lcp stage."""
    return LcpStage(config, setup)


class LcpStage:
    """Keeps the last few Local IRMs, so that a request is answered on the version that it names."""

    def __init__(self, config: Config, setup: StageSetup) -> None:
        self._config = config
        self._seed = setup.seed
        self._stopwatch = setup.stopwatch
        self._irms: OrderedDict[int, LocalIrm] = OrderedDict()
        self._covering = True
        self._answered = 0
        self._promises = Promises(config.promises, config.promise_rest_s)
        self._next_view = NextBestView(config.nbv, setup.seed)
        self._frontier_look = FrontierLook(config.hfe)
        self._solver = Pomcp(
            state_size=BITS + tile_count(61),
            max_actions=ACTIONS,
            max_nodes=config.max_nodes,
            max_depth=config.max_depth,
            max_branches=12 * config.max_nodes,
            exploration=config.exploration,
        )

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Answer the newest episode request, once."""
        for received in inputs.new(LOCAL_IRM):
            self._irms[received.message.irm_version] = received.message
            while len(self._irms) > _KEPT_IRMS:
                self._irms.popitem(last=False)
        request = inputs.current(EPISODE)
        mission = inputs.latest(MISSION)
        if request is None or request.episode == self._answered:
            return []
        self._answered = request.episode
        returning = mission is not None and mission.message.phase == MissionPhase.RETURN
        policy = inputs.current(GLOBAL_POLICY)
        return [Output(LOCAL_POLICY, self._answer(now, request, policy, returning))]

    def _answer(
        self, now: Stamp, request: EpisodeRequest, policy: GlobalPolicy | None, returning: bool
    ) -> LocalPolicy:
        irm = self._irms.get(request.irm_version)
        if irm is None:
            return _nothing(now, request, f"Local IRM {request.irm_version} is not here")
        try:
            junction = junction_of(request, irm)
        except ValueError as error:
            return _nothing(now, request, str(error))
        entropy = local_entropy(irm)
        uncovered = indexed(irm, entropy)
        for index in self._promises.left_alone(now, uncovered):
            if index in uncovered:
                entropy[_node(irm, index)] = 0.0
        if self._config.planner == "tour" and not returning:
            return self._tour(now, request, irm, junction, entropy, uncovered, policy)
        if self._config.planner != "pomcp" and not returning:
            return self._baseline(now, request, irm, junction, entropy, uncovered, policy)
        if not returning and self._should_cover(irm, junction, entropy, policy):
            return self._cover(now, request, irm, junction, entropy, uncovered, policy)
        return self._guide(now, request, irm, junction, policy)

    def _baseline(
        self,
        now: Stamp,
        request: EpisodeRequest,
        irm: LocalIrm,
        junction: Junction,
        entropy: np.ndarray,
        uncovered: dict[Index, float],
        policy: GlobalPolicy | None,
    ) -> LocalPolicy:
        """The path to the next best view, or the way to gcp's frontier and a look there."""
        look, by_frontier = self._frontier_look, self._config.planner == "hfe"
        if by_frontier and not look.arrived(policy):
            guided = self._guide(now, request, irm, junction, policy)
            if guided.phase == LocalPhase.GUIDE or policy is None or policy.target < 0:
                return guided
            look.note_arrival(policy)
        counted = leftover_entropy(entropy, irm.state == 1, irm.size, self._config.weights)
        if by_frontier and policy is not None:
            counted = look.near_target(irm, policy, counted)
        model = coverage_model(irm, counted, np.zeros(irm.size**2), junction, self._config)
        if by_frontier:
            view = look.choose(model, junction, parameters(self._config.weights).k_risk)
        else:
            view = self._next_view.choose(irm, model, junction, request.episode)
        if view is None:
            return self._guide(now, request, irm, junction, policy)
        terms = self._promise(now, irm, model, junction, view.moves, uncovered)
        reason = f"goes to a view worth {view.reward:.2f}"
        return _policy(now, request, irm, LocalPhase.COVER, reason, policy, junction, view.moves, 0,
                       _EMPTY_TREE, view.reward, 0, 0, 0.0, terms)  # fmt: skip

    def _tour(
        self,
        now: Stamp,
        request: EpisodeRequest,
        irm: LocalIrm,
        junction: Junction,
        entropy: np.ndarray,
        uncovered: dict[Index, float],
        policy: GlobalPolicy | None,
    ) -> LocalPolicy:
        """The beginning of the tour over all viewpoints; where there are none, along the global path."""
        k_risk = parameters(self._config.weights).k_risk
        tour = plan_tour(irm, junction.node, entropy, policy, self._config.tour, k_risk, _MAX_RISK)
        if tour is None:
            return self._guide(now, request, irm, junction, policy)
        moves, at = [], junction.node
        for node in tour.nodes:
            moves += moves_to(irm, at, node, k_risk, _MAX_RISK) or []
            at = node
            if len(moves) >= self._config.path_steps:
                break
        moves = moves[: self._config.path_steps]
        model = coverage_model(irm, entropy, np.zeros(irm.size**2), junction, self._config)
        terms = self._promise(now, irm, model, junction, moves, uncovered)
        reason = f"tour over {len(tour.nodes)} viewpoints that see {tour.gain:.1f} nats"
        return _policy(now, request, irm, LocalPhase.COVER, reason, policy, junction, moves, 0,
                       _EMPTY_TREE, float(terms[0].sum()), 0, 0, 0.0, terms)  # fmt: skip

    def _should_cover(
        self, irm: LocalIrm, junction: Junction, entropy: np.ndarray, policy: GlobalPolicy | None
    ) -> bool:
        """Phase 2 while enough remains in reach, or when the target is reachable within the Local IRM."""
        n = irm.size * irm.size
        cost, move = np.empty(n), np.empty(n, np.int8)
        p = parameters(self._config.weights)
        travel_costs(
            junction.node, irm.size, irm.edge_distance_m, irm.edge_risk, p.k_risk, _MAX_RISK, cost, move
        )
        in_reach = float(entropy[_near_reach(irm, cost, self._config.cover_radius_m)].sum())
        bound = self._config.cover_end_entropy if self._covering else self._config.cover_begin_entropy
        self._covering = in_reach >= bound
        if self._covering or policy is None or policy.target < 0:
            return in_reach > 0.0
        x, y = planar(policy.map_to_odom).inverse().apply(*policy.target_xyz_m[:2])
        target = node_at(irm, x, y)
        return (
            target >= 0
            and bool(np.isfinite(cost[target]))
            and float(entropy.sum()) > 0.0
            and (float(entropy[_near_reach(irm, cost, cost[target] + 3.0)].sum()) > 0.0)
        )

    def _cover(
        self,
        now: Stamp,
        request: EpisodeRequest,
        irm: LocalIrm,
        junction: Junction,
        entropy: np.ndarray,
        uncovered: dict[Index, float],
        policy: GlobalPolicy | None,
    ) -> LocalPolicy:
        """Phase 2. entropy: without the patches that are left alone; uncovered: with them."""
        leaf = leaf_values(irm, policy, self._config.weights)
        counted = leftover_entropy(entropy, irm.state == 1, irm.size, self._config.weights)
        model = coverage_model(irm, counted, leaf, junction, self._config)
        seed = int(stream(self._seed, "lcp", request.episode).integers(2**63))
        report = self._solver.search(
            search_coverage, model, seed=seed, simulations=request.simulations, should_stop=self._deadline()
        )
        tree = self._solver.policy(self._config.min_visits)
        moves, in_tree = likely_moves(model, tree, junction.node, junction.heading, self._config.path_steps)
        if not moves:
            return self._guide(now, request, irm, junction, policy)
        root = self._solver.root()
        if root.best_value - leaf[junction.node] < self._config.cover_min_value:
            guided = self._guide(now, request, irm, junction, policy)
            if guided.phase == LocalPhase.GUIDE:
                return guided
        rollout = rollout_value(
            model,
            junction.node,
            junction.heading,
            model.covered,
            random_stream(seed),
            self._config.value_rollouts,
        )
        reason = f"covers: value {root.best_value:.2f} by {report.simulations} simulations"
        terms = self._promise(now, irm, model, junction, moves, uncovered)
        return _policy(now, request, irm, LocalPhase.COVER, reason, policy, junction, moves, in_tree, tree,
                       float(root.best_value), report.simulations, report.nodes, float(rollout), terms)  # fmt: skip

    def _promise(
        self,
        now: Stamp,
        irm: LocalIrm,
        model: CoverageModel,
        junction: Junction,
        moves: list[int],
        uncovered: dict[Index, float],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Note what a path promises to cover soon. Returns its `step_terms`."""
        soon = covered_by(model, junction.node, junction.heading, moves[: self._config.promise_moves])
        self._promises.note(now, (index for index in uncovered if soon[_node(irm, index)]), uncovered)
        return step_terms(model, junction.node, junction.heading, moves)

    def _deadline(self) -> Callable[[], bool] | None:
        """Whether the planning time of this episode is over; None where time is not measured (lock-step)."""
        if self._stopwatch is None:
            return None
        watch, ends = self._stopwatch, self._stopwatch() + self._config.seconds_per_deadline
        return lambda: watch() > ends

    def _guide(
        self,
        now: Stamp,
        request: EpisodeRequest,
        irm: LocalIrm,
        junction: Junction,
        policy: GlobalPolicy | None,
    ) -> LocalPolicy:
        """Phase 1: along the global path, as far as the Local IRM reaches."""
        if policy is None or len(policy.path_xyz_m) == 0:
            return _nothing(now, request, "no target" if policy is None else policy.reason)
        k_risk = parameters(self._config.weights).k_risk
        # A way that is riskier than any other planner would take is still better than to stand in a pocket.
        for max_risk in (_MAX_RISK, 1.0):
            moves = way_along(irm, policy, junction.node, k_risk, max_risk)
            if moves:
                reason = f"guides to target {policy.target}"
                return _policy(now, request, irm, LocalPhase.GUIDE, reason, policy, junction, moves, 0,
                               _EMPTY_TREE, policy.target_q, 0, 0)  # fmt: skip
        reason = f"no way to target {policy.target} in the Local IRM"
        return _nothing(now, request, reason, policy.target)

    def snapshot(self) -> bytes:
        """The phase, the last episode, the Local IRMs that the next one may name, and what was promised; a search
        begins anew."""
        return pack_snapshot(
            {
                "covering": self._covering,
                "answered": self._answered,
                "irms": [pack_message(irm) for irm in self._irms.values()],
                "promises": self._promises.state(),
                "next_view": self._next_view.state(),
                "frontier_look": self._frontier_look.state(),
            }
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        state = unpack_snapshot(snapshot)
        self._covering, self._answered = bool(state["covering"]), int(state["answered"])
        irms = [unpack_message(packed, LocalIrm) for packed in state["irms"]]
        self._irms = OrderedDict((irm.irm_version, irm) for irm in irms)
        self._promises.set_state(state["promises"])
        self._next_view.set_state(state["next_view"])
        self._frontier_look.set_state(state["frontier_look"])


def indexed(irm: LocalIrm, entropy: np.ndarray) -> dict[Index, float]:
    """The uncovered patches of a window by their global lattice index."""
    return {
        (irm.ix0 + int(n) % irm.size, irm.iy0 + int(n) // irm.size): float(entropy[n])
        for n in np.flatnonzero(entropy > 0.0)
    }


def _node(irm: LocalIrm, index: Index) -> int:
    return (index[1] - irm.iy0) * irm.size + index[0] - irm.ix0


def _near_reach(irm: LocalIrm, cost: np.ndarray, radius_m: float) -> np.ndarray:
    """Nodes that can be seen from nodes within so much travel: those nodes and what lies two nodes around. (n,)"""
    reached = (cost <= radius_m).reshape(irm.size, irm.size)
    grown = reached.copy()
    for _ in range(2):
        padded = np.pad(grown, 1)
        grown = (
            padded[1:-1, 1:-1] | padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
        )
    return grown.ravel()


def _policy(
    now: Stamp,
    request: EpisodeRequest,
    irm: LocalIrm,
    phase: LocalPhase,
    reason: str,
    policy: GlobalPolicy | None,
    junction: Junction,
    moves: list[int],
    in_tree: int,
    tree: PolicyTree,
    root_value: float,
    simulations: int,
    tree_nodes: int,
    rollout: float = 0.0,
    terms: tuple[np.ndarray, np.ndarray] | None = None,
) -> LocalPolicy:
    nodes, points, at = line_of(irm, junction.node, moves)
    reward, looks = terms or (np.zeros(len(nodes)), np.zeros(len(nodes), np.uint8))
    lattice = [(irm.ix0 + n % irm.size, irm.iy0 + n // irm.size) for n in nodes]
    return LocalPolicy(
        stamp_ns=now,
        episode=request.episode,
        irm_version=irm.irm_version,
        phase=phase,
        reason=reason,
        target=policy.target if policy is not None else -1,
        root_value=root_value,
        rollout_value=rollout,
        simulations=simulations,
        tree_nodes=tree_nodes,
        planning_ms=0.0,
        path_lattice=np.array(lattice, np.int32).reshape(-1, 2),
        path_reward=reward,
        path_in_tree=np.array([1 if i <= in_tree else 0 for i in range(len(nodes))], np.uint8),
        path_look=looks,
        path_xy_m=np.array(points, np.float64).reshape(-1, 2),
        path_node_point=np.array(at, np.int32),
        tree_action=tree.node_action,
        tree_value=np.nan_to_num(tree.node_value),
        tree_visits=tree.node_visits,
        child_start=tree.child_start,
        child_node=tree.child_node,
        child_observation=tree.child_observation,
    )


def _nothing(now: Stamp, request: EpisodeRequest, reason: str, target: int = -1) -> LocalPolicy:
    """No way; target: the one to which there is none."""
    none = np.zeros(0)
    return LocalPolicy(
        stamp_ns=now,
        episode=request.episode,
        irm_version=request.irm_version,
        phase=LocalPhase.NONE,
        reason=reason,
        target=target,
        root_value=0.0,
        rollout_value=0.0,
        simulations=0,
        tree_nodes=0,
        planning_ms=0.0,
        path_lattice=np.zeros((0, 2), np.int32),
        path_reward=none,
        path_in_tree=np.zeros(0, np.uint8),
        path_look=np.zeros(0, np.uint8),
        path_xy_m=np.zeros((0, 2)),
        path_node_point=np.zeros(0, np.int32),
        tree_action=np.zeros(0, np.int32),
        tree_value=none,
        tree_visits=np.zeros(0, np.int32),
        child_start=np.zeros(0, np.int32),
        child_node=np.zeros(0, np.int32),
        child_observation=np.zeros(0, np.int32),
    )


def warm_up() -> None:
    """Compile what a rehearsal may not need: the spreading of global values (arrays of messages are read-only)."""
    edges, value = np.zeros((9, 8), np.float32), np.zeros(9)
    edges.setflags(write=False)
    spread_values(np.zeros(9), 3, edges, edges, 0.9, 0.0, 0.0, value)
    warm_up_viewpoints()
