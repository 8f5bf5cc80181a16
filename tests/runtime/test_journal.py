"""The journal: what was written is there again, whatever the process or the disk did to it in the meantime."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plgrim.errors import JournalError
from plgrim.runtime.journal import Journal, Recovered
from tests.runtime.helpers import REPOSITORY

FILES = ("s.a.sqlite", "s.b.sqlite", "s.a.sqlite-wal", "s.b.sqlite-wal", "s.a.sqlite-shm", "s.b.sqlite-shm")


def _state(generation: int) -> bytes:
    """A snapshot that cannot be mistaken for another; larger than a page."""
    return b"snapshot %d " % generation * 2000


def _record(number: int) -> bytes:
    return b"record %d " % number * 50


def _write(journal: Journal, generations: int, per_generation: int, first: int = 1) -> int:
    """Generations with so many records each; gives the number after the last record."""
    number = first
    for generation in range(1, generations + 1):
        journal.begin(_state(number), generation)
        for _ in range(per_generation):
            journal.append(_record(number))
            number += 1
    return number


def _meaning(state: Recovered) -> int:
    """How many records the state knows of; fails for what never was a state: that is the property of this file."""
    first = int(state.snapshot.split()[1])
    assert state.snapshot == _state(first)
    assert list(state.records) == [_record(first + k) for k in range(len(state.records))]
    return first + len(state.records) - 1


def _recover(folder: Path) -> list[Recovered]:
    journal = Journal(folder, "s")
    try:
        return journal.recover()
    finally:
        journal.close()


def test_nothing_was_written_nothing_is_there(tmp_path: Path) -> None:
    assert _recover(tmp_path) == []


@pytest.mark.parametrize("generations", [1, 2, 3, 4])
@pytest.mark.parametrize("records", [0, 1, 5])
def test_what_was_written_is_there_again(tmp_path: Path, generations: int, records: int) -> None:
    journal = Journal(tmp_path, "s")
    assert journal.recover() == []
    end = _write(journal, generations, records)
    journal.close()
    found = _recover(tmp_path)
    assert [_meaning(state) for state in found] == [end - 1] * min(generations, 2)
    assert [len(state.records) for state in found] == [records, 2 * records][: len(found)]
    assert found[0].saved_ns == generations


def test_it_goes_on_after_a_recovery(tmp_path: Path) -> None:
    for life in range(4):
        journal = Journal(tmp_path, "s")
        found = journal.recover()
        assert journal.damage == []
        assert [_meaning(state) for state in found][:1] == ([3 * life] if life else [])
        _write(journal, 1, 3, first=3 * life + 1)
        journal.close()


def _change(file: Path, statement: str) -> None:
    connection = sqlite3.connect(file)
    connection.execute(statement)
    connection.commit()
    connection.close()


_DAMAGE = {
    "nothing": ("s.b.sqlite", "SELECT 1", 6),
    "the newer snapshot": ("s.b.sqlite", "UPDATE generation SET state = x'00'", 6),
    "the last record": ("s.b.sqlite", "UPDATE record SET content = x'00' WHERE number = 6", 5),
    "a record with another behind it": ("s.b.sqlite", "DELETE FROM record WHERE number = 5", 4),
}


@pytest.mark.parametrize("damage", _DAMAGE)
def test_short_lives_append_to_what_was_found_and_leave_the_snapshots(tmp_path: Path, damage: str) -> None:
    file, statement, known = _DAMAGE[damage]
    journal = Journal(tmp_path, "s")
    _write(journal, 2, 3)
    journal.close()
    _change(tmp_path / file, statement)
    before = [state.snapshot for state in _recover(tmp_path)]
    for life in range(3):
        journal = Journal(tmp_path, "s")
        found = journal.recover()
        assert _meaning(found[0]) == known + 2 * life
        assert journal.go_on(found[0])
        for number in (1, 2):
            journal.append(_record(known + 2 * life + number))
        journal.close()
    after = _recover(tmp_path)
    assert [_meaning(state) for state in after] == [known + 6] * len(after)
    assert [state.snapshot for state in after] == before


def test_a_state_that_does_not_lead_to_the_newest_record_is_gone_on_from_by_a_snapshot(
    tmp_path: Path,
) -> None:
    """The newer one cannot be restored, and between the two a record is missing: the older file stays."""
    journal = Journal(tmp_path, "s")
    _write(journal, 2, 3)
    journal.close()
    _change(tmp_path / "s.a.sqlite", "DELETE FROM record WHERE number = 2")
    journal = Journal(tmp_path, "s")
    _, older = journal.recover()
    assert _meaning(older) == 1
    assert not journal.go_on(older)
    with pytest.raises(JournalError, match="begins with a snapshot"):
        journal.append(b"")
    journal.begin(_state(2), 9)
    journal.close()
    assert [state.snapshot for state in _recover(tmp_path)] == [_state(2), older.snapshot]


def test_the_journal_of_a_long_run_stays_small(tmp_path: Path) -> None:
    journal = Journal(tmp_path, "s")
    journal.recover()
    _write(journal, 200, 20)
    journal.close()
    written = 200 * (len(_state(1)) + 20 * len(_record(1)))
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < written / 20


def test_a_record_needs_a_snapshot_first(tmp_path: Path) -> None:
    with pytest.raises(JournalError, match="begins with a snapshot"):
        Journal(tmp_path, "s").append(b"x")


def test_a_folder_that_cannot_be_written_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="ascii")
    with pytest.raises(JournalError, match="file"):
        Journal(tmp_path / "file", "s")


def test_a_journal_of_a_later_format_is_not_misread(tmp_path: Path) -> None:
    journal = Journal(tmp_path, "s")
    journal.recover()
    _write(journal, 2, 1)
    journal.close()
    for name in FILES[:2]:
        with sqlite3.connect(tmp_path / name) as connection:
            connection.execute("PRAGMA user_version = 99")
        connection.close()
    journal = Journal(tmp_path, "s")
    assert journal.recover() == []
    assert all("format 99" in damage for damage in journal.damage)
    _write(journal, 1, 2)
    journal.close()
    assert _meaning(_recover(tmp_path)[0]) == 2


# --- damage ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of a process that died without closing them: 3 generations of 4 records, logs and all."""
    live, kept = tmp_path_factory.mktemp("live"), tmp_path_factory.mktemp("kept")
    journal = Journal(live, "s")
    journal.recover()
    _write(journal, 3, 4)
    for path in live.iterdir():
        shutil.copy(path, kept / path.name)
    journal.close()
    assert [_meaning(state) for state in _recover_copy(kept, tmp_path_factory.mktemp("check"))] == [12, 12]
    return kept


