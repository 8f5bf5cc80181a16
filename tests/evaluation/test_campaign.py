"""Campaigns in processes that stand in for missions: what is run, kept, refused, broken off; and a real one."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from plgrim.errors import AlreadyRunningError, PlgrimError
from plgrim.evaluation import campaign as campaign_module
from plgrim.evaluation.campaign import CampaignFolder, Outcome, run_campaign
from plgrim.evaluation.campaign_child import CRASHED, FINISHED, RUN_FILE, read_json, write_json
from plgrim.evaluation.campaign_plan import Campaign, Variant, World
from plgrim.evaluation.campaign_pool import mission_environment
from plgrim.evaluation.campaign_rows import Row
from tests.evaluation.fake_mission import command


class Seen:
    """A display that remembers; sets `stop` when a run of `stop_at` is under way."""

    def __init__(self, stop: threading.Event | None = None, stop_at: str = "") -> None:
        self.kept = -1
        self.names: list[str] = []
        self.most = 0
        self._stop, self._stop_at = stop, stop_at

    def planned(self, total: int, kept: int) -> None:
        """Note what there was."""
        self.kept = kept

    def ended(self, name: str, row: Row) -> None:
        """Note a name."""
        self.names.append(name)

    def poll(self, running: Sequence[Path]) -> None:
        """Note how many ran at once."""
        self.most = max(self.most, len(running))
        if self._stop and any(folder.name == self._stop_at for folder in running):
            self._stop.set()


@pytest.fixture(autouse=True)
def no_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    """No world is built here."""
    monkeypatch.setattr(campaign_module, "check_worlds", lambda runs: None)


def plan(seeds: Sequence[int], limit_s: float = 40.0) -> Campaign:
    """A campaign in `maze`."""
    return Campaign([World.built_in("maze")], [Variant("default", {})], seeds, limit_s)


def drive(out: Path, seeds: Sequence[int], seen: Seen | None = None, **options: object) -> Outcome:
    """Run a campaign with processes that stand in for missions, two at a time."""
    return run_campaign(plan(seeds), out, 2, seen, command=command, **options)  # type: ignore[arg-type]


def test_every_run_becomes_a_row_and_a_lost_robot_is_no_error(tmp_path: Path) -> None:
    seen = Seen()
    outcome = drive(tmp_path, [1, 2, 3, 7], seen)
    assert (outcome.complete, outcome.crashed) == (True, [])
    assert [row["seed"] for row in outcome.table] == [1, 2, 3, 7]
    assert [row["lost"] for row in outcome.table] == [False, False, False, True]
    assert seen.most == 2
    for name in ("runs.csv", "summary.md", "coverage.png"):
        assert (tmp_path / name).stat().st_size > 100


def test_a_crash_is_a_row_and_does_not_end_the_campaign(tmp_path: Path) -> None:
    outcome = drive(tmp_path, [13, 17, 19, 1])
    errors = {row["seed"]: row["error"] for row in outcome.table}
    assert "killed by SIGKILL" in errors[13]
    assert "exit code 5" in errors[17]
    assert errors[19] == "ValueError: no"
    assert errors[1] == ""
    assert outcome.complete
    assert sorted(outcome.crashed) == [f"maze/default/seed_0{seed}" for seed in (13, 17, 19)]


def test_finished_runs_are_kept_and_others_made_anew(tmp_path: Path) -> None:
    drive(tmp_path, [1, 2, 19])
    folder = CampaignFolder(tmp_path)
    (run,) = plan([2]).runs()
    write_json(folder.of(run) / RUN_FILE, {**read_json(folder.of(run) / RUN_FILE), "status": "pending"})
    seen = Seen()
    outcome = drive(tmp_path, [1, 2, 3, 19], seen)
    assert seen.kept == 1
    assert sorted(seen.names) == [f"maze/default/seed_{seed:03d}" for seed in (2, 3, 19)]
    assert len(outcome.table) == 4


def test_rows_of_earlier_campaigns_in_the_folder_stay(tmp_path: Path) -> None:
    drive(tmp_path, [1])
    outcome = drive(tmp_path, [2])
    assert [row["seed"] for row in outcome.table] == [1, 2]


def test_another_configuration_is_refused_by_name_or_forced(tmp_path: Path) -> None:
    drive(tmp_path, [1, 2])
    other = plan([1, 2, 3], limit_s=50.0)
    with pytest.raises(PlgrimError, match=r"2 finished runs .*--force(.|\n)*limit_s: 40.0 -> 50.0"):
        run_campaign(other, tmp_path, 2, command=command)
    outcome = run_campaign(other, tmp_path, 2, command=command, force=True)
    assert [row["budget_s"] for row in outcome.table] == [50.0] * 3


def test_other_code_is_refused_and_its_rows_are_not_mixed_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive(tmp_path, [1, 2])
    for module in ("plgrim.evaluation.campaign", "plgrim.evaluation.campaign_plan"):
        monkeypatch.setattr(f"{module}.code_version", lambda: "0.2.0+new")
    with pytest.raises(PlgrimError, match=r"code: .* -> \"0.2.0\+new\""):
        drive(tmp_path, [1])
    outcome = drive(tmp_path, [1], force=True)
    assert [(row["seed"], row["code"]) for row in outcome.table] == [(1, "0.2.0+new")]


def test_an_interrupted_campaign_keeps_what_is_finished_and_goes_on(tmp_path: Path) -> None:
    stop = threading.Event()
    outcome = drive(tmp_path, [1, 2, 23], Seen(stop, "seed_023"), stop=stop)
    assert not outcome.complete
    assert outcome.crashed == []
    kept = len(outcome.table)
    (run,) = plan([23]).runs()
    assert read_json(CampaignFolder(tmp_path).of(run) / RUN_FILE)["status"] == "pending"
    seen = Seen()
    again = drive(tmp_path, [1, 2], seen)
    assert seen.kept == kept
    assert again.complete


def test_two_campaigns_do_not_share_a_folder(tmp_path: Path) -> None:
    with CampaignFolder(tmp_path).locked(), pytest.raises(AlreadyRunningError, match="another campaign"):
        drive(tmp_path, [1])


def test_children_compute_on_one_thread_and_take_their_configuration_from_the_file_alone() -> None:
    given = {
        "OMP_NUM_THREADS": "8", "PLGRIM_SEED": "5", "PLGRIM_SIM__WORLD": "cave", "PLGRIM_CONFIG": "x", "HOME": "h",
        "PLGRIM_CACHE_DIR": "c",
    }  # fmt: skip
    found = mission_environment(given)
    assert (found["OMP_NUM_THREADS"], found["NUMBA_NUM_THREADS"], found["HOME"]) == ("1", "1", "h")
    assert found["PLGRIM_CACHE_DIR"] == "c"
    assert not {"PLGRIM_SEED", "PLGRIM_SIM__WORLD", "PLGRIM_CONFIG"} & set(found)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_real_campaign_repeats_itself(tmp_path: Path) -> None:
    """Two missions of three seconds side by side; the same ones again, elsewhere, give the same bytes."""

    def digests(out: Path, seeds: Sequence[int]) -> dict[int, str]:
        campaign = Campaign([World.built_in("dead_end")], [Variant("default", {})], seeds, 3.0)
        outcome = run_campaign(campaign, out, 2)
        assert outcome.complete, outcome
        assert {row["status"] for row in outcome.table} == {FINISHED}, outcome.table
        assert all(
            row["coverage"] > 0.05 and row["mission_s"] == pytest.approx(3.0, abs=0.6)
            for row in outcome.table
        )
        assert CRASHED not in (tmp_path / out / "runs.csv").read_text(encoding="utf-8")
        return {row["seed"]: row["digest"] for row in outcome.table}

    first = digests(tmp_path / "a", [1, 2])
    assert first[1] != first[2]
    assert digests(tmp_path / "b", [2]) == {2: first[2]}
