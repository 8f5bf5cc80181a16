"""Frontiers at the edge of the unseen, and which frontiers are kept, waited for, and given up."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from planning.coverage import LOG_2
from planning.grid import FREE, LETHAL, UNKNOWN
from schemas.snapshot import pack_snapshot, unpack_snapshot
from services.irm.borders import Found, beside, find_frontiers, least_gain
from services.irm.config import Config
from services.irm.frontiers import Frontier, FrontierManager
from services.irm.window import Window, solid
from tests.irm.worlds import Belief, room

SECOND = 10**9
RES = 0.2
ROBOT = (-6.0, 2.5)


class Scene:
    """A corridor of 16 x 3 m that the robot has covered up to some x, and its frontiers."""

    def __init__(self, covered_to_m: float = 99.0, **changes: float) -> None:
        self.config = Config.model_validate({"opening_range_m": 12.0, **changes})
        self.belief, self.flat = Belief.new(self.config, RES), room(-8.0, 1.0, 8.0, 4.0, RES)
        self.manager, self.rounds, self.next_id = FrontierManager(self.config), 0, 1
        x, _ = np.meshgrid(self.flat.spec.centres_x(), self.flat.spec.centres_y())
        self.belief.cover(self.flat.spec, x < covered_to_m)

    def window(self) -> Window:
        return self.belief.window(self.flat.risk_map(), *ROBOT)

    def find(self) -> list[Found]:
        return find_frontiers(self.window(), self.config)

    def round(self, robot: tuple[float, float] = ROBOT, ground_m2: float = 0.0) -> dict[int, Frontier]:
        """One update, a second after the last one."""
        self.next_id = self.manager.update(
            self.window(), robot, self.rounds * SECOND, 1.0, self.next_id, ground_m2
        )
        self.rounds += 1
        return self.manager.frontiers

    def only(self) -> Frontier:
        (frontier,) = self.manager.frontiers.values()
        return frontier

    def pursue(self, distance_m: float) -> None:
        """The global planner's target is the only frontier."""
        self.manager.pursue(self.only().node_id, distance_m, self.rounds * SECOND, 1.0)

    def forget(self, x_low: float, x_high: float) -> None:
        """The risk map knows nothing any more between two x."""
        self.flat.fill(x_low, 0.9, x_high, 4.1, UNKNOWN)


# --- the edge of the unseen ---------------------------------------------------------------------------------------


def test_beside_is_a_side_in_common() -> None:
    mask = np.zeros((5, 6), np.bool_)
    mask[2, 3] = mask[0, 0] = True
    expected = {(1, 3), (3, 3), (2, 2), (2, 4), (0, 1), (1, 0)}
    assert set(map(tuple, np.argwhere(beside(mask)).tolist())) == expected


def test_solid_leaves_out_single_cells_and_thin_lines() -> None:
    unseen = np.zeros((12, 12), np.bool_)
    unseen[1, 1] = True
    unseen[4, :] = True
    assert not solid(unseen).any()
    unseen[7:10, 7:10] = True
    assert set(map(tuple, np.argwhere(solid(unseen)).tolist())) == {
        (8, 8), (7, 8), (9, 8), (8, 7), (8, 9),
    }  # fmt: skip
    assert solid(np.ones((3, 3), np.bool_)).all(), "beyond the window's edge it goes on"


def test_covered_ground_at_the_edge_of_the_unseen_is_a_frontier_and_beside_a_wall_is_none() -> None:
    scene = Scene()
    assert scene.find() == []
    scene = Scene()
    scene.flat.fill(4.0, 0.0, 9.0, 5.0, UNKNOWN)  # the corridor's end was not seen: no wall
    found = scene.find()
    assert len(found) == 1
    x, y, gain, _ = found[0]
    assert 3.0 < x < 4.0 and 1.0 < y < 4.0
    width_m = gain / LOG_2 / scene.config.opening_depth_m
    assert 2.0 <= width_m <= 3.0, "of the corridor, where the robot's centre fits"


