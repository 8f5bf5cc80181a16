"""The reconciler stage: opens episodes, reconciles policies, and is the only one that emits motion."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec
from schemas.base import Message
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSetup, StageSpec, Stamp, Topic
from schemas.policy import EpisodeRequest, LocalPhase, LocalPolicy, Plan
from schemas.sensing import FollowerState, Odometry
from schemas.snapshot import pack_message, pack_snapshot, unpack_message, unpack_snapshot
from schemas.topics import EPISODE, FOLLOWER, LOCAL_IRM, LOCAL_POLICY, MISSION, ODOMETRY, PLAN, RISK_MAP
from schemas.world import LocalIrm
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
from services.reconciler.path import (
    STEP_M,
    Ground,
    first_hazard,
    headings,
    project,
    resample,
    smooth,
    speeds,
)
from services.reconciler.safety import SafetyInputs, SafetyLimits, Verdict, judge
from services.reconciler.tau import choose_tau, tau_terms
from services.reconciler.trail import Trail

__all__ = ["Config", "ReconcilerStage", "create", "spec"]

_NO_POINTS = np.zeros((0, 2))
_KEPT = (
    "at", "end", "episode", "opened_ns", "asked_ns", "plan_id", "published_ns", "changed", "slow", "why", "tau_s",
    "kept_end", "trouble_ns", "value_ratio", "latency_s", "backing_ns",
)  # fmt: skip
"""What a snapshot holds as it is."""
_SKIPPED_IDS = 10_000
"""More than the plans and episodes of the longest time between two snapshots."""
_TRAIL_M = 2.0
_BACKING_S = 5.0
"""Backing off ends then at the latest."""
_SOON_M = 2.5
"""With less of the path left than this a new episode opens at once."""


def spec(config: Config) -> StageSpec:
    """How to run the stage: at 10 Hz, and at once on risk maps and answers."""
    return StageSpec(
        "reconciler", SECOND_NS // 10, (RISK_MAP.name, LOCAL_POLICY.name), latency_ns=SECOND_NS // 100
    )


def create(config: Config, setup: StageSetup) -> Stage:
    """A reconciler stage."""
    return ReconcilerStage(config, setup.seed)


class ReconcilerStage:
    """Holds the committed policy, the open episode and what was last published."""

    def __init__(self, config: Config, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._committed: Committed | None = None
        self._opened: Opened | None = None
        self._at = 0
        self._end = 0
        self._episode = 0
        self._opened_ns = -(10**18)
        self._asked_ns = -1
        self._plan_id = 0
        self._published_ns = -(10**18)
        self._changed = False
        self._slow = False
        self._why = "starting"
        self._tau_s = 0.0
        self._kept_end = 0
        self._trouble_ns = -1
        self._value_ratio = 1.0
        self._latency_s = 0.0
        self._plan: Plan | None = None
        self._trail = Trail(_TRAIL_M)
        self._backing_ns = -1

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One cycle: safety first, then the path, then episodes."""
        odometry, risk = inputs.latest(ODOMETRY), inputs.latest(RISK_MAP)
        verdict = self._judge(now, inputs)
        if not verdict.may_move:
            self._asked_ns = -1
        if odometry is None or risk is None:
            return []
        g = risk.message.grid
        ground = Ground(
            GridSpec(g.resolution_m, g.ix0, g.iy0, g.width, g.height),
            risk.message.state,
            risk.message.clearance_m,
        )
        found: Outputs = []
        follower = inputs.current(FOLLOWER)
        self._follow(now, odometry.message, follower)
        for received in inputs.new(LOCAL_POLICY):
            self._install(now, received.message, odometry.message, ground)
        if (risk.fresh or self._changed) and self._backing_ns < 0:
            self._check_hazards(ground, odometry.message)
        irm = inputs.current(LOCAL_IRM)
        if verdict.may_move and irm is not None and self._wants_episode(now):
            found += self._open(now, irm, odometry.message, ground)
        found += self._publish(now, verdict, odometry.message, ground, risk.message.stamp_ns)
        return found

    # --- safety -----------------------------------------------------------------------------------------------

    def _judge(self, now: Stamp, inputs: Inputs) -> Verdict:
        c = self._config
        mission = inputs.current(MISSION)
        waiting = (now - self._asked_ns) / SECOND_NS if self._asked_ns >= 0 else 0.0
        return judge(
            SafetyLimits(c.risk_stale_s, c.odometry_stale_s, c.irm_stale_s, c.policy_silent_s),
            SafetyInputs(
                _age_s(inputs, RISK_MAP),
                _age_s(inputs, ODOMETRY),
                _age_s(inputs, LOCAL_IRM),
                waiting,
                mission.phase if mission is not None else None,
            ),
        )

    def _check_hazards(self, ground: Ground, odometry: Odometry) -> None:
        """Truncate the path before the first place where the robot does not fit or the ground is unknown."""
        if self._committed is None:
            return
        c, s = self._config, ground.spec
        points = self._committed.points
        hazard = first_hazard(
            points, self._at + 2, ground.state, ground.clearance_m, s.resolution_m, s.ix0, s.iy0,
            c.footprint_radius_m - 0.05,
        )  # fmt: skip
        end = len(points) - 1 if hazard < 0 else max(hazard - 3, self._at)
        if end != self._end:
            self._end, self._changed = end, True
            if hazard >= 0:
                self._why = f"hazard {(hazard - self._at) * STEP_M:.1f} m ahead"

    # --- following ----------------------------------------------------------------------------------------------

    def _follow(self, now: Stamp, odometry: Odometry, follower: FollowerState | None) -> None:
        """Where the robot is on its path; drop the path when the robot has left it or cannot go on."""
        self._trail.add(odometry.pose.x_m, odometry.pose.y_m)
        if self._committed is None:
            return
        points = self._committed.points
        self._at, off = project(
            points,
            odometry.pose.x_m,
            odometry.pose.y_m,
            max(self._at - 3, 0),
            min(self._at + 25, len(points) - 1),
        )
        if off > self._config.off_path_m:
            self._drop("off the path")
        trouble = follower is not None and (follower.blocked or follower.stuck)
        # Only a follower that has the newest plan and is well ends the trouble: a new plan every second would, else.
        if not trouble:
            if follower is None or follower.plan_id == self._plan_id:
                self._trouble_ns = -1
        elif self._trouble_ns < 0:
            self._trouble_ns = now
        elif now - self._trouble_ns > self._config.blocked_s * SECOND_NS:
            self._trouble_ns = -1
            backing = self._backing_ns >= 0
            self._drop("blocked")
            if not backing:
                self._back_off(now, odometry)
        if self._backing_ns >= 0 and (
            self._left_m() < STEP_M or now - self._backing_ns > _BACKING_S * SECOND_NS
        ):
            self._drop("backed off")

    def _back_off(self, now: Stamp, odometry: Odometry) -> None:
        """Drive back a little on the way that the robot came, facing what is in its way."""
        x, y = odometry.pose.x_m, odometry.pose.y_m
        line = resample(self._trail.back(x, y, self._config.back_off_m))
        if len(line) > 1:
            nothing = np.zeros((0, 2), np.int64)
            self._committed = Committed(line, nothing, np.zeros(0, np.int64))
            self._end, self._backing_ns, self._why = len(line) - 1, now, "blocked: backs off"

    def _drop(self, why: str) -> None:
        self._committed, self._opened = None, None
        self._backing_ns = -1
        self._at = self._end = 0
        self._changed, self._why = True, why

    def _left_m(self) -> float:
        return max(0, self._end - self._at) * STEP_M if self._committed is not None else 0.0

    # --- episodes -----------------------------------------------------------------------------------------------

    def _wants_episode(self, now: Stamp) -> bool:
        c = self._config
        if self._backing_ns >= 0:
            return False
        if self._opened is not None:
            if now - self._opened.opened_ns < c.episode_timeout_s * SECOND_NS:
                return False
            self._opened = None
        since = (now - self._opened_ns) / SECOND_NS
        return since >= c.episode_period_s or (self._left_m() < _SOON_M and since >= 0.3)

    def _open(self, now: Stamp, irm: LocalIrm, odometry: Odometry, ground: Ground) -> Outputs:
        self._episode += 1
        self._opened_ns = now
        opened = self._keep_prefix(now, irm, odometry) or self._from_here(now, irm, odometry, ground)
        if opened is None:
            self._why = "no node of the Local IRM in reach"
            return []
        self._opened, request = opened
        if self._asked_ns < 0:  # else lcp owes an answer since an earlier episode
            self._asked_ns = now
        return [Output(EPISODE, request)]

    def _keep_prefix(
        self, now: Stamp, irm: LocalIrm, odometry: Odometry
    ) -> tuple[Opened, EpisodeRequest] | None:
        """Junction on the old path: tau* of it is kept. None when too little of it is left."""
        if self._committed is None:
            return None
        c, committed = self._config, self._committed
        reachable = [
            i for i in usable_nodes(committed, irm, self._at) if committed.node_point[i] <= self._end
        ]
        v = odometry.speed_mps
        least_m = (
            abs(v) * max(c.planning_latency_s, 1.3 * self._latency_s)
            + v * v / (2.0 * c.max_acceleration_mps2)
            + 0.2
        )
        ahead = [int(committed.node_point[i] - self._at) * STEP_M for i in reachable]
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
        if c.profile == "paper":
            most = len(ahead) - 1
        kept = choose_tau(terms, first, most, c.regulariser, c.profile == "paper")
        if kept < first:
            return None
        cover_along(model, committed, irm, reachable[: kept + 1], covered)
        point = int(committed.node_point[reachable[kept]])
        node = self._node(irm, committed, reachable[kept])
        opened = Opened(
            number=self._episode,
            opened_ns=now,
            irm=irm,
            prefix=committed.points[self._at : point + 1],
            kept_lattice=committed.lattice[reachable[: kept + 1]],
            kept_point=committed.node_point[reachable[: kept + 1]] - self._at,
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
        found = line_to_lattice(irm, ground, odometry, self._config.footprint_radius_m - 0.03, set())
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
        if opened.keeps_old and self._at > opened.junction_point:
            self._why = "the answer came after its junction"
            return
        if policy.phase == LocalPhase.NONE or len(policy.path_lattice) == 0:
            self._why = policy.reason
            return
        if policy.phase == LocalPhase.COVER and policy.rollout_value > 0.1:
            ratio = min(max(policy.root_value / policy.rollout_value, 1.0), 2.0)
            self._value_ratio += 0.2 * (ratio - self._value_ratio)
        self._commit(opened, policy, odometry, ground)
        self._why = policy.reason

    def _commit(self, opened: Opened, policy: LocalPolicy, odometry: Odometry, ground: Ground) -> None:
        prefix = opened.prefix
        raw = np.concatenate([prefix, policy.path_xy_m[1:]]) if len(prefix) else policy.path_xy_m
        fixed = len(prefix) if opened.keeps_old else max(1, len(prefix) // 2)
        offset = len(raw) - len(policy.path_xy_m)
        points = smooth(raw, fixed, ground, self._config, offset + looked_along(policy))
        lattice = np.concatenate([opened.kept_lattice, policy.path_lattice[1:].astype(np.int64)])
        anchors = policy.path_xy_m[policy.path_node_point[1:]]
        node_point = list(opened.kept_point)
        at = int(node_point[-1]) if node_point else 0
        for x, y in anchors:
            at, _ = project(
                points, float(x), float(y), min(at, len(points) - 1), min(at + 30, len(points) - 1)
            )
            node_point.append(at)
        self._committed = Committed(points, lattice, np.array(node_point, np.int64), policy.target)
        self._at, _ = project(points, odometry.pose.x_m, odometry.pose.y_m, 0, min(40, len(points) - 1))
        self._end = len(points) - 1
        self._tau_s = opened.tau_s
        self._kept_end = len(prefix) if opened.keeps_old else 0
        self._changed = True

    # --- motion -------------------------------------------------------------------------------------------------

    def _publish(
        self, now: Stamp, verdict: Verdict, odometry: Odometry, ground: Ground, risk_stamp_ns: int
    ) -> Outputs:
        """A new plan when something changed, else the same plan again so that it does not expire."""
        moving = verdict.may_move and self._committed is not None
        was_moving = self._plan is not None and self._plan.valid
        state_changed = self._plan is None or self._plan.safety != verdict.state or was_moving != moving
        state_changed = state_changed or self._slow != verdict.slow
        due = now - self._published_ns >= 0.3 * SECOND_NS
        if not (self._changed or state_changed or due):
            return []
        if self._changed or state_changed:
            self._plan_id += 1
        share = self._config.degraded_speed_share if verdict.slow else 1.0
        self._plan = self._make_plan(now, verdict, odometry, ground, risk_stamp_ns, moving, share)
        self._changed, self._published_ns, self._slow = False, now, verdict.slow
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
        points, first = _NO_POINTS, max(self._at - 1, 0)
        if moving and self._committed is not None:
            points = self._committed.points[first : self._end + 1]
        speed, time_s = speeds(points, abs(odometry.speed_mps), ground, self._config, share)
        yaw = headings(points)
        if self._backing_ns >= 0:
            speed = np.minimum(speed, self._config.min_speed_mps)
            yaw = np.remainder(yaw + 2.0 * math.pi, 2.0 * math.pi) - math.pi
        return Plan(
            stamp_ns=now,
            plan_id=max(self._plan_id, 1),
            episode=self._episode,
            valid=moving and len(points) > 0,
            safety=verdict.state,
            reason=verdict.reason or self._why,
            tau_s=self._tau_s,
            kept_points=min(len(points), max(self._kept_end - first, 0)),
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
                "committed": None if self._committed is None else asdict(self._committed),
                "opened": None if self._opened is None else pack_opened(self._opened),
                "plan": None if self._plan is None else pack_message(self._plan),
                "trail": self._trail.state(),
            }
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        state = unpack_snapshot(snapshot)
        for name in _KEPT:
            setattr(self, f"_{name}", state[name])
        self._committed = None if state["committed"] is None else Committed(**state["committed"])
        self._opened = None if state["opened"] is None else unpack_opened(state["opened"])
        self._plan = None if state["plan"] is None else unpack_message(state["plan"], Plan)
        self._trail.load(state["trail"])

    def resumed(self) -> None:
        """The robot plans anew from where it stands. Ids that were given since the snapshot are not given again: the
        follower would take a new plan for an old one."""
        self._episode, self._plan_id = self._episode + _SKIPPED_IDS, self._plan_id + _SKIPPED_IDS
        self._drop("resumed after a restart")
        self._asked_ns = self._trouble_ns = -1
        self._plan = None


def looked_along(policy: LocalPolicy) -> NDArray[np.int64]:
    """Indices in the path's line of both ends of every step that a look hangs on."""
    steps = np.flatnonzero(policy.path_look)
    ends = np.unique(np.concatenate([np.maximum(steps - 1, 0), steps]))
    return policy.path_node_point[ends].astype(np.int64)


def _age_s(inputs: Inputs, topic: Topic[Message]) -> float | None:
    received = inputs.latest(topic)
    return None if received is None else received.age_ns / SECOND_NS
