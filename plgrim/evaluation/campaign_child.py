"""One mission of a campaign, in a process of its own: `python -m plgrim.evaluation.campaign_child FOLDER`.

The folder holds `config.yaml` and `run.json`; the result is written beside them. `run.json` says how it ended.
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from pathlib import Path
from typing import Any

RUN_FILE = "run.json"
PROGRESS_FILE = "progress.json"
CONFIG_FILE = "config.yaml"
LOG_FILE = "run.log"
PENDING, FINISHED, CRASHED = "pending", "finished", "crashed"

_SHOW_EVERY_S = 1.0


def read_json(path: Path) -> dict[str, Any]:
    """What a file holds; empty when there is none or it is not whole."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a file so that readers see the old one or the new one, never a part."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(content, indent=2, default=str) + "\n", encoding="utf-8")
    os.replace(part, path)


class _Reporter:
    """Writes progress.json about once a wall second."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / PROGRESS_FILE
        self._written_s = 0.0

    def __call__(self, recorder: Any) -> None:
        now = time.monotonic()
        if now - self._written_s < _SHOW_EVERY_S:
            return
        self._written_s = now
        mission, judge = recorder.mission, recorder.judge
        write_json(
            self._path,
            {
                "mission_s": mission.elapsed_s if mission else 0.0,
                "coverage": judge.coverage if judge else 0.0,
                "distance_m": judge.distance_m if judge else 0.0,
                "lost": recorder.lost,
            },
        )


def run(folder: Path) -> None:
    """Run the mission that the folder describes to its end, and write its result there."""
    from rich.console import Console

    from plgrim.config import load_config
    from plgrim.evaluation.campaign_plan import code_version
    from plgrim.logs import configure_logs
    from plgrim.missions import run_lockstep

    task = read_json(folder / RUN_FILE)
    if task["identity"]["code"] != code_version():
        raise RuntimeError(f"the code was changed to {code_version()} while the campaign ran")
    configure_logs("campaign")
    console = Console(file=sys.stdout, width=160, force_terminal=False)
    run_lockstep(
        load_config(folder / CONFIG_FILE), folder, console, task["identity"]["limit_s"], _Reporter(folder)
    )


def main() -> int:
    """Entry point; 0 when there is a result, lost robot or not."""
    from plgrim.runtime.process import die_with_parent

    die_with_parent()
    folder = Path(sys.argv[1])
    end: dict[str, Any] = {"status": FINISHED, "error": ""}
    try:
        run(folder)
    except Exception as error:
        traceback.print_exc()
        end = {"status": CRASHED, "error": f"{type(error).__name__}: {error}"}
    write_json(folder / RUN_FILE, {**read_json(folder / RUN_FILE), **end})
    return 0 if end["status"] == FINISHED else 1


if __name__ == "__main__":
    sys.exit(main())