def _recover_copy(source: Path, target: Path) -> list[Recovered]:
    for path in source.iterdir():
        shutil.copy(path, target / path.name)
    return _recover(target)


def _flip(content: bytearray, at: int, value: int) -> bytearray:
    content[at] ^= value
    return content


def _zero(content: bytearray, at: int, length: int) -> bytearray:
    content[at : at + length] = bytes(len(content[at : at + length]))
    return content


DAMAGES: dict[str, Callable[[bytearray, int, int], bytearray]] = {
    "truncated": lambda content, at, _: content[:at],
    "one byte": lambda content, at, how: _flip(content, at, how % 255 + 1),
    "zeros": lambda content, at, how: _zero(content, at, how),
    "noise": lambda content, at, how: content[:at] + random.Random(how).randbytes(how) + content[at + how :],
    "shifted": lambda content, at, how: content[:at] + bytes(how % 64 + 1) + content[at:],
}


@settings(max_examples=120)
@given(
    name=st.sampled_from(FILES[:4]),
    damage=st.sampled_from(sorted(DAMAGES)),
    place=st.floats(0, 1, exclude_max=True),
    how=st.integers(1, 20_000),
)
def test_damage_to_one_file_gives_an_earlier_state_and_never_garbage(
    written: Path, tmp_path_factory: pytest.TempPathFactory, name: str, damage: str, place: float, how: int
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    for path in written.iterdir():
        shutil.copy(path, folder / path.name)
    content = bytearray((folder / name).read_bytes())
    (folder / name).write_bytes(DAMAGES[damage](content, int(place * len(content)), how))
    known = [_meaning(state) for state in _recover(folder)]
    # One file alone leads to the end of its own generation: 8 for the older one, 12 for the newer one; a log that is
    # cut leads to what was in it before the cut.
    assert all(0 <= count <= 12 for count in known)
    if damage in ("one byte", "zeros", "noise") and not name.endswith("-wal"):
        assert known and known[0] >= 4
    journal = Journal(folder, "s")
    before = journal.recover()
    first = (_meaning(before[0]) if before else 0) + 1
    end = _write(journal, 1, 2, first)
    journal.close()
    assert _meaning(_recover(folder)[0]) == end - 1
    shutil.rmtree(folder)


@settings(max_examples=50)
@given(
    places=st.lists(
        st.tuples(st.sampled_from(FILES), st.floats(0, 1, exclude_max=True)), min_size=2, max_size=8
    )
)
def test_damage_all_over_never_gives_garbage(
    written: Path, tmp_path_factory: pytest.TempPathFactory, places: list[tuple[str, float]]
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    for path in written.iterdir():
        shutil.copy(path, folder / path.name)
    for name, place in places:
        content = bytearray((folder / name).read_bytes())
        (folder / name).write_bytes(_zero(content, int(place * len(content)), 700))
    for state in _recover(folder):
        assert 0 <= _meaning(state) <= 12
    journal = Journal(folder, "s")
    journal.recover()
    end = _write(journal, 2, 1, first=100)
    journal.close()
    assert _meaning(_recover(folder)[0]) == end - 1
    shutil.rmtree(folder)


# --- death at each write ----------------------------------------------------------------------------------------


def test_death_before_any_statement_loses_nothing_that_was_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The files as they are before each statement that SQLite is given, as a killed process would leave them."""
    live, copies = tmp_path / "live", tmp_path / "copies"
    acknowledged, checked = -1, 0
    connect = Journal._connect

    def check(statement: str) -> None:
        nonlocal checked
        if not statement.startswith(("BEGIN", "INSERT", "DELETE", "COMMIT", "CREATE", "PRAGMA user")):
            return
        checked += 1
        folder = copies / str(checked)
        shutil.copytree(live, folder)
        with monkeypatch.context() as patch:
            patch.setattr(Journal, "_connect", connect)
            found = _recover(folder)
        assert (_meaning(found[0]) if found else -1) == acknowledged, statement

    def traced(journal: Journal, path: Path) -> sqlite3.Connection:
        connection = connect(journal, path)
        connection.set_trace_callback(check)
        return connection

    monkeypatch.setattr(Journal, "_connect", traced)
    journal = Journal(live, "s")
    journal.recover()
    number = 1
    for generation in range(4):
        journal.begin(_state(number), generation)
        acknowledged = number - 1
        for _ in range(3):
            journal.append(_record(number))
            acknowledged, number = number, number + 1
    journal.close()
    assert checked > 40


# --- kill -9 ----------------------------------------------------------------------------------------------------

_WRITER = """
import sys
from pathlib import Path
from plgrim.runtime.journal import Journal
from tests.runtime.test_journal import _record, _state
journal = Journal(Path(sys.argv[1]), "s")
journal.recover()
number = 1
while True:
    journal.begin(_state(number), number)
    print(number - 1, flush=True)
    for _ in range(7):
        journal.append(_record(number))
        print(number, flush=True)  # acknowledged
        number += 1
"""


@pytest.mark.parametrize("acknowledged", [0, 3, 20, 41, 133])
def test_a_killed_writer_loses_nothing_that_it_acknowledged(tmp_path: Path, acknowledged: int) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", _WRITER, str(tmp_path)],
        stdout=subprocess.PIPE,
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        text=True,
    )
    assert process.stdout is not None
    heard = -1
    for line in process.stdout:
        heard = int(line)
        if heard >= acknowledged:
            break
    process.kill()
    heard = max([heard, *(int(line) for line in process.stdout.read().split("\n")[:-1])])
    process.wait()
    process.stdout.close()
    assert heard <= _meaning(_recover(tmp_path)[0]) <= heard + 1


def test_a_full_disk_is_a_clear_error_and_keeps_what_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(tmp_path, "s")
    journal.recover()
    end = _write(journal, 2, 3)

    def full(*_: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(journal, "_replace", full)
        with pytest.raises(JournalError, match="disk is full"):
            journal.begin(_state(end), 9)
    journal.append(_record(end))
    journal.close()
    assert _meaning(_recover(tmp_path)[0]) == end
