"""The local planner's stage: what it answers, on what, in which phase, and the same again."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from planning.lattice_graph import neighbour
from planning.reward import RewardWeights, leftover_entropy
from schemas.base import Pose
from schemas.codec import Envelope, encode
from schemas.contract import SECOND_NS, StageSetup
from schemas.operation import MissionPhase
from schemas.policy import EpisodeRequest, GlobalPolicy, LocalPhase, LocalPolicy
from schemas.topics import EPISODE, GLOBAL_POLICY, LOCAL_IRM, LOCAL_POLICY, MISSION
from schemas.world import LocalIrm
from services.lcp.guide import way_along
from services.lcp.stage import Config, LcpStage, create, spec
from tests.lcp.local_irms import IX0, IY0, anchor_of, global_policy, local_irm, mission, request
from tests.planning.coverage_lattices import STEPS, Edge, Reference, random_lattice
from tests.runtime.feeding import Feed, only

FAST = Config(max_nodes=2000, min_visits=4)
SIZE = 9


def corridor(entropy_at: dict[int, float]) -> Reference:
    """A corridor along row 4, with entropy in some of its nine nodes."""
    lattice = random_lattice(1, SIZE, 2, 120.0)
    edges: dict[tuple[int, int], Edge] = {}
    for column in range(SIZE - 1):
        edges[4 * SIZE + column, 0] = edges[4 * SIZE + column + 1, 4] = Edge(1.0, 0.0)
    entropy = np.zeros(SIZE * SIZE)
    for column, nats in entropy_at.items():
        entropy[4 * SIZE + column] = nats
    sees = {4 * SIZE + c: frozenset(4 * SIZE + o for o in entropy_at if abs(o - c) <= 2) for c in range(SIZE)}
    return Reference(SIZE, 2, lattice.fov_rad, lattice.weights, entropy, edges, sees)


def feed_of(lattice: Reference, config: Config = FAST, version: int = 1) -> Feed:
    feed = Feed("lcp", create(config, StageSetup("robot", 11)))
    feed.put(LOCAL_IRM, local_irm(lattice, version), 0)
    return feed


def answer(feed: Feed, wanted: EpisodeRequest, now: int = SECOND_NS) -> LocalPolicy | None:
    feed.put(EPISODE, wanted, now)
    return only(feed.step(now), LOCAL_POLICY)


# --- episodes -----------------------------------------------------------------------------------------------------


def test_an_episode_is_answered_once_with_its_id() -> None:
    lattice = random_lattice(4, SIZE, 2)
    feed = feed_of(lattice)
    assert feed.step(0) == []
    first = answer(feed, request(lattice, 40, episode=17))
    assert first is not None
    assert (first.episode, first.irm_version) == (17, 1)
    assert first.phase is LocalPhase.COVER
    assert first.simulations == 256
    assert feed.step(2 * SECOND_NS) == []
    feed.put(LOCAL_IRM, local_irm(lattice, 2), 2 * SECOND_NS)
    assert feed.step(2 * SECOND_NS) == [], "a new Local IRM alone asks for nothing"
    second = answer(feed, request(lattice, 40, episode=18, version=2), 3 * SECOND_NS)
    assert second is not None and (second.episode, second.irm_version) == (18, 2)


def test_an_unknown_version_is_refused_with_a_reason() -> None:
    lattice = random_lattice(4, SIZE, 2)
    found = answer(feed_of(lattice), request(lattice, 40, version=99))
    assert found is not None
    assert found.phase is LocalPhase.NONE
    assert "99" in found.reason
    assert (found.episode, found.irm_version, len(found.path_lattice)) == (1, 99, 0)


def test_only_the_last_few_versions_are_kept() -> None:
    lattice = random_lattice(4, SIZE, 2)
    feed = feed_of(lattice)
    for version in range(2, 12):
        feed.put(LOCAL_IRM, local_irm(lattice, version), version)
        feed.step(version)
    old = answer(feed, request(lattice, 40, episode=1, version=2))
    kept = answer(feed, request(lattice, 40, episode=2, version=10))
    assert old is not None and old.phase is LocalPhase.NONE
    assert kept is not None and kept.phase is LocalPhase.COVER


@pytest.mark.parametrize(
    ("wanted", "why"),
    [
        ({"node": SIZE * SIZE}, "fit"),
        ({"node": 40, "covered": np.zeros(SIZE + 1, np.uint64)}, "fit"),
        ({"node": 40, "particles": [(40, 0, 0.0)]}, "empty"),
    ],
)
def test_a_junction_that_does_not_fit_is_refused(wanted: dict[str, object], why: str) -> None:
    lattice = random_lattice(4, SIZE, 2)
    found = answer(feed_of(lattice), request(lattice, **wanted))  # type: ignore[arg-type]
    assert found is not None
    assert found.phase is LocalPhase.NONE
    assert why in found.reason


def test_a_stale_request_is_not_answered() -> None:
    lattice = random_lattice(4, SIZE, 2)
    feed = feed_of(lattice)
    feed.put(EPISODE, request(lattice, 40), 0)
    assert feed.step(EPISODE.stale_after_ns + 1) == []


def test_what_counts_as_covered_is_not_covered_again() -> None:
    """The rich end of the corridor is covered by the kept prefix already: the policy goes to the poor end."""
    lattice = corridor({0: 0.3, 1: 0.3, 7: 0.69, 8: 0.69})
    rich = answer(feed_of(lattice), request(lattice, 4 * SIZE + 4, heading=0))
    done = lattice.bits([4 * SIZE + 7, 4 * SIZE + 8])
    poor = answer(feed_of(lattice), request(lattice, 4 * SIZE + 4, heading=0, covered=done))
    assert rich is not None and poor is not None
    assert rich.path_lattice[1, 0] > rich.path_lattice[0, 0]
    assert poor.path_lattice[1, 0] < poor.path_lattice[0, 0]


def test_the_most_likely_particle_is_where_the_path_begins() -> None:
    lattice = random_lattice(4, SIZE, 2)
    belief = [(30, 0, 0.2), (40, 2, 0.5), (41, 0, 0.3)]
    found = answer(feed_of(lattice), request(lattice, 0, particles=belief))
    assert found is not None
    assert tuple(found.path_lattice[0]) == (IX0 + 40 % SIZE, IY0 + 40 // SIZE)


# --- phases -------------------------------------------------------------------------------------------------------


def at(column: float) -> tuple[float, float]:
    return (IX0 + column + 0.5, IY0 + 4.5)


def phase_of(found: LocalPolicy | None) -> LocalPhase:
    assert found is not None
    return found.phase


def test_with_nothing_in_reach_it_guides_to_a_target_outside() -> None:
    lattice = corridor({})
    feed = feed_of(lattice)
    feed.put(GLOBAL_POLICY, global_policy([at(2), at(20)]), 0)
    found = answer(feed, request(lattice, 4 * SIZE + 2))
    assert found is not None
    assert found.phase is LocalPhase.GUIDE
    assert found.target == 7
    assert [int(x) - IX0 for x in found.path_lattice[:, 0]] == [2, 3, 4, 5, 6, 7, 8], (
        "as far as the lattice reaches"
    )
    assert found.simulations == 0


def test_a_target_behind_a_wall_is_guided_to_even_when_it_is_near() -> None:
    """Reachable within the Local IRM is what counts, not near: the way leads around, over a node that is farther."""
    lattice = corridor({})
    feed = feed_of(lattice)
    behind = (IX0 + 2.5, IY0 + 6.5)
    feed.put(GLOBAL_POLICY, global_policy([at(2), at(8), (IX0 + 20.0, IY0 + 6.0), behind]), 0)
    found = answer(feed, request(lattice, 4 * SIZE + 2))
    assert found is not None
    assert found.phase is LocalPhase.GUIDE
    assert int(found.path_lattice[-1, 0]) - IX0 == 8


@pytest.mark.parametrize(("pieces", "ends_at"), [((0, 0, 0, 0), 8), ((0, 0, 1, 1), 0)])
def test_nothing_is_said_of_the_way_between_two_pieces(pieces: tuple[int, ...], ends_at: int) -> None:
    """The way leaves the window on one side and comes back far behind the other: the straight line is no way."""
    lattice = corridor({})
    feed = feed_of(lattice)
    feed.put(GLOBAL_POLICY, global_policy([at(2), at(-9), at(30), at(40)], pieces=pieces), 0)
    found = answer(feed, request(lattice, 4 * SIZE + 2))
    assert found is not None
    assert found.phase is LocalPhase.GUIDE
    assert int(found.path_lattice[-1, 0]) - IX0 == ends_at


def test_the_global_path_is_in_map_and_the_lattice_in_odom() -> None:
    lattice = corridor({})
    feed = feed_of(lattice)
    offset = Pose(x_m=100.0, y_m=50.0, yaw_rad=math.pi / 2.0)

    def in_map(column: float) -> tuple[float, float]:
        x, y = at(column)
        return (100.0 - y, 50.0 + x)

    feed.put(GLOBAL_POLICY, global_policy([in_map(2), in_map(6)], offset), 0)
    found = answer(feed, request(lattice, 4 * SIZE + 2))
    assert found is not None
    assert [int(x) - IX0 for x in found.path_lattice[:, 0]] == [2, 3, 4, 5, 6]


def test_without_anything_to_do_it_says_so() -> None:
    lattice = corridor({})
    nothing = answer(feed_of(lattice), request(lattice, 4 * SIZE + 2))
    assert nothing is not None
    assert (nothing.phase, nothing.reason) == (LocalPhase.NONE, "no target")
    feed = feed_of(lattice)
    feed.put(GLOBAL_POLICY, global_policy([]), 0)
    settled = answer(feed, request(lattice, 4 * SIZE + 2))
    assert settled is not None
    assert (settled.phase, settled.reason) == (LocalPhase.NONE, "nothing left to go to")


def test_covering_begins_and_ends_at_different_thresholds() -> None:
    thresholds = {"cover_begin_entropy": 0.6, "cover_end_entropy": 0.2, "cover_min_value": 0.0}
    config = FAST.model_copy(update=thresholds)
    rich, middle, poor = (corridor({5: nats}) for nats in (0.65, 0.4, 0.15))
    feed = Feed("lcp", create(config, StageSetup("robot", 1)))
    far: GlobalPolicy = global_policy([at(2), at(30)])
    phases = []
    for episode, lattice in enumerate((rich, middle, poor, middle, rich, middle), start=1):
        now = episode * SECOND_NS
        feed.put(GLOBAL_POLICY, far, now)
        feed.put(LOCAL_IRM, local_irm(lattice, episode), now)
        phases.append(
            phase_of(answer(feed, request(lattice, 4 * SIZE + 2, episode=episode, version=episode), now))
        )
    cover, guide = LocalPhase.COVER, LocalPhase.GUIDE
    assert phases == [cover, cover, guide, guide, cover, cover]


def test_little_is_covered_where_the_target_itself_lies() -> None:
    """Below the threshold, but the target is within the Local IRM and reachable: that is what there is to cover."""
    config = FAST.model_copy(update={"cover_begin_entropy": 5.0, "cover_end_entropy": 4.0})
    lattice = corridor({6: 0.69})
    feed = feed_of(lattice, config)
    feed.put(GLOBAL_POLICY, global_policy([at(2), at(6)]), 0)
    assert phase_of(answer(feed, request(lattice, 4 * SIZE + 2))) is LocalPhase.COVER
    feed.put(GLOBAL_POLICY, global_policy([at(2), at(30)]), 1)
    assert phase_of(answer(feed, request(lattice, 4 * SIZE + 2, episode=2))) is LocalPhase.GUIDE


def test_a_policy_that_is_worth_little_gives_way_to_the_target() -> None:
    lattice = corridor({8: 0.3})
    phases = []
    for least in (0.0, 50.0):
        feed = feed_of(
            lattice, FAST.model_copy(update={"cover_begin_entropy": 0.2, "cover_min_value": least})
        )
        feed.put(GLOBAL_POLICY, global_policy([at(-20), at(-30)]), 0)
        phases.append(phase_of(answer(feed, request(lattice, 4 * SIZE + 2))))
    assert phases[0] is LocalPhase.COVER
    assert phases[1] is LocalPhase.COVER, (
        "there is no way to the target from here: covering is better than nothing"
    )
    feed.put(GLOBAL_POLICY, global_policy([at(2), at(0)]), 1)
    assert phase_of(answer(feed, request(lattice, 4 * SIZE + 2, episode=2))) is LocalPhase.GUIDE


@pytest.mark.parametrize(("weight", "least"), [(0.0, 0.0), (3.0, 0.3), (1.0, 0.0)])
def test_ground_left_behind_counts_more(weight: float, least: float) -> None:
    """By the share of the known neighbours that are covered; with both numbers at 0 it is the paper's reward."""
    lattice = random_lattice(8, SIZE, 2, wall_share=0.2, covered_share=0.5)
    irm = local_irm(lattice)
    weights = RewardWeights(leftover_weight=weight, leftover_gain=least)
    found = leftover_entropy(lattice.entropy, irm.state == 1, irm.size, weights)
    for node in range(SIZE * SIZE):
        if lattice.entropy[node] == 0.0:
            assert found[node] == 0.0
            continue
        around = [o for k in range(8) if (o := lattice.neighbour(node, k)) >= 0]
        known = [o for o in around if irm.state[o] == 1 or lattice.entropy[o] > 0.0]
        covered = [o for o in known if lattice.entropy[o] == 0.0]
        share = len(covered) / max(len(known), 1)
        assert math.isclose(found[node], max(lattice.entropy[node], least) * (1.0 + weight * share))


