"""Stands in for a mission of a campaign: `python fake_mission.py FOLDER`. What it does follows from the seed.

Seeds: 13 dies of a signal, 17 ends without a word, 19 crashes with a message, 23 never ends, 7 loses its robot.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from plgrim.evaluation.campaign_child import (
    CRASHED,
    FINISHED,
    PROGRESS_FILE,
    RUN_FILE,
    read_json,
    write_json,
)


def command(folder: Path) -> list[str]:
    """Of a child, for the pool."""
    return [sys.executable, "-m", "tests.evaluation.fake_mission", str(folder)]


def result(lost: bool = False) -> dict[str, Any]:
    """As the recorder writes it, of a mission of 30 s."""
    return {
        "finish": "" if lost else "covered", "lost": lost, "lost_reason": "fell" if lost else "",
        "coverage_judge": 0.95, "coverage_belief": 0.9, "covered_area_m2": 95.0, "reachable_area_m2": 100.0,
        "distance_m": 30.0, "elapsed_s": 30.0, "contacts": 0, "target_switches_per_100m": 1.5, "wall_s": 3.0,
        "times_real_time": 10.0, "digest": "abc", "stages": {"gcp": {"step_p50_ms": 2.0, "step_p99_ms": 4.0}},
    }  # fmt: skip


def write_result(folder: Path, lost: bool = False) -> None:
    """result.json and trajectory.csv: half at once, 95 % at 20 s and 20 m."""
    write_json(folder / "result.json", result(lost))
    lines = ["t_s,distance_m,coverage", "0,0,0.5", "10,10,0.5", "20,20,0.95", "30,30,0.95"]
    (folder / "trajectory.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> int:
    """Entry point."""
    folder = Path(sys.argv[1])
    task = read_json(folder / RUN_FILE)
    (folder / "environment.txt").write_text("\n".join(sorted(os.environ)), encoding="utf-8")
    write_json(folder / PROGRESS_FILE, {"mission_s": 1.0, "coverage": 0.5, "distance_m": 1.0, "lost": False})
    match task["seed"]:
        case 13:
            os.kill(os.getpid(), signal.SIGKILL)
        case 17:
            return 5
        case 19:
            write_json(folder / RUN_FILE, {**task, "status": CRASHED, "error": "ValueError: no"})
            return 1
        case 23:
            time.sleep(600.0)
    write_result(folder, lost=task["seed"] == 7)
    write_json(folder / RUN_FILE, {**task, "status": FINISHED})
    return 0


if __name__ == "__main__":
    sys.exit(main())
