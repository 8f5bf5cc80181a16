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
    none = _keeper(tmp_path, Watch()).recover(lambda: Counter(refuses=(b"5", b"6", b"3")), 10)
    assert (none.count, none.resumes) == (0, 0)


def test_a_state_that_no_life_survives_is_not_restored_for_ever(tmp_path: Path) -> None:
    first = _keeper(tmp_path, Watch())
    _live(first, first.recover(Counter, 0), 4)
    counts = []
    for steps in (
        3,
        0,
        2,
        0,
        0,
    ):  # the first of these lives gets going; the next three die in their first steps
        keeper = _keeper(tmp_path, Watch())
        stage = keeper.recover(Counter, 10)
        counts.append(stage.count)
        _live(keeper, stage, steps, 10)
    assert counts == [4, 7, 7, 9, 0]


def test_after_a_state_was_given_up_the_next_life_goes_on_from_what_came_since(tmp_path: Path) -> None:
    """Three deaths at a start cost the state once, not at every later death."""
    for steps in (50, 1, 1, 1, 60):
        keeper = _keeper(tmp_path, Watch())
        stage = keeper.recover(Counter, 0)
        _live(keeper, stage, steps)
    assert stage.count == 60, "given up: as new"
    assert _keeper(tmp_path, Watch()).recover(Counter, 0).count == 60


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
