"""Lanes, budgets and meters, by stepping time."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plgrim.link.budget import Bucket, Meter
from plgrim.link.lanes import Lane, Parcel
from schemas.contract import SECOND_NS
from schemas.topics import COMMAND, GLOBAL_IRM, MISSION, ODOMETRY, PLAN, RISK_MAP

MS = SECOND_NS // 1000


def _lane(rate: float = 1e9, limit: int = 1000) -> Lane:
    every = frozenset({"irm/global_irm", "status/command"})
    return Lane(Bucket(rate), {}, every, frozenset({"irm/global_irm"}), limit)


def _drain(lane: Lane, now_ns: int = 0) -> list[bytes]:
    found = []
    while (parcel := lane.take(now_ns)[0]) is not None:
        found.append(parcel.payload)
    return found


def test_only_the_newest_of_a_topic_waits() -> None:
    lane = _lane()
    for number in range(100):
        lane.offer(Parcel(ODOMETRY, bytes([number])))
        lane.offer(Parcel(PLAN, bytes([number])))
    assert lane.waiting_bytes == 2
    assert _drain(lane) == [bytes([99]), bytes([99])]
    assert lane.replaced["sim/odometry"] == 99


def test_a_topic_that_is_replaced_often_starves_no_other() -> None:
    lane = _lane()
    lane.offer(Parcel(MISSION, b"m"))
    sent = []
    for number in range(10):
        lane.offer(Parcel(ODOMETRY, bytes([number])))
        parcel, _ = lane.take(0)
        assert parcel is not None
        sent.append(parcel.topic.name)
    assert sent[0] == "mission/state"


def test_topics_of_which_every_message_counts_go_first_and_in_order() -> None:
    lane = _lane()
    lane.offer(Parcel(ODOMETRY, b"o"))
    for payload in (b"1", b"2", b"3"):
        lane.offer(Parcel(COMMAND, payload))
    assert _drain(lane) == [b"1", b"2", b"3", b"o"]


def test_full_queues_drop_the_oldest_but_differences_all() -> None:
    lane = _lane(limit=10)
    for number in range(15):
        lane.offer(Parcel(COMMAND, bytes([number])))
        lane.offer(Parcel(GLOBAL_IRM, bytes([number])))
    assert lane.dropped == {"status/command": 5, "irm/global_irm": 11}
    assert _drain(lane) == [bytes([n]) for n in (*range(5, 15), *range(11, 15))]


def test_a_whole_is_never_dropped_and_its_differences_follow_it() -> None:
    """A graph larger than what may wait: a reader that asked for it and never got it would ask for ever."""
    lane = _lane(limit=100)
    lane.offer(Parcel(GLOBAL_IRM, b"d" * 90))
    lane.offer(Parcel(GLOBAL_IRM, b"W" * 300, whole=True))
    assert lane.dropped["irm/global_irm"] == 0, "what the whole contains is not lost"
    for number in range(3):
        lane.offer(Parcel(GLOBAL_IRM, bytes([number]) * 30))
    assert [payload[:1] for payload in _drain(lane)] == [b"W", b"\x00", b"\x01", b"\x02"]

    lane.offer(Parcel(GLOBAL_IRM, b"W" * 300, whole=True))
    for number in range(5):
        lane.offer(Parcel(GLOBAL_IRM, bytes([number]) * 30))
    assert [payload[:1] for payload in _drain(lane)] == [b"W", b"\x04"], "differences go, the whole stays"
    assert lane.dropped["irm/global_irm"] == 4


def test_of_two_wholes_the_newer_waits() -> None:
    lane = _lane(limit=10)
    for name in (b"1", b"2"):
        lane.offer(Parcel(GLOBAL_IRM, name * 300, whole=True))
        lane.offer(Parcel(GLOBAL_IRM, name))
    assert _drain(lane) == [b"2" * 300, b"2"]


def test_what_was_put_back_comes_first_of_its_topic_and_holds_no_other() -> None:
    lane = _lane()
    for payload in (b"1", b"2"):
        lane.offer(Parcel(COMMAND, payload))
    first = lane.take(0)[0]
    assert first is not None
    lane.put_back(first, 100 * MS)
    lane.offer(Parcel(ODOMETRY, b"o"))
    assert _drain(lane, 0) == [b"o"]
    assert lane.take(60 * MS) == (None, 40 * MS)
    assert _drain(lane, 100 * MS) == [b"1", b"2"]


@given(st.lists(st.tuples(st.integers(0, 500), st.integers(1, 50_000)), min_size=1, max_size=60))
def test_a_budget_is_kept_over_any_time(messages: list[tuple[int, int]]) -> None:
    bucket, now_ns, sent = Bucket(10_000.0), 0, []
    for wait_ms, size in messages:
        now_ns += wait_ms * MS
        if bucket.wait_ns(now_ns) == 0:
            bucket.spend(size, now_ns)
            sent.append((now_ns, size))
    for first, (began_ns, _) in enumerate(sent):
        for last in range(first, len(sent)):
            spent = sum(size for _, size in sent[first : last + 1])
            seconds = (sent[last][0] - began_ns) / SECOND_NS
            assert spent <= 10_000 * seconds + 5_000 + sent[last][1] + 1


def test_the_time_that_take_names_is_enough() -> None:
    lane = _lane(rate=1000.0)
    lane.topic_budgets["riskmap/risk_map"] = Bucket(100.0)
    lane.offer(Parcel(RISK_MAP, b"a"))
    assert lane.take(0)[0] is not None
    lane.spent("riskmap/risk_map", 400, 0)
    lane.offer(Parcel(RISK_MAP, b"b"))
    parcel, wait_ns = lane.take(0)
    assert parcel is None
    assert wait_ns == pytest.approx(3.5 * SECOND_NS, rel=0.01)
    assert lane.take(wait_ns - 10 * MS)[0] is None
    assert lane.take(wait_ns)[0] is not None
    assert lane.take(wait_ns) == (None, -1)


def test_a_topic_over_its_budget_does_not_hold_the_others() -> None:
    lane = _lane()
    lane.topic_budgets["riskmap/risk_map"] = Bucket(100.0)
    lane.spent("riskmap/risk_map", 1000, 0)
    lane.offer(Parcel(RISK_MAP, b"map"))
    lane.offer(Parcel(PLAN, b"plan"))
    assert _drain(lane) == [b"plan"]


def test_the_meter_forgets() -> None:
    meter = Meter()
    for second in range(10):
        meter.count("a", 2000, second * SECOND_NS)
    meter.count("b", 500, 0)
    assert meter.kb_per_s(9 * SECOND_NS) == {"a": pytest.approx(2.4)}
    assert meter.kb_per_s(60 * SECOND_NS) == {}
    assert meter.total == {"a": 20_000, "b": 500}
