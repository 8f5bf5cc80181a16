"""The reconciler in a scripted world: what it emits when inputs stop, hazards appear, and answers come late."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from schemas.codec import Envelope, encode
from schemas.contract import SECOND_NS, Resuming, StageSetup
from schemas.operation import MissionPhase, SupervisorReport
from schemas.policy import EpisodeRequest, LocalPhase, Plan, SafetyState
from schemas.snapshot import unpack_snapshot
from schemas.topics import FENCES, LOCAL_POLICY, MOVING, RISK_MAP, SUPERVISOR
from services.reconciler.config import Config
from services.reconciler.stage import create, spec
from services.reconciler.trail import Trail
from tests.reconciler.rig import FOOTPRINT_M, TICK_NS, Rig
from tests.runtime.feeding import Feed

FEW = Config(simulations=256)


def driving(seconds: float = 3.0, **options: object) -> Rig:
    """A rig whose robot is on its way."""
    rig = Rig(**options)  # type: ignore[arg-type]
    rig.run(seconds)
    assert rig.last().valid
    assert len(rig.last().x_m) > 30
    return rig


def points(plan: Plan) -> np.ndarray:
    return np.stack([plan.x_m, plan.y_m], axis=1)


# --- a mission that goes well -------------------------------------------------------------------------------------


def test_plans_are_well_formed_their_ids_increase_and_none_expires() -> None:
    rig = Rig()
    published = []
    for _ in range(120):
        before = len(rig.plans)
        rig.tick()
        published += [(rig.now, plan) for plan in rig.plans[before:]]
    assert math.hypot(rig.x_m, rig.y_m) > 0.5, "it drives"
    assert len({plan.plan_id for _, plan in published}) > 5
    for _, plan in published:
        assert plan.valid == (len(plan.x_m) > 0)
        assert plan.valid == (plan.safety is SafetyState.RUN and plan is not published[0][1])
        if plan.valid:
            assert plan.speed_mps[-1] == 0.0
            assert np.all(np.diff(plan.time_s) > 0.0)
    for (t0, a), (t1, b) in itertools.pairwise(published):
        assert b.plan_id in (a.plan_id, a.plan_id + 1)
        assert t1 - t0 <= 0.3 * SECOND_NS, "sent again long before it expires"
        if b.plan_id == a.plan_id:
            ahead = {p.tobytes() for p in points(a)}
            assert all(p.tobytes() in ahead for p in points(b)), (
                "the same plan again is the rest of the same line"
            )


def test_the_plan_begins_at_the_robot_and_keeps_off_walls() -> None:
    rig = driving()
    for _ in range(60):
        rig.tick()
        plan = rig.last()
        assert math.hypot(plan.x_m[0] - rig.x_m, plan.y_m[0] - rig.y_m) < 0.45
        assert min(rig.clearance_at(x, y) for x, y in points(plan)) > FOOTPRINT_M


def test_what_is_kept_of_the_old_policy_stays_as_it_was_to_the_bit() -> None:
    rig = Rig()
    kept = 0
    for _ in range(150):
        before = rig.plans[-1] if rig.plans else None
        rig.tick()
        after = rig.plans[-1] if rig.plans else None
        if (
            before is None
            or after is None
            or after.plan_id == before.plan_id
            or not (before.valid and after.valid)
        ):
            continue
        old = {p.tobytes() for p in points(before)}
        assert after.kept_points > 0, "tau covers latency and braking: the junction lies ahead of the robot"
        for p in points(after)[: after.kept_points]:
            assert p.tobytes() in old
        kept += 1
    assert kept > 5


def test_tau_covers_planning_latency_and_braking() -> None:
    rig = Rig()
    for _ in range(120):
        before, speed = len(rig.requests), rig.speed_mps
        rig.tick()
        if len(rig.requests) == before or len(rig.plans) < 3 or not rig.last().valid:
            continue
        wanted = rig.requests[-1]
        ahead_s = (wanted.junction_ns - wanted.stamp_ns) / SECOND_NS
        least_m = speed * FEW.planning_latency_s + speed**2 / (2.0 * FEW.max_acceleration_mps2)
        assert ahead_s * FEW.max_speed_mps >= least_m - 0.1


def test_every_request_names_the_local_irm_that_it_was_made_from() -> None:
    rig = driving(6.0)
    for wanted in rig.requests:
        irm = rig.irms[wanted.irm_version]
        assert np.all(irm.state[wanted.particle_node] == 1)
        assert math.isclose(wanted.particle_weight.sum(), 1.0)
        assert len(wanted.covered) == irm.size
    assert [wanted.episode for wanted in rig.requests] == list(range(1, len(rig.requests) + 1))
    assert any(wanted.covered.any() for wanted in rig.requests[1:]), "what the kept prefix covers is told"


def test_the_same_world_and_seed_give_the_same_bytes() -> None:
    def run() -> list[bytes]:
        rig = Rig()
        rig.run(5.0)
        return [encode(plan, Envelope("robot", "reconciler", 1, 1, 0)) for plan in rig.plans]

    assert run() == run()


def test_the_paper_profile_keeps_more() -> None:
    taus = {}
    for profile in ("default", "paper"):
        rig = Rig(config=Config(simulations=256, profile=profile))
        rig.run(8.0)
        taus[profile] = np.mean([(w.junction_ns - w.stamp_ns) / SECOND_NS for w in rig.requests[1:]])
    assert taus["paper"] > 1.5 * taus["default"]


def test_the_ablations_keep_nothing_but_what_latency_needs_and_everything() -> None:
    """always_new: junctions as near as can be. always_old: no episode before the end of the path is near."""
    taus, left_m = {}, []
    for profile in ("default", "always_new", "always_old"):
        rig = Rig(config=Config(simulations=256, profile=profile))
        for _ in range(400 if profile == "always_old" else 80):
            before, plan = len(rig.requests), rig.plans[-1] if rig.plans else None
            rig.tick()
            if profile == "always_old" and plan is not None and plan.valid and len(rig.requests) > before:
                ahead = np.hypot(plan.x_m - rig.x_m, plan.y_m - rig.y_m).argmin()
                left_m.append(float(np.hypot(np.diff(plan.x_m), np.diff(plan.y_m))[ahead:].sum()))
        taus[profile] = np.mean([(w.junction_ns - w.stamp_ns) / SECOND_NS for w in rig.requests[1:]])
        assert len(rig.requests) > 1
    assert taus["always_new"] < taus["default"]
    assert len(left_m) > 0 and max(left_m) < 2.8


# --- safety -------------------------------------------------------------------------------------------------------


def test_a_frozen_risk_map_holds_within_a_period_of_its_limit() -> None:
    rig = driving()
    rig.send_risk, last = False, (rig.ticks // 2 * 2) * TICK_NS
    while rig.now - last <= FEW.risk_stale_s * SECOND_NS:
        assert rig.last().valid
        rig.tick()
    assert rig.now - last <= FEW.risk_stale_s * SECOND_NS + TICK_NS
    assert not rig.last().valid
    assert rig.last().safety is SafetyState.HOLD
    assert "risk map" in rig.last().reason
    assert len(rig.last().x_m) == 0
    held = rig.last().plan_id
    rig.send_risk = True
    rig.run(0.3)
    assert rig.last().valid and rig.last().plan_id > held


def test_a_frozen_pose_holds() -> None:
    rig = driving()
    rig.send_odometry = False
    rig.run(FEW.odometry_stale_s + 0.1)
    assert not rig.last().valid
    assert rig.last().safety is SafetyState.HOLD


def test_nothing_is_emitted_before_the_first_pose_and_risk_map() -> None:
    rig = Rig(send_risk=False)
    rig.run(1.0)
    assert rig.plans == [] and rig.requests == []


@pytest.mark.parametrize(
    ("switch", "after_s"), [("send_irm", FEW.irm_stale_s), ("answer", FEW.policy_silent_s)]
)
def test_a_silent_planner_degrades_and_the_robot_slows_down(switch: str, after_s: float) -> None:
    rig = driving(config=Config(simulations=256, max_kept_m=30.0))
    setattr(rig, switch, False)
    rig.run(after_s + 1.6)
    assert rig.last().safety is SafetyState.DEGRADED
    limit = FEW.degraded_speed_share * FEW.max_speed_mps
    assert rig.last().valid and rig.last().speed_mps.max() <= limit + 1e-9
    setattr(rig, switch, True)
    rig.run(2.0)
    assert rig.last().safety is SafetyState.RUN
    assert rig.last().speed_mps.max() > limit


def test_a_pause_holds_at_once_and_no_episode_is_opened_meanwhile() -> None:
    rig = driving()
    rig.phase = MissionPhase.PAUSED
    rig.tick()
    assert not rig.last().valid
    assert rig.last().safety is SafetyState.HOLD
    assert "paused" in rig.last().reason
    asked, place = len(rig.requests), (rig.x_m, rig.y_m)
    rig.run(8.0)
    assert len(rig.requests) == asked
    assert math.dist(place, (rig.x_m, rig.y_m)) < 1e-9
    rig.phase = MissionPhase.EXPLORE
    rig.run(0.2)
    assert rig.last().valid
    assert rig.last().safety is SafetyState.RUN, "the time of the pause is not lcp's silence"


@pytest.mark.parametrize(
    ("phase", "safety", "moves"),
    [
        (MissionPhase.RETURN, SafetyState.RETURN, True),
        (MissionPhase.DONE, SafetyState.DONE, False),
        (MissionPhase.STOPPED, SafetyState.DONE, False),
        (MissionPhase.IDLE, SafetyState.HOLD, False),
    ],
)
def test_the_mission_rules(phase: MissionPhase, safety: SafetyState, moves: bool) -> None:
    rig = driving()
    rig.phase = phase
    rig.tick()
    assert (rig.last().safety, rig.last().valid) == (safety, moves)


# --- hazards ------------------------------------------------------------------------------------------------------


def test_a_hazard_on_the_driven_path_truncates_it_in_the_first_step_that_shows_it() -> None:
    rig = driving(4.1)
    assert rig.ticks % 2 == 0
    before = rig.last()
    x, y = points(before)[25]
    rig.wall_at(x, y)
    rig.tick()
    assert points(rig.last())[-1].tobytes() == points(before)[-1].tobytes(), "no risk map has shown it yet"
    rig.tick()
    after = rig.last()
    assert after.plan_id > before.plan_id
    assert after.valid and len(after.x_m) < 30
    assert after.speed_mps[-1] == 0.0
    assert "hazard" in after.reason
    assert min(rig.clearance_at(px, py) for px, py in points(after)) > FOOTPRINT_M - 0.05
    rig.run(8.0)
    assert rig.last().valid and len(rig.last().x_m) > 10, "it goes another way"
    assert min(rig.clearance_at(px, py) for px, py in points(rig.last())) > FOOTPRINT_M - 0.05


def test_ground_that_is_not_known_any_more_is_a_hazard() -> None:
    rig = driving(4.1)
    x, y = points(rig.last())[25]
    row, column = rig.grid.cell_of(x, y)
    unknown = rig.risk_map()
    state = unknown.state.copy()
    state[row - 2 : row + 3, column - 2 : column + 3] = 0
    rig.send_risk = False
    rig.tick()
    rig.reconciler.put(RISK_MAP, unknown.model_copy(update={"state": state}), rig.now)
    rig.tick()
    assert len(rig.last().x_m) < 30
    assert "hazard" in rig.last().reason


def test_a_hazard_that_was_none_gives_the_path_back() -> None:
    rig = driving(4.1)
    clean = rig.lethal.copy()
    end = points(rig.last())[-1].copy()
    rig.wall_at(*points(rig.last())[25])
    rig.answer = False
    rig.run(0.2)
    assert len(rig.last().x_m) < 30
    rig.lethal = clean
    rig.run(0.2)
    np.testing.assert_array_equal(points(rig.last())[-1], end)


# --- episodes -----------------------------------------------------------------------------------------------------


def test_answers_to_old_episodes_are_dropped() -> None:
    rig = Rig(answer_delay=round(FEW.episode_timeout_s * 10) + 5)
    rig.run(9.0)
    assert len(rig.delivered) >= 2, "they came"
    assert all(policy.episode < rig.requests[-1].episode for policy in rig.delivered)
    assert not any(plan.valid for plan in rig.plans)


def late(rig: Rig, ticks: int) -> tuple[EpisodeRequest, Plan]:
    """The next answer takes so many ticks, in which the robot drives: its request, and the plan just before it."""
    asked, rig.answer_delay = len(rig.requests), ticks
    while len(rig.requests) == asked:
        rig.tick()
    wanted, before = rig.requests[asked], rig.last()
    while not any(policy.episode == wanted.episode for policy in rig.delivered):
        before = rig.last()
        rig.tick()
    return wanted, before


def test_an_answer_that_comes_after_its_junction_is_dropped() -> None:
    """Driven back to a junction that it has passed, the robot would turn round at every late answer."""
    rig = driving(4.0, config=Config(simulations=256, max_kept_m=1.0))
    wanted, before = late(rig, 25)
    assert rig.now > wanted.junction_ns + SECOND_NS // 2, "the robot is well beyond the junction"
    rig.answer = False
    rig.run(0.3)
    after = rig.last()
    assert after.reason == "the answer came after its junction"
    np.testing.assert_array_equal(points(after)[-1], points(before)[-1])
    ahead = {p.tobytes() for p in points(before)}
    assert after.valid and all(p.tobytes() in ahead for p in points(after)), "it drives on along the old path"


def test_an_answer_in_time_is_driven() -> None:
    rig = driving(4.0, config=Config(simulations=256, max_kept_m=1.0))
    _, before = late(rig, 3)
    assert rig.last().plan_id > before.plan_id
    assert rig.last().reason.startswith(("covers", "guides"))


def test_tau_grows_with_the_latency_that_was_measured_and_shrinks_again_by_degrees() -> None:
    """Slow answers are expected to stay slow: the next junction lies beyond what is driven until they come."""
    taus = []
    rig = driving(4.0, config=Config(simulations=256, max_kept_m=1.0))
    for delay in (3, 25, 3, 3, 3, 3, 3, 3):
        late(rig, delay)
        rig.answer_delay, asked = 3, len(rig.requests)
        while len(rig.requests) == asked:
            rig.tick()
        wanted = rig.requests[-1]
        taus.append((wanted.junction_ns - wanted.stamp_ns) / SECOND_NS)
    fast, slow, later = taus[0], taus[1], taus[-1]
    assert slow > 2.5, "at nearly full speed"
    assert fast < slow - 1.5
    assert later < slow - 1.0


@pytest.mark.parametrize(
    ("root", "rollout", "phase", "expected"),
    [
        (3.0, 2.0, LocalPhase.COVER, 1.1),
        (9.0, 2.0, LocalPhase.COVER, 1.2),
        (1.0, 2.0, LocalPhase.COVER, 1.0),
        (3.0, 0.05, LocalPhase.COVER, 1.0),
        (3.0, 2.0, LocalPhase.GUIDE, 1.0),
    ],
)
def test_what_planning_gains_over_its_rollouts_is_learnt_from_answers(
    root: float, rollout: float, phase: LocalPhase, expected: float
) -> None:
    """A fifth of the way to the answer's own ratio, from 1 to 2; tiny values and guidance teach nothing."""
    rig = Rig()
    while not rig.answers:
        rig.tick()
    due, policy = rig.answers.pop()
    update = {"root_value": root, "rollout_value": rollout, "phase": phase}
    rig.answers.append((due, policy.model_copy(update=update)))
    while not rig.delivered:
        rig.tick()
    assert unpack_snapshot(rig.reconciler.stage.snapshot())["value_ratio"] == pytest.approx(expected)


