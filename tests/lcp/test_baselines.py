"""The baselines in the local planner's stage: when they view, when they are led, and that they remember."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from schemas.contract import SECOND_NS, StageSetup
from schemas.operation import MissionPhase
from schemas.policy import GlobalPolicy, LocalPhase, LocalPolicy
from schemas.topics import EPISODE, GLOBAL_POLICY, LOCAL_IRM, LOCAL_POLICY, MISSION
from services.lcp.stage import Config, LcpStage
from tests.lcp.local_irms import IX0, IY0, anchor_of, global_policy, local_irm, mission, request
from tests.lcp.test_viewpoints import row_of
from tests.planning.coverage_lattices import Reference, random_lattice
from tests.runtime.feeding import Feed, only

SIZE = 13


class Bench:
    """Asks a stage one episode after the other."""

    def __init__(self, lattice: Reference, planner: str, **options: Any) -> None:
        self.lattice = lattice
        config = Config.model_validate({"planner": planner, **options})
        self.stage = LcpStage(config, StageSetup("robot", 5))
        self.feed = Feed("lcp", self.stage)
        self.episode = 0
        self.feed.put(LOCAL_IRM, local_irm(lattice), 0)

    def ask(
        self,
        node: int,
        policy: GlobalPolicy | None = None,
        phase: MissionPhase | None = None,
        heading: int = 0,
    ) -> LocalPolicy:
        """The answer from a node."""
        self.episode += 1
        now = self.episode * SECOND_NS
        if policy is not None:
            self.feed.put(GLOBAL_POLICY, policy.model_copy(update={"stamp_ns": now}), now)
        if phase is not None:
            self.feed.put(MISSION, mission(phase, now), now)
        self.feed.put(EPISODE, request(self.lattice, node, heading, episode=self.episode), now)
        found = only(self.feed.step(now), LOCAL_POLICY)
        assert found is not None
        assert (found.simulations, found.episode) == (0, self.episode)
        return found


def columns(policy: LocalPolicy) -> list[int]:
    """The columns of the lattice that a path along its lowest row goes through."""
    assert (policy.path_lattice[:, 1] == IY0).all()
    return [int(ix) - IX0 for ix, _ in policy.path_lattice]


def leading_to(lattice: Reference, *nodes: int) -> GlobalPolicy:
    """A global policy along these nodes; the last one is the target."""
    return global_policy([anchor_of(lattice, node) for node in nodes])


def test_nbv_goes_to_the_view_and_says_what_it_is_worth() -> None:
    found = Bench(row_of(SIZE, {8: 0.69}), "nbv").ask(4)
    assert found.phase is LocalPhase.COVER
    assert columns(found) == [4, 5, 6, 7]
    assert found.root_value == pytest.approx(float(found.path_reward @ 0.985 ** np.array([0, 0, 1, 2])))
    assert found.path_look.tolist() == [0, 0, 0, 1]
    assert "view" in found.reason


def test_nbv_is_led_to_the_target_where_no_view_is_worth_its_way_and_on_the_way_back() -> None:
    nothing, something = row_of(SIZE, {}), row_of(SIZE, {2: 0.69})
    led = Bench(nothing, "nbv").ask(4, leading_to(nothing, 4, 12))
    assert (led.phase, columns(led)) == (LocalPhase.GUIDE, list(range(4, 13)))
    assert Bench(nothing, "nbv").ask(4).phase is LocalPhase.NONE
    home = Bench(something, "nbv").ask(4, leading_to(something, 4, 12), MissionPhase.RETURN)
    assert home.phase is LocalPhase.GUIDE


def test_nbv_leaves_alone_what_its_looks_do_not_cover() -> None:
    """The patch in front of it stays uncovered however often it is looked at."""
    bench = Bench(row_of(SIZE, {6: 0.69}), "nbv", promises=3.0)
    led = leading_to(bench.lattice, 5, 12)
    phases = [bench.ask(5, led).phase for _ in range(6)]
    assert phases[:4] == [LocalPhase.COVER] * 4
    assert phases[4:] == [LocalPhase.GUIDE] * 2


def test_hfe_follows_the_way_whatever_it_passes_and_looks_around_at_its_end() -> None:
    """The patch beside the way is not its business; the one at the frontier is, once the way ends."""
    lattice = row_of(SIZE, {2: 0.69, 9: 0.69})
    bench = Bench(lattice, "hfe", hfe={"look_radius_m": 2.0})
    led = leading_to(lattice, 4, 11)
    way = bench.ask(4, led)
    assert (way.phase, columns(way)) == (LocalPhase.GUIDE, list(range(4, 12)))
    look = bench.ask(11, led)
    assert look.phase is LocalPhase.COVER
    assert columns(look) == [11, 10]
    assert bench.ask(10, led, heading=4).phase is LocalPhase.COVER, (
        "it does not go back to the end of the way first"
    )


def test_hfe_is_led_on_by_a_new_target_and_does_nothing_without_one() -> None:
    lattice = row_of(SIZE, {9: 0.69})
    bench = Bench(lattice, "hfe", hfe={"look_radius_m": 2.0})
    led = leading_to(lattice, 4, 11)
    assert bench.ask(11, led).phase is LocalPhase.COVER
    other = leading_to(lattice, 11, 2).model_copy(update={"target": 8})
    back = bench.ask(11, other)
    assert (back.phase, columns(back)) == (LocalPhase.GUIDE, list(range(11, 1, -1)))
    assert Bench(lattice, "hfe").ask(4).phase is LocalPhase.NONE
    assert Bench(lattice, "hfe").ask(4, global_policy([])).phase is LocalPhase.NONE


def test_hfe_that_sees_nothing_to_look_at_stands_still() -> None:
    lattice = row_of(SIZE, {2: 0.69})
    bench = Bench(lattice, "hfe", hfe={"look_radius_m": 2.0})
    assert bench.ask(11, leading_to(lattice, 4, 11)).phase is LocalPhase.NONE


@pytest.mark.parametrize("planner", ["nbv", "hfe"])
def test_a_restored_stage_answers_as_the_other_would(planner: str) -> None:
    lattice = random_lattice(9, SIZE, 2, covered_share=0.6)
    one, other = Bench(lattice, planner), Bench(lattice, planner)
    led = leading_to(lattice, 84, 20)
    first = one.ask(84, led)
    one.ask(20, led)
    other.stage.restore(one.stage.snapshot())
    other.episode = one.episode
    a, b = one.ask(60, led), other.ask(60, led)
    assert first.episode == 1
    np.testing.assert_array_equal(a.path_lattice, b.path_lattice)
    assert (a.phase, a.reason) == (b.phase, b.reason)
