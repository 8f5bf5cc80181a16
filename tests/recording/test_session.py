"""The recorder as a process has it: healthy while the disk takes what comes, and of the base what the base has."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from plgrim.cli import application
from plgrim.config import Config
from plgrim.link.config import LinkConfig
from plgrim.recording.recorder import Recorder
from plgrim.recording.session import run_recorder
from plgrim.recording.transfer import Fetcher
from plgrim.recording.writer import Ring
from plgrim.runtime.live import drive
from plgrim.runtime.step_log import NotedStopwatch, StepLog
from plgrim.runtime.zenoh_session import Link
from schemas.contract import SECOND_NS, Inputs, Outputs, Stage, StageSpec, Stamp
from tests.runtime.helpers import eventually


class Quiet:
    """A stage that says nothing."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Nothing."""
        return []

    def snapshot(self) -> bytes:
        """Nothing."""
        return b""

    def restore(self, snapshot: bytes) -> None:
        """Nothing."""


@pytest.fixture
def base(config: Config, monkeypatch: pytest.MonkeyPatch) -> Config:
    """This host as the base."""
    monkeypatch.setenv("PLGRIM_LINK__HOST", "base")
    return config.model_copy(update={"link": LinkConfig(host="base")})


@pytest.fixture
def gcp_at_base(base: Config, link: Link) -> Iterator[None]:
    """gcp's instance at the base, with a stage that says nothing."""

    def make() -> tuple[StageSpec, Stage]:
        return StageSpec("gcp", SECOND_NS // 20), Quiet()

    stop, log = threading.Event(), StepLog("gcp", 1, "{}", NotedStopwatch(), period_s=1000.0)
    thread = threading.Thread(target=drive, args=("gcp", base, make, stop, log))
    thread.start()
    yield
    stop.set()
    thread.join()


def healthy() -> bool:
    """What the health check of a container would say."""
    return CliRunner().invoke(application, ["healthcheck", "recorder"]).exit_code == 0


@pytest.mark.parametrize("host", ["", "base"])
def test_a_recorder_answers_health_checks(
    host: str, config: Config, link: Link, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLGRIM_LINK__HOST", host or "''")
    here = config.model_copy(update={"link": LinkConfig.model_validate({"host": host})})
    assert not healthy()
    stop = threading.Event()
    thread = threading.Thread(target=run_recorder, args=(here, tmp_path / "r", stop, 60.0, 0, True))
    thread.start()
    try:
        eventually(healthy, "the recorder is healthy")
        # The base's own segments lie there already, and would be taken for the robot's.
        assert Fetcher(link, tmp_path / "f", timeout_s=20.0).round(stop) == (-1 if host else 0)
    finally:
        stop.set()
        thread.join()
    assert not healthy()


def test_a_recorder_at_the_base_has_the_steps_of_the_bases_instance(
    base: Config, gcp_at_base: None, link: Link, tmp_path: Path
) -> None:
    recorder = Recorder(link, Ring(tmp_path / "r", {}), None, base.link.instance)
    recorder.start()
    eventually(lambda: recorder.counts["gcp/steps"] > 5, "steps came")
    eventually(
        lambda: recorder.counts["gcp/snapshot"] >= 2, "a snapshot, and the one asked for", recorder.tick
    )
    link.close()
    recorder.close()