def test_an_answer_that_nobody_asked_for_changes_nothing() -> None:
    rig = driving()
    stale = rig.delivered[-1]
    before = rig.last()
    rig.moving = False
    rig.reconciler.put(LOCAL_POLICY, stale, rig.now)
    rig.tick()
    assert rig.last().plan_id == before.plan_id
    np.testing.assert_array_equal(points(rig.last())[-1], points(before)[-1])


def test_one_episode_at_a_time() -> None:
    rig = Rig(answer=False)
    rig.run(FEW.episode_timeout_s)
    assert len(rig.requests) == 1
    rig.run(0.5)
    assert len(rig.requests) == 2, "an unanswered one is given up"


def test_off_its_path_it_plans_from_where_the_robot_is() -> None:
    rig = driving()
    rig.moving = False
    line = points(rig.last())
    places = [(x, y) for x in np.arange(-4.0, 4.0, 0.5) for y in np.arange(-3.0, 3.0, 0.5)]
    rig.x_m, rig.y_m = max(places, key=lambda p: float(np.hypot(line[:, 0] - p[0], line[:, 1] - p[1]).min()))
    assert np.hypot(line[:, 0] - rig.x_m, line[:, 1] - rig.y_m).min() > FEW.off_path_m
    rig.tick()
    assert not rig.last().valid
    assert rig.last().reason == "off the path"
    rig.run(1.5)
    assert rig.last().valid
    assert math.hypot(rig.last().x_m[0] - rig.x_m, rig.last().y_m[0] - rig.y_m) < 1e-6
    assert rig.last().kept_points == 0