def test_a_ragged_edge_of_the_unseen_is_one_opening() -> None:
    """Beams end where they end: every other row of cells is seen two cells farther."""
    scene = Scene()
    scene.flat.fill(4.0, 0.0, 9.0, 5.0, UNKNOWN)
    for row in range(4):
        low = 1.4 + 0.6 * row
        scene.flat.fill(4.0, low, 4.4, low + 0.2, FREE)
    found = scene.find()
    assert len(found) == 1
    assert found[0].gain > 2.0 * LOG_2 * scene.config.opening_depth_m, "most of the corridor's width"


@pytest.mark.parametrize(("most", "gain"), [(2.0, 2.0), (1.0, 1.0), (0.1, 0.4)])
def test_the_unseen_counts_up_to_a_limit_and_at_least_as_an_opening(most: float, gain: float) -> None:
    scene = Scene(unknown_max_gain=most, frontier_enough_gain=0.4)
    scene.flat.fill(4.0, 0.0, 9.0, 5.0, UNKNOWN)
    assert [g for _, _, g, _ in scene.find()] == [pytest.approx(gain)]


@pytest.mark.parametrize(("width_m", "found"), [(0.2, 0), (0.4, 0), (0.8, 1), (1.2, 1)])
def test_an_opening_that_the_robot_fits_is_a_frontier_however_large_the_world(
    width_m: float, found: int
) -> None:
    """A beam passes through each of them; the robot, 0.5 m wide, through the wider ones (whole cells of 0.2 m)."""
    scene = Scene()
    scene.flat.fill(4.0, 0.0, 9.0, 5.0, UNKNOWN)
    scene.flat.fill(4.0, 0.8, 4.2, 4.2, LETHAL)
    scene.flat.fill(4.0, 2.4, 4.2, 2.4 + width_m, FREE)
    scene.belief.cover(scene.flat.spec, scene.flat.state == FREE)
    assert len(scene.round(ground_m2=1e5)) == found


def test_frontiers_of_doubtful_place_are_judged_when_the_robot_is_beside_them() -> None:
    scene = Scene(covered_to_m=2.0, opening_range_m=5.0, missed_rounds=2)
    scene.round()
    name, place = scene.only().node_id, (scene.only().x_m, scene.only().y_m)
    scene.only().keyframe = 7
    scene.belief.cover(scene.flat.spec, scene.flat.state == FREE)
    for robot, kept in ((ROBOT, True), ((place[0] - 3.0, 2.5), False)):
        window = scene.belief.window(scene.flat.risk_map(), *robot)
        for k in range(4):
            scene.manager.update(window, robot, k * SECOND, 1.0, 99, doubtful=frozenset({7}))
        assert (name in scene.manager.frontiers) is kept


def test_openings_are_looked_for_near_the_robot_and_kept_when_it_goes() -> None:
    """Far walls seen at a slant are full of holes; an opening seen from near by is one."""
    scene = Scene(opening_range_m=5.0)
    scene.flat.fill(4.0, 0.0, 9.0, 5.0, UNKNOWN)
    assert scene.find() == [], "10 m away"
    near = scene.belief.window(scene.flat.risk_map(), 1.0, 2.5)
    for k in range(3):
        scene.next_id = scene.manager.update(near, (1.0, 2.5), k * SECOND, 1.0, scene.next_id)
    name = scene.only().node_id
    for _ in range(20):
        scene.round()
    assert scene.only().node_id == name
    scene.flat.fill(4.0, 0.0, 9.0, 5.0, LETHAL)
    for _ in range(20):
        scene.round()
    assert scene.manager.frontiers == {}, "it is seen from afar that there is none"


