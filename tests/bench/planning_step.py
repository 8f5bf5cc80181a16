"""What a planning step of all five stages costs: `python -m tests.bench.planning_step`.

A mission in lock-step with the default sensors and simulations. For every answer of lcp: the processor time of that
step and of the last steps of riskmap, irm, gcp and reconciler that said something before it, so that the sum is what
one core needs from a cloud to a plan. Printed: median and 99th percentile of each stage and of the sum, in the first
and the second half of the mission. Against the size of the graph: `python -m plgrim.evaluation.flat_cost`.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from plgrim.config import load_config
from plgrim.registry import STAGES, make_stage
from plgrim.runtime.lockstep import Lockstep
from schemas.contract import SECOND_NS, Inputs, Outputs, Stage, StageSetup, Stamp

PLANNERS = ("riskmap", "irm", "gcp", "lcp", "reconciler")


class Timed:
    """A stage that notes the processor time of its steps that said something."""

    def __init__(self, name: str, stage: Stage, told: dict[str, float], rows: list[list[float]]) -> None:
        self._name, self._stage, self._told, self._rows = name, stage, told, rows

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """As the stage does."""
        began = time.thread_time()
        outputs = list(self._stage.step(now, inputs))
        if outputs:
            self._told[self._name] = 1e3 * (time.thread_time() - began)
            if self._name == "lcp":
                self._rows.append([self._told[name] for name in PLANNERS])
        return outputs

    def snapshot(self) -> bytes:
        """As the stage does."""
        return self._stage.snapshot()

    def restore(self, snapshot: bytes) -> None:
        """As the stage does."""
        self._stage.restore(snapshot)


def measure(world: str, seed: int, seconds: int) -> NDArray[np.float64]:
    """(planning steps, 5) ms of processor time, by stage."""
    config = load_config(None, {"seed": seed, "sim": {"world": world}})
    told: dict[str, float] = defaultdict(float)
    rows: list[list[float]] = []
    setup = StageSetup("robot", seed)
    timed = {}
    for name in PLANNERS:
        spec, stage = make_stage(name, config.options(name), setup)
        timed[name] = (spec, Timed(name, stage, told, rows))
    options = {name: config.options(name) for name in STAGES}
    others = tuple(name for name in STAGES if name not in PLANNERS)
    lockstep = Lockstep(options, seed, stages=others, extra=timed)
    lockstep.run_until(seconds * SECOND_NS)
    return np.array(rows[10:])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="cave")
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--seconds", type=int, default=300, help="of the mission")
    options = parser.parse_args()
    rows = measure(options.world, options.seed, options.seconds)
    print(
        f"{options.world}, seed {options.seed}, {options.seconds} s: {len(rows)} planning steps, ms of one core"
    )
    half = len(rows) // 2
    for title, part in (("all", rows), ("first half", rows[:half]), ("second half", rows[half:])):
        whole = part.sum(axis=1)
        stages = ", ".join(
            f"{name} {np.median(part[:, i]):.1f} / {np.percentile(part[:, i], 99):.1f}"
            for i, name in enumerate(PLANNERS)
        )
        print(
            f"  {title}: p50 {np.median(whole):.1f}, p99 {np.percentile(whole, 99):.1f}; p50 / p99 of {stages}"
        )


if __name__ == "__main__":
    main()
