"""The tables and the picture of a campaign."""

from __future__ import annotations

from pathlib import Path

import pytest

from plgrim.evaluation.campaign_child import CRASHED
from plgrim.evaluation.campaign_picture import campaign_plot
from plgrim.evaluation.campaign_rows import COLUMNS, Row
from plgrim.evaluation.campaign_summary import Metric, ordered_variants, paired, summary_text
from tests.evaluation.test_campaign_rows import finished

COVERAGE = Metric("coverage", "coverage [%]", 100.0)


def row(variant: str, seed: int, coverage: float | None, **values: object) -> Row:
    """A finished run of `maze`."""
    base = {"world": "maze", "variant": variant, "seed": seed, "status": "finished", "lost": False}
    return {**dict.fromkeys(COLUMNS), **base, "coverage": coverage, "budget_s": 60.0, **values}


def cells(text: str, variant: str, table: int = 0) -> dict[str, str]:
    """The cells of a variant in the first or second table of a summary, by title."""
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    heads = [index for index, line in enumerate(lines) if line[0] == "variant"]
    below = next(line for line in lines[heads[table] :] if line[0] == f"`{variant}`")
    return dict(zip(lines[heads[table]], below, strict=True))


def test_the_variants_are_told_with_mean_and_spread() -> None:
    table = [
        row("a", seed, 0.9 + 0.02 * seed, lost=seed == 1, t90_s=50.0 if seed == 2 else None)
        for seed in (1, 2, 3)
    ]
    found = cells(summary_text(table, ["a"], "T"), "a")
    assert found["coverage [%]"] == "94.0 ± 2.0"
    assert found["lost"].startswith("1/3 (")
    assert found["90 % at [s]"] == "50 (1/3)"
    assert found["contacts"] == "-"


def test_variants_are_compared_with_the_first_in_pairs() -> None:
    """Each seed has a level of its own, far apart; in pairs the difference of 2 points is sure."""
    levels = {1: 0.1, 2: 0.5, 3: 0.9, 4: 0.3}
    table = [row("base", seed, level) for seed, level in levels.items()]
    table += [row("other", seed, level + 0.02) for seed, level in levels.items()]
    found = cells(summary_text(table, ["base", "other"], "T"), "other", 1)
    assert found["coverage [%]"] == "+2.0 [+2.0, +2.0]"
    assert found["pairs"] == "4"
    assert cells(summary_text(table, ["other", "base"], "T"), "base", 1)["coverage [%]"].startswith("-2.0")


def test_only_complete_pairs_count() -> None:
    base = [row("a", 1, 0.5), row("a", 2, None), row("a", 3, 0.5), row("a", 4, 0.5, budget_s=99.0)]
    other = [row("b", seed, 0.75) for seed in (5, 4, 3, 2, 1)]
    assert paired(COVERAGE, other, base) == pytest.approx([25.0, 25.0])


def test_crashed_runs_and_other_budgets_are_named() -> None:
    table = [
        row("a", 1, 0.5),
        row("a", 2, None, status=CRASHED, budget_s=None),
        row("a", 3, 0.5, budget_s=99.0),
    ]
    text = summary_text(table, ["a"], "T")
    assert "Crashed, and in no figure here: a seed 2." in text
    assert "Time budgets differ (60 s, 99 s)" in text
    assert cells(text, "a")["runs"] == "2"


def test_a_world_where_all_crashed_has_a_table() -> None:
    table = [row(name, 1, None, status=CRASHED, lost=None) for name in ("a", "b")]
    text = summary_text(table, ["a", "b"], "T")
    assert cells(text, "a")["runs"] == "0"
    assert cells(text, "b", 1)["coverage [%]"] == "-"


def test_variants_keep_the_order_they_were_given_in() -> None:
    assert ordered_variants(["x", "b", "a", "b"], ["a", "none", "b"]) == ["a", "b", "x"]


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    runs = [
        finished(tmp_path / f"{world}{variant}{seed}", world=world, variant=variant, seed=seed)
        for world in ("cave", "maze")
        for variant in ("a", "b")
        for seed in (1, 2)
    ]
    runs[0].result["lost"] = True
    campaign_plot(tmp_path / "coverage.png", runs, ["a", "b"])
    assert (tmp_path / "coverage.png").read_bytes().startswith(b"\x89PNG")
    campaign_plot(tmp_path / "none.png", [], ["a"])
    assert not (tmp_path / "none.png").exists()
