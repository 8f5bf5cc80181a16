"""The table of a campaign: one row a run, read from the run's folder, so that it can be made anew without driving."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plgrim.evaluation.campaign_child import CRASHED, FINISHED, RUN_FILE, read_json
from plgrim.registry import STAGES

Floats = NDArray[np.float64]
Row = dict[str, Any]

LEVELS = (50, 80, 90, 95, 97, 98, 99)
"""Coverage in per cent whose time and distance a row tells."""

COLUMNS = (
    "world", "variant", "seed", "status", "finish", "lost", "lost_reason", "coverage", "coverage_belief",
    "coverage_mean", "budget_s", "covered_area_m2", "reachable_area_m2", "mission_s", "distance_m", "contacts",
    "target_switches_per_100m",
    *(f"t{level}_s" for level in LEVELS), *(f"d{level}_m" for level in LEVELS),
    *(f"{stage}_{share}_ms" for stage in STAGES for share in ("p50", "p99")),
    *(f"{stage}_answer_{share}_ms" for stage in ("lcp", "gcp") for share in ("p50", "p99")),
    "heading_jump_deg", "heading_jump_p95_deg", "sharp_jumps", "junctions", "turned_deg_per_m",
    "hazards", "hazard_cut_s", "hazard_reaction_s",
    "wall_s", "times_real_time", "digest", "code", "fingerprint", "error",
)  # fmt: skip
"""Of runs.csv. An empty cell: there is no such value (a level that was not reached, a run that crashed).

coverage_mean: area under the judge's coverage over `budget_s` of mission time, divided by it; what was covered at the
end counts until then. t90_s, d90_m: mission time and driven distance at 90 % coverage by the judge.
lcp_answer_*: wall time of the steps that answered, not of all. heading_jump_deg ... hazard_reaction_s: see
`plgrim.evaluation.plan_changes`. turned_deg_per_m: all turning of the true pose, over the distance driven.
"""


@dataclass(frozen=True)
class Curve:
    """Coverage by the judge (share) and driven distance (m) over mission time (s), each (n,), times ascending."""

    time_s: Floats
    coverage: Floats
    distance_m: Floats
    yaw_rad: Floats = field(default_factory=lambda: np.zeros(0))
    """Of the true pose, (n,)."""

    @classmethod
    def read(cls, path: Path) -> Curve:
        """From a trajectory.csv; empty when there is none."""
        names = ("t_s", "coverage", "distance_m", "true_yaw_rad")
        try:
            with path.open(newline="", encoding="utf-8") as file:
                rows = [[float(row.get(name, 0.0)) for name in names] for row in csv.DictReader(file)]
        except OSError:
            rows = []
        table = np.array(rows, np.float64).reshape(-1, 4)
        return cls(*table.T)

    @property
    def turned_deg_per_m(self) -> float | None:
        """All turning over the distance driven, degrees a metre; None when it did not drive."""
        if self.yaw_rad.size < 2 or self.distance_m[-1] <= 0.0:
            return None
        turns = np.remainder(np.diff(self.yaw_rad) + np.pi, 2.0 * np.pi) - np.pi
        return float(np.degrees(np.abs(turns).sum()) / self.distance_m[-1])

    def at(self, times_s: Floats) -> Floats:
        """Coverage at times; before the first sample 0, after the last what it was then. Shape of `times_s`."""
        after = np.searchsorted(self.time_s, times_s, side="right")
        return np.concatenate([[0.0], self.coverage])[after]

    def mean(self, budget_s: float) -> float | None:
        """Area under the coverage from 0 to the budget, divided by the budget."""
        if not self.time_s.size or budget_s <= 0:
            return None
        inside = self.time_s < budget_s
        edges = np.concatenate([np.maximum(self.time_s[inside], 0.0), [budget_s]])
        return float(np.sum(self.coverage[inside] * np.diff(edges)) / budget_s)

    def reached(self, share: float) -> tuple[float, float] | None:
        """(mission time in s, driven distance in m) of the first sample with so much coverage."""
        there = np.flatnonzero(self.coverage >= share)
        return (float(self.time_s[there[0]]), float(self.distance_m[there[0]])) if there.size else None


@dataclass(frozen=True)
class Finished:
    """A run that has ended: how it is filed, what was written, and its curve."""

    task: dict[str, Any]
    result: dict[str, Any]
    curve: Curve

    @classmethod
    def read(cls, folder: Path) -> Finished | None:
        """From a run's folder; None while it has not ended."""
        task = read_json(folder / RUN_FILE)
        result = read_json(folder / "result.json")
        if task.get("status") == CRASHED:
            return cls(task, {}, Curve.read(folder / "-"))
        if task.get("status") != FINISHED or not result:
            return None
        return cls(task, result, Curve.read(folder / "trajectory.csv"))

    @property
    def mission_s(self) -> float:
        """Mission time at the end."""
        return float(self.result.get("elapsed_s") or 0.0)


def rows(runs: Sequence[Finished]) -> list[Row]:
    """A row a run, in this order. Where no time budget was set it is, for all in a world, the longest mission there."""
    longest: dict[str, float] = {}
    for run in runs:
        longest[run.task["world"]] = max(longest.get(run.task["world"], 0.0), run.mission_s)
    return [_row(run, run.task["budget_s"] or longest[run.task["world"]]) for run in runs]


def _row(run: Finished, budget_s: float) -> Row:
    task, result = run.task, run.result
    row: Row = dict.fromkeys(COLUMNS)
    for name in ("world", "variant", "seed", "status", "error", "fingerprint"):
        row[name] = task[name]
    row["code"] = task["identity"]["code"]
    if not result:
        return row
    for name in (
        "lost", "lost_reason", "coverage_belief", "covered_area_m2", "reachable_area_m2", "distance_m",
        "contacts", "target_switches_per_100m", "wall_s", "times_real_time", "digest",
    ):  # fmt: skip
        row[name] = result.get(name)
    row |= {
        "coverage": result["coverage_judge"],
        "coverage_mean": run.curve.mean(budget_s),
        "budget_s": budget_s,
        "mission_s": result["elapsed_s"],
        "finish": result["finish"] or ("lost" if result["lost"] else "time_limit"),
    }
    changes = result.get("plan_changes", {})
    row |= {name: changes[name] for name in COLUMNS if name in changes}
    row["turned_deg_per_m"] = run.curve.turned_deg_per_m
    for stage, cost in result.get("answers", {}).items():
        for share in ("p50", "p99"):
            if f"{stage}_answer_{share}_ms" in row:
                row[f"{stage}_answer_{share}_ms"] = cost[f"{share}_ms"]
    for level in LEVELS:
        if (found := run.curve.reached(level / 100.0)) is not None:
            row[f"t{level}_s"], row[f"d{level}_m"] = found
    for stage, cost in result["stages"].items():
        for share in ("p50", "p99"):
            if f"{stage}_{share}_ms" in row:
                row[f"{stage}_{share}_ms"] = cost[f"step_{share}_ms"]
    return row


def write_rows(path: Path, table: Iterable[Row]) -> None:
    """Write runs.csv: the columns in their order, numbers to six digits, nothing where there is no value."""
    part = path.with_suffix(".part")
    with part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for row in table:
            writer.writerow([_cell(row[name]) for name in COLUMNS])
    part.replace(path)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.6g}" if isinstance(value, float) else str(value)
