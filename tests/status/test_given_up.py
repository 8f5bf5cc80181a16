"""Which frontiers are told as given up: each place once, though it comes and goes."""

from __future__ import annotations

from typing import Any

import numpy as np

from schemas.contract import SECOND_NS
from schemas.world import CoverageSummary
from services.status.events import GivenUp
from tests.status.scene import summary

WHY = "out of reach"


def listed(second: int, *places: tuple[float, float], why: str = WHY) -> CoverageSummary:
    """A summary that lists these places."""
    changes: dict[str, Any] = {
        "stamp_ns": second * SECOND_NS,
        "unreachable_xy_m": np.array(places, np.float64).reshape(-1, 2),
        "unreachable_reason": [why] * len(places),
    }
    return summary(1).model_copy(update=changes)


def test_a_place_that_comes_and_goes_by_a_few_centimetres_is_told_once() -> None:
    given_up = GivenUp()
    assert given_up.fresh(listed(1, (3.0, 4.0))) == [(3.0, 4.0, WHY)]
    for second in range(2, 600, 2):
        places = [(3.0 + 0.001 * second % 0.4, 4.1)] if second % 4 else []
        assert given_up.fresh(listed(second, *places)) == []
    assert given_up.fresh(listed(601, (5.0, 4.0))) == [(5.0, 4.0, WHY)], "another place"
    assert given_up.fresh(listed(602, (5.0, 4.0), why="nothing gained")) == [(5.0, 4.0, "nothing gained")]


def test_after_minutes_without_it_a_place_is_told_again() -> None:
    given_up = GivenUp()
    given_up.fresh(listed(1, (3.0, 4.0)))
    given_up.fresh(listed(100, (3.0, 4.0)))
    assert given_up.fresh(listed(279, (3.0, 4.0))) == []
    assert given_up.fresh(listed(460, (3.0, 4.0))) == [(3.0, 4.0, WHY)]


def test_a_snapshot_keeps_what_was_told() -> None:
    given_up, after = GivenUp(), GivenUp()
    given_up.fresh(listed(1, (3.0, 4.0)))
    after.set_state(given_up.state())
    assert after.fresh(listed(2, (3.0, 4.0))) == []
    after.set_state([[3.0, 4.0, WHY]])
    assert after.fresh(listed(3, (3.0, 4.0))) == [(3.0, 4.0, WHY)], "an older snapshot has no times"
