"""What is kept of a stage, when it is written, and what happens when that goes wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from plgrim.config import RuntimeConfig
from plgrim.errors import JournalError
from plgrim.runtime.journal import Journal
from plgrim.runtime.keeper import Keeper, next_epoch
from schemas.contract import Inputs, Output, Outputs, Stamp
from schemas.operation import FinishReason
from schemas.topics import LOCAL_IRM, MISSION, ODOMETRY
from tests.runtime.fake_services import mission_state, odometry


class Counter:
    """Counts its steps and tells every one; a record is the count."""

    def __init__(self, refuses: tuple[bytes, ...] = ()) -> None:
        self.count = 0
        self.snapshots = self.resumes = 0
        self._refuses = refuses

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One more."""
        self.count += 1
        return [Output(MISSION, mission_state(now, self.count, FinishReason.NONE))]

    def snapshot(self) -> bytes:
        """The count."""
        self.snapshots += 1
        return b"%d" % self.count

    def restore(self, snapshot: bytes) -> None:
        """The count of a snapshot; some are refused."""
        self.count = -1
        if snapshot in self._refuses:
            raise ValueError("of another version")
        self.count = int(snapshot)

    def journal(self, outputs: Outputs) -> bytes:
        """The count."""
        return b"%d" % self.count

    def replay(self, record: bytes) -> None:
        """Records lead on by one."""
        assert int(record) == self.count + 1
        self.count = int(record)

    def resumed(self) -> None:
        """Noted."""
        self.resumes += 1


