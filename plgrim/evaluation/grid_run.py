"""`plgrim evaluate grid`: many maps side by side, a row each; finished maps are kept, and the tables made of them."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plgrim.errors import ConfigError
from plgrim.evaluation.campaign_plan import code_version
from plgrim.evaluation.grid_rules import Rules
from plgrim.runtime.process import THREAD_LIMITS

PARAMETERS = Path(__file__).with_name("grid_parameters.yaml")
ROWS_FILE, SUMMARY_FILE = "maps.csv", "summary.md"
COLUMNS = (
    "set", "map", "travel", "ratio", "reference", "ratio_rule_here", "rule_here", "known_map_tour", "moves",
    "finished", "unseen_cells", "moves_by_path", "moves_by_target", "moves_goal_kept", "moves_by_protocol",
    "plan_ms_p50", "plan_ms_p99", "wall_s", "notes",
)  # fmt: skip
_PEERS = {"ariadne": ("utility_px", "set_cover_tsp_px"), "dare": ("tare_port_m",)}
"""The peers that a travel is compared with: the better of them."""
_TOUR = "full_map_tour_px"
_UNIT = {"ariadne": "px", "dare": "m"}
_HOW = {
    "path": "moves_by_path", "target": "moves_by_target", "goal kept": "moves_goal_kept",
    "protocol's nearest": "moves_by_protocol",
}  # fmt: skip


@dataclass(frozen=True)
class Task:
    """One map: where it is, what it is held against (NaN: nothing is known), and where its result goes."""

    group: str
    image: Path
    rules: Rules
    parameters: Path
    out: Path
    reference: float
    tour: float
    pictures: bool
    identity: str

    @property
    def result(self) -> Path:
        """The result of this map."""
        return self.out / "maps" / f"{self.group}_{self.image.stem}.json"


def find_maps(folder: Path, rules: Rules) -> list[Path]:
    """The PNG images of a folder, or of its sub-folders whose names begin with the rules' name. Raises ConfigError."""
    if not folder.is_dir():
        raise ConfigError(f"--maps: {folder} is no folder")
    found = sorted(folder.glob("*.png"), key=_natural) or sorted(folder.glob(f"{rules}*/*.png"), key=_natural)
    if not found:
        raise ConfigError(f"--maps: no PNG image in {folder}, nor in {folder}/{rules}*")
    return found


def _natural(path: Path) -> tuple[str, int, str]:
    digits = "".join(c for c in path.stem if c.isdigit())
    return path.parent.name, int(digits or 0), path.stem


def read_peers(path: Path | None, folder: Path, rules: Rules) -> dict[tuple[str, str], dict[str, float]]:
    """The peers' travels by (set, file name): from a CSV, else from peers_<rules>.csv in or beside the folder."""
    places = [path] if path else [place / f"peers_{rules}.csv" for place in (folder, folder.resolve().parent)]
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        if path is not None:
            raise ConfigError(f"--peers: {path} cannot be read")
        return {}
    with file.open(encoding="utf-8", newline="") as lines:
        rows = list(csv.DictReader(lines))
    if rows and not {"set", "map", *_PEERS[rules]} <= rows[0].keys():
        raise ConfigError(f"{file}: columns set, map, {', '.join(_PEERS[rules])} are wanted")
    return {
        (row["set"], row["map"]): {k: float(v) for k, v in row.items() if k not in ("set", "map")}
        for row in rows
    }


def plan_tasks(
    folder: Path, rules: Rules, out: Path, parameters: Path, peers: Path | None, pictures: bool
) -> list[Task]:
    """A task a map."""
    known = read_peers(peers, folder, rules)
    identity = hashlib.sha256(f"{rules} {code_version()}".encode() + parameters.read_bytes()).hexdigest()[:16]
    tasks = []
    for image in find_maps(folder, rules):
        row = known.get((image.parent.name, image.name), {})
        reference = min((row[c] for c in _PEERS[rules] if c in row), default=math.nan)
        tasks.append(
            Task(image.parent.name, image, rules, parameters, out, reference, row.get(_TOUR, math.nan), pictures,
                 identity)
        )  # fmt: skip
    return tasks


def run_map(task: Task) -> dict[str, Any]:
    """Drive one map, write its result (and picture), and give its row."""
    from plgrim.evaluation.grid_drive import drive, milliseconds
    from plgrim.evaluation.grid_peers import discounted_utility, explore, nearest
    from plgrim.evaluation.grid_rules import make_world, read_map
    from plgrim.explorer import ExplorerConfig

    began = time.monotonic()
    grid = read_map(task.image, task.rules)
    rule = make_world(grid, task.rules)
    explore(rule, discounted_utility if task.rules == "ariadne" else nearest)
    found = drive(make_world(grid, task.rules), task.rules, ExplorerConfig.of(task.parameters))
    row: dict[str, Any] = {
        "set": task.group, "map": task.image.name, "travel": round(found.travelled, 2),
        "reference": task.reference, "ratio": found.travelled / task.reference,
        "rule_here": round(rule.travelled, 2), "ratio_rule_here": found.travelled / rule.travelled,
        "known_map_tour": task.tour, "moves": found.moves, "finished": found.finished,
        "unseen_cells": found.unseen_cells, **{column: found.how.get(how, 0) for how, column in _HOW.items()},
        **milliseconds(found.plan_s), "wall_s": round(time.monotonic() - began, 1), "notes": "; ".join(found.notes),
    }  # fmt: skip
    task.result.parent.mkdir(parents=True, exist_ok=True)
    if task.pictures:
        from plgrim.evaluation.grid_picture import grid_picture

        title = f"{task.group} {task.image.stem}: {row['travel']:.0f} {_UNIT[task.rules]}, ratio {row['ratio']:.3f}"
        grid_picture(task.result.with_suffix(".png"), grid, found.belief, found.track, title)
    record = {"identity": task.identity, "row": row, "track": found.track.tolist()}
    temporary = task.result.with_suffix(".tmp")
    temporary.write_text(json.dumps(record), encoding="utf-8")
    temporary.replace(task.result)
    return row


