"""The tour over viewpoints: it sees all that can be seen, in the right order, beyond the window too."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.coverage_build import reachable_entropy
from planning.lattice_graph import travel_costs
from schemas.operation import MissionPhase
from schemas.policy import Alternative, GlobalPolicy, LocalPhase
from services.lcp.config import TourConfig
from services.lcp.tour import plan_tour
from tests.lcp.local_irms import anchor_of, local_irm
from tests.lcp.test_baselines import SIZE, Bench, columns, leading_to
from tests.lcp.test_viewpoints import row_of
from tests.planning.coverage_lattices import Reference, random_lattice

ALL = TourConfig(stops=14, min_gain=0.0)


@pytest.mark.parametrize(("early", "first"), [(0.0, [4, 3]), (2.0, [4, 5])])
def test_early_gain_decides_where_it_begins(early: float, first: list[int]) -> None:
    """A crumb is near to the left, much is farther to the right: the shorter tour turns left first."""
    lattice = row_of(SIZE, {2: 0.2, 8: 0.69, 9: 0.69, 10: 0.69})
    found = Bench(lattice, "tour", tour={"early_per_nat": early}).ask(4)
    assert found.phase is LocalPhase.COVER
    assert columns(found)[:2] == first
    assert {2, 9} <= set(columns(found)) | {c + 1 for c in columns(found)} | {c - 1 for c in columns(found)}
    assert found.root_value == pytest.approx(float(found.path_reward.sum()))


@pytest.mark.parametrize(("stop_gain", "first"), [(0.0, 5), (20.0, 3)])
def test_what_each_stop_counts_more_brings_a_crumb_nearby_forward(stop_gain: float, first: int) -> None:
    lattice = row_of(SIZE, {2: 0.2, 8: 0.69, 9: 0.69, 10: 0.69})
    tour = {"early_per_nat": 2.0, "stop_gain": stop_gain}
    assert columns(Bench(lattice, "tour", tour=tour).ask(4))[1] == first


def test_a_crumb_is_left_until_there_is_nothing_else() -> None:
    crumb = row_of(SIZE, {2: 0.05})
    assert columns(Bench(crumb, "tour").ask(4))[:2] == [4, 3]
    both = row_of(SIZE, {2: 0.05, 8: 0.69})
    assert 3 not in columns(Bench(both, "tour", tour={"early_per_nat": 0.0}).ask(4))


def test_it_is_led_to_the_target_where_nothing_is_in_the_window_and_on_the_way_back() -> None:
    nothing, something = row_of(SIZE, {}), row_of(SIZE, {2: 0.69})
    led = Bench(nothing, "tour").ask(4, leading_to(nothing, 4, 12))
    assert (led.phase, columns(led)) == (LocalPhase.GUIDE, list(range(4, 13)))
    home = Bench(something, "tour").ask(4, leading_to(something, 4, 12), MissionPhase.RETURN)
    assert (home.phase, columns(home)) == (LocalPhase.GUIDE, list(range(4, 13)))


def test_frontiers_beyond_the_window_are_stops_and_those_in_it_are_not() -> None:
    lattice = row_of(SIZE, {2: 0.69})
    irm = local_irm(lattice)
    nobody = plan_tour(irm, 4, lattice.entropy, weighing(lattice, 0.0), ALL, 0.0, 0.9)
    assert nobody is not None
    assert nobody.nodes == [3]
    far = plan_tour(irm, 4, lattice.entropy, weighing(lattice, 30.0), ALL, 0.0, 0.9)
    assert far is not None
    assert far.nodes == [3, 12]
    assert far.gain == pytest.approx(nobody.gain + 5.0)
    assert far.cost > nobody.cost + 30.0


def weighing(lattice: Reference, beyond_m: float) -> GlobalPolicy:
    """A global policy that weighs a frontier so far to the right of the row's end."""
    x, y = anchor_of(lattice, 12)
    other = Alternative(frontier=3, x_m=x + beyond_m, y_m=y, gain=5.0, distance_m=9.0, risk=0.0, q=1.0)
    return leading_to(lattice, 4, 12).model_copy(update={"alternatives": [other]})


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_the_viewpoints_together_see_all_that_can_be_seen(seed: int) -> None:
    lattice = random_lattice(seed, 5, 2, wall_share=0.2, hidden_share=0.2, covered_share=0.3)
    irm = local_irm(lattice)
    ways, move = np.empty(25), np.empty(25, np.int8)
    start = int(np.argmax(irm.state == 1))
    travel_costs(start, 5, irm.edge_distance_m, irm.edge_risk, 0.0, 0.9, ways, move)
    there = np.isfinite(ways) & (irm.state == 1) & (np.arange(25) != start)
    edges = np.where(there[:, None], irm.edge_distance_m, np.float32(0.0))
    seen = reachable_entropy(irm.entropy, irm.visible, edges, 5, irm.reach)
    tour = plan_tour(irm, start, lattice.entropy, None, ALL, 0.0, 0.9)
    assert (tour.gain if tour else 0.0) == pytest.approx(float(seen.sum()), rel=1e-5)
