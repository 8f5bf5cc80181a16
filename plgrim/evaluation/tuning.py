"""Tuning the baselines: each parameter is tried around its default, on seeds that are never scored.

One change at a time, in whole missions; the best by mean area under the coverage curve is written as a YAML file that
`plgrim evaluate paper` takes. The grid is fixed here, so that what was tried is on record.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from plgrim.errors import ConfigError
from plgrim.evaluation.campaign_plan import Overlay, Variant, World, merged
from plgrim.evaluation.campaign_rows import Row
from plgrim.evaluation.campaign_summary import markdown
from plgrim.evaluation.paper import FIRST_TUNING_SEED, PLANNERS, best_of

BASE = "as_it_is"


def _nbv(**changes: object) -> Overlay:
    return {"lcp": {"nbv": changes}}


def _hfe(**changes: object) -> Overlay:
    return {"gcp": {"hfe": changes}}


_LEFTOVERS = {"leftover_weight": 3.0, "leftover_gain": 0.3}
"""Weighed up: PLGRIM counted them so before it was measured that plain ones cover more."""

GRID: Mapping[str, Mapping[str, Overlay]] = {
    "nbv": {
        BASE: {},
        "radius_6": _nbv(radius_m=6.0),
        "radius_8": _nbv(radius_m=8.0),
        "radius_20": _nbv(radius_m=20.0),
        "samples_64": _nbv(samples=64),
        "samples_1024": _nbv(samples=1024),
        "min_reward_0.1": _nbv(min_reward=0.1),
        "min_reward_1": _nbv(min_reward=1.0),
        "forgets_best": _nbv(keep_best=False),
        "switches_for_half": _nbv(switch_share=0.5),
        "goes_to_the_view": _nbv(switch_share=1e9),
        "shortest_paths": _nbv(risk_weight_m=0.0),
        "myopic": {"lcp": {"weights": {"gamma_per_m": 0.95}}},
        "far_sighted": {"lcp": {"weights": {"gamma_per_m": 0.995}}},
        "leftovers": {"lcp": {"weights": _LEFTOVERS}, "reconciler": {"weights": _LEFTOVERS}},
        "best_frontier": _hfe(gain_weight=1.0),
        "tau_new": {"reconciler": {"profile": "always_new"}},
        "tau_old": {"reconciler": {"profile": "always_old"}},
    },
    "hfe": {
        BASE: {},
        "global_only": _hfe(scopes_m=[]),
        "scope_8": _hfe(scopes_m=[8.0]),
        "scope_20": _hfe(scopes_m=[20.0]),
        "scopes_8_25": _hfe(scopes_m=[8.0, 25.0]),
        "nearest": _hfe(gain_weight=0.0, scopes_m=[]),
        "gain_0.3": _hfe(gain_weight=0.3),
        "gain_3": _hfe(gain_weight=3.0),
        "margin_0.2": _hfe(switch_margin=0.2),
        "margin_4": _hfe(switch_margin=4.0),
        "goes_to_the_end": _hfe(switch_margin=1e9),
        "look_6": {"lcp": {"hfe": {"look_radius_m": 6.0}}},
        "tau_default": {"reconciler": {"profile": "default"}},
        "tau_old": {"reconciler": {"profile": "always_old"}},
    },
}
"""By baseline: what is laid over it, by name."""


def tuning_variants(planner: str, names: Sequence[str] = ()) -> list[Variant]:
    """The variants of a baseline's grid, all or those named. Raises ConfigError for a name that is not in it."""
    grid = GRID[planner]
    for name in names:
        if name not in grid:
            raise ConfigError(f"{name!r} is not in the grid of {planner}: {', '.join(grid)}")
    return [Variant(name, merged(PLANNERS[planner], grid[name])) for name in names or grid]


def check_tuning_seeds(seeds: Sequence[int]) -> None:
    """ConfigError when a seed is one of those that are scored."""
    if scored := [seed for seed in seeds if seed < FIRST_TUNING_SEED]:
        raise ConfigError(f"seeds {scored} are scored: tune on seeds from {FIRST_TUNING_SEED} on")


def check_scored_seeds(seeds: Sequence[int]) -> None:
    """ConfigError when a seed is one of those for tuning."""
    if tuned := [seed for seed in seeds if seed >= FIRST_TUNING_SEED]:
        raise ConfigError(f"seeds {tuned} are for tuning: score on seeds below {FIRST_TUNING_SEED}")


def write_tuning(folder: Path, planner: str, table: Sequence[Row], worlds: Sequence[World]) -> str:
    """Write ranking.md and best.yaml (what to lay over the baseline) into the folder; gives the best variant's name."""
    names, variants = [world.name for world in worlds], list(GRID[planner])
    ranked = best_of(table, names, variants)
    whole = [name for name, mean in ranked if not math.isnan(mean)]
    cells = [
        [f"`{name}`", "-" if math.isnan(mean) else f"{mean:.2f}", str(dict(GRID[planner][name]) or "-")]
        for name, mean in ranked
    ]
    seeds = sorted({int(row["seed"]) for row in table})
    text = f"# Tuning of {planner}\n\nMean AUC [%] over {', '.join(names)}; seeds {seeds}.\n\n"
    lines = markdown(["variant", "mean AUC [%]", "changes"], cells)
    (folder / "ranking.md").write_text(text + "\n".join(lines) + "\n", encoding="utf-8")
    best = whole[0] if whole else BASE
    changes = yaml.safe_dump(_plain(GRID[planner][best]), sort_keys=False)
    (folder / "best.yaml").write_text(f"# {planner}: {best}\n{changes}", encoding="utf-8")
    return best


def _plain(overlay: Overlay) -> dict[str, object]:
    """An overlay as plain dictionaries."""
    return {
        key: _plain(value) if isinstance(value, Mapping) else value
        for key, value in overlay.items()
        if not isinstance(value, Mapping) or value
    }
