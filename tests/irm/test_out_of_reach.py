"""What is seen and cannot be got to is told by its nearest place; what may have a way is not."""

from __future__ import annotations

import math

import pytest

from planning.coverage import LOG_2
from planning.frames import Planar
from planning.grid import UNKNOWN
from services.irm.config import Config
from services.irm.keyframes import Anchor
from services.irm.out_of_reach import OutOfReach, closed_off
from services.irm.window import Window
from tests.irm.worlds import RADIUS_M, Belief, Flat, two_rooms

AT = (-2.5, 0.0)


def seen(flat: Flat) -> Window:
    return Belief.new(Config(), 0.1).window(flat.risk_map(*AT), *AT)


def test_a_room_behind_a_slit_is_closed_off_and_one_behind_a_door_is_not() -> None:
    ((x, y, area_m2, fenced),) = closed_off(seen(two_rooms(door_m=0.3)), RADIUS_M, RADIUS_M)
    assert -0.1 <= x <= 0.3 and abs(y) <= 0.2, "named by the slit"
    assert area_m2 == pytest.approx(25.0, abs=0.3)
    assert not fenced
    assert closed_off(seen(two_rooms(door_m=1.0)), RADIUS_M, RADIUS_M) == []


def test_where_the_wall_is_not_known_there_may_be_a_way() -> None:
    flat = two_rooms(door_m=0.3).fill(-0.1, -2.5, 0.3, -1.5, UNKNOWN)
    assert closed_off(seen(flat), RADIUS_M, RADIUS_M) == []


def test_corners_that_the_body_does_not_fit_into_are_not_worth_a_word() -> None:
    flat = two_rooms(door_m=0.3).fill(1.0, -2.5, 5.2, 2.5, 2)
    assert closed_off(seen(flat.fill(0.2, 1.0, 1.0, 2.5, 2)), RADIUS_M, RADIUS_M)
    assert not closed_off(
        seen(flat.fill(0.2, -0.6, 1.0, 2.5, 2).fill(0.2, -2.5, 1.0, -1.6, 2)), RADIUS_M, RADIUS_M
    )


def test_places_stay_when_the_window_has_rolled_on_and_go_where_their_keyframe_goes() -> None:
    places = OutOfReach(1.0)
    flat = two_rooms(door_m=0.3)
    anchor = Anchor(3, Planar(1.0, 0.0, 0.0))
    for _ in range(2):
        places.update(seen(flat), RADIUS_M, RADIUS_M, anchor)
    (place,) = places.places
    assert place.gain == pytest.approx(25.0 * LOG_2, rel=0.02)
    far = Belief.new(Config(), 0.1).window(flat.risk_map(-4.0, 0.0, window_m=2.0), -4.0, 0.0)
    places.update(far, RADIUS_M, RADIUS_M, anchor)
    assert places.places == [place]
    before = place.x_m, place.y_m
    places.follow({3: Planar(1.0, 0.5, 0.0), 4: Planar(9.0, 9.0, 0.0)})
    assert math.dist(before, (place.x_m, place.y_m)) == pytest.approx(0.5)
    other = OutOfReach(1.0)
    other.set_state(places.state())
    assert other.places == places.places
    places.follow({3: anchor.pose})
    places.update(seen(two_rooms(door_m=1.0)), RADIUS_M, RADIUS_M, anchor)
    assert places.places == [], "a way was found"
