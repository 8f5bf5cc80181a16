"""What a person sees while a campaign runs: a bar a mission on a terminal, a line a finished mission everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from plgrim.evaluation.campaign_child import PROGRESS_FILE, read_json
from plgrim.evaluation.campaign_rows import Row


def row_text(row: Row) -> str:
    """How a mission ended, in one line."""
    if row["error"]:
        return f"CRASHED: {row['error']}"
    lost = f"  LOST: {row['lost_reason']}" if row["lost"] else ""
    return (
        f"{row['finish']}: {100.0 * (row['coverage'] or 0.0):.1f} % in {row['mission_s'] or 0.0:.0f} s, "
        f"{row['distance_m'] or 0.0:.0f} m, {row['times_real_time']:.1f} times real time{lost}"
    )


class CampaignDisplay:
    """Shows a campaign; a context manager."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=30),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
            refresh_per_second=4,
            disable=not console.is_terminal,
        )
        self._all: TaskID | None = None
        self._tasks: dict[Path, TaskID] = {}

    def __enter__(self) -> CampaignDisplay:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def planned(self, total: int, kept: int) -> None:
        """So many missions there are; so many were there from before."""
        self._print(f"{total} missions, {kept} of them finished before")
        self._all = self._progress.add_task("campaign", total=total, completed=kept, note=f"{kept}/{total}")

    def ended(self, name: str, row: Row) -> None:
        """A mission has ended."""
        self._print(f"{name}  {row_text(row)}")
        if self._all is not None:
            self._progress.advance(self._all)
            task = next(t for t in self._progress.tasks if t.id == self._all)
            self._progress.update(self._all, note=f"{task.completed:.0f}/{task.total:.0f}")

    def poll(self, running: Sequence[Path]) -> None:
        """Bring the bars of the running missions up to date."""
        for folder in [f for f in self._tasks if f not in running]:
            self._progress.remove_task(self._tasks.pop(folder))
        for folder in running:
            if folder not in self._tasks:
                name = "/".join(folder.parts[-3:])
                self._tasks[folder] = self._progress.add_task(name, total=1.0, note="starting")
            self._show(folder)

    def _show(self, folder: Path) -> None:
        state = read_json(folder / PROGRESS_FILE)
        if state:
            note = f"{100.0 * state['coverage']:.1f} % at {state['mission_s']:.0f} s"
            self._progress.update(
                self._tasks[folder],
                completed=state["coverage"],
                note=note + (" LOST" if state["lost"] else ""),
            )

    def _print(self, text: str) -> None:
        self._console.print(text, soft_wrap=True, highlight=False, markup=False)
