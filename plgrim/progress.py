"""What a person sees while a mission runs: live lines on a terminal, one line every ten seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any

from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from plgrim.evaluation.recorder import MissionRecorder

_LINE_EVERY_S = 10.0


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f} %"


def progress_text(recorder: MissionRecorder) -> str:
    """One line: phase, coverage by belief and judge, distance, elapsed, speed of the robot."""
    mission, judge, coverage = recorder.mission, recorder.judge, recorder.coverage
    phase = mission.phase.value if mission else "waiting"
    belief = _percent(coverage.covered_fraction if coverage else None)
    true = _percent(judge.coverage if judge else None)
    distance = judge.distance_m if judge else mission.distance_m if mission else 0.0
    elapsed = mission.elapsed_s if mission else 0.0
    lost = "  ROBOT LOST" if recorder.lost else ""
    return (
        f"{phase:<8} coverage {belief} (judge {true})  driven {distance:.0f} m  elapsed {elapsed:.0f} s{lost}"
    )


def target_text(recorder: MissionRecorder) -> str:
    """One line: where the robot goes, and why."""
    policy, plan = recorder.policy, recorder.plan
    if policy is None:
        return "target  none yet"
    where = "none"
    if policy.target >= 0:
        x, y, _ = policy.target_xyz_m
        where = f"frontier {policy.target} at ({x:.1f}, {y:.1f}), {policy.target_distance_m:.0f} m away"
    safety = f"  [{plan.safety.value}]" if plan else ""
    return f"target  {where}: {policy.reason}{safety}"


class MissionProgress:
    """Shows a recorder's state; a context manager. page: address of the status page, or empty."""

    def __init__(self, recorder: MissionRecorder, page: str, console: Console) -> None:
        self._recorder = recorder
        self._page = page
        self._console = console
        self._note = ""
        self._shown_s = 0.0
        self._live = Live(console=console, refresh_per_second=4, transient=True, auto_refresh=False)

    def __enter__(self) -> MissionProgress:
        if self._page:
            self._console.print(f"page: {self._page}", soft_wrap=True, highlight=False, markup=False)
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def waiting(self, missing: list[str]) -> None:
        """Show which services are not ready; for use while they start."""
        self._note = f"starting: {', '.join(missing)}" if missing else ""
        self.update()

    def update(self) -> None:
        """Show what is new; call as often as you like."""
        now = time.monotonic()
        if self._console.is_terminal:
            self._live.update(self._render(), refresh=now - self._shown_s > 0.25)
            if now - self._shown_s > 0.25:
                self._shown_s = now
        elif now - self._shown_s >= _LINE_EVERY_S:
            self._shown_s = now
            self._console.print(self._note or progress_text(self._recorder), soft_wrap=True, highlight=False)

    def _render(self) -> RenderableType:
        if self._note:
            return Text(self._note)
        coverage = self._recorder.coverage
        rows = Table.grid(padding=0)
        rows.add_column(no_wrap=True)
        rows.add_row(Text(progress_text(self._recorder), overflow="ellipsis"))
        rows.add_row(
            ProgressBar(total=1.0, completed=coverage.covered_fraction if coverage else 0.0, width=60)
        )
        rows.add_row(Text(target_text(self._recorder), overflow="ellipsis"))
        return rows


def summary_table(result: Mapping[str, Any]) -> Table:
    """The result as a table."""
    table = Table(title=f"mission in {result['world']}, seed {result['seed']}", show_header=False)
    switches = result["target_switches_per_100m"]
    latency = result["cloud_to_plan"]
    p50, p95 = (_number(latency[name], "s", 2) for name in ("p50_mission_s", "p95_mission_s"))
    rows: list[tuple[str, str]] = [
        ("finish", f"{result['finish'] or 'not finished'}: {result['finish_text']}"),
        ("coverage by the judge", _percent(result["coverage_judge"])),
        ("coverage by the belief", _percent(result["coverage_belief"])),
        ("driven", _number(result["distance_m"], "m")),
        ("elapsed (mission)", _number(result["elapsed_s"], "s")),
        ("target switches", f"{result['target_switches']} ({_number(switches, 'per 100 m', 2)})"),
        ("lost", f"{result['lost']} {result['lost_reason']}".strip()),
        ("contacts", str(result["contacts"])),
        ("cloud to plan", f"p50 {p50}, p95 {p95} of mission time"),
    ]  # fmt: skip
    if "tour" in result:
        rows += _tour_rows(result)
    if "times_real_time" in result:
        rows.append(("speed", f"{result['times_real_time']:.1f} times real time"))
    if result["restarts"]:
        rows.append(("restarts", ", ".join(f"{name} {count}" for name, count in result["restarts"].items())))
    for name, value in rows:
        table.add_row(name, value)
    return table


def _tour_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The mission beside a tour that knows the map."""
    tour = result["tour"]
    return [
        ("covered area", _number(result["covered_area_m2"], "m2")),
        ("a tour that knows the map", f"{_number(tour['covered_area_m2'], 'm2')} in the same time"),
        ("ratio", _percent(tour["ratio"])),
    ]


def stage_table(result: Mapping[str, Any]) -> Table:
    """Step times, memory, errors and drops of each service."""
    table = Table("service", "steps", "p50 ms", "p99 ms", "memory MB", "errors", "dropped")
    for name, stage in result["stages"].items():
        table.add_row(
            name,
            str(stage["steps"]),
            f"{stage['step_p50_ms']:.1f}",
            f"{stage['step_p99_ms']:.1f}",
            _number(stage.get("memory_mb"), ""),
            str(stage.get("errors", "-")),
            str(sum(stage.get("dropped", {}).values())),
        )
    return table


def _number(value: float | None, unit: str, digits: int = 0) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}".strip()
