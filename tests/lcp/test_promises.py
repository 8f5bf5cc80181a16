"""A patch that is promised too often and stays uncovered is left alone for a while."""

from __future__ import annotations

from schemas.contract import SECOND_NS
from schemas.snapshot import pack_snapshot, unpack_snapshot
from services.lcp.promises import Promises

HERE, THERE = (3, -7), (4, 2)


def promised(rounds: int, promises: Promises, entropy: float = 0.5) -> set[tuple[int, int]]:
    for k in range(rounds):
        promises.note(k * SECOND_NS, [HERE], {HERE: entropy, THERE: 0.3})
    return promises.left_alone(rounds * SECOND_NS, {HERE: entropy, THERE: 0.3})


def test_a_patch_may_be_promised_so_often_and_no_more() -> None:
    assert promised(5, Promises(5.0, 100.0)) == set()
    assert promised(6, Promises(5.0, 100.0)) == {HERE}


def test_it_comes_back_after_its_rest_or_when_it_changes() -> None:
    promises = Promises(5.0, 100.0)
    promised(6, promises)
    assert promises.left_alone(104 * SECOND_NS, {HERE: 0.5}) == {HERE}
    assert promises.left_alone(105 * SECOND_NS, {HERE: 0.5}) == set()
    promised(6, promises)
    assert promises.left_alone(7 * SECOND_NS, {HERE: 0.2}) == set()


def test_a_patch_out_of_view_rests_on() -> None:
    promises = Promises(5.0, 100.0)
    promised(6, promises)
    assert promises.left_alone(50 * SECOND_NS, {}) == {HERE}


def test_what_gets_covered_bit_by_bit_is_no_broken_promise() -> None:
    promises = Promises(5.0, 100.0)
    for k in range(30):
        promises.note(k, [HERE], {HERE: 0.6 * 0.9**k})
    assert promises.left_alone(31, {HERE: 0.6 * 0.9**30}) == set()


def test_a_planner_that_wavers_between_two_breaks_both_promises() -> None:
    promises = Promises(5.0, 100.0)
    for k in range(20):
        promises.note(k, [HERE if k % 2 else THERE], {HERE: 0.5, THERE: 0.5})
    assert promises.left_alone(21, {HERE: 0.5, THERE: 0.5}) == {HERE, THERE}


def test_old_promises_are_forgotten() -> None:
    promises = Promises(5.0, 100.0)
    promised(5, promises)
    for k in range(60):
        promises.note(k, [], {HERE: 0.5})
    promised(5, promises)
    assert promises.left_alone(60, {HERE: 0.5}) == set()


def test_a_snapshot_holds_counts_and_rests() -> None:
    one, other = Promises(5.0, 100.0), Promises(5.0, 100.0)
    promised(6, one)
    one.note(8, [THERE], {THERE: 0.3})
    other.set_state(unpack_snapshot(pack_snapshot(one.state())))
    assert other.state() == one.state()
    assert other.left_alone(9, {HERE: 0.5}) == {HERE}
