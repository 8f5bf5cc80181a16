"""A disk that fills up or turns read-only under a running service: it goes on, says so, and loses nothing safe."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from plgrim.config import RuntimeConfig
from plgrim.errors import AlreadyRunningError, JournalError
from plgrim.runtime.keeper import Keeper
from schemas.contract import Inputs, Output, Outputs, Stamp
from schemas.operation import FinishReason
from schemas.topics import MISSION
from tests.runtime.fake_services import mission_state

needs_mount = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("mount") is None, reason="needs root, to mount a small tmpfs"
)


class Counting:
    """A stage that journals its count."""

    def __init__(self) -> None:
        self.count = 0

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Counts."""
        self.count += 1
        return [Output(MISSION, mission_state(now, self.count, FinishReason.NONE))]

    def snapshot(self) -> bytes:
        """The count, in more than a few pages."""
        return str(self.count).encode().rjust(20_000)

    def restore(self, snapshot: bytes) -> None:
        """The count."""
        self.count = int(snapshot)

    def journal(self, outputs: Outputs) -> bytes:
        """The count."""
        return str(self.count).encode().rjust(2000)

    def replay(self, record: bytes) -> None:
        """The count."""
        self.count = int(record)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 2 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(place)], check=True)
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def _run(keeper: Keeper, stage: Counting, steps: int) -> None:
    for now in range(steps):
        outputs = stage.step(now, Inputs({}))
        keeper.before_publishing(stage, outputs)
        keeper.after_step(stage, now)


def _fill(disk: Path) -> None:
    with (disk / "filler").open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(1024))
        except OSError:
            return


def _keeper(disk: Path, period_s: float = 600.0) -> Keeper:
    keeper = Keeper.of(
        RuntimeConfig(state_dir=str(disk / "state"), snapshot_period_s=period_s), "robot", "mission"
    )
    assert keeper is not None
    return keeper


def _remount(disk: Path, how: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{how}", str(disk)], check=True)


@needs_mount
@pytest.mark.parametrize("trouble", ["full", "read-only"])
def test_what_was_safe_is_there_and_the_service_goes_on(small_disk: Path, trouble: str) -> None:
    keeper = _keeper(small_disk)
    stage = keeper.recover(Counting, 0)
    _run(keeper, stage, 20)
    assert keeper.trouble == ""
    safe = stage.count
    if trouble == "full":
        _fill(small_disk)
        _run(keeper, stage, 200)  # what is left in the last pages is used first
    else:
        keeper._journal.close()  # the kernel refuses to remount while a file is open for writing
        if keeper._lock is not None:
            keeper._lock.close()
        _remount(small_disk, "ro")
        _run(keeper, stage, 5)
    assert "cannot be written" in keeper.trouble or "begins with a snapshot" in keeper.trouble
    # The process dies; the next one goes on from what was safe, on the same disk.
    if trouble == "full":
        keeper._journal.close()
        keeper.close()
    again = _keeper(small_disk)
    resumed = again.recover(Counting, 10**12)
    assert again.recovered and again.trouble
    assert resumed.count >= safe
    _run(again, resumed, 3)
    again.close()
    # The disk is well again: journaled with the next snapshot.
    if trouble == "full":
        (small_disk / "filler").unlink()
    else:
        _remount(small_disk, "rw")
    well = _keeper(small_disk, 0.001)
    healed = well.recover(Counting, 10**12)
    _run(well, healed, 3)
    assert well.trouble == "" and healed.count >= safe
    well.close(healed, 10**12)


@needs_mount
def test_a_disk_that_is_full_before_the_mission_is_the_users_to_mend(small_disk: Path) -> None:
    _fill(small_disk)
    with pytest.raises(JournalError, match="cannot be written"):
        _keeper(small_disk).recover(Counting, 0)


def test_a_journal_is_one_process_s_alone(tmp_path: Path) -> None:
    first = _keeper(tmp_path)
    with pytest.raises(
        AlreadyRunningError, match=rf"mission.lock: another mission .*{os.getpid()}.*state_dir"
    ):
        _keeper(tmp_path)
    first.close()
    _keeper(tmp_path).close()
