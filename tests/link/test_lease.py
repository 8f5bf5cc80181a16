"""The lease, by stepping time: takeover, hand-back, flapping, epochs."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from plgrim.link.lease import BASE, STANDBY, Lease, LeaseTimes

MS = 1_000_000
TIMES = LeaseTimes(2000 * MS, 1500 * MS)


def _run(lease: Lease, start_ms: int, end_ms: int, base: bool = True, standby: bool = True) -> list[int]:
    """Both beat every 500 ms; the times (ms) at which the lease changed hands."""
    changes = []
    for now_ms in range(start_ms, end_ms, 100):
        if base and now_ms % 500 == 0:
            lease.good(BASE, now_ms * MS)
        if standby and now_ms % 500 == 0:
            lease.good(STANDBY, now_ms * MS)
        if lease.tick(now_ms * MS):
            changes.append(now_ms)
    return changes


def _first_change(lease: Lease, start_ms: int, base: bool = True) -> int:
    """When the lease changes hands next, ms."""
    for now_ms in range(start_ms, start_ms + 60_000, 100):
        if changes := _run(lease, now_ms, now_ms + 100, base):
            return changes[0]
    raise AssertionError("the lease never changes hands")


def test_the_base_gets_the_lease_after_a_while_in_step() -> None:
    lease = Lease(TIMES, 7)
    assert _run(lease, 0, 1500) == []
    assert lease.holder == STANDBY
    assert _run(lease, 1500, 2000) == [1500]
    assert (lease.holder, lease.epoch) == (BASE, 8)


def test_silence_of_the_base_is_a_takeover_within_its_limit() -> None:
    lease = Lease(TIMES, 7)
    _run(lease, 0, 20_000)
    (taken,) = _run(lease, 20_000, 30_000, base=False)
    assert 19_500 + 2000 <= taken <= 19_500 + 2200
    assert (lease.holder, lease.epoch) == (STANDBY, 9)


def test_a_base_that_flaps_waits_longer_each_time_and_no_longer_than_eightfold() -> None:
    lease = Lease(TIMES, 1)
    waits = []
    now = 0
    for _ in range(7):
        back = _first_change(lease, now)
        waits.append(back - now)
        taken = _first_change(lease, back + 100, base=False)
        now = taken + 5000 - taken % 500
    assert waits[:4] == [1500, 3000, 6000, 12_000]
    assert waits[4:] == [12_000] * 3


def test_a_long_tenure_forgives() -> None:
    lease = Lease(TIMES, 1)
    _run(lease, 0, 60_000)
    _run(lease, 60_000, 65_000, base=False)
    assert _run(lease, 65_000, 70_000) == [66_500]


def test_a_word_out_of_step_begins_the_time_anew() -> None:
    lease = Lease(TIMES, 1)
    _run(lease, 0, 1400)
    lease.bad(BASE)
    assert _run(lease, 1500, 2900) == []
    assert _run(lease, 2900, 3100) == [3000]


def test_words_out_of_step_do_not_keep_the_lease() -> None:
    lease = Lease(TIMES, 1)
    _run(lease, 0, 20_000)
    changes = []
    for now_ms in range(20_000, 24_000, 100):
        lease.bad(BASE)
        if lease.tick(now_ms * MS):
            changes.append(now_ms)
    assert changes == [21_600]


def test_a_dead_standby_gives_way_at_once() -> None:
    lease = Lease(TIMES, 1)
    _run(lease, 0, 1000, base=False)
    _run(lease, 1000, 4000, base=False, standby=False)
    assert _run(lease, 4000, 4100, standby=False) == [4000]


def test_an_unanswered_question_takes_the_lease_and_keeps_it_away() -> None:
    lease = Lease(TIMES, 1)
    _run(lease, 0, 20_000)
    assert lease.tick(20_000 * MS, base_lags=True)
    assert lease.holder == STANDBY
    for now_ms in range(20_000, 40_000, 500):
        lease.good(BASE, now_ms * MS)
        assert not lease.tick(now_ms * MS, base_lags=True)


_Events = st.lists(
    st.tuples(
        st.integers(0, 3000), st.sampled_from(["base", "standby", "bad base", "bad standby", "tick", "lag"])
    ),
    max_size=80,
)


@given(_Events)
def test_whatever_happens(events: list[tuple[int, str]]) -> None:
    """Epochs grow by one with each change and only then; the base never holds the lease longer than its limit."""
    lease, now_ms, last_good_ms = Lease(TIMES, 5), 0, -(10**9)
    for wait_ms, event in events:
        now_ms += wait_ms
        before, epoch = lease.holder, lease.epoch
        if event in (BASE, STANDBY):
            lease.good(event, now_ms * MS)
            last_good_ms = now_ms if event == BASE else last_good_ms
        elif event.startswith("bad"):
            lease.bad(event.removeprefix("bad "))
        changed = lease.tick(now_ms * MS, base_lags=event == "lag")
        assert changed == (lease.holder != before)
        assert lease.epoch == epoch + changed
        assert lease.holder == STANDBY or now_ms - last_good_ms <= 2000
    assert lease.epoch == 5 + lease.takeovers + lease.hand_backs