def test_on_the_way_back_nothing_is_covered() -> None:
    lattice = random_lattice(4, SIZE, 2)
    feed = feed_of(lattice)
    feed.put(GLOBAL_POLICY, global_policy([at(2), at(0)]), 0)
    feed.put(MISSION, mission(MissionPhase.RETURN), 0)
    assert phase_of(answer(feed, request(lattice, 4 * SIZE + 4), 1)) is LocalPhase.GUIDE


def test_the_value_of_the_leaf_draws_the_policy_to_where_the_mission_goes_on() -> None:
    """The same little ground on both sides: what is worth more afterwards decides which comes last."""
    lattice = corridor({1: 0.69, 7: 0.69})
    ends = []
    for column in (0, 8):
        feed = feed_of(lattice)
        policy = global_policy([at(4), at(column)], values=[(*at(column), 6.0)])
        feed.put(GLOBAL_POLICY, policy, 0)
        found = answer(feed, request(lattice, 4 * SIZE + 4, heading=2, simulations=1024))
        assert found is not None and found.phase is LocalPhase.COVER
        ends.append(int(found.path_lattice[-1, 0]) - IX0)
    assert ends[0] < 4 < ends[1]


# --- the answer ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_the_path_goes_over_edges_and_its_line_through_the_anchors(seed: int) -> None:
    lattice = random_lattice(seed, SIZE, 2, wall_share=0.2)
    node = min(a for a, _ in lattice.edges)
    found = answer(feed_of(lattice), request(lattice, node, simulations=512))
    assert found is not None and found.phase is LocalPhase.COVER
    nodes = [(int(y) - IY0) * SIZE + int(x) - IX0 for x, y in found.path_lattice]
    assert nodes[0] == node
    for a, b in itertools.pairwise(nodes):
        step = (b % SIZE - a % SIZE, b // SIZE - a // SIZE)
        assert (a, STEPS.index(step)) in lattice.edges
    assert len(found.path_node_point) == len(nodes)
    for point, at_node in zip(found.path_node_point, nodes, strict=True):
        np.testing.assert_allclose(found.path_xy_m[point], anchor_of(lattice, at_node))
    assert np.all(np.diff(found.path_node_point) > 0)
    assert found.path_in_tree[0] == 1
    assert np.all(np.diff(found.path_in_tree.astype(int)) <= 0), "first the tree, then its rollout"


@pytest.mark.parametrize("backwards", [False, True])
def test_a_bent_edge_is_driven_along_its_inner_points_in_both_directions(backwards: bool) -> None:
    lattice = corridor({})
    inner = [(IX0 + 3.7, IY0 + 4.9), (IX0 + 4.2, IY0 + 5.1)]
    feed = Feed("lcp", create(FAST, StageSetup("robot", 1)))
    feed.put(LOCAL_IRM, local_irm(lattice, bent={(4 * SIZE + 3, 0): inner}), 0)
    first, last = (5, 2) if backwards else (2, 5)
    feed.put(GLOBAL_POLICY, global_policy([at(first), at(last)]), 0)
    found = answer(feed, request(lattice, 4 * SIZE + first))
    assert found is not None
    line = (
        [anchor_of(lattice, 4 * SIZE + c) for c in (2, 3)]
        + inner
        + [anchor_of(lattice, 4 * SIZE + c) for c in (4, 5)]
    )
    np.testing.assert_allclose(found.path_xy_m, line[::-1] if backwards else line, atol=1e-5)
    assert found.path_node_point.tolist() == [0, 1, 4, 5]


def test_an_answer_tells_what_its_rollouts_alone_are_worth() -> None:
    """So that the reconciler can weigh rollouts like plans; a guide has no rollouts."""
    lattice = random_lattice(6, SIZE, 2, risky_share=0.5)
    found = answer(feed_of(lattice), request(lattice, 40, simulations=2048))
    assert found is not None and found.phase is LocalPhase.COVER
    assert 0.3 * found.root_value < found.rollout_value <= 1.05 * found.root_value
    feed = feed_of(corridor({}))
    feed.put(GLOBAL_POLICY, global_policy([at(2), at(20)]), 0)
    guided = answer(feed, request(lattice, 4 * SIZE + 2))
    assert guided is not None and guided.phase is LocalPhase.GUIDE
    assert guided.rollout_value == 0.0


def test_the_policy_tree_is_a_tree() -> None:
    lattice = random_lattice(6, SIZE, 2, risky_share=0.5)
    found = answer(feed_of(lattice), request(lattice, 40, simulations=1024))
    assert found is not None
    m = len(found.tree_action)
    assert sorted(found.child_node.tolist()) == list(range(1, m)), (
        "every node but the root is one node's child"
    )
    assert found.child_start[0] == 0 and found.child_start[-1] == len(found.child_node)
    assert np.all(np.diff(found.child_start) >= 0)
    assert np.all(found.tree_action[0] >= 0)
    assert found.tree_visits[0] >= found.tree_visits.max()
    assert math.isclose(found.root_value, found.tree_value[0])


# --- the same again -----------------------------------------------------------------------------------------------


def bytes_of(policy: LocalPolicy) -> bytes:
    return encode(policy, Envelope("robot", "lcp", 1, 1, 0))


def test_the_same_request_gives_the_same_bytes_and_another_seed_does_not() -> None:
    lattice = random_lattice(6, SIZE, 2, risky_share=0.5)

    def run(seed: int, episode: int) -> bytes:
        feed = Feed("lcp", create(FAST, StageSetup("robot", seed)))
        feed.put(LOCAL_IRM, local_irm(lattice), 0)
        found = answer(feed, request(lattice, 40, episode=episode, simulations=512))
        assert found is not None
        return bytes_of(found.model_copy(update={"episode": 1}))

    assert run(5, 1) == run(5, 1)
    assert run(5, 1) != run(6, 1)
    assert run(5, 1) != run(5, 2), "every episode has a stream of its own"


def test_an_answer_does_not_depend_on_the_episodes_before_it() -> None:
    lattice = random_lattice(6, SIZE, 2)
    warm, fresh = feed_of(lattice), feed_of(lattice)
    answer(warm, request(lattice, 30, episode=1))
    later = answer(warm, request(lattice, 40, episode=2), 2 * SECOND_NS)
    alone = answer(fresh, request(lattice, 40, episode=2), 2 * SECOND_NS)
    assert later is not None and alone is not None
    assert bytes_of(later) == bytes_of(alone)


def test_it_goes_on_from_a_snapshot() -> None:
    thresholds = {"cover_begin_entropy": 0.6, "cover_end_entropy": 0.2, "cover_min_value": 0.0}
    config = FAST.model_copy(update=thresholds)
    first = Feed("lcp", create(config, StageSetup("robot", 1)))
    poor, middle = corridor({5: 0.1}), corridor({5: 0.4})
    first.put(LOCAL_IRM, local_irm(poor), 0)
    first.put(GLOBAL_POLICY, global_policy([at(2), at(30)]), 0)
    assert phase_of(answer(first, request(poor, 4 * SIZE + 2, episode=4))) is LocalPhase.GUIDE
    second = Feed("lcp", create(config, StageSetup("robot", 1)))
    second.stage.restore(first.stage.snapshot())
    second.put(LOCAL_IRM, local_irm(middle), 0)
    second.put(GLOBAL_POLICY, global_policy([at(2), at(30)]), 0)
    assert answer(second, request(middle, 4 * SIZE + 2, episode=4)) is None, "that episode was answered"
    again = answer(second, request(middle, 4 * SIZE + 2, episode=5), 2 * SECOND_NS)
    assert phase_of(again) is LocalPhase.GUIDE, (
        "it had stopped covering, and this is too little to begin again"
    )


def test_a_deadline_ends_the_search_and_says_how_far_it_came() -> None:
    """The stopwatch is the driver's; here every look at it takes 0.1 s."""
    ticks = iter(range(10**6))
    lattice = random_lattice(6, SIZE, 2)
    setup = StageSetup("robot", 1, stopwatch=lambda: 0.1 * next(ticks))
    feed = Feed("lcp", create(FAST.model_copy(update={"seconds_per_deadline": 0.35}), setup))
    feed.put(LOCAL_IRM, local_irm(lattice), 0)
    found = answer(feed, request(lattice, 40, simulations=100_000))
    assert found is not None
    assert found.phase is LocalPhase.COVER
    assert 0 < found.simulations < 100_000


def test_the_stage_runs_on_requests() -> None:
    assert spec(Config()).triggers == (EPISODE.name,)
    assert spec(Config()).name == "lcp"
    assert isinstance(create(Config(), StageSetup("robot", 0)), LcpStage)


def test_unknown_keys_are_refused_at_every_level() -> None:
    for bad in ({"max_deph": 3}, {"weights": {"k_riks": 1.0}}):
        with pytest.raises(ValueError, match="Extra inputs"):
            Config.model_validate(bad)


def test_its_messages_are_those_of_the_table() -> None:
    assert isinstance(local_irm(corridor({})), LocalIrm)
    assert LOCAL_POLICY.writer == "lcp"


def test_a_target_whose_patch_has_its_anchor_behind_a_wall_is_approached_from_its_own_side() -> None:
    """Column 5 is anchored on this side of a wall, the target lies beyond it: the way goes round, over row 5."""
    lattice = corridor({})
    irm = _walled(lattice)
    target = (IX0 + 5.6, IY0 + 4.9)
    policy = global_policy([at(4), target])
    assert _columns(way_along(irm, policy, 4 * SIZE + 4, 1.0, 0.9), 4 * SIZE + 4)[-1] == (6, 5)
    assert way_along(irm, policy, 5 * SIZE + 6, 1.0, 0.9) == [], "it is there; it is not sent to and fro"


def _walled(lattice: Reference) -> LocalIrm:
    """Rows 4 and 5 join at column 4; in row 4 column 5 is a dead end, in row 5 the way goes on to column 6."""
    irm = local_irm(lattice)
    n = lattice.size**2
    edges = np.zeros((n, 8), np.float32)
    for (column, row), k in {(3, 4): 0, (4, 4): 0, (4, 5): 0, (5, 5): 0}.items():
        edges[row * SIZE + column, k] = edges[row * SIZE + column + 1, (k + 4) % 8] = 1.0
    edges[4 * SIZE + 4, 2] = edges[5 * SIZE + 4, 6] = 1.0
    anchor = irm.anchor_m.copy()
    anchor[4 * SIZE + 5] = (IX0 + 5.02, IY0 + 4.02)
    anchor[5 * SIZE + 5] = (IX0 + 5.1, IY0 + 5.9)
    anchor[5 * SIZE + 6] = (IX0 + 6.0, IY0 + 5.2)
    state = np.where((edges > 0.0).any(axis=1), 1, 2).astype(np.uint8)
    return irm.model_copy(
        update={
            "edge_distance_m": edges,
            "edge_risk": np.zeros((n, 8), np.float32),
            "anchor_m": anchor,
            "state": state,
        }
    )


def _columns(moves: list[int], node: int) -> list[tuple[int, int]]:
    places = []
    for k in moves:
        node = neighbour(node, k, SIZE)
        places.append((node % SIZE, node // SIZE))
    return places