def test_an_opening_that_was_seen_only_once_was_noise() -> None:
    for rounds, kept in ((1, 0), (3, 1)):
        scene = Scene(covered_to_m=-99.0, opening_rounds=3)
        scene.flat.fill(4.0, 0.0, 9.0, 5.0, UNKNOWN)
        looked = np.ones(scene.flat.spec.shape, np.bool_)
        looked[scene.flat.spec.cell_of(3.7, 2.5)] = (
            False  # a sliver: else it would be plain that nothing is left
        )
        scene.belief.cover(scene.flat.spec, looked)
        for _ in range(rounds + 1):
            scene.round()
        scene.flat.fill(4.0, 1.0, 4.2, 4.0, LETHAL)
        assert len(scene.round()) == kept


def test_an_opening_out_of_sight_stays_a_frontier_when_the_known_ground_grows() -> None:
    scene = Scene(unknown_max_gain=0.1)
    scene.flat.fill(4.0, 0.0, 9.0, 5.0, UNKNOWN)
    scene.round(ground_m2=50.0)
    name = scene.only().node_id
    away = scene.belief.window(scene.flat.risk_map(*ROBOT, window_m=6.0), *ROBOT)
    scene.manager.update(away, ROBOT, 9 * SECOND, 1.0, scene.next_id, 1e5)
    assert scene.only().node_id == name


def test_gaps_between_far_rays_are_no_frontier() -> None:
    scene = Scene()
    for row in range(0, scene.flat.state.shape[0], 2):
        line = scene.flat.state[row]
        line[line == FREE] = np.where(np.arange((line == FREE).sum()) > 40, UNKNOWN, FREE)
    assert (scene.flat.state == UNKNOWN).sum() > 100
    assert scene.find() == []


def test_ground_that_was_known_and_forgotten_is_no_edge_of_the_unseen() -> None:
    scene = Scene()
    assert scene.find() == []
    scene.forget(2.0, 9.0)
    assert scene.find() == []


# --- what is worth a trip -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ground_m2", "spacing_m", "least"),
    [
        (0.0, 1.0, 0.1),
        (100.0, 1.0, 0.1),
        (500.0, 1.0, 0.25 * LOG_2),
        (500.0, 0.8, 0.25 * LOG_2 / 0.64),
        (1e6, 1.0, 0.5),
    ],
)
def test_the_least_gain_is_a_share_of_the_known_ground_within_its_bounds(
    ground_m2: float, spacing_m: float, least: float
) -> None:
    config = Config(
        frontier_min_gain=0.1, frontier_min_share=0.0005, frontier_enough_gain=0.5, spacing_m=spacing_m
    )
    assert least_gain(config, ground_m2) == pytest.approx(least)


def test_in_a_large_world_little_ground_is_no_frontier_and_what_was_one_goes() -> None:
    scene = Scene()
    x, y = np.meshgrid(scene.flat.spec.centres_x(), scene.flat.spec.centres_y())
    corner = (x > 7.2) & (y > 3.2)
    scene = Scene(covered_to_m=-99.0)
    scene.belief.cover(scene.flat.spec, ~corner)
    scene.round(ground_m2=100.0)
    assert 0.1 < scene.only().gain < 0.45
    assert scene.round(ground_m2=1e5) == {}, "it is there still, but not worth a trip"
    assert scene.manager.given_up == []
    assert len(scene.round(ground_m2=100.0)) == 1


def test_the_window_may_be_elsewhere_when_a_frontier_becomes_too_little() -> None:
    scene = Scene(covered_to_m=2.0)
    scene.manager.frontiers = {k: Frontier(k, 500.0 + k, 0.0, gain) for k, gain in ((1, 0.3), (2, 0.6))}
    scene.next_id = 3
    assert {1, 2} <= set(scene.round(ground_m2=100.0))
    after = scene.round(ground_m2=1e5)
    assert 1 not in after and 2 in after


# --- which frontiers are kept -------------------------------------------------------------------------------------


