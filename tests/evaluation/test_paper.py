"""The paper's experiments: what is run, and the figures of the table against ones worked out by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from plgrim.cli import application
from plgrim.errors import ConfigError
from plgrim.evaluation import campaign as campaign_module
from plgrim.evaluation import campaign_pool
from plgrim.evaluation.campaign_child import FINISHED
from plgrim.evaluation.campaign_plan import Campaign, merged
from plgrim.evaluation.campaign_rows import COLUMNS, Curve, Row
from plgrim.evaluation.paper import (
    BUDGETS_S,
    PLANNERS,
    best_of,
    growth,
    lead,
    paper_text,
    paper_variants,
    paper_worlds,
)
from plgrim.evaluation.reconciliation import reconciliation_text, reconciliation_variants
from plgrim.evaluation.tuning import (
    BASE,
    GRID,
    check_scored_seeds,
    check_tuning_seeds,
    tuning_variants,
    write_tuning,
)
from services.sim.worlds import WORLD_NAMES
from tests.evaluation.fake_mission import command


def row(world: str, planner: str, seed: int, auc: float, **more: Any) -> Row:
    """A row of a finished run."""
    own = {"world": world, "variant": planner, "seed": seed, "status": FINISHED, "coverage_mean": auc}
    return {**dict.fromkeys(COLUMNS), "budget_s": 900.0, "lost": False, **own, **more}


def table(leads: dict[str, Sequence[float]]) -> list[Row]:
    """PLGRIM at 60 % in every run, and NBV behind it by these points."""
    return [
        found
        for world, points in leads.items()
        for seed, behind in enumerate(points, 1)
        for found in (row(world, "plgrim", seed, 0.6), row(world, "nbv", seed, 0.6 - behind / 100.0))
    ]


def test_the_area_under_a_hand_made_curve_is_what_the_table_compares() -> None:
    """Half at 100 s, all at 300 s, over 400 s: (200 * 0.5 + 100 * 1.0) / 400."""
    curve = Curve(np.array([0.0, 100.0, 300.0]), np.array([0.0, 0.5, 1.0]), np.zeros(3))
    assert curve.mean(400.0) == pytest.approx(0.5)


def test_a_lead_is_of_pairs_and_in_points() -> None:
    rows = [*table({"maze": [1.0, 3.0]}), row("maze", "nbv", 9, 0.1), row("cave", "nbv", 1, 0.1)]
    assert lead(rows, "maze", "nbv") == pytest.approx([1.0, 3.0])
    assert lead(rows, "maze", "hfe") == []
    other_budget = [*table({"maze": [1.0]})[:1], row("maze", "nbv", 1, 0.5, budget_s=450.0)]
    assert lead(other_budget, "maze", "nbv") == []


def test_growth_is_the_difference_of_means_with_an_interval_that_covers_it() -> None:
    small, large = [1.0, 2.0, 3.0, 2.0], [5.0, 9.0, 7.0]
    found = growth(small, large, "x")
    assert found.mean == pytest.approx(5.0)
    assert 3.0 <= found.low < 5.0 < found.high <= 7.0
    # By hand: of all 4^4 * 3^3 pairs of resamples.
    exact = [
        np.mean([large[a], large[b], large[c]]) - np.mean([small[d], small[e], small[f], small[g]])
        for a in range(3) for b in range(3) for c in range(3)
        for d in range(4) for e in range(4) for f in range(4) for g in range(4)
    ]  # fmt: skip
    assert (found.low, found.high) == pytest.approx(np.quantile(exact, [0.025, 0.975]), abs=0.2)
    assert growth(small, large, "x") == found, "the same again"
    assert math.isnan(growth([1.0, 2.0], large).low)


def test_the_table_tells_means_leads_and_growth() -> None:
    rows = table({"subway_1x": [1.0, 1.0, 1.0], "subway_2x": [2.0, 3.0, 4.0], "subway_3x": [6.0, 6.0, 6.0]})
    rows[1] |= {"lost": True, "t95_s": 500.0, "lcp_answer_p50_ms": 12.34}
    text = paper_text(rows, "Paper")
    lines = [line for line in text.splitlines() if line.startswith("| subway")]
    assert len(lines) == 6
    cells = [cell.strip() for cell in lines[1].split("|")][1:]
    assert cells[:6] == ["subway_1x", "900", "`nbv`", "3", "1", "+1.00 [+1.00, +1.00]"]
    assert cells[6] == "59.00"
    assert "500 (1/3)" in cells and "12.3 (1/3)" in cells
    assert [cell.strip() for cell in lines[3].split("|")][6].startswith("+3.00 [+2.")
    assert "3x minus 1x: +5.00 [+5.00, +5.00] points" in text
    assert "hfe" not in text.split("Lead over")[1]


# --- what is run --------------------------------------------------------------------------------------------------


def test_the_worlds_are_the_papers_and_the_planners_are_accepted_by_every_service() -> None:
    assert list(BUDGETS_S) == ["subway_1x", "subway_2x", "subway_3x", "maze", "cave", "lava_tube"]
    campaign = Campaign(paper_worlds(list(BUDGETS_S), 0.5), paper_variants(), [1, 2])
    runs = campaign.runs()
    assert len(runs) == 36
    assert {run.world: run.budget_s for run in runs} == {w: 0.5 * s for w, s in BUDGETS_S.items()}
    assert {run.world: run.identity["limit_s"] for run in runs}["cave"] == 900.0


def test_baselines_replace_the_planners_only() -> None:
    """Risk map, roadmaps, mission and simulator have the same options; of the reconciler only tau* differs."""
    for world in BUDGETS_S:
        campaign = Campaign(paper_worlds([world]), paper_variants(), [1])
        mine, *others = campaign.runs()
        for other in others:
            for service in ("riskmap", "irm", "mission", "sim"):
                assert other.identity[service] == mine.identity[service]
            others_own, own = other.identity["reconciler"], mine.identity["reconciler"]
            left = {key for key in {*own, *others_own} if own.get(key) != others_own.get(key)}
            assert left <= {"profile", "weights"}, "tau* and what it counts; nothing of motion and safety"


def test_every_variant_of_the_grids_is_a_configuration() -> None:
    for planner in GRID:
        assert GRID[planner][BASE] == {}
        variants = tuning_variants(planner)
        assert Campaign(paper_worlds(["maze"]), variants, [101]).runs()
        assert all(v.overlay["lcp"]["planner"] == planner for v in variants)
    with pytest.raises(ConfigError, match=r"'nonsense' is not in the grid of nbv: as_it_is"):
        tuning_variants("nbv", ["nonsense"])
    assert Campaign(paper_worlds(["maze"]), reconciliation_variants(), [1]).runs()


def test_seeds_for_tuning_are_never_scored() -> None:
    check_scored_seeds([1, 100])
    check_tuning_seeds([101, 999])
    with pytest.raises(ConfigError, match="are for tuning"):
        check_scored_seeds([1, 101])
    with pytest.raises(ConfigError, match="are scored"):
        check_tuning_seeds([100, 101])


def test_the_best_variant_weighs_every_world_alike(tmp_path: Path) -> None:
    rows = [
        row("maze", "radius_6", 101, 0.5), row("maze", "radius_6", 102, 0.7), row("cave", "radius_6", 101, 0.2),
        row("maze", BASE, 101, 0.5), row("cave", BASE, 101, 0.28), row("maze", "radius_8", 101, 0.9),
    ]  # fmt: skip
    ranked = best_of(rows, ["maze", "cave"], [BASE, "radius_6", "radius_8"])
    assert [name for name, _ in ranked] == ["radius_6", BASE, "radius_8"]
    assert [mean for _, mean in ranked[:2]] == pytest.approx([40.0, 39.0])
    assert math.isnan(ranked[2][1]), "not run in the cave"
    assert write_tuning(tmp_path, "nbv", rows, paper_worlds(["maze", "cave"])) == "radius_6"
    best = yaml.safe_load((tmp_path / "best.yaml").read_text())
    assert best == {"lcp": {"nbv": {"radius_m": 6.0}}}
    assert merged(PLANNERS["nbv"], best)["lcp"]["nbv"] == {"radius_m": 6.0}
    assert "| `radius_6` | 40.00 |" in (tmp_path / "ranking.md").read_text()


def test_the_table_of_the_ablation_compares_with_tau() -> None:
    rows = [
        row("subway_blocks", profile, seed, 0.5, heading_jump_deg=jump + seed, hazard_cut_s=0.5)
        for profile, jump in (("default", 10.0), ("always_new", 30.0))
        for seed in (1, 2, 3)
    ]
    text = reconciliation_text(rows, "Reconciliation")
    lines = [line for line in text.splitlines() if line.startswith("| subway_blocks")]
    assert "| 12.0 |" in lines[0]
    assert "32.0 (+20.00 [+20.00, +20.00])" in lines[1]
    assert "always_old" not in text.split("| tau*")[1]


# --- the commands -------------------------------------------------------------------------------------------------


@pytest.fixture
def fake_missions(monkeypatch: pytest.MonkeyPatch) -> None:
    """No world is built, and processes stand in for missions."""
    monkeypatch.setattr(campaign_module, "check_worlds", lambda runs: None)
    monkeypatch.setattr(campaign_pool.Pool.__init__, "__defaults__", (command,))


def run(*arguments: str) -> str:
    """`plgrim evaluate ...`: what it prints."""
    result = CliRunner().invoke(application, ["evaluate", *arguments])
    assert result.exit_code == 0, result.output + str(result.exception)
    return result.output


@pytest.mark.usefixtures("fake_missions")
def test_the_command_writes_the_table_and_goes_on_where_it_was(tmp_path: Path) -> None:
    out = tmp_path / "paper"
    options = ("--world", "maze", "--time-scale", "0.1", "--jobs", "2", "--out", str(out))
    first = run("paper", "--seeds", "1", *options)
    assert "3 missions, 0 of them finished before" in first
    text = (out / "paper.md").read_text()
    assert [line.split("|")[3].strip() for line in text.splitlines() if line.startswith("| maze")] == [
        "`plgrim`", "`nbv`", "`hfe`",
    ]  # fmt: skip
    second = run("paper", "--seeds", "1-2", *options)
    assert "6 missions, 3 of them finished before" in second
    assert (out / "coverage.png").stat().st_size > 1000
    only = run("paper", "--seeds", "1", "--planner", "nbv", *options)
    assert "1 missions, 1 of them finished before" in only
    assert "`plgrim`" not in (out / "paper.md").read_text()


@pytest.mark.usefixtures("fake_missions")
def test_tuning_gives_a_file_that_the_paper_takes(tmp_path: Path) -> None:
    out = tmp_path / "tune"
    run("tune", "hfe", "--world", "cave", "--seeds", "101", "--variant", "gain_3", "--variant", BASE,
        "--jobs", "2", "--out", str(out))  # fmt: skip
    best = out / "best.yaml"
    assert (out / "ranking.md").exists()
    best.write_text("gcp: {hfe: {gain_weight: 3.0}}\n")
    run("paper", "--world", "cave", "--planner", "hfe", "--seeds", "1", "--hfe", str(best), "--jobs", "1",
        "--out", str(tmp_path / "paper"))  # fmt: skip
    config = yaml.safe_load((tmp_path / "paper/runs/cave/hfe/seed_001/config.yaml").read_text())
    assert config["gcp"] == {"solver": "hfe", "hfe": {"gain_weight": 3.0}}
    assert config["lcp"]["planner"] == "hfe"


@pytest.mark.usefixtures("fake_missions")
def test_the_ablation_runs_every_profile(tmp_path: Path) -> None:
    out = tmp_path / "reconciliation"
    said = run("reconciliation", "--world", "subway_blocks", "--seeds", "1", "--jobs", "2", "--out", str(out))
    assert "4 missions" in said
    assert "subway_blocks" in WORLD_NAMES
    text = (out / "reconciliation.md").read_text()
    assert all(f"`{name}`" in text for name in ("default", "paper", "always_new", "always_old"))


def test_wrong_names_are_refused(tmp_path: Path) -> None:
    for arguments in (
        ["paper", "--world", "moon"], ["paper", "--planner", "tare"], ["tune", "plgrim"], ["paper", "--seeds", "101"],
    ):  # fmt: skip
        result = CliRunner().invoke(application, ["evaluate", *arguments, "--out", str(tmp_path / "x")])
        assert isinstance(result.exception, ConfigError), result.output