def test_dropping_the_path_drops_the_episode_that_was_to_continue_it() -> None:
    rig = driving()
    rig.answer_delay, asked = 8, len(rig.requests)
    while len(rig.requests) == asked:
        rig.tick()
    rig.moving = False
    rig.x_m, rig.y_m = rig.x_m + (3.0 if rig.x_m < 0.0 else -3.0), -rig.y_m
    rig.tick()
    assert rig.last().reason == "off the path"
    while rig.delivered[-1].episode < rig.requests[asked].episode:
        rig.tick()
    assert not rig.last().valid, "the answer continues a path that the robot has left"
    assert len(rig.requests) > asked + 1, "another episode was opened at once"


def test_blocked_for_long_it_backs_off_on_the_way_that_it_came() -> None:
    rig = driving()
    came = rig.yaw_rad
    rig.moving, rig.follower_blocked = False, True
    rig.run(FEW.blocked_s - 0.1)
    assert rig.last().valid and "backs off" not in rig.last().reason
    rig.run(0.3)
    plan = rig.last()
    assert plan.valid and plan.reason == "blocked: backs off"
    x, y = plan.x_m[-1] - rig.x_m, plan.y_m[-1] - rig.y_m
    assert 0.7 * FEW.back_off_m <= math.hypot(x, y) <= FEW.back_off_m + 0.01  # the way may bend
    assert x * math.cos(came) + y * math.sin(came) < -0.8 * FEW.back_off_m
    assert np.cos(plan.yaw_rad[0] - came) > 0.8, "it faces what it was blocked by"
    assert plan.speed_mps.max() <= FEW.min_speed_mps
    begun = rig.x_m, rig.y_m
    rig.moving, rig.follower_blocked = True, False
    episodes = len(rig.requests)
    rig.run(1.0)
    assert len(rig.requests) == episodes, "no episode while it backs off"
    rig.run(3.0)
    assert len(rig.requests) > episodes
    assert rig.last().valid and "backs off" not in rig.last().reason
    assert math.dist(begun, (rig.x_m, rig.y_m)) > 0.3