def test_a_frontier_whose_place_the_risk_map_has_forgotten_is_kept_as_it_was() -> None:
    scene = Scene(covered_to_m=2.0)
    scene.round()
    before = (scene.only().node_id, scene.only().x_m, scene.only().y_m)
    scene.forget(-2.0, 9.0)
    for _ in range(3 * scene.config.missed_rounds):
        scene.round()
    assert (scene.only().node_id, scene.only().x_m, scene.only().y_m) == before
    assert scene.manager.given_up == []


def test_a_frontier_that_is_cut_off_is_waited_for_and_keeps_its_name() -> None:
    scene = Scene(covered_to_m=2.0, missed_rounds=5)
    scene.round()
    name = scene.only().node_id
    scene.flat.fill(-2.0, 0.9, -1.6, 4.1, LETHAL)  # someone stands in the way
    for missed in range(1, 6):
        scene.round()
        assert (scene.only().node_id, scene.only().missed) == (name, missed)
    scene.flat.fill(-2.0, 1.0, -1.6, 4.0, FREE)
    scene.round()
    assert (scene.only().node_id, scene.only().missed) == (name, 0)
    assert scene.manager.given_up == []


def test_a_frontier_that_stays_cut_off_is_given_up_with_its_reason() -> None:
    scene = Scene(covered_to_m=2.0, missed_rounds=5)
    scene.round()
    scene.flat.fill(-2.0, 0.9, -1.6, 4.1, LETHAL)
    for _ in range(5):
        assert len(scene.round()) == 1
    assert scene.round() == {}
    assert ["cut off" in g.reason for g in scene.manager.given_up] == [True]


def test_a_frontier_of_which_a_sliver_is_left_within_reach_goes_without_a_word() -> None:
    """Nothing is given up there: what is left is too thin to be ground to cover."""
    scene = Scene(covered_to_m=2.0, missed_rounds=5)
    scene.round()
    row, column = scene.flat.spec.cell_of(scene.only().x_m, scene.only().y_m)
    sliver = np.ones(scene.flat.spec.shape, np.bool_)
    sliver[row, column] = False
    scene.belief.cover(scene.flat.spec, sliver)
    for _ in range(5):
        assert len(scene.round()) == 1
    assert scene.round() == {}
    assert scene.manager.given_up == []


def test_time_beside_a_frontier_begins_anew_when_its_place_moves() -> None:
    """A robot that moves on with the border is not standing beside it in vain, though no gain shrinks."""
    times = {}
    for step_m in (0.0, 0.8):
        scene = Scene(covered_to_m=-4.0, give_up_s=3.0)
        x, _ = np.meshgrid(scene.flat.spec.centres_x(), scene.flat.spec.centres_y())
        scene.round()
        for k in range(3):
            cells: NDArray[np.bool_] = x < -4.0 + step_m * k
            scene.belief.cover(scene.flat.spec, cells)
            scene.round()
            scene.round((scene.only().x_m, scene.only().y_m))
        times[step_m] = scene.only().beside_s
    assert times[0.0] == 3.0
    assert times[0.8] <= 1.0


# --- targets ------------------------------------------------------------------------------------------------------


def test_a_target_that_comes_no_nearer_is_given_up() -> None:
    scene = Scene(covered_to_m=2.0, pursue_s=5.0, second_chance_gain=99.0)
    scene.round()
    place = (scene.only().x_m, scene.only().y_m)
    scene.pursue(10.0)
    for k in range(5):
        scene.pursue(9.6 + 0.1 * k)  # up and down, but never half a metre nearer
        scene.round()
    assert len(scene.manager.frontiers) == 1
    scene.pursue(10.0)
    assert scene.manager.frontiers == {}
    (given_up,) = scene.manager.given_up
    assert (given_up.x_m, given_up.y_m) == place
    assert "no nearer" in given_up.reason
    assert given_up.until_ns == scene.rounds * SECOND + int(scene.config.retry_after_s * 1e9)
    assert all(math.dist(place, (f.x_m, f.y_m)) > 1.0 for f in scene.round().values())


