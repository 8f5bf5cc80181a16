"""Writes a journal as a service does: `python disk_writer.py FOLDER ACKS GENERATIONS RECORDS`, for tests of the disk.

What it takes for safe goes to the file ACKS: `epoch E`, and `known N` for N records that the journal must know of.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from plgrim.config import RuntimeConfig
from plgrim.errors import JournalError
from plgrim.runtime.journal import Journal
from plgrim.runtime.keeper import next_epoch


def state(number: int) -> bytes:
    """A snapshot that knows of the records up to `number`; larger than a page."""
    return b"snapshot %d " % number * 600


def record(number: int) -> bytes:
    """Record `number`."""
    return b"record %d " % number * 50


def main() -> None:
    """Epoch, recovery, then generations with their records. A write that fails is left until the next snapshot."""
    folder, acks = Path(sys.argv[1]), os.open(sys.argv[2], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    runtime = RuntimeConfig(state_dir=str(folder))

    def acknowledge(text: str) -> None:
        os.write(acks, f"{text}\n".encode())

    for now_ms in (1000, 10):  # the second life begins with a clock that was set back
        epoch = next_epoch(runtime, "robot", "s", now_ms)
        acknowledge(f"epoch {epoch}")
        known = _live(Journal(folder / "robot", "s"), acknowledge)
    print(f"ends with {known}")


def _live(journal: Journal, acknowledge: object) -> int:
    states = journal.recover()
    known = int(states[0].snapshot.split()[1]) + len(states[0].records) if states else 0
    for _ in range(int(sys.argv[3])):
        journaled = _try(lambda: journal.begin(state(known), 1))  # noqa: B023
        if journaled:
            acknowledge(f"known {known}")  # type: ignore[operator]
        for _ in range(int(sys.argv[4])):
            journaled = journaled and _try(lambda: journal.append(record(known + 1)))  # noqa: B023
            if journaled:
                known += 1
                acknowledge(f"known {known}")  # type: ignore[operator]
    journal.close()
    return known


def _try(work: object) -> bool:
    try:
        work()  # type: ignore[operator]
    except JournalError:
        return False
    return True


if __name__ == "__main__":
    main()