def test_blocked_while_it_backs_off_it_plans_anew() -> None:
    rig = driving()
    rig.moving, rig.follower_blocked = False, True
    rig.run(FEW.blocked_s + 0.3)
    assert rig.last().reason == "blocked: backs off"
    seen = len(rig.plans)
    rig.run(FEW.blocked_s + 0.2)
    dropped = [plan for plan in rig.plans[seen:] if plan.reason == "blocked"]
    assert dropped and not dropped[0].valid


def test_the_trail_goes_back_the_way_it_came_and_no_farther() -> None:
    trail = Trail(2.0)
    for k in range(100):
        trail.add(0.03 * k, 0.0)
    back = trail.back(2.97, 0.0, 0.5)
    assert np.allclose(back[0], [2.97, 0.0]) and np.allclose(back[-1], [2.47, 0.0])
    assert (
        np.hypot(*(trail.back(2.97, 0.0, 10.0)[-1] - [2.97, 0.0])) <= 1.3 * 2.0 + 0.1
    )  # every second point is 0.06 m on
    for k in range(20):
        trail.add(2.97 - 0.03 * k, 0.0)
    assert trail.back(2.4, 0.0, 0.5)[-1][0] < 2.0, "what was driven back over is no part of the way any more"
    other = Trail(2.0)
    other.load(trail.state())
    assert np.array_equal(other.back(2.4, 0.0, 1.0), trail.back(2.4, 0.0, 1.0))
    assert len(Trail(1.0).back(0.0, 0.0, 1.0)) == 1


