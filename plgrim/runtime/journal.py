"""A service's journal: the newest snapshots of its state and what it has acknowledged since, on disk.

Two SQLite files in WAL mode, written in turn. Each holds one generation: a snapshot, and the records that were appended
after it. A snapshot begins the next generation in the other file, in one transaction, and thereby compacts: what that
file held before goes. So there are always two generations that share no page: a damaged one costs nothing but the way
back to the other, from which the records of both lead on. Records are numbered through; everything carries a checksum
of its own, and reading stops at the first record that is missing or damaged: what is given back is a state that once
was, never a mixture.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import xxhash

from plgrim.errors import JournalError
from plgrim.runtime.durable import make_folder

_FORMAT = 1
_SLOTS = ("a", "b")
_TABLES = (
    "CREATE TABLE IF NOT EXISTS generation (number INTEGER PRIMARY KEY, first INTEGER NOT NULL, "
    "saved_ns INTEGER NOT NULL, checksum BLOB NOT NULL, state BLOB NOT NULL)",
    "CREATE TABLE IF NOT EXISTS record (number INTEGER PRIMARY KEY, checksum BLOB NOT NULL, content BLOB NOT NULL)",
)
_WAL_BYTES = 4 * 1024 * 1024
_UNREADABLE = (sqlite3.Error, OSError, ValueError, TypeError, OverflowError, MemoryError, struct.error)
"""What reading a damaged file may raise."""


@dataclass(frozen=True, slots=True)
class Recovered:
    """A state that the service was in: a snapshot and the records after it, oldest first.

    generation: number of the snapshot. first: number of the first record after it. saved_ns: mission clock of the
    snapshot, ns.
    """

    generation: int
    first: int
    saved_ns: int
    snapshot: bytes
    records: tuple[bytes, ...]


@dataclass(slots=True)
class _Slot:
    """What one file holds, as far as it is whole. snapshot None: its snapshot is damaged, its records may not be."""

    number: int
    first: int
    saved_ns: int
    snapshot: bytes | None
    records: list[bytes] = field(default_factory=list)


def _checksum(content: bytes, *numbers: int) -> bytes:
    digest = xxhash.xxh3_64(struct.pack(f">{len(numbers)}q", *numbers))
    digest.update(content)
    return digest.digest()


class Journal:
    """The journal of one service in `folder`, which is made if need be. One process at a time writes it.

    `recover` first, which reads; then `begin` with a snapshot, or `go_on` with a state that was found; then `append`
    and `begin` as often as one likes. Each returns when its content is on the disk. damage: what `recover` found
    wrong, for the log. Raises JournalError.
    """

    def __init__(self, folder: Path, service: str, durable: bool = True) -> None:
        """durable: wait for the disk, so that a loss of power costs nothing either; not only the process's death."""
        self.folder, self.service = folder, service
        self._paths = tuple(folder / f"{service}.{slot}.sqlite" for slot in _SLOTS)
        self._synchronous = "FULL" if durable else "NORMAL"
        self._connections: list[sqlite3.Connection | None] = [None, None]
        self._slot = 1
        self._tail = 1
        """The file in which records are written; -1: what was found is too damaged to append to."""
        self._slots_found: dict[int, int] = {}
        self._generation = 0
        self._next = 1
        self._writing = False
        self.damage: list[str] = []
        with _clear_errors(folder):
            make_folder(folder)

    def recover(self) -> list[Recovered]:
        """The states there are, the newest first: at most one from each file's snapshot. Empty without any.

        The first is the one to go on from; the next is for when it cannot be restored.
        """
        slots = [self._read(index) for index in range(len(_SLOTS))]
        found = sorted((s for s in slots if s is not None), key=lambda s: s.number, reverse=True)
        states = []
        for age, slot in enumerate(found):
            if slot.snapshot is None:
                continue
            records = list(slot.records)
            for newer in reversed(found[:age]):
                if newer.first == slot.first + len(records):
                    records += newer.records
            states.append(Recovered(slot.number, slot.first, slot.saved_ns, slot.snapshot, tuple(records)))
        if states:  # the generation that one goes on from must outlive the writing of the next
            newest = states[0]
            self._generation, self._next = newest.generation, newest.first + len(newest.records)
            self._slots_found = {s.number: i for i, s in enumerate(slots) if s is not None}
            self._slot = self._slots_found[newest.generation]
            # The last of its records may stand in a newer file, of which only the snapshot is damaged.
            leads_on = found[0].first + len(found[0].records) == self._next
            self._tail = self._slots_found[found[0].number] if leads_on else -1
        elif any(
            path.exists() for path in self._paths
        ):  # of no use, and not to be taken for newer ones later
            with _clear_errors(self._paths[self._slot]):
                self._discard(self._slot)
        return states

    def _read(self, index: int) -> _Slot | None:
        path = self._paths[index]
        if not path.exists():
            return None
        found = len(self.damage)
        try:
            with contextlib.closing(self._connect(path)) as connection:
                return self._read_slot(connection, path.name)
        except _UNREADABLE as error:
            self.damage.append(f"{path.name}: {error}")
        copied = self._read_copy(path)
        if copied is not None and copied.snapshot is not None:
            del self.damage[found]  # nothing is wrong but that SQLite cannot write beside it
        return copied

    def _read_copy(self, path: Path) -> _Slot | None:
        """As `_read`, from a copy in memory: SQLite reads no log without writing, which a full disk does not allow."""
        place = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
        try:
            with tempfile.TemporaryDirectory(dir=place) as folder:
                for suffix in ("", "-wal"):
                    file = path.with_name(path.name + suffix)
                    if file.exists():
                        shutil.copyfile(file, Path(folder) / file.name)
                with contextlib.closing(self._connect(Path(folder) / path.name)) as connection:
                    return self._read_slot(connection, path.name)
        except _UNREADABLE:
            return None

    def _read_slot(self, connection: sqlite3.Connection, name: str) -> _Slot | None:
        if connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'record'").fetchone() is None:
            return None  # the process ended before anything was in it
        head = connection.execute("SELECT number, first, saved_ns, checksum FROM generation").fetchone()
        if head is None:
            return None
        number, first, saved_ns, checksum = head
        if not all(isinstance(value, int) for value in (number, first, saved_ns)):
            raise ValueError("the generation's numbers are damaged")
        slot = _Slot(number, first, saved_ns, None)
        try:
            (state,) = connection.execute("SELECT state FROM generation").fetchone()
            if _checksum(state, number, first, saved_ns) == checksum:
                slot.snapshot = bytes(state)
            else:
                self.damage.append(f"{name}: the snapshot's checksum does not match")
        except _UNREADABLE as error:
            self.damage.append(f"{name}: the snapshot cannot be read: {error}")
        self._read_records(connection, slot, name)
        return slot

    def _read_records(self, connection: sqlite3.Connection, slot: _Slot, name: str) -> None:
        """The records in order, up to the first that is missing or damaged."""
        query = "SELECT number, checksum, content FROM record ORDER BY number"
        try:
            for number, checksum, content in connection.execute(query):
                expected = slot.first + len(slot.records)
                if number != expected or _checksum(content, number) != checksum:
                    self.damage.append(
                        f"{name}: record {expected} is damaged or missing: the rest is not used"
                    )
                    return
                slot.records.append(bytes(content))
        except _UNREADABLE as error:
            self.damage.append(f"{name}: {len(slot.records)} records, then: {error}")

    def _connect(self, path: Path) -> sqlite3.Connection:
        connection = sqlite3.connect(path, isolation_level=None, timeout=5.0)
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute(f"PRAGMA synchronous = {self._synchronous}")
            connection.execute(f"PRAGMA journal_size_limit = {_WAL_BYTES}")
            (found,) = connection.execute("PRAGMA user_version").fetchone()
            if found not in (0, _FORMAT):
                raise sqlite3.DatabaseError(f"format {found}, this program writes {_FORMAT}")
        except BaseException:
            connection.close()
            raise
        return connection

    def go_on(self, state: Recovered) -> bool:
        """Append to a state that was found, without a new snapshot: both generations stay. Raises JournalError.

        False when its records do not lead to the newest one: a snapshot has to come first, and the next `begin` keeps
        this state's file. What stands behind the last record was of no use and goes.
        """
        if state.first + len(state.records) != self._next or self._tail < 0:
            self._slot = self._slots_found[state.generation]
            return False
        with _clear_errors(self._paths[self._tail]):
            connection = self._writable(self._tail)
            with _transaction(connection):
                connection.execute("DELETE FROM record WHERE number >= ?", (self._next,))
                connection.execute(f"PRAGMA user_version = {_FORMAT}")  # written: a full disk is noticed now
        self._writing = True
        return True

    def begin(self, snapshot: bytes, now_ns: int) -> None:
        """Begin the next generation with a snapshot. now_ns: mission clock, ns. Raises JournalError."""
        target = 1 - self._slot
        number = self._generation + 1
        row = (number, self._next, now_ns, _checksum(snapshot, number, self._next, now_ns), snapshot)
        with _clear_errors(self._paths[target]):
            try:
                self._replace(target, row)
            except sqlite3.Error:  # damaged, or no space: it holds nothing that is still needed
                self._discard(target)
                self._replace(target, row)
        self._slot = self._tail = target
        self._generation, self._writing = number, True

    def _replace(self, index: int, row: tuple[int, int, int, bytes, bytes]) -> None:
        connection = self._writable(index)
        with _transaction(connection):
            connection.execute("DELETE FROM generation")
            connection.execute("DELETE FROM record")
            connection.execute("INSERT INTO generation VALUES (?, ?, ?, ?, ?)", row)

    def _writable(self, index: int) -> sqlite3.Connection:
        held = self._connections[index]
        if held is None:
            held = self._connect(self._paths[index])
            self._connections[index] = held
            with _transaction(held):
                for table in _TABLES:
                    held.execute(table)
                held.execute(f"PRAGMA user_version = {_FORMAT}")
        return held

    def _discard(self, index: int) -> None:
        """Remove a file that SQLite cannot use, with its log."""
        self._close(index)
        path = self._paths[index]
        for suffix in ("", "-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)

    def append(self, content: bytes) -> None:
        """Add one record. It is on the disk when this returns. Raises JournalError; then begin anew."""
        if not self._writing:
            raise JournalError("a journal begins with a snapshot")
        with _clear_errors(self._paths[self._tail]):
            connection = self._writable(self._tail)
            with _transaction(connection):
                connection.execute(
                    "INSERT INTO record VALUES (?, ?, ?)",
                    (self._next, _checksum(content, self._next), content),
                )
        self._next += 1

    def close(self) -> None:
        """Close the files."""
        self._writing = False
        for index in range(len(_SLOTS)):
            self._close(index)

    def _close(self, index: int) -> None:
        connection, self._connections[index] = self._connections[index], None
        if connection is not None:
            with contextlib.suppress(sqlite3.Error):
                connection.close()


@contextlib.contextmanager
def _transaction(connection: sqlite3.Connection) -> Iterator[None]:
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with contextlib.suppress(sqlite3.Error):
            connection.execute("ROLLBACK")
        raise


@contextlib.contextmanager
def _clear_errors(path: Path) -> Iterator[None]:
    """Errors of SQLite and of the file system become a JournalError that names the file."""
    try:
        yield
    except (sqlite3.Error, OSError) as error:
        raise JournalError(f"{path}: the journal cannot be written: {error}") from error