def kept_row(task: Task) -> dict[str, Any] | None:
    """The row of a map that was driven before by the same code and parameters."""
    try:
        record = json.loads(task.result.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    same = record.get("identity") == task.identity and (
        not task.pictures or task.result.with_suffix(".png").exists()
    )
    return dict(record["row"]) if same else None


def run_tasks(
    tasks: list[Task],
    jobs: int,
    told: Callable[[dict[str, Any]], None],
    stopped: Callable[[], bool] = lambda: False,
    force: bool = False,
) -> tuple[list[dict[str, Any]], list[str]]:
    """Rows of all maps, and what failed. told: each row as it comes. Stops between maps when `stopped`."""
    rows: list[dict[str, Any]] = []
    failed: list[str] = []
    waiting = []
    for task in tasks:
        row = None if force else kept_row(task)
        if row is None:
            waiting.append(task)
        else:
            rows.append(row)
            told(row)
    if waiting:
        os.environ.update(THREAD_LIMITS)
        context = multiprocessing.get_context("spawn")
        # The first map alone: it compiles the kernels that the others load.
        for piece, count in ((waiting[:1], 1), (waiting[1:], jobs)):
            with ProcessPoolExecutor(count, mp_context=context) as pool:
                pending = {pool.submit(run_map, task): task for task in piece}
                while pending:
                    done, _ = wait(pending, timeout=0.5, return_when=FIRST_COMPLETED)
                    if stopped():
                        pool.shutdown(wait=True, cancel_futures=True)
                        return rows, failed
                    for future in done:
                        task = pending.pop(future)
                        error = future.exception()
                        if error is not None:
                            failed.append(f"{task.group}/{task.image.name}: {type(error).__name__}: {error}")
                            continue
                        rows.append(future.result())
                        told(rows[-1])
    return rows, failed


def write_tables(rows: Iterable[Mapping[str, Any]], rules: Rules, out: Path, command: str) -> str:
    """Write maps.csv and summary.md; gives the summary."""
    ordered = sorted(rows, key=lambda row: (row["set"], _natural(Path(str(row["map"])))))
    out.mkdir(parents=True, exist_ok=True)
    with (out / ROWS_FILE).open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(ordered)
    text = summary(ordered, rules, command)
    (out / SUMMARY_FILE).write_text(text, encoding="utf-8")
    return text


def summary(rows: list[Mapping[str, Any]], rules: Rules, command: str) -> str:
    """Mean ratios with bootstrap intervals, by set and over all, as Markdown."""
    rule = "utility times exp(-d / 160)" if rules == "ariadne" else "nearest useful node"
    against = "the better of utility and set cover + TSP" if rules == "ariadne" else "the TARE port"
    lines = [
        f"# Grid protocol: {rules}",
        "",
        f"`{command}`",
        "",
        f"Ratio: our travel over that of {against}, mean over maps, 95 % bootstrap interval. Rule: the peers' "
        f"{rule}, run here. Moves by the protocol: to the nearest useful node, where PLGRIM had none.",
        "",
        f"| set | maps | finished | travel, {_UNIT[rules]} | ratio | ratio to the rule | worst | "
        "moves by the protocol | plan p50 / p99, ms |",
        "|-|-|-|-|-|-|-|-|-|",
    ]
    groups = sorted({str(row["set"]) for row in rows})
    for name in groups:
        lines.append(_line(name, [row for row in rows if row["set"] == name], rules))
    if len(groups) > 1:
        lines.append(_line("all", rows, rules))
    unfinished = [f"{row['set']}/{row['map']}" for row in rows if not row["finished"]]
    lines += ["", f"Not finished: {', '.join(unfinished) or 'none'}.", ""]
    return "\n".join(lines)


def _line(name: str, rows: list[Mapping[str, Any]], rules: Rules) -> str:
    from plgrim.evaluation.statistics import bootstrap_mean

    cells = []
    for column in ("ratio", "ratio_rule_here"):
        values = [float(row[column]) for row in rows if math.isfinite(float(row[column]))]
        found = bootstrap_mean(values, "grid", rules, name, column)
        interval = f" [{found.low:.3f}, {found.high:.3f}]" if math.isfinite(found.low) else ""
        cells.append(f"{found.mean:.3f}{interval}" if values else "-")
    worst = max((float(row["ratio"]) for row in rows), default=math.nan)
    travel = sum(float(row["travel"]) for row in rows) / len(rows)
    moves = sum(int(row["moves"]) for row in rows)
    helped = sum(int(row["moves_by_protocol"]) for row in rows)
    p50 = sorted(float(row["plan_ms_p50"]) for row in rows)[len(rows) // 2]
    p99 = max(float(row["plan_ms_p99"]) for row in rows)
    finished = sum(bool(row["finished"]) for row in rows)
    return (
        f"| {name} | {len(rows)} | {finished} | {travel:.1f} | {cells[0]} | {cells[1]} | {worst:.3f} | "
        f"{helped} of {moves} | {p50:.0f} / {p99:.0f} |"
    )
