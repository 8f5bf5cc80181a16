"""A whole live mission, recorded by `plgrim record`, says the same again byte for byte: every stage, from its start to
the mission's end. Every service a process of its own over Zenoh, its planners stopped by deadlines."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from plgrim.recording.reader import read_raw
from plgrim.registry import STAGES
from schemas.codec import decode
from schemas.operation import FinishReason, MissionState
from tests.faults.kill import free_port
from tests.faults.small_map import START, write_small_map
from tests.runtime.helpers import REPOSITORY

SPEED = 0.5
"""Slower than time, so that a busy machine loses nothing: what is shown is that it is the same, not its pace."""


def _plgrim(folder: Path, environment: dict[str, str], name: str, *arguments: str) -> subprocess.Popen[bytes]:
    """A command at a terminal of its own, as far as the scheduler is concerned."""
    with (folder / f"{name}.out").open("wb") as out, (folder / f"{name}.log").open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "plgrim", name, *arguments],
            cwd=folder, env=environment, stdout=out, stderr=log, start_new_session=True,
        )  # fmt: skip


def _states(recording: Path) -> list[MissionState]:
    raws = read_raw(recording, lambda _: None, {"mission/state"}.__contains__)
    return [decode(raw.payload, MissionState, 1 << 20)[0] for raw in raws]


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_whole_live_mission_says_the_same_again(tmp_path: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PLGRIM_") or "_DIR" in k} | {
        "PYTHONPATH": str(REPOSITORY),
        "PLGRIM_ROUTER": f"tcp/127.0.0.1:{free_port()}",
        "PLGRIM_STATUS__PORT": str(free_port()),
    }
    where = ["--map", str(write_small_map(tmp_path)), "--start", str(START["x_m"]), str(START["y_m"])]
    mission = _plgrim(tmp_path, environment, "explore", *where, "--speed", str(SPEED), "--out", "m")
    recorder = _plgrim(tmp_path, environment, "record", "--raw-only", "--out", "r")
    try:
        assert mission.wait(1000) == 0, (tmp_path / "explore.log").read_text(errors="replace")[-3000:]
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(60) == 0
    finally:
        for process in (mission, recorder):
            if process.poll() is None:
                process.terminate()
                process.wait(60)
    said = (tmp_path / "record.out").read_text(errors="replace")
    assert "lost:" not in said, f"this machine is too busy for the test: {said[-2000:]}"
    states = _states(tmp_path / "r")
    assert states[-1].finish == FinishReason.COVERED
    again = _plgrim(tmp_path, environment, "replay", "r", "--json")
    code = again.wait(900)
    report = json.loads((tmp_path / "replay.out").read_text())
    print(f"\n{report}")
    assert code == 0
    assert report["same"]
    assert set(report["steps"]) == set(STAGES)
    assert min(report["outputs"].values()) > 10