def test_after_a_restart_ids_go_on_increasing() -> None:
    rig = driving()
    rig.moving = False
    last, asked = rig.last().plan_id, len(rig.requests)
    snapshot = rig.reconciler.stage.snapshot()
    stage = create(FEW, StageSetup("robot", 3))
    stage.restore(snapshot)
    assert stage.snapshot() == snapshot
    assert isinstance(stage, Resuming)
    stage.resumed()
    rig.reconciler.stage = stage
    rig.answers.clear()
    rig.run(2.0)
    assert all(plan.plan_id > last + 1000 for plan in rig.plans if plan is rig.last())
    assert rig.requests[asked].episode > rig.requests[asked - 1].episode + 1000
    assert rig.last().valid
    assert math.hypot(rig.last().x_m[0] - rig.x_m, rig.last().y_m[0] - rig.y_m) < 0.1


def test_the_stage_runs_on_risk_maps_and_answers() -> None:
    assert spec(FEW).period_ns == TICK_NS
    assert set(spec(FEW).triggers) == {RISK_MAP.name, MOVING.name, LOCAL_POLICY.name, FENCES.name}
    assert isinstance(Feed("reconciler", create(FEW, StageSetup("robot", 0))), Feed)


def test_unknown_keys_are_refused_at_every_level() -> None:
    for bad in ({"max_kept": 3}, {"weights": {"k_riks": 1.0}}):
        with pytest.raises(ValueError, match="Extra inputs"):
            Config.model_validate(bad)