class Watch:
    """A stopwatch that the test moves."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


NO_INPUTS = Inputs({})


def _keeper(folder: Path, watch: Callable[[], float], period_s: float = 5.0) -> Keeper:
    return Keeper(Journal(folder, "mission"), period_s, watch)


def _live(keeper: Keeper, stage: Counter, steps: int, now: Stamp = 0) -> None:
    """So many steps as the driver does them."""
    for _ in range(steps):
        keeper.before_publishing(stage, stage.step(now, NO_INPUTS))
        keeper.after_step(stage, now)


def test_a_new_stage_stays_as_it_is_and_a_dead_one_goes_on(tmp_path: Path) -> None:
    first = _keeper(tmp_path, Watch())
    stage = first.recover(Counter, 0)
    assert (stage.count, stage.resumes, first.recovered) == (0, 0, False)
    _live(first, stage, 7)
    second = _keeper(tmp_path, Watch())  # the first one never closed its journal: its process was killed
    again = second.recover(Counter, 10)
    assert (again.count, again.resumes, second.recovered) == (7, 1, True)
    assert stage.snapshots == 1


def test_only_journaled_topics_are_written(tmp_path: Path) -> None:
    keeper, stage = _keeper(tmp_path, Watch()), Counter()
    keeper.recover(lambda: stage, 0)
    stage.count = 5
    keeper.before_publishing(stage, [Output(ODOMETRY, odometry(0, 0.0))])
    assert not ODOMETRY.journaled and not LOCAL_IRM.journaled and MISSION.journaled
    assert _keeper(tmp_path, Watch()).recover(Counter, 10).count == 0


def test_snapshots_come_at_their_period_and_more_rarely_when_they_are_expensive(tmp_path: Path) -> None:
    watch = Watch()
    keeper, stage = _keeper(tmp_path, watch, period_s=5.0), Counter()
    keeper.recover(lambda: stage, 0)
    for second in range(1, 21):
        watch.now_s = float(second)
        _live(keeper, stage, 1)
    assert stage.snapshots == 1 + 4

    def slowly() -> bytes:
        watch.now_s += 1.0
        return Counter.snapshot(stage)

    stage.snapshot = slowly  # type: ignore[method-assign]
    for _ in range(200):
        watch.now_s += 1.0
        _live(keeper, stage, 1)
    assert stage.snapshots == 5 + 4  # one second each, at most a fiftieth of the time


def test_a_state_that_cannot_be_restored_gives_way_to_the_one_before(tmp_path: Path) -> None:
    watch = Watch()
    keeper = _keeper(tmp_path, watch, period_s=1.0)
    stage = keeper.recover(Counter, 0)
    for _ in range(3):
        watch.now_s += 1.0
        _live(keeper, stage, 2)
    found = _keeper(tmp_path, Watch()).recover(lambda: Counter(refuses=(b"5",)), 10)
    assert found.count == 6  # from the snapshot at 3, over the records of both generations


def test_what_is_acknowledged_is_not_written_over_by_a_stage_that_cannot_restore_it(tmp_path: Path) -> None:
    """As after an upgrade, or with another configuration: the service does not run, whatever its next starts find."""
    first = _keeper(tmp_path, Watch())
    _live(first, first.recover(Counter, 0), 4)
    for _ in range(3):
        with pytest.raises(
            JournalError, match=r"no state of mission leads on.*mission.tries.*mission\.\*\.sqlite"
        ):
            _keeper(tmp_path, Watch()).recover(lambda: Counter(refuses=(b"0",)), 10)
    assert _keeper(tmp_path, Watch()).recover(Counter, 10).count == 4


def _deaths(folder: Path, steps: list[int]) -> list[int]:
    """Lives that die after so many steps; with which count each began."""
    counts = []
    for number in steps:
        keeper = _keeper(folder, Watch())
        stage = keeper.recover(Counter, 10)
        counts.append(stage.count)
        _live(keeper, stage, number, 10)
    return counts


def test_a_crash_loop_erases_nothing_that_was_acknowledged(tmp_path: Path) -> None:
    """What each short life says is kept too; at the end the service fails, and what it knew is still there."""
    assert _deaths(tmp_path, [4, 3, 0, 2, 0, 1, 1, 0]) == [0, 4, 7, 7, 9, 9, 10, 11]
    for _ in range(3):
        with pytest.raises(JournalError, match="does not begin anew"):
            _keeper(tmp_path, Watch()).recover(Counter, 10)
    (tmp_path / "mission.tries").unlink()
    assert _deaths(tmp_path, [3, 0, 0]) == [11, 14, 14]


def test_a_state_that_no_life_survives_gives_way_to_the_one_before(tmp_path: Path) -> None:
    """Two short lives leave both generations as they were: the older one is there to be tried."""
    watch = Watch()
    keeper = _keeper(tmp_path, watch, period_s=1.0)
    stage = keeper.recover(Counter, 0)
    watch.now_s = 2.0
    _live(keeper, stage, 2)  # the newer generation: a snapshot at 1, and a record
    assert [s.snapshot for s in Journal(tmp_path, "mission").recover()] == [b"1", b"0"]
    assert _deaths(tmp_path, [1, 0, 1]) == [2, 3, 3]
    assert [s.snapshot for s in Journal(tmp_path, "mission").recover()] == [b"1", b"0"]
    seen: list[bytes] = []

    class Telling(Counter):
        def restore(self, snapshot: bytes) -> None:
            seen.append(snapshot)
            super().restore(snapshot)

    assert _keeper(tmp_path, Watch()).recover(Telling, 10).count == 4
    assert seen == [b"0"]


def test_numbers_that_short_lives_gave_are_skipped_by_all_that_follow(tmp_path: Path) -> None:
    _deaths(tmp_path, [4, 1, 1])
    stage = _keeper(tmp_path, Watch()).recover(Counter, 10)
    assert stage.resumes == 3


def test_an_orderly_end_in_the_first_steps_is_no_death(tmp_path: Path) -> None:
    _deaths(tmp_path, [4])
    for _ in range(8):
        keeper = _keeper(tmp_path, Watch())
        keeper.close(keeper.recover(Counter, 10), 10)
    assert _deaths(tmp_path, [0]) == [4]


class Plain:
    """A stage with nothing to acknowledge."""

    def __init__(self) -> None:
        self.state = b"new"

    def snapshot(self) -> bytes:
        """The state."""
        return self.state

    def restore(self, snapshot: bytes) -> None:
        """From a snapshot."""
        self.state = snapshot


def test_what_acknowledges_nothing_begins_anew_after_a_crash_loop(tmp_path: Path) -> None:
    """Its state is worth less than its service: three deaths at a start cost it once, not at every later death."""
    keeper = Keeper(Journal(tmp_path, "lcp"), 5.0, Watch())
    stage = keeper.recover(Plain, 0)
    stage.state = b"old"
    keeper.close(stage, 0)
    states = [Keeper(Journal(tmp_path, "lcp"), 5.0, Watch()).recover(Plain, 10).state for _ in range(5)]
    assert states == [b"old", b"old", b"old", b"new", b"new"]


def test_the_journal_of_a_mission_that_began_later_is_not_used(tmp_path: Path) -> None:
    keeper, stage = _keeper(tmp_path, Watch()), Counter()
    keeper.recover(lambda: stage, 1000)
    _live(keeper, stage, 3, now=1000)
    assert _keeper(tmp_path, Watch()).recover(Counter, 999).count == 0


def test_a_service_goes_on_without_its_journal_says_so_and_mends_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = Watch()
    journal = Journal(tmp_path, "mission")
    keeper, stage = Keeper(journal, 5.0, watch), Counter()
    keeper.recover(lambda: stage, 0)

    def full(*_: object) -> None:
        raise JournalError("no space")

    with monkeypatch.context() as patch:
        patch.setattr(journal, "append", full)
        _live(keeper, stage, 3)
    assert keeper.trouble == "no space"
    _live(keeper, stage, 3)  # records after a gap would lead nowhere
    assert _keeper(tmp_path, Watch()).recover(Counter, 10).count == 0
    watch.now_s = 6.0
    _live(keeper, stage, 2)
    assert keeper.trouble == ""
    assert stage.count == 8


def test_a_journal_that_cannot_be_begun_is_an_error_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(tmp_path, "mission")

    def full(*_: object) -> None:
        raise JournalError("no space")

    monkeypatch.setattr(journal, "begin", full)
    with pytest.raises(JournalError, match="no space"):
        Keeper(journal, 5.0).recover(Counter, 0)


def test_an_orderly_end_keeps_everything(tmp_path: Path) -> None:
    keeper, stage = _keeper(tmp_path, Watch()), Counter()
    keeper.recover(lambda: stage, 0)
    stage.count = 41
    keeper.close(stage, 0)
    assert _keeper(tmp_path, Watch()).recover(Counter, 10).count == 41


def test_no_folder_no_keeper(tmp_path: Path) -> None:
    assert Keeper.of(RuntimeConfig(), "robot", "irm") is None
    assert Keeper.of(RuntimeConfig(state_dir=str(tmp_path)), "robot", "irm") is not None
    assert (tmp_path / "robot").is_dir()


def test_epochs_grow_even_when_the_wall_clock_is_set_back(tmp_path: Path) -> None:
    config = RuntimeConfig(state_dir=str(tmp_path))
    assert next_epoch(config, "robot", "irm", 1000) == 1000
    assert next_epoch(config, "robot", "irm", 400) == 11_000
    assert next_epoch(config, "robot", "gcp", 400) == 400
    assert next_epoch(config, "robot", "irm", 50_000) == 50_000
    (tmp_path / "robot" / "irm.epoch").write_text("damaged", encoding="ascii")
    assert next_epoch(config, "robot", "irm", 6000) == 6000
    assert next_epoch(RuntimeConfig(), "robot", "irm", 7) == 7
