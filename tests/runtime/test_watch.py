"""Pulses and what is seen in them; and, with real processes, stages that go astray."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from plgrim.config import Config
from plgrim.errors import AlreadyRunningError
from plgrim.runtime.pulse import Pulse, Reading, clear_pulse, read_pulse
from plgrim.runtime.supervisor import Supervisor
from plgrim.runtime.watch import FLAG_PERIODS, Watch, Watched
from tests.runtime.helpers import eventually, fake_command

PERIOD_NS = 200_000_000


def _reading(steps: int, beats: int = 0, pid: int = 7, compiling: int = 0) -> Reading:
    return Reading(pid, PERIOD_NS, steps, beats, compiling)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "pulse" / "irm"
    assert read_pulse(path) == Reading()
    clear_pulse(path)
    pulse = Pulse(path)
    assert read_pulse(path) == Reading(pid=os.getpid())
    pulse.expect(0.2)
    for _ in range(3):
        pulse.stepped()
    pulse.beat()
    pulse.compiling(1)
    pulse.compiling(1)
    pulse.compiling(-1)
    assert read_pulse(path) == Reading(os.getpid(), PERIOD_NS, 3, 1, 1)
    clear_pulse(path)
    pulse.stepped()  # of a process that is being replaced
    assert read_pulse(path) == Reading()
    Pulse(None).stepped()


def test_late_after_two_and_a_half_periods_and_well_again_with_the_next_step() -> None:
    watched = Watched(_reading(4))
    for tick in range(1, 100):
        watched.look(_reading(4), 0.01, now=tick / 100)
        assert (watched.flagged_s is not None) == (tick / 100 >= FLAG_PERIODS * 0.2 - 1e-9)
    watched.look(_reading(5), 0.01, now=1.0)
    assert watched.flagged_s is None


@pytest.mark.parametrize("why", ["no first step yet", "compiling", "another process", "no period"])
def test_nobody_is_late_who_need_not_step(why: str) -> None:
    watched = Watched(_reading(4))
    for tick in range(1, 100):
        reading = {
            "no first step yet": _reading(0),
            "compiling": _reading(4, compiling=1),
            "another process": _reading(4, pid=tick),
            "no period": Reading(7, 0, 4, 0),
        }[why]
        watched.look(reading, 0.01, now=tick / 100)
        assert watched.flagged_s is None


def test_a_supervisor_that_was_stopped_blames_nobody(tmp_path: Path) -> None:
    clear_pulse(tmp_path / "irm")
    pulse = Pulse(tmp_path / "irm")
    pulse.expect(0.2)
    pulse.stepped()
    seconds = [0.0]
    watch = Watch(tmp_path, ("irm",), stopwatch=lambda: seconds[0])
    watch.look()
    seconds[0] = 3600.0
    watch.look()
    assert watch.flagged() == {}
    for _ in range(10):
        seconds[0] += 0.1
        watch.look()
    assert set(watch.flagged()) == {"irm"}
    assert watch.late_s("irm", os.getpid()) > 0.5
    assert watch.late_s("irm", os.getpid() + 1) == 0.0


@pytest.mark.parametrize("behaviour", ["loops", "locks"])
def test_an_endless_loop_is_flagged_within_three_periods_and_replaced(
    config: Config, tmp_path: Path, behaviour: str
) -> None:
    """Also one that holds Python's lock, so that the process cannot say anything itself. Period 0.2 s; the bar is
    0.6 s from the last step that ended, and 0.25 s of margin is for this machine."""
    runtime = config.runtime.model_copy(update={"stuck_after_s": 1.5, "silent_after_s": 1.5})
    config = config.model_copy(update={"runtime": runtime})
    command = fake_command({"mission": behaviour})
    with Supervisor(config, tmp_path, ("sim", "mission"), command) as supervisor:
        supervisor.start()
        path = tmp_path / "pulse" / "mission"
        eventually(lambda: read_pulse(path).steps == 19, "it goes astray", supervisor.poll)
        astray, first = time.monotonic(), supervisor.children["mission"].process
        eventually(lambda: "mission" in supervisor.watch.flagged(), "it is flagged", supervisor.poll)
        flagged_s = time.monotonic() - astray
        print(f"flagged {flagged_s:.2f} s after its last step")
        eventually(
            lambda: supervisor.children["mission"].process is not first, "it is replaced", supervisor.poll
        )
        assert supervisor.children["mission"].restarted == 1
        assert "sim" not in supervisor.failed() and supervisor.children["sim"].restarted == 0
        assert flagged_s < 3 * PERIOD_NS / 1e9 + 0.25


def test_one_supervisor_a_folder_and_the_second_empties_nothing(config: Config, tmp_path: Path) -> None:
    with Supervisor(config, tmp_path, ("sim",), fake_command({})) as first:
        kept = Path(first.config.runtime.state_dir) / "kept"
        kept.parent.mkdir(parents=True)
        kept.touch()
        with pytest.raises(AlreadyRunningError, match=rf"supervisor.lock: .*process {os.getpid()}.*--out"):
            Supervisor(config, tmp_path, ("sim",), fake_command({}))
        assert kept.exists()
    Supervisor(config, tmp_path, ("sim",), fake_command({})).__exit__(None)


def test_the_spare_becomes_the_service_that_is_asked_for(tmp_path: Path, config: Config) -> None:
    """With a stand-in that waits for its order as the real one does."""
    from plgrim.runtime.spare import Spare

    program = (
        "import os, sys, pathlib\n"
        "from plgrim.runtime.spare import wait_for_order\n"
        "import threading\n"
        "name = wait_for_order(threading.Event())\n"
        "print('now', name, os.environ['PLGRIM_PULSE'], flush=True)\n"
    )
    spare = Spare(lambda _: [sys.executable, "-c", program], tmp_path, dict(os.environ))
    try:
        assert spare.take("irm", tmp_path / "irm.log", {}) is None
        spare.keep()
        eventually(lambda: spare.warm, "it is warm")
        process = spare.take("irm", tmp_path / "irm.log", {"PLGRIM_PULSE": "here"})
        assert process is not None
        assert process.wait(30.0) == 0
        assert (tmp_path / "irm.log").read_text(encoding="utf-8") == "now irm here\n"
        assert not spare.warm
        spare.keep()
        eventually(lambda: spare.warm, "there is another one")
    finally:
        spare.close()
