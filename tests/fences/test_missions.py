"""Whole missions in lock-step: fences drawn on the way are obeyed by the true robot, bound it, can be taken away."""

from __future__ import annotations

from pathlib import Path

import pytest

from schemas.fences import FenceFrame, FenceKind
from schemas.operation import CommandKind, FinishReason, MissionCommand
from tests.fences.scene import Seen, box, command, fence, mission

EAST = (8.0, -1.0, 16.0, 9.0)
"""All of the east room with half of its door."""


NORTH = (0.0, 8.0, 8.0, 14.0)
DRIFT = {
    "slam": {
        "drift_fraction": 0.1,
        "drift_yaw_deg_per_10m": 4.0,
        "closure_min_path_m": 6.0,
        "closure_radius_m": 3.0,
        "closure_interval_m": 2.0,
    }
}
"""A poor SLAM: what it believes parts from the truth, and loop closures move `map` against `odom`."""


def draw(
    name: str, kind: FenceKind, *corners: float, frame: FenceFrame = FenceFrame.MAP, weight: float = 1.0
) -> MissionCommand:
    return command(name, CommandKind.FENCE, fences=[fence(kind, box(*corners), frame, weight=weight)])


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_no_go_polygon_drawn_on_the_way_is_never_entered(tmp_path: Path) -> None:
    run = mission(tmp_path, {4.0: draw("a", FenceKind.NO_GO, *EAST)})
    end = run.to_its_end()
    assert [answer.accepted for answer in run.seen.answers] == [True]
    assert run.seen.inside(*EAST, since_s=4.0) == 0
    assert end.finish == FinishReason.COVERED
    assert run.seen.inside(0.5, 8.5, 7.5, 13.5) > 0  # the north room was explored
    assert any("fence" in place.reason for place in end.left)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_geofence_bounds_a_mission_that_still_ends_covered(tmp_path: Path) -> None:
    run = mission(tmp_path, {0.5: draw("a", FenceKind.GEOFENCE, -1.0, -1.0, 8.0, 8.0)})
    end = run.to_its_end()
    assert end.finish == FinishReason.COVERED
    assert all(-1.0 < x < 8.0 and -1.0 < y < 8.0 for _, x, y in run.seen.track)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_ground_behind_a_fence_that_is_removed_is_explored(tmp_path: Path) -> None:
    script = {0.5: draw("a", FenceKind.NO_GO, *EAST), 22.0: command("b", CommandKind.UNFENCE)}
    run = mission(tmp_path, script)
    run.until(lambda seen: len(seen.answers) == 2, 40.0)
    assert run.seen.inside(*EAST) == 0
    end = run.to_its_end()
    assert end.finish == FinishReason.COVERED
    assert run.seen.inside(*EAST) > 0
    assert run.seen.coverage > 0.95


PARTING = {
    "slam": {
        "drift_fraction": 0.2,
        "drift_yaw_deg_per_10m": 10.0,
        "closure_min_path_m": 6.0,
        "closure_radius_m": 3.0,
        "closure_interval_m": 2.0,
    }
}
"""A SLAM so poor that the two frames part by decimetres while the mission lasts."""


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("frame", list(FenceFrame))
def test_a_no_go_polygon_is_obeyed_in_its_own_frame_while_the_frames_part(
    tmp_path: Path, frame: FenceFrame
) -> None:
    """By what the robot believes: it cannot know better. Margin: 0.1 m, by which a closure may move what was passed."""
    run = mission(tmp_path, {4.0: draw("a", FenceKind.NO_GO, *EAST, frame=frame)}, sim=PARTING)
    end = run.to_its_end()
    seen = run.seen
    assert [answer.accepted for answer in seen.answers] == [True]
    assert seen.drift_m() > 0.3, "the frames did not part: the test would show nothing"
    poses = seen.in_odom if frame == FenceFrame.ODOM else seen.in_map
    x0, y0, x1, y1 = EAST
    inside = [(t, x, y) for t, x, y in poses if t >= 5.0 and x0 + 0.1 < x < x1 and y0 < y < y1]
    assert inside == []
    assert end.finish == FinishReason.COVERED
    assert seen.inside(*NORTH) > 0


def _first_room(seen: Seen) -> str:
    for _, x, y in seen.track:
        if x > 8.5:
            return "east"
        if y > 8.5:
            return "north"
    return ""


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("name", "room"), [("east", EAST), ("north", NORTH)])
def test_the_room_in_a_priority_polygon_in_odom_is_entered_first(
    tmp_path: Path, name: str, room: tuple[float, float, float, float]
) -> None:
    wanted = draw("a", FenceKind.PRIORITY, *room, frame=FenceFrame.ODOM, weight=10.0)
    run = mission(tmp_path, {0.5: wanted}, sim=DRIFT)
    run.until(lambda seen: bool(_first_room(seen)), 200.0)
    assert _first_room(run.seen) == name


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_geofence_in_odom_bounds_a_mission_that_drifts(tmp_path: Path) -> None:
    bounds = draw("a", FenceKind.GEOFENCE, -1.0, -1.0, 8.0, 8.0, frame=FenceFrame.ODOM)
    run = mission(tmp_path, {0.5: bounds}, sim=DRIFT)
    end = run.to_its_end()
    assert end.finish == FinishReason.COVERED
    assert all(-1.0 < x < 8.0 and -1.0 < y < 8.0 for _, x, y in run.seen.in_odom)
