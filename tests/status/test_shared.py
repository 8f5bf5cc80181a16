"""The status that many ask for is made once for all of them."""

from __future__ import annotations

from services.status.config import Config
from services.status.shared import SharedStatus
from tests.status.test_app import Clock


def test_those_who_ask_within_a_tenth_of_a_second_get_one_and_the_same_status() -> None:
    clock = Clock()
    shared = SharedStatus(Config(), "husky1", clock)
    first = shared.status()
    clock.now_ns += 60_000_000
    assert shared.status() is first
    clock.now_ns += 60_000_000
    later = shared.status()
    assert later is not first
    clock.now_ns -= 10**9  # a clock that was set back makes no status eternal
    assert shared.status() is not later
