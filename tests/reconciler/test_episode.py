"""The parts of an episode: nodes of the old path that still hold, what its prefix covers, the junction belief."""

from __future__ import annotations

import itertools
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from planning.coverage_build import reachable_entropy
from planning.coverage_tiles import by_tile
from planning.reward import RewardWeights, leftover_entropy
from schemas.base import Pose
from schemas.sensing import Odometry
from schemas.world import LocalIrm
from services.reconciler.config import Config
from services.reconciler.episode import (
    Committed,
    cover_along,
    heading_index,
    junction_particles,
    line_to_lattice,
    model_here,
    moves_between,
    node_index,
    usable_nodes,
)
from services.reconciler.path import Ground, headings
from tests.lcp.local_irms import IX0, IY0, anchor_of, local_irm
from tests.planning.coverage_lattices import Reference, random_lattice
from tests.reconciler.grounds import ground_of

SEEDS = st.integers(0, 2**32 - 1)
SIZE = 7
CONFIG = Config()


def walk(lattice: Reference, rng: np.random.Generator, length: int) -> list[int]:
    """Nodes of a walk over edges."""
    nodes = [int(rng.choice(sorted({node for node, _ in lattice.edges})))]
    for _ in range(length):
        k = int(rng.choice(list(lattice.directions(nodes[-1]))))
        nodes.append(lattice.neighbour(nodes[-1], k))
    return nodes


