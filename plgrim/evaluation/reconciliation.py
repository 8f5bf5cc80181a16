"""What reconciliation is good for: tau* against keeping all of the old policy, or nothing of it.

The same planners in the same worlds; only how much of the driven policy a new one keeps differs. In `subway_blocks`
blocks come down before the robot, so that it is seen how soon a plan heeds what was not there when it was made.
"""

from __future__ import annotations

from collections.abc import Sequence

from plgrim.evaluation.campaign_child import FINISHED
from plgrim.evaluation.campaign_plan import Variant, World
from plgrim.evaluation.campaign_rows import Row
from plgrim.evaluation.campaign_summary import Metric, markdown, paired
from plgrim.evaluation.paper import interval_text
from plgrim.evaluation.statistics import bootstrap_mean, spread

PROFILES = ("default", "paper", "always_new", "always_old")
"""Of the reconciler; the first is what the others are compared with."""

BUDGETS_S = {"subway_blocks": 900.0, "subway_1x": 900.0, "maze": 1800.0, "lava_tube": 1500.0}
"""Worlds, and the mission time in each, s."""

METRICS = (
    Metric("heading_jump_deg", "heading jump [deg]"),
    Metric("heading_jump_p95_deg", "95 % of jumps below [deg]"),
    Metric("turned_deg_per_m", "turned [deg/m]"),
    Metric("target_switches_per_100m", "switches per 100 m", digits=2),
    Metric("distance_m", "driven [m]", digits=0),
    Metric("d90_m", "90 % after [m]", digits=0),
    Metric("d95_m", "95 % after [m]", digits=0),
    Metric("coverage_mean", "AUC [%]", 100.0, 2),
    Metric("hazards", "hazards met"),
    Metric("hazard_cut_s", "path cut after [s]", digits=2),
    Metric("hazard_reaction_s", "new way after [s]", digits=2),
    Metric("contacts", "contacts"),
)

_LEGEND = """\
Means over the seeds; in brackets the difference from `default` in pairs of the same seed with its 95 % bootstrap
interval. Heading jump: between the direction of a new plan just behind the point where it leaves the plan that is
driven, and the direction before (the robot's own where they part at once). Turned: all turning of the robot over its
way. Hazard: a block that comes down on the line being driven; cut: the line no longer runs into it; new way: a line
that leads on elsewhere.
"""


def reconciliation_worlds(names: Sequence[str], time_scale: float = 1.0) -> list[World]:
    """The worlds with their time budgets, times a factor. Raises KeyError for another world."""
    return [World.built_in(name, time_scale * BUDGETS_S[name]) for name in names]


def reconciliation_variants() -> list[Variant]:
    """PLGRIM with each profile of the reconciler."""
    return [Variant(name, {"reconciler": {"profile": name}}) for name in PROFILES]


def reconciliation_text(table: Sequence[Row], title: str) -> str:
    """The result as Markdown: one table."""
    header = ["world", "tau*", "runs", "lost", *(metric.title for metric in METRICS)]
    cells = [
        cell
        for world in dict.fromkeys(row["world"] for row in table)
        for cell in _world_cells([row for row in table if row["world"] == world], world)
    ]
    return "\n".join([f"# {title}\n", _LEGEND, *markdown(header, cells)]) + "\n"


def _world_cells(table: Sequence[Row], world: str) -> list[list[str]]:
    runs = {
        name: [row for row in table if row["variant"] == name and row["status"] == FINISHED]
        for name in PROFILES
    }
    return [
        [
            world,
            f"`{name}`",
            str(len(rows)),
            str(sum(bool(row["lost"]) for row in rows)),
            *(_text(metric, rows, runs[PROFILES[0]], world, name) for metric in METRICS),
        ]
        for name, rows in runs.items()
        if rows
    ]


def _text(metric: Metric, rows: Sequence[Row], base: Sequence[Row], world: str, name: str) -> str:
    values = metric.values(rows)
    if not values:
        return "-"
    mean = metric.text(spread(values)[0])
    pairs = [] if name == PROFILES[0] else paired(metric, rows, base)
    if not pairs:
        return mean
    return f"{mean} ({interval_text(bootstrap_mean(pairs, world, name, metric.column))})"
