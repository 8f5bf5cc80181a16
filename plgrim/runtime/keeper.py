"""Keeps a stage's state over the death of its process: recovers it at the start, journals it while it runs.

The order is what makes it safe: a step, its record on the disk, and only then its outputs on the wire. Snapshots are
taken between steps, never inside one.

A stage that acknowledges (`Journaling`) is never begun anew over what it has acknowledged: neither after a crash loop
nor when nothing can be restored. Until a resumed life has got through its first steps it takes no snapshot, so that
both generations outlive it; its records go behind those of the life before.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, TypeVar

from plgrim.config import RuntimeConfig
from plgrim.errors import JournalError
from plgrim.logs import get_logger
from plgrim.runtime.durable import write_whole
from plgrim.runtime.journal import Journal, Recovered
from plgrim.runtime.lock import Lock
from schemas.contract import SECOND_NS, Journaling, Outputs, Resuming, Stamp

_LARGEST_SHARE = 0.02
"""Of the time that snapshots may take: expensive ones are taken less often, and the records bridge the longer gap."""
_NOT_DURABLE = frozenset({"sim"})
"""The simulated world dies with its host: its journal need not wait for the disk, 4 times a second."""
_TRIES = 3
"""A state from which so many lives in a row did not get through their first steps gives way to the one before it."""
_GOOD_STEPS = 3
_EPOCHS_OF_A_LIFE = 10_000
"""The link process begins a new epoch with every lease that it grants: its next life comes after all of these."""


class Restorable(Protocol):
    """What a keeper keeps: a stage, or anything else with its two methods."""

    def snapshot(self) -> bytes:
        """Everything that is needed to go on."""
        ...

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        ...


_R = TypeVar("_R", bound=Restorable)


class Keeper:
    """The journal of one service, and when it is written. Used by the thread that steps the stage.

    trouble: why nothing is journaled now; empty while all is well. A service goes on without its journal (a full disk
    must not stop a robot), says so, and tries again with the next snapshot.
    """

    def __init__(
        self, journal: Journal, period_s: float, stopwatch: Callable[[], float] = time.monotonic
    ) -> None:
        """period_s: wall time between snapshots. stopwatch: wall seconds."""
        self._journal = journal
        self._period_s = period_s
        self._stopwatch = stopwatch
        self._due_s = 0.0
        self._tries = journal.folder / f"{journal.service}.tries"
        self._steps_to_go = 0
        self._lock: Lock | None = None
        self.trouble = ""
        self.recovered = False
        self._log = get_logger()

    @classmethod
    def of(cls, config: RuntimeConfig, robot: str, service: str) -> Keeper | None:
        """The keeper of a service, or None when no `state_dir` is configured. Raises JournalError."""
        if not config.state_dir:
            return None
        folder = Path(config.state_dir) / robot
        journal = Journal(folder, service, service not in _NOT_DURABLE)
        keeper = cls(journal, config.snapshot_period_s)
        keeper._lock = _lock(folder, service)
        return keeper

    def recover(self, make: Callable[[], _R], now: Stamp) -> _R:
        """A stage as it was when its process died; as new when there is nothing to go on from.

        make: gives a new stage; called again when a state cannot be restored. now: mission clock. Raises JournalError
        and what `make` raises.
        """
        states = self._usable(now)
        for damage in self._journal.damage:
            self._log.error("journal damaged", what=damage)
        tries = _read_number(self._tries)
        stage = make()
        used = None
        for state in self._still_good(states, tries, isinstance(stage, Journaling)):
            if self._restore(stage, state):
                used = state
                break
            stage = make()
        if used is None:
            self._start_new(stage, now, bool(states))
        else:
            self._resume(stage, used, tries + 1, now)
        return stage

    def _usable(self, now: Stamp) -> list[Recovered]:
        """The states of this mission, the newest first."""
        states = self._journal.recover()
        for state in states:
            if state.saved_ns > now:
                self._log.warning("journal of another mission: not used", saved_s=state.saved_ns / SECOND_NS)
        return [state for state in states if state.saved_ns <= now]

    def _still_good(self, states: list[Recovered], tries: int, acknowledges: bool) -> list[Recovered]:
        """Those with which so many lives have not been tried in vain."""
        if tries < _TRIES:
            return states
        self._log.error("the newest state is not used: no life that began with it went on", tries=tries)
        if not acknowledges or tries >= 2 * _TRIES:
            return []
        return states[1:] or states

    def _start_new(self, stage: Restorable, now: Stamp, was_more: bool) -> None:
        """was_more: there are states of this mission, none of which is any good."""
        if was_more and isinstance(stage, Journaling):
            raise JournalError(
                f"{self._journal.folder}: no state of {self._journal.service} leads on, see its log, and it does not "
                f"begin anew over what it has acknowledged (a stop, fences, the map); to try once more remove "
                f"{self._tries.name}, to begin anew move {self._journal.service}.*.sqlite elsewhere as well"
            )
        self._forget_tries()  # what this life comes to is a state to go on from again
        self._begin(stage, now)
        if self.trouble:  # the user's to mend; a robot on its way goes on without a journal
            raise JournalError(self.trouble)

    def _resume(self, stage: Restorable, state: Recovered, tries: int, now: Stamp) -> None:
        """tries: the lives that have begun with what is on the disk, this one included."""
        self.recovered = True
        self._steps_to_go = _GOOD_STEPS
        _write_number(self._tries, tries)
        if not isinstance(stage, Journaling):
            _tell(stage, 1)
            self._begin(stage, now)
            return
        _tell(stage, tries)  # the lives before it left no snapshot of the numbers that they gave
        leads_on = False

        def go_on() -> None:
            nonlocal leads_on
            leads_on = self._journal.go_on(state)

        self._write(go_on)
        if not leads_on and not self.trouble:
            self._begin(stage, now)

    def _restore(self, stage: Restorable, state: Recovered) -> bool:
        began = self._stopwatch()
        try:
            stage.restore(state.snapshot)
            if isinstance(stage, Journaling):
                for record in state.records:
                    stage.replay(record)
        except Exception as error:  # of another version of the program, or of another configuration
            self._log.error("state cannot be restored", generation=state.generation, exc_info=error)
            return False
        self._log.info(
            "resumed",
            generation=state.generation,
            records=len(state.records),
            kib=len(state.snapshot) // 1024,
            took_ms=round(1e3 * (self._stopwatch() - began), 1),
        )
        return True

    def before_publishing(self, stage: Restorable, outputs: Outputs) -> None:
        """Write what the outputs acknowledge; call it after a step and before any of them is published."""
        if self.trouble or not isinstance(stage, Journaling):
            return
        if any(output.topic.journaled for output in outputs):
            record = stage.journal(outputs)
            self._write(lambda: self._journal.append(record))

    def after_step(self, stage: Restorable, now: Stamp) -> None:
        """Take a snapshot when it is time. Call it between steps that went well."""
        if self._steps_to_go:
            self._steps_to_go -= 1
            if self._steps_to_go:
                return
            self._begin(
                stage, now
            )  # before the tries are forgotten: it holds the numbers that they have skipped
            self._forget_tries()
        elif self._stopwatch() >= self._due_s:
            self._begin(stage, now)

    def _forget_tries(self) -> None:
        with contextlib.suppress(OSError):  # of a read-only disk, on which they could not be written either
            self._tries.unlink(missing_ok=True)

    def _begin(self, stage: Restorable, now: Stamp) -> None:
        began = self._stopwatch()
        snapshot = stage.snapshot()
        self._write(lambda: self._journal.begin(snapshot, now))
        ended = self._stopwatch()
        self._due_s = ended + max(self._period_s, (ended - began) / _LARGEST_SHARE)

    def _write(self, work: Callable[[], None]) -> None:
        try:
            work()
        except JournalError as error:
            if not self.trouble:
                self._log.error("nothing is journaled", reason=str(error))
            self.trouble = str(error)
        else:
            self.trouble = ""

    def close(self, stage: Restorable | None = None, now: Stamp = 0) -> None:
        """Close the journal, with a last snapshot of a stage that ends in order."""
        if stage is not None:
            self._begin(stage, now)
            self._forget_tries()  # it did not die
        self._journal.close()
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def _lock(folder: Path, service: str) -> Lock | None:
    """The journal is this process's alone. Raises AlreadyRunningError; a disk that takes no lock file is no reason."""
    mend = "stop it first, or give this one a folder of its own with runtime.state_dir"
    try:
        return Lock(folder / f"{service}.lock", f"another {service} writes this journal", mend)
    except OSError as error:
        get_logger().warning("journal not locked", reason=str(error))
        return None


def _tell(stage: object, lives: int) -> None:
    """Once for each life that began with this state: numbers that any of them gave are not given again."""
    if isinstance(stage, Resuming):
        for _ in range(lives):
            stage.resumed()


def next_epoch(config: RuntimeConfig, robot: str, service: str, now_ms: int) -> int:
    """The epoch of a service's new life: the wall clock, ms, but always later than any of its last one.

    Readers refuse what comes from an epoch that is over: a wall clock that was set back must not silence a service.
    """
    if not config.state_dir:
        return now_ms
    path = Path(config.state_dir) / robot / f"{service}.epoch"
    last = _read_number(path)
    epoch = max(now_ms, last + _EPOCHS_OF_A_LIFE if last else 0)
    _write_number(path, epoch)
    return epoch


def _read_number(path: Path) -> int:
    """The number in a small file; 0 when there is none."""
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return 0


def _write_number(path: Path, number: int) -> None:
    """Write a small file whole or not at all; a failure is logged, for nothing hangs on it alone."""
    try:
        write_whole(path, str(number))
    except OSError as error:
        get_logger().warning("not written", file=str(path), error=str(error))
