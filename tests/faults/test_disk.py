"""A power cut, or a disk that refuses, at each write, fsync, truncate, rename and unlink of a journal.

The calls are those of a real process, recorded below the C library. The rule: what recovery gives is a state that once
was, and knows of all that was acknowledged; a life that begins with it goes on.
"""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import pytest

from plgrim.config import RuntimeConfig
from plgrim.runtime.journal import Journal
from plgrim.runtime.keeper import next_epoch
from tests.faults.disk import Disk, build_shim, run_writer
from tests.faults.disk_writer import record, state


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled shim."""
    found = build_shim(tmp_path_factory.mktemp("shim"))
    if found is None:
        pytest.skip("needs Linux and a C compiler")
    return found


def _known(folder: Path) -> int | None:
    """How many records the recovered state knows of; fails for what never was a state."""
    journal = Journal(folder / "robot", "s")
    states = journal.recover()
    journal.close()
    if not states:
        return None
    first = int(states[0].snapshot.split()[1])
    assert states[0].snapshot == state(first)
    found = list(states[0].records)
    assert found == [record(first + 1 + k) for k in range(len(found))]
    return first + len(found)


def _goes_on(folder: Path, known: int | None) -> None:
    """A life after the cut writes and is recovered."""
    journal = Journal(folder / "robot", "s")
    journal.recover()
    journal.begin(state(known or 0), 1)
    journal.append(record((known or 0) + 1))
    journal.close()
    assert _known(folder) == (known or 0) + 1


def _check(folder: Path, acknowledged: list[str], where: str, refused: bool = False) -> None:
    """refused: the disk refused a call, maybe that of the epoch: then only the wall clock keeps epochs growing."""
    epochs = [int(text.split()[1]) for text in acknowledged if text.startswith("epoch")]
    counts = [int(text.split()[1]) for text in acknowledged if text.startswith("known")]
    epoch = next_epoch(RuntimeConfig(state_dir=str(folder)), "robot", "s", 5)
    assert refused or epoch > max(epochs, default=0), (
        f"{where}: a new life takes epoch {epoch} after {epochs}"
    )
    known = _known(folder)
    if counts:
        assert known is not None, f"{where}: nothing is left of {counts[-1]} acknowledged records"
        assert counts[-1] <= known <= counts[-1] + 1, f"{where}: {known} of {counts[-1]} acknowledged records"
    _goes_on(folder, known)


def _cut_everywhere(
    shim: Path, tmp_path: Path, generations: int, records: int, every: int, seeds: range
) -> int:
    calls, _ = run_writer(shim, tmp_path, generations, records)
    disk = Disk(str(tmp_path / "state"))
    images = 0
    for number, call in enumerate(calls):
        disk.take(call)
        if number % every and number != len(calls) - 1:
            continue
        for image in disk.images(tmp_path / "image", seeds):
            _check(image, disk.acknowledged, f"cut after call {number} ({call.kind} {Path(call.path).name})")
            images += 1
    kinds = {call.kind for call in calls}
    assert kinds >= set("acmwsr")
    print(f"{len(calls)} calls, {images} images")
    return images


def test_a_power_cut_between_any_two_calls_now_and_then(shim: Path, tmp_path: Path) -> None:
    assert _cut_everywhere(shim, tmp_path, 2, 2, every=11, seeds=range(2)) > 30


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_power_cut_between_any_two_calls(shim: Path, tmp_path: Path) -> None:
    assert _cut_everywhere(shim, tmp_path, 4, 3, every=1, seeds=range(8)) > 1000


def _refuse_at(shim: Path, folder: Path, at: int, number: int, lasting: bool) -> None:
    """One run in which a call fails, and all after it when lasting."""
    folder.mkdir()
    faults = {"DISK_FAIL_AT": at, "DISK_FAIL_ERRNO": number} | ({"DISK_FAIL_ALL": 1} if lasting else {})
    try:
        calls, _ = run_writer(shim, folder, 2, 2, **faults)
    except (
        RuntimeError
    ) as error:  # at its very start, before anything was acknowledged, a life may refuse to begin
        if "JournalError" not in str(error) or "known" in (folder / "log").read_text(errors="replace"):
            raise
        return
    disk = Disk(str(folder / "state"))
    for call in calls:
        disk.take(call)
    _check(folder / "state", disk.acknowledged, f"errno {number} at call {at}", refused=True)
    shutil.rmtree(folder)


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC, errno.EROFS])
def test_a_call_that_fails_costs_nothing_acknowledged(shim: Path, tmp_path: Path, number: int) -> None:
    for at in (9, 23, 41):
        _refuse_at(shim, tmp_path / f"at{at}", at, number, lasting=at == 23)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("lasting", [False, True])
@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_every_call_that_fails(shim: Path, tmp_path: Path, number: int, lasting: bool) -> None:
    calls, _ = run_writer(shim, tmp_path, 2, 2)
    for at in range(1, sum(call.kind != "a" for call in calls) + 1):
        _refuse_at(shim, tmp_path / f"at{at}", at, number, lasting)
