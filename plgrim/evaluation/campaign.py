"""Campaigns: whole missions in lock-step, many worlds x variants x seeds, each in a process of its own.

What is finished stays: a campaign that was broken off goes on where it was. Results are only mixed when configuration
and code are the same. Library use: `run_campaign(Campaign(...), Path("out"), jobs=8)`.
"""

from __future__ import annotations

import fcntl
import shutil
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from plgrim.config import check_service, write_config
from plgrim.errors import AlreadyRunningError, PlgrimError
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
from plgrim.evaluation.campaign_plan import Campaign, Run, code_version, differences, run_name
from plgrim.evaluation.campaign_pool import Command, Pool, Runner, child_command
from plgrim.evaluation.campaign_rows import Finished, Row, rows, write_rows
from plgrim.evaluation.campaign_summary import summary_text
from plgrim.registry import check_world
from plgrim.runtime.process import Interrupted, interruptible

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
        self._known: dict[Path, Finished] = {}

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
        self._known.pop(folder, None)
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
        """Every run here that has ended under this code, those of earlier campaigns too, by world, variant and seed."""
        found = [self._read(file.parent) for file in sorted((self.path / "runs").glob(f"*/*/*/{RUN_FILE}"))]
        code = code_version()
        ended = [run for run in found if run is not None and run.task["identity"]["code"] == code]
        return sorted(ended, key=lambda run: (run.task["world"], run.task["variant"], run.task["seed"]))

    def _read(self, folder: Path) -> Finished | None:
        """Curves are long and do not change any more: read once."""
        if folder not in self._known and (run := Finished.read(folder)) is not None:
            self._known[folder] = run
        return self._known.get(folder)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other campaigns out. Raises AlreadyRunningError when there is one."""
        self.path.mkdir(parents=True, exist_ok=True)
        with (self.path / ".lock").open("w", encoding="utf-8") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise AlreadyRunningError(f"{self.path}: another campaign is at work here") from error
            yield


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
    pool: Runner | None = None,
) -> Outcome:
    """Run what is missing, `jobs` at a time; write runs.csv and summary.md after every run, coverage.png at the end.

    force: runs of another configuration or other code are made anew instead of refused. pool: runs them elsewhere than
    in child processes of this one. Raises PlgrimError.
    """
    stop = stop or threading.Event()
    folder, runs = CampaignFolder(out), campaign.runs()
    with folder.locked():
        outdated = folder.outdated(runs)
        if outdated and not force:
            refuse_outdated(folder, outdated)
        todo = [run for run in runs if not folder.is_finished(run)]
        try:
            with interruptible(stop):
                check_worlds(todo)
                folders = [folder.prepare(run) for run in todo]
        except Interrupted:
            folders = []
        if display is not None:
            display.planned(len(runs), len(runs) - len(todo))
        _drive(campaign, folder, folders, pool or Pool(jobs, command), display, stop)
        table = write_outputs(campaign, folder, with_picture=True)
    status = {(row_name(row), row["fingerprint"]): row["status"] for row in table}
    own = {run.name: status.get((run.name, run.fingerprint)) for run in runs}
    return Outcome(table, None not in own.values(), [name for name, how in own.items() if how == CRASHED])


def _drive(
    campaign: Campaign,
    folder: CampaignFolder,
    folders: Sequence[Path],
    pool: Runner,
    display: Display | None,
    stop: threading.Event,
) -> None:
    """Have the pool run the prepared folders, and write what there is after each."""

    def ended(path: Path, code: int) -> None:
        note_death(path, code)
        table = write_outputs(campaign, folder)
        if display is not None:
            name = folder.name_of(path)
            display.ended(name, next(row for row in table if row_name(row) == name))

    def poll() -> None:
        if display is not None:
            display.poll(pool.folders)

    pool.run(folders, stop, ended, poll)


def row_name(row: Row) -> str:
    """`world/variant/seed`, as the run is called."""
    return run_name(row["world"], row["variant"], row["seed"])


def write_outputs(campaign: Campaign, folder: CampaignFolder, with_picture: bool = False) -> list[Row]:
    """Write runs.csv, summary.md and (when asked: it takes a second) coverage.png from the runs that have ended."""
    ended = folder.ended()
    table, variants = rows(ended), [variant.name for variant in campaign.variants]
    write_rows(folder.path / "runs.csv", table)
    text = summary_text(table, variants, f"Missions of plgrim {code_version()}")
    (folder.path / "summary.md").write_text(text, encoding="utf-8")
    if with_picture:
        from plgrim.evaluation.campaign_picture import campaign_plot  # matplotlib: only when it is needed

        campaign_plot(folder.path / "coverage.png", ended, variants)
    return table


def note_death(folder: Path, code: int) -> None:
    """A child that could not say how it ended has crashed: note how. code: of the process, negative for a signal."""
    task = read_json(folder / RUN_FILE)
    if task["status"] in (FINISHED, CRASHED):
        return
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    error = f"the process {how}; see {folder / LOG_FILE}"
    write_json(folder / RUN_FILE, {**task, "status": CRASHED, "error": error})
