"""Lock-step: the same seed gives the same bytes, whatever PYTHONHASHSEED."""

from __future__ import annotations

import os
import subprocess
import sys

_MISSION = """
from plgrim.runtime.lockstep import Lockstep
run = Lockstep({"sim": {"world": "subway_1x", "seed": 3}, "reconciler": {"simulations": 512}}, seed=%d)
run.run_until(12 * 10**9)
assert run.dropped() == {}
print(run.digest())
"""


def _digest(hash_seed: str, seed: int = 3) -> str:
    environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
    done = subprocess.run(
        [sys.executable, "-c", _MISSION % seed], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_three_runs_of_one_seed_are_byte_identical_under_different_hash_seeds() -> None:
    digests = {_digest(hash_seed) for hash_seed in ("0", "1", "4242")}
    assert len(digests) == 1


def test_another_seed_gives_another_mission() -> None:
    assert _digest("0", seed=3) != _digest("0", seed=4)
