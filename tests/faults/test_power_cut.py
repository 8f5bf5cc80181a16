"""Everything dies in the middle of a mission, the supervisor first; `plgrim recover` goes on with all acknowledged."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from plgrim.config import load_config
from plgrim.errors import ConfigError
from plgrim.runtime.process import child_environment
from plgrim.runtime.run_folder import ClockFile, with_fresh_state, with_kept_state
from plgrim.runtime.zenoh_session import connect
from schemas.topics import PLAN
from tests.faults.kill import free_port
from tests.faults.observer import Observer
from tests.faults.system import Ear
from tests.runtime.helpers import REPOSITORY, eventually

RESUMED_WITHIN_S = 15.0


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("PLGRIM_")]:
        if name not in ("PLGRIM_CACHE_DIR", "PLGRIM_DATA_DIR"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    monkeypatch.setenv("PLGRIM_ROUTER", f"tcp/127.0.0.1:{free_port()}")
    monkeypatch.setenv("PLGRIM_STATUS__PORT", str(free_port()))


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[bytes]]]:
    """Ended, with all they have started, whatever happens."""
    found: list[subprocess.Popen[bytes]] = []
    yield found
    for process in found:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(30.0)
            except subprocess.TimeoutExpired:
                process.kill()
        process.wait()


def test_the_mission_clock_goes_on_after_a_reboot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = with_fresh_state(load_config(overrides={"clock": {"speed": 2.0, "origin_ns": 5}}), tmp_path)
    with pytest.raises(ConfigError, match=r"config.yaml: there is none"):
        with_kept_state(tmp_path)
    from plgrim.config import write_config

    write_config(config, tmp_path / "config.yaml")
    with pytest.raises(ConfigError, match=r"runtime.state_dir: .*no journals"):
        with_kept_state(tmp_path)
    Path(config.runtime.state_dir).mkdir()
    ClockFile(Path(config.runtime.state_dir)).write(600 * 10**9)
    assert with_kept_state(tmp_path).clock.origin_ns == 5, "the same boot: the clock has run on"
    monkeypatch.setattr("plgrim.runtime.run_folder.boot_id", lambda: "another")
    resumed = with_kept_state(tmp_path)
    now_s = (time.monotonic_ns() - resumed.clock.origin_ns) * 2.0 / 1e9
    assert 603.0 <= now_s < 613.0


def _start(arguments: list[str], out: Path, wrap: tuple[str, ...] = ()) -> subprocess.Popen[bytes]:
    with (out.parent / "program.log").open("ab") as log:
        return subprocess.Popen(
            [*wrap, sys.executable, "-m", "plgrim", *arguments],
            stdout=log,
            stderr=log,
            env=dict(os.environ) if wrap else child_environment(os.environ),  # wrapped: another is its parent
        )


def _reboot(folder: Path) -> tuple[str, ...]:
    """A command that runs another with a CLOCK_MONOTONIC that began anew, and another boot's name."""
    (folder / "boot_id").write_text("another-boot\n", encoding="ascii")
    mount = f'mount --bind {folder / "boot_id"} /proc/sys/kernel/random/boot_id && exec "$@"'
    back_s = -int(time.monotonic()) + 100
    return (
        "unshare",
        "--time",
        "--mount",
        "--fork",
        "--kill-child",
        f"--monotonic={back_s}",
        "sh",
        "-c",
        mount,
        "sh",
    )


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("reboot", [False, True], ids=["same boot", "after a reboot"])
def test_all_killed_in_mid_mission(
    tmp_path: Path, processes: list[subprocess.Popen[bytes]], reboot: bool
) -> None:
    if reboot and (os.geteuid() != 0 or shutil.which("unshare") is None or time.monotonic() < 200):
        pytest.skip("needs root, for a time namespace")
    out = tmp_path / "out"
    processes.append(_start(["explore", "--world", "subway_1x", "--speed", "1", "--out", str(out)], out))
    observer, ear = Observer(), Ear()
    with connect(load_config().router, "robot", threading.Event(), 120.0) as link:
        observer.attach(link)
        ear.attach(link, PLAN)
        eventually(lambda: any(p.valid for _, p in ear.plans(0.0)), "the robot drives", within_s=240.0)
        eventually(lambda: observer.graph_size()[0] > 12, "a graph has grown", within_s=240.0)
        epoch = ear.said[PLAN.name][-1].envelope.epoch
        children = psutil.Process(processes[0].pid).children(recursive=True)
        processes[0].kill()
        processes[0].wait()
        killed = time.monotonic()
        gone = psutil.wait_procs(children, timeout=10.0)
        print(f"\n{len(gone[0])} processes gone {time.monotonic() - killed:.2f} s after the supervisor")
        assert gone[1] == [], "orphans"
        before = observer.graph_size()
        began = time.monotonic()
        processes.append(_start(["recover", str(out)], out, _reboot(tmp_path) if reboot else ()))

        def drives() -> list[float]:
            said = ear.since(PLAN, began)
            moving = {t for t, p in ear.plans(began) if p.valid}
            return [s.at_s for s in said if s.envelope.epoch > epoch and s.at_s in moving]

        eventually(drives, "the robot drives on", within_s=120.0)
        back_s = drives()[0] - began
        eventually(lambda: observer.handovers, "irm has told its graph")
        print(
            f"drives {back_s:.1f} s after the restart; {before[0]} nodes, {before[1]} edges: {observer.handovers}"
        )
        assert [fault for handover in observer.handovers for fault in handover.faults()] == []
        assert observer.handovers[0].nodes == before[0]
        assert all(back <= 1e-9 for back in observer.judge_setbacks)
        assert all(jump < 1.0 for jump in observer.jumps_m)
        assert back_s < RESUMED_WITHIN_S
