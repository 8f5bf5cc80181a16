"""The reconciler stage: opens episodes, reconciles policies, and is the only one that emits motion."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planning.fences import FenceView
from planning.frames import planar
from planning.grid import GridSpec
from schemas.base import Message
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSetup, StageSpec, Stamp, Topic
from schemas.operation import MissionPhase
from schemas.policy import EpisodeRequest, LocalPhase, LocalPolicy, Plan
from schemas.sensing import Odometry
from schemas.snapshot import pack_message, pack_snapshot, unpack_message, unpack_snapshot
from schemas.topics import (
    EPISODE,
    FENCES,
    FOLLOWER,
    LOCAL_IRM,
    LOCAL_POLICY,
    MISSION,
    MOVING,
    ODOMETRY,
    PLAN,
    RISK_MAP,
    SUPERVISOR,
)
from schemas.world import LocalIrm, RiskMap
from services.reconciler.config import Config
from services.reconciler.episode import (
    Committed,
    Opened,
    cover_along,
    heading_index,
    junction_particles,
    line_to_lattice,
    model_here,
    moves_between,
    node_index,
    pack_opened,
    unpack_opened,
    usable_nodes,
)
from services.reconciler.following import Driven
from services.reconciler.path import STEP_M, Ground, fenced_ground, headings, resample, speeds
from services.reconciler.rehearsal import rehearse
from services.reconciler.safety import SafetyInputs, SafetyLimits, Verdict, judge
from services.reconciler.separation import Guard
from services.reconciler.tau import choose_tau, tau_terms

__all__ = ["Config", "ReconcilerStage", "create", "spec", "warm_up"]

_NO_POINTS = np.zeros((0, 2))
_KEPT = (
    "episode", "opened_ns", "asked_ns", "plan_id", "published_ns", "share", "tau_s", "kept_end", "value_ratio",
    "latency_s",
)  # fmt: skip
"""What a snapshot holds as it is."""
_SKIPPED_IDS = 10_000
"""More than the plans and episodes of the longest time between two snapshots."""
_SOON_M = 2.5
"""With less of the path left than this a new episode opens at once."""


def spec(config: Config) -> StageSpec:
    """How to run the stage: at 10 Hz, and at once on risk maps, on what moves, and on answers."""
    triggers = (RISK_MAP.name, MOVING.name, LOCAL_POLICY.name, FENCES.name)
    return StageSpec("reconciler", SECOND_NS // 10, triggers, latency_ns=SECOND_NS // 100)


def create(config: Config, setup: StageSetup) -> Stage:
    """A reconciler stage."""
    return ReconcilerStage(config, setup.seed)


def warm_up() -> None:
    """Compile the kernels, or load them: before the stage is ready, not in its first steps."""
    rehearse(ReconcilerStage(Config(), 0))


class ReconcilerStage:
    """Holds the committed policy, the open episode and what was last published."""

    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._driven = Driven(config)
        self._guard = Guard(config)
        self._fences = FenceView()
        self._opened: Opened | None = None
        self._episode = 0
        self._opened_ns = -(10**18)
        self._asked_ns = -1
        self._plan_id = 0
        self._published_ns = -(10**18)
        self._share = 1.0
        """Of the speed limits, in the last plan."""
        self._tau_s = 0.0
        self._kept_end = 0
        self._value_ratio = 1.0
        self._latency_s = 0.0
        self._plan: Plan | None = None

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One cycle: safety first, then the path, then episodes."""
        odometry, risk = inputs.latest(ODOMETRY), inputs.latest(RISK_MAP)
        moving = inputs.current(MOVING)
        points = None if moving is None else moving.points_m
        if odometry is not None:
            self._guard.watch(now, points, self._driven.ahead(odometry.message))
        verdict = self._judge(now, inputs)
        if not verdict.may_move:
            self._asked_ns = -1
        if odometry is None or risk is None:
            return []
        ground, fences_changed = self._ground(inputs, risk.message, odometry.message)
        found: Outputs = []
        follower = inputs.current(FOLLOWER)
        if self._driven.follow(now, odometry.message, follower, self._plan_id, ground):
            self._opened = None
        for received in inputs.new(LOCAL_POLICY):
            self._install(now, received.message, odometry.message, ground)
        if risk.fresh or self._driven.changed or fences_changed:
            self._driven.check_hazards(ground)
            if self._driven.changed:  # another line: who is in its way?
                self._guard.watch(now, points, self._driven.ahead(odometry.message))
                verdict = self._judge(now, inputs)
        self._driven.leave_if_idle(now, odometry.message, verdict.may_move and self._left(inputs))
        irm = inputs.current(LOCAL_IRM)
        if verdict.may_move and irm is not None and self._wants_episode(now):
            found += self._open(now, irm, odometry.message, ground)
        found += self._publish(now, verdict, odometry.message, ground, risk.message.stamp_ns)
        return found

    def _ground(self, inputs: Inputs, risk: RiskMap, odometry: Odometry) -> tuple[Ground, bool]:
        """What may be driven on: the risk map within the fences. Whether the fences are others than before."""
        told, frame, pose = inputs.latest(FENCES), odometry.map_to_odom, odometry.pose
        changed = told is not None and self._fences.update(told.message.version, told.message.fences)
        g = risk.grid
        spec = GridSpec(g.resolution_m, g.ix0, g.iy0, g.width, g.height)
        shut = self._fences.shut(spec, planar(frame))
        return fenced_ground(risk, shut, (pose.x_m, pose.y_m)), changed

    # --- safety -----------------------------------------------------------------------------------------------

    @staticmethod
    def _left(inputs: Inputs) -> bool:
        """Whether something is left to drive for: exploring or on the way home."""
        mission = inputs.current(MISSION)
        return mission is not None and mission.phase in (MissionPhase.EXPLORE, MissionPhase.RETURN)

    def _judge(self, now: Stamp, inputs: Inputs) -> Verdict:
        c = self._config
        mission, report = inputs.current(MISSION), inputs.current(SUPERVISOR)
        waiting = (now - self._asked_ns) / SECOND_NS if self._asked_ns >= 0 else 0.0
        return judge(
            SafetyLimits(c.risk_stale_s, c.odometry_stale_s, c.irm_stale_s, c.policy_silent_s),
            SafetyInputs(
                _age_s(inputs, RISK_MAP),
                _age_s(inputs, ODOMETRY),
                _age_s(inputs, LOCAL_IRM),
                waiting,
                mission.phase if mission is not None else None,
                self._guard.share <= 0.0,
                failed=tuple(sorted(report.failed)) if report else (),
                unsaved=tuple(sorted(report.degraded)) if report else (),
                fences_missing=mission is not None and mission.fences_version != self._fences_heard(inputs),
            ),
        )

    def _fences_heard(self, inputs: Inputs) -> int:
        """Version of the fences that hold here: of what was told now, else of before a restart; 0 without any."""
        told = inputs.latest(FENCES)
        return max(self._fences.version, 0) if told is None else told.message.version

    # --- episodes -----------------------------------------------------------------------------------------------

    def _wants_episode(self, now: Stamp) -> bool:
        c = self._config
        if self._driven.backing:
            return False
        if self._opened is not None:
            if now - self._opened.opened_ns < c.episode_timeout_s * SECOND_NS:
                return False
            self._opened = None
        since = (now - self._opened_ns) / SECOND_NS
        soon = self._driven.left_m() < _SOON_M and since >= 0.3
        if c.profile == "always_old":  # else what is kept would grow by a whole policy with every episode
            return soon
        return since >= c.episode_period_s or soon

    def _open(self, now: Stamp, irm: LocalIrm, odometry: Odometry, ground: Ground) -> Outputs:
        self._episode += 1
        self._opened_ns = now
        opened = self._keep_prefix(now, irm, odometry) or self._from_here(now, irm, odometry, ground)
        if opened is None:
            self._driven.why = "no node of the Local IRM in reach"
            return []
        self._opened, request = opened
        if self._asked_ns < 0:  # else lcp owes an answer since an earlier episode
            self._asked_ns = now
        return [Output(EPISODE, request)]

    def _keep_prefix(
        self, now: Stamp, irm: LocalIrm, odometry: Odometry
    ) -> tuple[Opened, EpisodeRequest] | None:
        """Junction on the old path: tau* of it is kept. None when too little of it is left."""
        c, driven, committed = self._config, self._driven, self._driven.committed
        if committed is None:
            return None
        reachable = [
            i for i in usable_nodes(committed, irm, driven.at) if committed.node_point[i] <= driven.end
        ]
        v = odometry.speed_mps
        least_m = (
            abs(v) * max(c.planning_latency_s, 1.3 * self._latency_s)
            + v * v / (2.0 * c.max_acceleration_mps2)
            + 0.2
        )
        ahead = [int(committed.node_point[i] - driven.at) * STEP_M for i in reachable]
        first = next((j for j, m in enumerate(ahead) if m >= least_m), None)
        if first is None:
            return None
        covered = np.zeros(irm.size, np.uint64)
        start = self._node(irm, committed, reachable[0])
        heading = self._heading(committed, reachable[0])
        model = model_here(irm, start, heading, covered, c)
        moves = moves_between(committed, reachable[0], reachable[-1])
        terms = tau_terms(
            model, start, heading, moves, c.replan_rollouts, self._value_ratio, self._stream_seed()
        )
        most = max(first, sum(1 for m in ahead if m <= c.max_kept_m) - 1)
        if c.profile in ("paper", "always_old"):
            most = len(ahead) - 1
        kept = choose_tau(terms, first, most, c.regulariser, c.profile)
        if kept < first:
            return None
        cover_along(model, committed, irm, reachable[: kept + 1], covered)
        point = int(committed.node_point[reachable[kept]])
        node = self._node(irm, committed, reachable[kept])
        opened = Opened(
            number=self._episode,
            opened_ns=now,
            irm=irm,
            prefix=committed.points[driven.at : point + 1],
            kept_lattice=committed.lattice[reachable[: kept + 1]],
            kept_point=committed.node_point[reachable[: kept + 1]] - driven.at,
            tau_s=ahead[kept] / max(c.max_speed_mps, 0.1),
            keeps_old=True,
            junction_point=point,
        )
        return opened, self._request(
            now, irm, node, self._heading(committed, reachable[kept]), odometry, covered, opened
        )

    def _from_here(
        self, now: Stamp, irm: LocalIrm, odometry: Odometry, ground: Ground
    ) -> tuple[Opened, EpisodeRequest] | None:
        """Junction at the nearest node: nothing is kept but the way to it."""
        needed_m = self._config.footprint_radius_m + self._config.clearance_margin_m - 0.03
        found = line_to_lattice(irm, ground, odometry, needed_m, set())
        if found is None:
            return None
        node, line = found
        prefix = resample(line)
        covered = np.zeros(irm.size, np.uint64)
        heading = heading_index(odometry.pose.yaw_rad)
        if len(prefix) > 4:
            heading = heading_index(float(headings(prefix)[-1]))
        lattice = np.array([[irm.ix0 + node % irm.size, irm.iy0 + node // irm.size]], np.int64)
        opened = Opened(
            self._episode, now, irm, prefix, lattice, np.array([len(prefix) - 1], np.int64), 0.0, False,
        )  # fmt: skip
        return opened, self._request(now, irm, node, heading, odometry, covered, opened)

    def _request(
        self,
        now: Stamp,
        irm: LocalIrm,
        node: int,
        heading: int,
        odometry: Odometry,
        covered: NDArray[np.uint64],
        opened: Opened,
    ) -> EpisodeRequest:
        c = self._config
        nodes, at_headings, weights = junction_particles(
            irm, node, heading, odometry, c.particles, self._seed, self._episode
        )
        return EpisodeRequest(
            stamp_ns=now,
            episode=self._episode,
            irm_version=irm.irm_version,
            junction_ns=now + int(opened.tau_s * SECOND_NS),
            junction_speed_mps=max(odometry.speed_mps, 0.0),
            horizon_m=c.horizon_m,
            simulations=c.simulations,
            particle_node=nodes,
            particle_heading=at_headings,
            particle_weight=weights,
            covered=covered,
        )

    def _stream_seed(self) -> int:
        return (self._seed * 1_000_003 + self._episode) & 0x7FFFFFFFFFFFFFFF

    @staticmethod
    def _node(irm: LocalIrm, committed: Committed, position: int) -> int:
        return node_index(irm, int(committed.lattice[position, 0]), int(committed.lattice[position, 1]))

    @staticmethod
    def _heading(committed: Committed, position: int) -> int:
        point = int(committed.node_point[position])
        return heading_index(float(headings(committed.points)[max(point - 1, 0)]))

    # --- answers ------------------------------------------------------------------------------------------------

    def _install(self, now: Stamp, policy: LocalPolicy, odometry: Odometry, ground: Ground) -> None:
        """Concatenate the kept prefix and the new policy (Eq. 19); answers to other episodes are dropped."""
        opened = self._opened
        self._asked_ns = -1
        if opened is None or policy.episode != opened.number:
            return
        self._opened = None
        latency_s = (now - opened.opened_ns) / SECOND_NS
        self._latency_s = max(
            latency_s, 0.8 * self._latency_s + 0.2 * latency_s
        )  # slower at once, faster by degrees
        if opened.keeps_old and self._driven.at > opened.junction_point:
            self._driven.why = "the answer came after its junction"
            return
        if policy.phase == LocalPhase.NONE or len(policy.path_lattice) == 0:
            self._driven.why = policy.reason
            return
        if policy.phase == LocalPhase.COVER and policy.rollout_value > 0.1:
            ratio = min(max(policy.root_value / policy.rollout_value, 1.0), 2.0)
            self._value_ratio += 0.2 * (ratio - self._value_ratio)
        self._kept_end = self._driven.commit(opened, policy, odometry, ground)
        self._tau_s = opened.tau_s

    # --- motion -------------------------------------------------------------------------------------------------

    def _publish(
        self, now: Stamp, verdict: Verdict, odometry: Odometry, ground: Ground, risk_stamp_ns: int
    ) -> Outputs:
        """A new plan when something changed, else the same plan again so that it does not expire."""
        driven = self._driven
        moving = verdict.may_move and driven.committed is not None
        was_moving = self._plan is not None and self._plan.valid
        share = min(self._config.degraded_speed_share if verdict.slow else 1.0, self._guard.share)
        state_changed = self._plan is None or self._plan.safety != verdict.state or was_moving != moving
        state_changed = state_changed or self._share != share
        due = now - self._published_ns >= 0.3 * SECOND_NS
        if not (driven.changed or state_changed or due):
            return []
        if driven.changed or state_changed:
            self._plan_id += 1
        self._plan = self._make_plan(now, verdict, odometry, ground, risk_stamp_ns, moving, share)
        driven.changed, self._published_ns, self._share = False, now, share
        return [Output(PLAN, self._plan)]

    def _make_plan(
        self,
        now: Stamp,
        verdict: Verdict,
        odometry: Odometry,
        ground: Ground,
        risk_stamp_ns: int,
        moving: bool,
        share: float,
    ) -> Plan:
        driven = self._driven
        points, first = _NO_POINTS, max(driven.at - 1, 0)
        if moving and driven.committed is not None:
            points = driven.committed.points[first : driven.end + 1]
        c, yaw = self._config, headings(points)
        kept = min(len(points), max(self._kept_end - first, 0))
        if driven.backing:
            kept, share = 0, min(share, c.min_speed_mps / c.max_speed_mps)
            yaw = np.remainder(yaw + 2.0 * math.pi, 2.0 * math.pi) - math.pi
        speed, time_s = speeds(points, abs(odometry.speed_mps), ground, c, share)
        return Plan(
            stamp_ns=now,
            plan_id=max(self._plan_id, 1),
            episode=self._episode,
            valid=moving and len(points) > 0,
            safety=verdict.state,
            reason=verdict.reason or driven.why,
            tau_s=0.0 if driven.backing else self._tau_s,
            kept_points=kept,
            ttl_s=self._config.plan_ttl_s,
            risk_stamp_ns=risk_stamp_ns,
            x_m=np.ascontiguousarray(points[:, 0]),
            y_m=np.ascontiguousarray(points[:, 1]),
            yaw_rad=yaw,
            speed_mps=speed,
            time_s=time_s,
        )

    def snapshot(self) -> bytes:
        """The policy that is driven, the open episode, the last plan and the counters."""
        return pack_snapshot(
            {
                **{name: getattr(self, f"_{name}") for name in _KEPT},
                "driven": self._driven.state(),
                "guard": self._guard.state(),
                "fences": self._fences.state(),
                "opened": None if self._opened is None else pack_opened(self._opened),
                "plan": None if self._plan is None else pack_message(self._plan),
            }
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        state = unpack_snapshot(snapshot)
        for name in _KEPT:
            setattr(self, f"_{name}", state[name])
        self._driven.load(state["driven"])
        self._guard.load(state["guard"])
        if "fences" in state:  # older snapshots have none
            self._fences.set_state(state["fences"])
        self._opened = None if state["opened"] is None else unpack_opened(state["opened"])
        self._plan = None if state["plan"] is None else unpack_message(state["plan"], Plan)

    def resumed(self) -> None:
        """The robot plans anew from where it stands. Ids that were given since the snapshot are not given again: the
        follower would take a new plan for an old one."""
        self._episode, self._plan_id = self._episode + _SKIPPED_IDS, self._plan_id + _SKIPPED_IDS
        self._driven.drop("resumed after a restart")
        self._driven.forget_trail()
        self._opened = None
        self._asked_ns = self._driven.trouble_ns = -1
        self._plan = None


def _age_s(inputs: Inputs, topic: Topic[Message]) -> float | None:
    received = inputs.latest(topic)
    return None if received is None else received.age_ns / SECOND_NS
