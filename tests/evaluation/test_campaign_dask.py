"""Missions on a Dask cluster: of one worker in this process, with processes that stand in for missions."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from plgrim.errors import ConfigError
from plgrim.evaluation import campaign as campaign_module
from plgrim.evaluation.campaign import Outcome, run_campaign
from plgrim.evaluation.campaign_child import FINISHED, RUN_FILE, read_json
from plgrim.evaluation.campaign_dask import DaskPool, read_folder, run_files, write_folder
from plgrim.evaluation.campaign_plan import Campaign, Variant, World
from tests.evaluation.fake_mission import command
from tests.evaluation.test_campaign import Seen

distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Of a scheduler with one worker of two threads, all in this process."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, silence_logs=50
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(autouse=True)
def no_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    """No world is built here."""
    monkeypatch.setattr(campaign_module, "check_worlds", lambda runs: None)


def drive(address: str, out: Path, seeds: list[int], seen: Any = None, **options: Any) -> Outcome:
    """Run a campaign on the cluster."""
    campaign = Campaign([World.built_in("maze")], [Variant("default", {})], seeds, 40.0)
    pool = DaskPool(address, command)
    try:
        return run_campaign(campaign, out, 0, seen, pool=pool, **options)
    finally:
        pool.close()


def test_rows_are_those_of_a_campaign_here(address: str, tmp_path: Path) -> None:
    seen = Seen()
    there = drive(address, tmp_path / "there", [1, 2, 7, 13, 19], seen)
    campaign = Campaign([World.built_in("maze")], [Variant("default", {})], [1, 2, 7, 13, 19], 40.0)
    here = run_campaign(campaign, tmp_path / "here", 2, command=command)
    names = ("seed", "status", "coverage", "coverage_mean", "lost", "digest", "fingerprint")
    assert [[row[n] for n in names] for row in there.table] == [[row[n] for n in names] for row in here.table]
    assert there.crashed == here.crashed == ["maze/default/seed_013", "maze/default/seed_019"]
    assert "SIGKILL" in there.table[3]["error"]
    assert 1 <= seen.most <= 3, "two threads, and one that waits"


def test_finished_runs_are_kept_and_an_interrupted_campaign_goes_on(address: str, tmp_path: Path) -> None:
    stop = threading.Event()
    first = drive(address, tmp_path, [1, 23], Seen(stop, "seed_023"), stop=stop)
    assert not first.complete and first.crashed == []
    seen = Seen()
    again = drive(address, tmp_path, [1, 2], seen)
    assert again.complete
    assert seen.kept == len(first.table)


def test_a_mission_that_is_stopped_is_ended(tmp_path: Path) -> None:
    write_folder(tmp_path, {RUN_FILE: b'{"seed": 23, "status": "pending"}'})
    code, files = run_files(read_folder(tmp_path), command, lambda: True)
    assert code < 0
    assert b"pending" in files[RUN_FILE]


def test_a_folder_goes_there_and_comes_back(tmp_path: Path) -> None:
    write_folder(tmp_path / "a", {RUN_FILE: b'{"seed": 1, "status": "pending"}', "config.yaml": b"seed: 1\n"})
    code, files = run_files(read_folder(tmp_path / "a"), command, lambda: False)
    assert code == 0
    write_folder(tmp_path / "b", files)
    assert read_json(tmp_path / "b" / RUN_FILE)["status"] == FINISHED
    assert {"config.yaml", "result.json", "trajectory.csv", "run.log"} <= set(os.listdir(tmp_path / "b"))
    write_folder(tmp_path / "c", {"../../evil": b"x"})
    assert [path.name for path in (tmp_path / "c").iterdir()] == ["evil"], "names of files, not ways"


def test_a_scheduler_that_does_not_answer_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError("Timed out")

    monkeypatch.setattr(distributed, "Client", refuse)
    with pytest.raises(ConfigError, match=r"--dask tcp://127.0.0.1:1: no scheduler answers there: Timed out"):
        DaskPool("tcp://127.0.0.1:1")
