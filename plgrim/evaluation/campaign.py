"""Campaigns: whole missions in lock-step, many worlds x variants x seeds, each in a process of its own.

What is finished stays: a campaign that was broken off goes on where it was. Results are only mixed when configuration
and code are the same. Library use: `run_campaign(Campaign(...), Path("out"), jobs=8)`.
"""

from __future__ import annotations

import shutil
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from plgrim.config import check_service, write_config
from plgrim.errors import PlgrimError
from plgrim.evaluation.campaign_child import (
    CONFIG_FILE,
    CRASHED,
    FINISHED,
    LOG_FILE,
    PENDING,
    RUN_FILE,
    read_json,
    write_json,
)
from plgrim.evaluation.campaign_plan import Campaign, Run, code_version, differences
from plgrim.evaluation.campaign_pool import Command, Pool, child_command
from plgrim.evaluation.campaign_rows import Finished, Row, rows, write_rows
from plgrim.registry import check_world

_SHOWN_DIFFERENCES = 6


class Display(Protocol):
    """What shows how a campaign gets on."""

    def planned(self, total: int, kept: int) -> None:
        """So many runs there are; so many of them were there from before."""

    def ended(self, name: str, row: Row) -> None:
        """A run has ended with this row."""

    def poll(self, running: Sequence[Path]) -> None:
        """Some times a second, with the folders of the running missions."""


@dataclass(frozen=True)
class Outcome:
    """How a campaign ended. complete: every run has a row. crashed: names of runs that ended with an error."""

    table: list[Row]
    complete: bool
    crashed: list[str]


class CampaignFolder:
    """Where a campaign keeps its runs: `runs/<world>/<variant>/seed_<n>` below a folder, with `runs.csv` beside."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def of(self, run: Run) -> Path:
        """The folder of a run."""
        return self.path / "runs" / run.name

    def name_of(self, folder: Path) -> str:
        """`world/variant/seed` of a run's folder."""
        return folder.relative_to(self.path / "runs").as_posix()

    def is_finished(self, run: Run) -> bool:
        """Whether it has a result that holds. A crashed run is not finished."""
        task = read_json(self.of(run) / RUN_FILE)
        return task.get("status") == FINISHED and task.get("fingerprint") == run.fingerprint

    def outdated(self, runs: Sequence[Run]) -> list[Run]:
        """Runs with a result of another configuration or other code."""
        tasks = [(run, read_json(self.of(run) / RUN_FILE)) for run in runs]
        return [
            run
            for run, task in tasks
            if task.get("status") == FINISHED and task.get("fingerprint") != run.fingerprint
        ]

    def prepare(self, run: Run) -> Path:
        """Make the folder of a run anew: configuration and identity, nothing else."""
        folder = self.of(run)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_config(run.config, folder / CONFIG_FILE)
        write_json(
            folder / RUN_FILE,
            {
                "world": run.world,
                "variant": run.variant,
                "seed": run.seed,
                "budget_s": run.budget_s,
                "status": PENDING,
                "error": "",
                "fingerprint": run.fingerprint,
                "identity": run.identity,
            },
        )
        return folder

    def ended(self) -> list[Finished]:
        """Every run here that has ended under this code, those of earlier campaigns too, sorted by world and seed."""
        found = [Finished.read(file.parent) for file in sorted((self.path / "runs").rglob(RUN_FILE))]
        code = code_version()
        return [run for run in found if run is not None and run.task["identity"]["code"] == code]


def refuse_outdated(folder: CampaignFolder, outdated: Sequence[Run]) -> None:
    """PlgrimError that names what has changed since the runs were made."""
    first = outdated[0]
    changes = differences(read_json(folder.of(first) / RUN_FILE).get("identity", {}), first.identity)
    shown = "\n  ".join(changes[:_SHOWN_DIFFERENCES])
    more = f"\n  and {len(changes) - _SHOWN_DIFFERENCES} more" if len(changes) > _SHOWN_DIFFERENCES else ""
    raise PlgrimError(
        f"{folder.path}: {len(outdated)} finished runs are of another configuration or other code; "
        f"--force makes them anew, another --out keeps them. In {first.name}:\n  {shown}{more}"
    )


def check_worlds(runs: Sequence[Run]) -> None:
    """Build each world once, so that a wrong name or file is found before anything starts. Raises ConfigError."""
    firsts = {run.world: run for run in reversed(runs)}
    for run in firsts.values():
        options = check_service(run.config, "sim")
        if options is not None:
            check_world(options)


def run_campaign(
    campaign: Campaign,
    out: Path,
    jobs: int,
    display: Display | None = None,
    stop: threading.Event | None = None,
    force: bool = False,
    command: Command = child_command,
) -> Outcome:
    """Run what is missing, `jobs` at a time, and write runs.csv after every run.

    force: runs of another configuration or other code are made anew instead of refused. Raises PlgrimError.
    """
    folder, runs = CampaignFolder(out), campaign.runs()
    outdated = folder.outdated(runs)
    if outdated and not force:
        refuse_outdated(folder, outdated)
    todo = [run for run in runs if not folder.is_finished(run)]
    check_worlds(todo)
    if display is not None:
        display.planned(len(runs), len(runs) - len(todo))
    pool = Pool(jobs, command)

    def ended(path: Path, code: int) -> None:
        _note_death(path, code)
        table = write_table(folder)
        if display is not None:
            row = next(r for r in table if row_name(r) == folder.name_of(path))
            display.ended(folder.name_of(path), row)

    def poll() -> None:
        if display is not None:
            display.poll([child.folder for child in pool.running])

    folders = [folder.prepare(run) for run in todo]
    complete = pool.run(folders, stop or threading.Event(), ended, poll)
    table = write_table(folder)
    names = {run.name for run in runs}
    crashed = [row_name(row) for row in table if row["status"] == CRASHED and row_name(row) in names]
    return Outcome(table, complete, crashed)


def row_name(row: Row) -> str:
    """`world/variant/seed`, as the run is called."""
    return f"{row['world']}/{row['variant']}/seed_{row['seed']:03d}"


def write_table(folder: CampaignFolder) -> list[Row]:
    """Write runs.csv from the folders of the runs that have ended; gives its rows."""
    table = rows(folder.ended())
    folder.path.mkdir(parents=True, exist_ok=True)
    write_rows(folder.path / "runs.csv", table)
    return table


def _note_death(folder: Path, code: int) -> None:
    """A child that could not say how it ended has crashed."""
    task = read_json(folder / RUN_FILE)
    if task["status"] in (FINISHED, CRASHED):
        return
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    write_json(
        folder / RUN_FILE, {**task, "status": CRASHED, "error": f"the process {how}; see {folder / LOG_FILE}"}
    )