def test_much_to_gain_is_tried_once_more_when_nothing_else_is_left() -> None:
    scene = Scene(covered_to_m=2.0, pursue_s=5.0, second_chance_gain=0.2)
    scene.round()
    place = (scene.only().x_m, scene.only().y_m)
    for chance in (False, True):
        assert scene.only().again is chance
        for _ in range(7):
            if scene.manager.frontiers:
                scene.pursue(10.0)
        assert scene.manager.frontiers == {}
        scene.round()
    (given_up,) = scene.manager.given_up
    assert (given_up.x_m, given_up.y_m) == place and given_up.again
    assert scene.round() == {}, "not a third time"


def test_no_second_chance_while_there_is_something_else_or_for_little() -> None:
    for config, others in (({"second_chance_gain": 0.2}, True), ({"second_chance_gain": 99.0}, False)):
        scene = Scene(covered_to_m=2.0, pursue_s=5.0, **config)
        scene.round()
        name = scene.only().node_id
        for _ in range(7):
            if name in scene.manager.frontiers:
                scene.pursue(10.0)
        if others:
            scene.manager.frontiers[99] = Frontier(99, 500.0, 0.0, 9.0)
        scene.round()
        assert set(scene.manager.frontiers) == ({99} if others else set())
        assert len(scene.manager.given_up) == 1


def test_progress_elsewhere_takes_the_time_of_a_pursuit_back() -> None:
    scene = Scene(covered_to_m=2.0, pursue_s=5.0)
    scene.round()
    for _ in range(5):
        for _ in range(4):
            scene.pursue(10.0)
            scene.round()
        scene.manager.progressed()
    assert len(scene.manager.frontiers) == 1


def test_a_target_that_comes_nearer_is_not_given_up() -> None:
    scene = Scene(covered_to_m=2.0, pursue_s=5.0)
    scene.round()
    for k in range(30):
        scene.pursue(100.0 - 0.2 * k)  # half a metre every third second
        scene.round()
    assert len(scene.manager.frontiers) == 1 and scene.manager.given_up == []


def test_a_target_that_shrinks_is_not_pursued_in_vain() -> None:
    """Seen from afar it is covered piece by piece: the robot need not come nearer."""
    scene = Scene(covered_to_m=2.0, pursue_s=8.0, frontier_block_m=50.0, frontier_same_m=10.0)
    x, _ = np.meshgrid(scene.flat.spec.centres_x(), scene.flat.spec.centres_y())
    scene.round()
    gain = scene.only().gain
    for k in range(7):
        scene.belief.cover(scene.flat.spec, x > 7.5 - 0.7 * k)
        for _ in range(3):
            scene.pursue(10.0)
            scene.round()
    assert scene.only().gain < 0.5 * gain and scene.only().nearest_m == 10.0
    assert scene.manager.given_up == []


def test_what_is_no_frontier_is_not_pursued() -> None:
    scene = Scene(covered_to_m=2.0, pursue_s=1.0)
    scene.round()
    for _ in range(9):
        scene.manager.pursue(12345, 10.0, 0, 1.0)
    assert len(scene.manager.frontiers) == 1


def test_a_snapshot_keeps_how_long_a_target_was_pursued_and_a_frontier_missed() -> None:
    scene = Scene(covered_to_m=2.0, missed_rounds=4, pursue_s=8.0)
    scene.round()
    scene.flat.fill(-2.0, 0.9, -1.6, 4.1, LETHAL)
    scene.pursue(10.0)
    for _ in range(3):
        scene.pursue(10.0)
        scene.round()
    other = FrontierManager(scene.config)
    other.set_state(unpack_snapshot(pack_snapshot(scene.manager.state())))
    assert other.frontiers == scene.manager.frontiers
    assert (scene.only().missed, scene.only().pursued_s, scene.only().nearest_m) == (3, 3.0, 10.0)