def test_paths_keep_their_margin_and_a_robot_in_a_tight_place_gets_out_of_it() -> None:
    rig = Rig(config=FEW.model_copy(update={"clearance_margin_m": 0.1}))
    rig.run(3.0)
    assert rig.last().valid
    line = rig.last()
    rig.wall_at(float(line.x_m[25]) + 0.45, float(line.y_m[25]), 0.1)
    rig.run(0.4)
    clear = [
        rig.clearance_at(float(x), float(y)) for x, y in zip(rig.last().x_m, rig.last().y_m, strict=True)
    ]
    assert min(clear[2:]) >= FEW.footprint_radius_m + 0.1 - 0.05 - 1e-6
    rig.moving = False
    rig.wall_at(rig.x_m - 0.36, rig.y_m, 0.1)  # 0.26 m of clearance: less than is kept, more than it needs
    rig.run(2.5)
    assert rig.last().valid and len(rig.last().x_m) > 10


def test_it_does_not_back_off_into_what_stands_on_its_trail() -> None:
    rig = driving()
    rig.moving, rig.follower_blocked = False, True
    yaw = rig.yaw_rad
    rig.run(FEW.blocked_s - 0.1)
    behind = rig.x_m - 0.6 * math.cos(yaw), rig.y_m - 0.6 * math.sin(yaw)
    rig.wall_at(*behind, 0.15)
    rig.run(0.5)
    plan = rig.last()
    clear = [rig.clearance_at(float(x), float(y)) for x, y in zip(plan.x_m, plan.y_m, strict=True)]
    assert "goes back" not in plan.reason
    assert not plan.valid or min(clear) >= FEW.footprint_radius_m - 0.1


def test_without_a_way_on_for_long_it_goes_back() -> None:
    rig = driving()
    rig.answer = False
    rig.reconciler.stage._driven.drop("a test")  # type: ignore[attr-defined]
    was, came = (rig.x_m, rig.y_m), rig.yaw_rad
    rig.run(FEW.idle_s + 0.5)
    assert rig.last().valid and math.cos(rig.last().yaw_rad[0] - came) > 0.5
    rig.run(4.0)
    assert math.dist(was, (rig.x_m, rig.y_m)) > 0.5


def test_what_the_supervisor_says_holds_and_degrades() -> None:
    rig = driving()
    said = {"stamp_ns": rig.now, "starting": [], "late": [], "restarts": {}}
    rig.reconciler.put(SUPERVISOR, SupervisorReport(**said, failed={}, degraded={"irm": "no space"}), rig.now)
    rig.tick()
    rig.tick()
    assert (rig.last().safety, rig.last().valid) == (SafetyState.DEGRADED, True)
    rig.reconciler.put(SUPERVISOR, SupervisorReport(**said, failed={"lcp": "ended"}, degraded={}), rig.now)
    rig.tick()
    assert (rig.last().safety, rig.last().valid) == (SafetyState.HOLD, False)
    assert "lcp failed" in rig.last().reason
    rig.reconciler.put(SUPERVISOR, SupervisorReport(**said, failed={}, degraded={}), rig.now)
    rig.run(0.3)
    assert rig.last().valid
