"""What a campaign shows, as Markdown: per world a table of the variants, and their differences in pairs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from plgrim.evaluation.campaign_child import FINISHED
from plgrim.evaluation.campaign_rows import Row
from plgrim.evaluation.statistics import bootstrap_mean, share_interval, spread


@dataclass(frozen=True)
class Metric:
    """A column of runs.csv as the tables show it: value times scale, with so many digits."""

    column: str
    title: str
    scale: float = 1.0
    digits: int = 1

    def values(self, rows: Iterable[Row]) -> list[float]:
        """Of the runs that have one, scaled."""
        return [self.scale * float(row[self.column]) for row in rows if row[self.column] is not None]

    def text(self, value: float) -> str:
        """A number, or a dash."""
        return "-" if math.isnan(value) else f"{value:.{self.digits}f}"


METRICS = (
    Metric("coverage", "coverage [%]", 100.0),
    Metric("coverage_mean", "mean coverage [%]", 100.0),
    Metric("t90_s", "90 % at [s]", digits=0),
    Metric("t95_s", "95 % at [s]", digits=0),
    Metric("t97_s", "97 % at [s]", digits=0),
    Metric("d95_m", "95 % after [m]", digits=0),
    Metric("distance_m", "driven [m]", digits=0),
    Metric("mission_s", "mission [s]", digits=0),
    Metric("target_switches_per_100m", "switches per 100 m", digits=2),
    Metric("contacts", "contacts"),
)
_LOST = Metric("lost", "lost [points]", 100.0, 0)


def summary_text(table: Sequence[Row], variants: Sequence[str], title: str) -> str:
    """The whole summary. variants: in this order, others after them; the first that a world has is compared with."""
    parts = [f"# {title}\n", _LEGEND]
    for world in dict.fromkeys(row["world"] for row in table):
        parts.append(_world_text(world, [row for row in table if row["world"] == world], variants))
    return "\n".join(parts)


_LEGEND = """\
Mean ± standard deviation over the runs; (n/N) where only n of N runs have the value. Coverage is the judge's;
mean coverage is the area under its curve over the time budget. Differences are of runs with the same seed: means with
95 % bootstrap intervals (from three pairs on, and too narrow with few); times to a level only of pairs in which both
reached it. Intervals of lost shares: Wilson.
"""


def ordered_variants(found: Iterable[str], wanted: Sequence[str]) -> list[str]:
    """Those that were found: first the wanted ones in their order, then the others."""
    names = dict.fromkeys(found)
    return [name for name in wanted if name in names] + [name for name in names if name not in wanted]


def _world_text(world: str, rows: Sequence[Row], wanted: Sequence[str]) -> str:
    variants = ordered_variants((row["variant"] for row in rows), wanted)
    finished = {
        name: [row for row in rows if row["variant"] == name and row["status"] == FINISHED]
        for name in variants
    }
    lines = [f"## {world}\n", *_notes(rows)]
    lines += markdown(
        ["variant", "runs", "lost", *(metric.title for metric in METRICS), "times real time"],
        [_variant_cells(name, finished[name]) for name in variants],
    )
    first, *others = variants
    if others:
        lines += ["", f"Differences from `{first}`:", ""]
        lines += markdown(
            ["variant", "pairs", _LOST.title, *(metric.title for metric in METRICS)],
            [_difference_cells(world, name, finished[name], finished[first]) for name in others],
        )
    return "\n".join(lines) + "\n"


def _notes(rows: Sequence[Row]) -> list[str]:
    notes = []
    budgets = sorted({row["budget_s"] for row in rows if row["budget_s"] is not None})
    if len(budgets) > 1:
        shown = ", ".join(f"{budget:.0f} s" for budget in budgets)
        notes.append(f"Time budgets differ ({shown}): only runs with the same one are paired.\n")
    elif budgets:
        notes.append(f"Time budget {budgets[0]:.0f} s.\n")
    if crashed := [row for row in rows if row["status"] != FINISHED]:
        names = ", ".join(f"{row['variant']} seed {row['seed']}" for row in crashed)
        notes.append(f"**Crashed, and in no figure here: {names}.**\n")
    return notes


def _variant_cells(name: str, rows: Sequence[Row]) -> list[str]:
    speed = Metric("times_real_time", "")
    return [
        f"`{name}`", str(len(rows)), _lost_text(rows), *(_spread_text(m, rows) for m in METRICS),
        speed.text(spread(speed.values(rows))[0]),
    ]  # fmt: skip


def _lost_text(rows: Sequence[Row]) -> str:
    if not rows:
        return "-"
    lost = sum(bool(row["lost"]) for row in rows)
    share = share_interval(lost, len(rows))
    return f"{lost}/{len(rows)} ({100 * share.low:.0f} to {100 * share.high:.0f} %)"


def _spread_text(metric: Metric, rows: Sequence[Row]) -> str:
    values = metric.values(rows)
    if not values:
        return "-"
    mean, deviation = spread(values)
    some = "" if len(values) == len(rows) else f" ({len(values)}/{len(rows)})"
    around = "" if math.isnan(deviation) else f" ± {metric.text(deviation)}"
    return f"{metric.text(mean)}{around}{some}"


def paired(metric: Metric, rows: Sequence[Row], base: Sequence[Row]) -> list[float]:
    """Differences from the base, of runs with the same seed and time budget in which both have the value; by seed."""
    of_base = {(row["seed"], row["budget_s"]): row for row in base}
    found = []
    for row in sorted(rows, key=lambda row: int(row["seed"])):
        other = of_base.get((row["seed"], row["budget_s"]))
        if other is not None and row[metric.column] is not None and other[metric.column] is not None:
            found.append(metric.scale * (float(row[metric.column]) - float(other[metric.column])))
    return found


def _difference_cells(world: str, name: str, rows: Sequence[Row], base: Sequence[Row]) -> list[str]:
    return [
        f"`{name}`", str(len(paired(_LOST, rows, base))),
        *(_difference_text(metric, paired(metric, rows, base), world, name) for metric in (_LOST, *METRICS)),
    ]  # fmt: skip


def _difference_text(metric: Metric, differences: Sequence[float], world: str, name: str) -> str:
    if not differences:
        return "-"
    found = bootstrap_mean(differences, world, name, metric.column)
    text = f"{found.mean:+.{metric.digits}f}"
    if math.isnan(found.low):
        return text
    return f"{text} [{found.low:+.{metric.digits}f}, {found.high:+.{metric.digits}f}]"


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = [header, ["-"] * len(header), *rows]
    return ["| " + " | ".join(cells) + " |" for cells in lines]
