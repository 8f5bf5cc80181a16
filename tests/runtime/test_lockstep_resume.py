"""A lock-step mission that was stopped and resumed gives the same bytes as one that was not."""

from __future__ import annotations

from typing import Any

import pytest

from plgrim.runtime.lockstep import Lockstep
from schemas.contract import SECOND_NS
from schemas.errors import MalformedError
from schemas.snapshot import unpack_snapshot

OPTIONS: dict[str, dict[str, Any]] = {
    "sim": {"world": "subway_1x", "seed": 3},
    "reconciler": {"simulations": 256},
}


def test_a_resumed_run_gives_the_same_bytes() -> None:
    whole = Lockstep(OPTIONS, seed=3)
    taken = []
    for stop_ms in (500, 9_730, 16_210):
        whole.run_until(stop_ms * SECOND_NS // 1000)
        taken.append(whole.snapshot())
    whole.run_until(22 * SECOND_NS)
    last = whole.snapshot()
    for snapshot in taken[1:]:
        part = Lockstep(OPTIONS, seed=3)
        part.restore(snapshot)
        assert part.snapshot() == snapshot
        part.run_until(22 * SECOND_NS)
        assert part.digest() == whole.digest()
        ours, theirs = unpack_snapshot(part.snapshot()), unpack_snapshot(last)
        for name, runner in theirs["runners"].items():
            assert ours["runners"][name]["stage"] == runner["stage"], name
    assert part.dropped() == {}


def test_a_damaged_snapshot_is_refused() -> None:
    with pytest.raises(MalformedError):
        Lockstep(OPTIONS, seed=3).restore(b"\xc1 not a snapshot")
