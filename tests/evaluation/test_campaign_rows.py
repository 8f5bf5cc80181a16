"""A row is read from what a run left behind."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plgrim.evaluation.campaign_child import CRASHED, FINISHED, PENDING, RUN_FILE, write_json
from plgrim.evaluation.campaign_rows import COLUMNS, Curve, Finished, rows, write_rows
from tests.evaluation.fake_mission import write_result


def curve(*samples: tuple[float, float, float]) -> Curve:
    """Of (time, coverage, distance)."""
    return Curve(*np.array(samples, np.float64).reshape(-1, 3).T)


def task(**changes: Any) -> dict[str, Any]:
    """As the campaign files a run."""
    return {
        "world": "maze", "variant": "default", "seed": 1, "budget_s": 40.0, "status": FINISHED, "error": "",
        "fingerprint": "f", "identity": {"code": "0.1.0+abc"}, **changes,
    }  # fmt: skip


def finished(folder: Path, **changes: Any) -> Finished:
    """A run of 30 s, half covered at once and 95 % from 20 s on."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / RUN_FILE, task(**changes))
    write_result(folder)
    run = Finished.read(folder)
    assert run is not None
    return run


def test_the_area_under_a_curve() -> None:
    found = curve((0.0, 0.0, 0.0), (10.0, 0.5, 5.0), (20.0, 1.0, 9.0))
    assert found.mean(20.0) == pytest.approx(0.25)
    assert found.mean(40.0) == pytest.approx((10 * 0.5 + 20 * 1.0) / 40)  # what is covered stays covered
    assert found.mean(15.0) == pytest.approx(5 * 0.5 / 15)  # what comes later does not count
    assert curve((5.0, 1.0, 0.0)).mean(10.0) == pytest.approx(0.5)
    assert curve().mean(10.0) is None
    assert found.mean(0.0) is None


def test_a_level_is_reached_at_its_first_sample() -> None:
    found = curve((0.0, 0.2, 0.0), (10.0, 0.5, 5.0), (20.0, 0.9, 9.0))
    assert found.reached(0.5) == (10.0, 5.0)
    assert found.reached(0.51) == (20.0, 9.0)
    assert found.reached(0.95) is None
    assert found.at(np.array([-1.0, 0.0, 9.9, 10.0, 99.0])).tolist() == [0.0, 0.2, 0.2, 0.5, 0.9]


def test_a_row_tells_the_run(tmp_path: Path) -> None:
    (row,) = rows([finished(tmp_path)])
    assert tuple(row) == COLUMNS
    assert row["coverage_mean"] == pytest.approx((20 * 0.5 + 20 * 0.95) / 40)
    assert (row["t50_s"], row["d50_m"], row["t95_s"], row["d95_m"]) == (0.0, 0.0, 20.0, 20.0)
    assert row["t97_s"] is None
    assert (row["gcp_p50_ms"], row["gcp_p99_ms"], row["lcp_p50_ms"]) == (2.0, 4.0, None)
    assert (row["finish"], row["lost"], row["code"]) == ("covered", False, "0.1.0+abc")


def test_without_a_budget_all_of_a_world_are_judged_over_the_longest(tmp_path: Path) -> None:
    runs = [finished(tmp_path / str(seed), seed=seed, budget_s=0.0) for seed in (1, 2)]
    runs[1].result["elapsed_s"] = 60.0
    assert [row["budget_s"] for row in rows(runs)] == [60.0, 60.0]
    assert rows(runs)[0]["coverage_mean"] == pytest.approx((20 * 0.5 + 40 * 0.95) / 60)


def test_a_crash_is_a_row_with_its_error(tmp_path: Path) -> None:
    write_json(tmp_path / RUN_FILE, task(status=CRASHED, error="ValueError: no"))
    run = Finished.read(tmp_path)
    assert run is not None
    (row,) = rows([run])
    assert (row["status"], row["error"], row["coverage"]) == (CRASHED, "ValueError: no", None)


def test_what_has_not_ended_is_no_row(tmp_path: Path) -> None:
    assert Finished.read(tmp_path) is None
    write_json(tmp_path / RUN_FILE, task(status=PENDING))
    write_result(tmp_path)
    assert Finished.read(tmp_path) is None
    write_json(tmp_path / RUN_FILE, task())
    (tmp_path / "result.json").write_text("{", encoding="utf-8")
    assert Finished.read(tmp_path) is None


def test_the_file_has_the_columns_in_order(tmp_path: Path) -> None:
    run = finished(tmp_path)
    run.result.update(lost=True, finish="", lost_reason="fell, and tipped")
    write_rows(tmp_path / "runs.csv", rows([run]))
    with (tmp_path / "runs.csv").open(newline="", encoding="utf-8") as file:
        header, cells = list(csv.reader(file))
    assert tuple(header) == COLUMNS
    row = dict(zip(header, cells, strict=True))
    assert (row["lost"], row["lost_reason"], row["finish"]) == ("true", "fell, and tipped", "lost")
    assert (row["t99_s"], row["coverage"], row["seed"]) == ("", "0.95", "1")


def test_a_row_tells_answers_junctions_and_turning(tmp_path: Path) -> None:
    run = finished(tmp_path)
    run.result.update(
        answers={"lcp": {"count": 9, "p50_ms": 5.0, "p99_ms": 8.0}, "sim": {"count": 1, "p50_ms": 1, "p99_ms": 1}},
        plan_changes={"junctions": 4, "heading_jump_deg": 12.5, "hazard_cut_s": None, "sharp_jumps": 0},
    )  # fmt: skip
    (row,) = rows([run])
    assert tuple(row) == COLUMNS
    assert (row["lcp_answer_p50_ms"], row["lcp_answer_p99_ms"], row["gcp_answer_p50_ms"]) == (5.0, 8.0, None)
    assert (row["heading_jump_deg"], row["junctions"], row["hazard_cut_s"]) == (12.5, 4, None)


def test_turning_is_summed_the_short_way_round() -> None:
    """From 170 to -170 degrees are 20, and back to 170 another 20: 40 over 5 m."""
    yaw = np.radians([170.0, -170.0, 170.0])
    found = Curve(np.arange(3.0), np.zeros(3), np.array([0.0, 2.0, 5.0]), yaw)
    assert found.turned_deg_per_m == pytest.approx(8.0)
    assert curve((0.0, 0.0, 0.0), (1.0, 0.0, 2.0)).turned_deg_per_m is None
