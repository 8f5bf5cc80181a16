"""Tours of small worlds: all covered, on the ground, whole; the score is the judge's; cached; compared."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from plgrim.cli import application
from plgrim.evaluation import tour as tours
from plgrim.evaluation.known_ground import KnownGround
from plgrim.evaluation.tour import Tour, TourError, compare, make_tour, peer_tour, tour_judge, tour_world
from plgrim.evaluation.tour_drive import drive_tour
from plgrim.evaluation.tour_plan import Stretch, TourPlanner, speed_limit_mps
from plgrim.progress import summary_table
from services.sim.config import SimConfig
from services.sim.world import World
from tests.evaluation.worlds import CONFIG, rooms, silent

_WALLS = ((6.0, 0.0, 6.2, 7.0), (12.0, 2.0, 12.2, 9.0), (12.0, 4.0, 16.0, 4.2))


@pytest.fixture(scope="module")
def flat() -> tuple[World, Tour]:
    world = rooms(18.0, 9.0, _WALLS)
    return world, make_tour(world, CONFIG, 300.0, silent, ((1.0, 0.2, 0.04),))


def test_a_small_flat_world_is_covered_whole(flat: tuple[World, Tour]) -> None:
    world, tour = flat
    assert tour.finished
    assert tour.covered_m2[-1] == pytest.approx(tour.reachable_m2, abs=0.02)
    assert tour.reachable_m2 == tour_judge(world, CONFIG).reachable_area_m2
    assert tour.contacts == tour.skipped == 0
    assert 2 <= tour.viewpoints <= 20
    assert tour.two_opt_m <= tour.nearest_neighbour_m


def test_the_score_is_the_judges_for_the_same_poses(flat: tuple[World, Tour]) -> None:
    world, tour = flat
    judge = tour_judge(world, CONFIG)
    for x_m, y_m, yaw_rad, covered_m2 in zip(
        tour.x_m.tolist(), tour.y_m.tolist(), tour.yaw_rad.tolist(), tour.covered_m2.tolist(), strict=True
    ):
        judge.update(x_m, y_m, yaw_rad)
        assert judge.covered_area_m2 == covered_m2


def test_the_tour_stays_where_the_robot_fits(flat: tuple[World, Tour]) -> None:
    world, tour = flat
    judge = tour_judge(world, CONFIG)
    ground = KnownGround(judge.spec, judge.roamed)
    assert (ground.margin_at(np.stack([tour.x_m, tour.y_m], axis=1)) > 0.0).all()


def test_it_keeps_the_robots_limits(flat: tuple[World, Tour]) -> None:
    _, tour = flat
    steps_s = np.diff(tour.time_s)
    assert steps_s == pytest.approx(1.0 / CONFIG.coverage_sensor.rate_hz)
    speed = np.hypot(np.diff(tour.x_m), np.diff(tour.y_m)) / steps_s
    turn = np.abs(np.array([math.remainder(t, math.tau) for t in np.diff(tour.yaw_rad)])) / steps_s
    assert speed.max() <= CONFIG.robot.max_speed_mps + 1e-6
    assert speed.max() > 0.95 * CONFIG.robot.max_speed_mps
    assert turn.max() <= CONFIG.robot.max_turn_rate_radps + 1e-6
    assert np.abs(np.diff(speed)).max() <= CONFIG.robot.max_acceleration_mps2 * 0.101


def test_it_is_the_same_every_time(flat: tuple[World, Tour]) -> None:
    world, tour = flat
    again = make_tour(world, CONFIG, 300.0, silent, ((1.0, 0.2, 0.04),))
    assert again.x_m.tobytes() == tour.x_m.tobytes()
    assert again.covered_m2.tobytes() == tour.covered_m2.tobytes()


def test_with_less_time_less_is_driven_and_the_best_of_several_tours_is_taken() -> None:
    world = rooms(18.0, 9.0, _WALLS)
    one = make_tour(world, CONFIG, 12.0, silent, ((0.05,),))
    best = make_tour(world, CONFIG, 12.0, silent, ((0.05,), (10.0, 0.5)))
    assert not best.finished
    assert best.time_s[-1] == pytest.approx(12.0)
    assert best.covered_m2[-1] >= one.covered_m2[-1]
    assert best.covered_at(6.0) < best.covered_at(12.0) == best.covered_at(99.0) < best.reachable_m2


def test_rough_ground_is_gone_round_and_does_not_lose_the_robot() -> None:
    """A pit with sheer sides, a boulder, and a ramp that is too steep to climb."""
    x, y = np.meshgrid((np.arange(120) + 0.5) * 0.1, (np.arange(80) + 0.5) * 0.1)
    floor = np.where(np.hypot(x - 4.0, y - 4.0) < 1.0, -1.0, 0.0)
    floor += 0.7 * (np.hypot(x - 8.0, y - 2.5) < 0.6) + 1.2 * np.maximum(x - 10.0, 0.0)
    world = rooms(12.0, 8.0, floor_m=floor.astype(np.float32))
    tour = make_tour(world, CONFIG, 200.0, silent, ((0.5, 0.1),))
    assert tour.finished
    assert tour.contacts == 0
    assert tour.covered_m2[-1] > 0.99 * tour.reachable_m2
    assert np.hypot(tour.x_m - 4.0, tour.y_m - 4.0).min() > 1.2
    assert tour.x_m.max() < 10.3


def test_a_passage_barely_wider_than_the_robot_is_driven_in_its_middle() -> None:
    world = rooms(9.0, 4.0, walls=((4.0, 0.0, 5.0, 1.7), (4.0, 2.3, 5.0, 4.0)))
    tour = make_tour(world, CONFIG, 120.0, silent, ((0.5, 0.05),))
    assert tour.contacts == tour.skipped == 0
    assert tour.covered_m2[-1] > 0.99 * tour.reachable_m2
    assert np.abs(tour.y_m[(tour.x_m > 4.2) & (tour.x_m < 4.8)] - 2.0).max() < 0.05


def test_a_robot_that_is_held_goes_on_with_what_comes_next() -> None:
    """The planned way leads through a wall: given up, and the next stretch driven from where it stands."""
    world = rooms(9.0, 4.0, walls=((4.0, 0.0, 4.2, 3.0),))
    judge = tour_judge(world, CONFIG)
    ground = KnownGround(judge.spec, judge.roamed)
    through = Stretch(np.array([[1.0, 1.0], [3.5, 1.0], [7.0, 1.0]]), None)
    back = Stretch(np.array([[7.0, 1.0], [7.0, 3.0]]), 0.0)
    driven = drive_tour(world, CONFIG, judge, ground, [through, back], 200.0)
    assert driven.lost_reason == ""
    assert driven.contacts >= 1
    assert (driven.x_m[-1], driven.y_m[-1]) == pytest.approx((7.0, 3.0), abs=0.1)
    assert driven.yaw_rad[-1] == pytest.approx(0.0, abs=0.06)


def test_near_the_rim_it_is_slow_enough_to_survive_a_touch() -> None:
    speeds = speed_limit_mps(np.array([0.0, 0.1, 0.2, 0.3, 5.0]), 1.0)
    assert speeds[0] == speeds[1] < CONFIG.contact_lost_speed_mps < speeds[2] < speeds[3] == speeds[4] == 1.0
    assert speed_limit_mps(np.array([0.0]), 0.2) == 0.2


def test_nothing_is_gone_to_that_was_seen_on_the_way() -> None:
    world = tour_world(SimConfig(world="subway_1x"))
    judge = tour_judge(world, CONFIG)
    planner = TourPlanner(world, CONFIG, judge, KnownGround(judge.spec, judge.roamed), silent)
    plan = planner.rehearse((0.2,), 1e6)
    assert 1 <= len(plan.stops_m) < plan.viewpoints
    assert plan.covered_m2 > 0.95 * judge.reachable_area_m2
    assert planner.rehearse((0.2,), 5.0).time_s < plan.time_s


def test_ground_that_loses_the_robot_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    world = rooms(9.0, 4.0)
    seen: list[int] = []

    def drive(*arguments: object) -> object:
        ground = arguments[3]
        assert isinstance(ground, KnownGround)
        driven = drive_tour(*arguments)  # type: ignore[arg-type]
        seen.append(int(ground.roamed.sum()))
        lost = "tipped over" if len(seen) == 1 else ""
        return type(driven)(**{**vars(driven), "lost_reason": lost})

    monkeypatch.setattr(tours, "drive_tour", drive)
    tour = make_tour(world, CONFIG, 60.0, silent, ((1.0, 0.2),))
    assert len(seen) == 2
    assert seen[1] < seen[0]
    assert tour.covered_m2[-1] > 0.9 * tour.reachable_m2
    seen.clear()

    def lost_always(*arguments: object) -> object:
        seen.clear()
        return drive(*arguments)

    monkeypatch.setattr(tours, "drive_tour", lost_always)
    with pytest.raises(TourError, match="tipped over"):
        make_tour(world, CONFIG, 5.0, silent, ((1.0, 0.2),))


def test_movers_and_doors_are_left_out() -> None:
    assert tour_world(SimConfig(world="moving_person")).movers == ()
    assert tour_world(SimConfig(world="closing_door")).doors == ()


def test_a_peer_is_made_once_and_read_after(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLGRIM_CACHE_DIR", str(tmp_path))
    config = SimConfig(world="dead_end")
    first = peer_tour(config, 15.2, silent)
    assert first.time_s[-1] == pytest.approx(20.0)
    monkeypatch.setattr(tours, "make_tour", lambda *_: pytest.fail("the cache was not used"))
    second = peer_tour(config, 14.9, silent)
    assert second.covered_m2.tobytes() == first.covered_m2.tobytes()
    assert (second.viewpoints, second.finished) == (first.viewpoints, first.finished)
    assert type(second.viewpoints) is int
    assert type(second.finished) is bool
    slower = config.robot.model_copy(update={"max_speed_mps": 0.5})
    with pytest.raises(pytest.fail.Exception):
        peer_tour(config.model_copy(update={"robot": slower}), 14.9, silent)


def test_a_result_is_compared_with_the_tour_at_its_own_time(flat: tuple[World, Tour]) -> None:
    _, tour = flat
    compared = compare({"elapsed_s": 20.0, "covered_area_m2": 30.0, "seed": 4}, tour)
    assert compared["seed"] == 4
    assert compared["tour"]["covered_area_m2"] == tour.covered_at(20.0)
    assert compared["tour"]["ratio"] == 30.0 / tour.covered_at(20.0)
    json.dumps(compared)
    assert compare({"elapsed_s": None, "covered_area_m2": None}, tour)["tour"]["ratio"] is None


def test_the_table_of_a_mission_shows_both_areas(flat: tuple[World, Tour]) -> None:
    result = {
        "world": "rooms", "seed": 1, "finish": "covered", "finish_text": "", "coverage_judge": 0.9,
        "coverage_belief": 0.9, "distance_m": 10.0, "elapsed_s": 40.0, "target_switches": 0, "lost": False,
        "target_switches_per_100m": 0.0, "lost_reason": "", "contacts": 0, "restarts": {},
        "cloud_to_plan": {"p50_mission_s": 0.1, "p95_mission_s": 0.2}, "covered_area_m2": 41.0,
    }  # fmt: skip
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(summary_table(compare(result, flat[1])))
    text = console.export_text()
    assert "41 m2" in text
    assert f"{flat[1].covered_at(40.0):.0f} m2 in the same time" in text


def test_the_command_prints_and_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLGRIM_CACHE_DIR", str(tmp_path / "cache"))
    call = ["evaluate", "tour", "--world", "dead_end", "--time-budget", "30", "--out", str(tmp_path)]
    answer = CliRunner().invoke(application, call)
    assert answer.exit_code == 0, answer.output
    assert "covered in 30 s" in answer.output
    written = json.loads((tmp_path / "tour.json").read_text())
    assert written["time_s"] == 30.0
    assert written["track"]["time_s"][-1] <= 30.0
    assert written["track"]["covered_m2"][-1] <= written["covered_area_m2"] <= written["reachable_area_m2"]
    assert (tmp_path / "tour.png").stat().st_size > 1000