def committed_along(lattice: Reference, nodes: list[int], between: int = 3) -> Committed:
    """A path through the anchors of these nodes with some points in between."""
    line: list[tuple[float, float]] = []
    node_point = []
    for a, b in itertools.pairwise(nodes):
        (x0, y0), (x1, y1) = anchor_of(lattice, a), anchor_of(lattice, b)
        node_point.append(len(line))
        line += [(x0 + (x1 - x0) * i / between, y0 + (y1 - y0) * i / between) for i in range(between)]
    node_point.append(len(line))
    line.append(anchor_of(lattice, nodes[-1]))
    indices = [(IX0 + node % SIZE, IY0 + node // SIZE) for node in nodes]
    return Committed(np.array(line), np.array(indices, np.int64), np.array(node_point, np.int64))


def test_headings_are_the_nearest_of_eight() -> None:
    for degree in range(-720, 720):
        yaw = math.radians(degree + 0.1)
        off = {k: abs(math.remainder(yaw - k * math.pi / 4.0, 2.0 * math.pi)) for k in range(8)}
        assert heading_index(yaw) == min(off, key=lambda k: off[k])


@given(SEEDS)
def test_moves_and_coverage_of_the_kept_prefix(seed: int) -> None:
    """What the prefix covers: looks at every node in its heading, and at both headings where it turns."""
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, SIZE, 2, wall_share=0.1)
    nodes = walk(lattice, rng, 6)
    committed, irm = committed_along(lattice, nodes), local_irm(lattice)
    moves = moves_between(committed, 0, 6)
    for node, k, after in zip(nodes, moves.tolist(), nodes[1:], strict=False):
        assert lattice.neighbour(node, k) == after
    usable = usable_nodes(committed, irm, 0)
    assert usable == list(range(7))
    kept = int(rng.integers(1, 7))
    covered = np.zeros(SIZE, np.uint64)
    model = model_here(irm, nodes[0], 0, covered, CONFIG)
    cover_along(model, committed, irm, usable[: kept + 1], covered)
    heading = heading_index(float(headings(committed.points)[0]))
    expected = lattice.footprint(nodes[0], heading)
    at, facing = nodes[0], heading
    for k in moves[:kept].tolist():
        at, expected, _, _ = lattice.move(at, facing, expected, k, False)
        facing = k
    assert lattice.nodes(covered) == expected


def test_usable_nodes_end_at_the_first_one_that_is_gone_and_begin_at_the_robot() -> None:
    lattice = random_lattice(1, SIZE, 1)
    nodes = [0, 1, 2, 3, 4, 5, 6]
    committed, irm = committed_along(lattice, nodes), local_irm(lattice)
    assert usable_nodes(committed, irm, int(committed.node_point[2])) == [2, 3, 4, 5, 6]
    assert usable_nodes(committed, irm, int(committed.node_point[2]) + 1) == [3, 4, 5, 6]
    state = irm.state.copy()
    state[4] = 2
    assert usable_nodes(committed, irm.model_copy(update={"state": state}), 0) == [0, 1, 2, 3]
    rolled = irm.model_copy(update={"ix0": IX0 - 3})
    assert usable_nodes(committed, rolled, 0) == [0, 1, 2, 3], "the window has rolled: 4 to 6 are outside"


def test_nodes_keep_their_identity_when_the_window_rolls() -> None:
    lattice = random_lattice(1, SIZE, 1)
    irm = local_irm(lattice)
    for node in range(SIZE * SIZE):
        ix, iy = IX0 + node % SIZE, IY0 + node // SIZE
        assert node_index(irm, ix, iy) == node
        rolled = irm.model_copy(update={"ix0": IX0 + 1, "iy0": IY0 - 2})
        inside = node % SIZE >= 1 and node // SIZE + 2 < SIZE
        assert node_index(rolled, ix, iy) == (node - 1 + 2 * SIZE if inside else -1)


def odometry(x_m: float, y_m: float, yaw_rad: float = 0.0, deviation: float = 0.01) -> Odometry:
    return Odometry(
        stamp_ns=0,
        pose=Pose(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad),
        map_to_odom=Pose(),
        speed_mps=0.0,
        turn_rate_radps=0.0,
        covariance=np.diag([deviation**2] * 3),
    )


@given(SEEDS, st.floats(0.0, 2.0), st.integers(1, 200))
def test_the_junction_belief(seed: int, deviation: float, count: int) -> None:
    rng = np.random.default_rng(seed)
    lattice = random_lattice(seed, SIZE, 1, wall_share=0.3)
    node = int(rng.choice(sorted({node for node, _ in lattice.edges})))
    irm, pose = local_irm(lattice), odometry(0.0, 0.0, deviation=deviation)
    nodes, headings_, weights = junction_particles(irm, node, 3, pose, count, 5, 9)
    assert math.isclose(weights.sum(), 1.0) and weights.min() > 0.0
    states = list(zip(nodes.tolist(), headings_.tolist(), strict=True))
    assert len(set(states)) == len(states)
    assert (node, 3) in states
    assert {n for n, _ in states} <= {n for n, _ in lattice.edges}, "only where the robot can be"
    assert np.all(np.diff(weights) <= 1e-12), "the most likely first"
    again = junction_particles(irm, node, 3, pose, count, 5, 9)
    np.testing.assert_array_equal(again[0], nodes)
    np.testing.assert_array_equal(again[1], headings_)
    np.testing.assert_array_equal(again[2], weights)


def test_the_junction_belief_does_not_spread_with_the_drift_in_map() -> None:
    """The junction lies in odom: metres of uncertainty in `map` change nothing there, centimetres do as they are."""
    irm = local_irm(random_lattice(2, SIZE, 1))
    near, far = (
        junction_particles(irm, 24, 0, odometry(0.0, 0.0, deviation=d), 300, 1, 1) for d in (0.05, 3.0)
    )
    for one, other in zip(near, far, strict=True):
        assert np.asarray(one).tolist() == np.asarray(other).tolist()


# --- the way to the lattice ---------------------------------------------------------------------------------------


def room() -> tuple[LocalIrm, np.ndarray]:
    """A lattice of 7 x 7 nodes and 0.1 m ground around it, all free."""
    return local_irm(random_lattice(1, SIZE, 1)), np.zeros((90, 90), np.bool_)


def ground(lethal: np.ndarray) -> Ground:
    return ground_of(lethal, ix0=10 * IX0 - 10, iy0=10 * IY0 - 10)


def test_the_nearest_node_by_travel_is_joined() -> None:
    irm, lethal = room()
    x, y = IX0 + 3.1, IY0 + 3.2
    found = line_to_lattice(irm, ground(lethal), odometry(x, y), 0.22, set())
    assert found is not None
    node, line = found
    distance = np.hypot(irm.anchor_m[:, 0] - x, irm.anchor_m[:, 1] - y)
    assert distance[node] <= distance.min() + 0.6, "the nearest, but for half a turn"
    np.testing.assert_allclose(line[0], (x, y))
    np.testing.assert_allclose(line[-1], irm.anchor_m[node])


def test_a_node_behind_a_wall_is_not_near() -> None:
    irm, lethal = room()
    lethal[10 + 33, :80] = True  # a wall at y = IY0 + 3.3, open at its far end
    x, y = IX0 + 2.5, IY0 + 3.0
    found = line_to_lattice(irm, ground(lethal), odometry(x, y), 0.12, set())
    assert found is not None
    node, line = found
    assert irm.anchor_m[node, 1] < IY0 + 3.3
    assert line[:, 1].max() < IY0 + 3.3


def test_nodes_to_avoid_and_nodes_without_edges_are_no_way_back() -> None:
    irm, lethal = room()
    x, y = IX0 + 3.4, IY0 + 3.6
    first = line_to_lattice(irm, ground(lethal), odometry(x, y), 0.2, set())
    assert first is not None
    second = line_to_lattice(irm, ground(lethal), odometry(x, y), 0.2, {first[0]})
    assert second is not None and second[0] != first[0]
    cut = irm.edge_distance_m.copy()
    cut[first[0]] = 0.0
    third = line_to_lattice(
        irm.model_copy(update={"edge_distance_m": cut}), ground(lethal), odometry(x, y), 0.2, set()
    )
    assert third is not None and third[0] != first[0]


def test_walled_in_there_is_no_way() -> None:
    irm, lethal = room()
    lethal[10 + 30 : 10 + 40, 10 + 30 : 10 + 40] = True
    lethal[10 + 32 : 10 + 38, 10 + 32 : 10 + 38] = False
    blocked = irm.state.copy()
    blocked[3 * SIZE + 3] = 2
    x, y = IX0 + 3.5, IY0 + 3.5
    assert (
        line_to_lattice(irm.model_copy(update={"state": blocked}), ground(lethal), odometry(x, y), 0.2, set())
        is None
    )
    outside = odometry(IX0 + 50.0, IY0)
    assert line_to_lattice(irm, ground(lethal), outside, 0.2, set()) is None


def test_the_model_is_the_shared_one() -> None:
    lattice = random_lattice(3, SIZE, 2)
    model = model_here(local_irm(lattice), 24, 1, np.zeros(SIZE, np.uint64), CONFIG)
    np.testing.assert_array_equal(model.edge_distance_m, lattice.model().edge_distance_m)
    assert (int(model.particle_node[0]), int(model.particle_heading[0])) == (24, 1)


def test_the_model_counts_ground_left_behind_as_lcp_does() -> None:
    lattice = random_lattice(3, SIZE, 2, wall_share=0.2, covered_share=0.5)
    irm = local_irm(lattice)
    weights = RewardWeights(leftover_weight=3.0, leftover_gain=0.3)
    found = model_here(irm, 24, 1, np.zeros(SIZE, np.uint64), Config(weights=weights)).entropy
    reached = reachable_entropy(irm.entropy, irm.visible, irm.edge_distance_m, irm.size, irm.reach)
    expected = leftover_entropy(reached, irm.state == 1, irm.size, weights)
    np.testing.assert_allclose(found, by_tile(expected, irm.size))
    paper = model_here(irm, 24, 1, np.zeros(SIZE, np.uint64), CONFIG).entropy
    np.testing.assert_allclose(paper, by_tile(reached, irm.size))
    assert (found > paper).any()
