"""Steps against the rule pair by pair, bit for bit."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.riskmap.steps import find_steps


def _pair_by_pair(
    height_m: NDArray[np.float32],
    single: NDArray[np.float32],
    drift_m: NDArray[np.float32],
    known: NDArray[np.bool_],
    resolution_m: float,
    reach: int,
    max_slope: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    step, variance = np.zeros_like(height_m), np.zeros_like(height_m)

    def is_known(r: int, c: int) -> bool:
        return 0 <= r < known.shape[0] and 0 <= c < known.shape[1] and bool(known[r, c])

    for r, c in np.argwhere(known):
        for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
            length = resolution_m * (math.sqrt(2.0) if dr and dc else 1.0)
            for n in range(1, reach + 1):
                if n > 1 and n * length > reach * resolution_m + 1e-6:
                    break
                r1, c1 = r + n * dr, c + n * dc
                if not is_known(r1, c1):
                    continue
                rise = float(height_m[r1, c1] - height_m[r, c])
                if is_known(r - n * dr, c - n * dc) and is_known(r1 + n * dr, c1 + n * dc):
                    sign = 1.0 if rise > 0.0 else -1.0
                    before = sign * float(height_m[r, c] - height_m[r - n * dr, c - n * dc])
                    after = sign * float(height_m[r1 + n * dr, c1 + n * dc] - height_m[r1, c1])
                    rise -= sign * max(0.0, min(before, after, sign * rise, max_slope * n * length))
                doubt = single[r, c] + single[r1, c1] + (drift_m[r, c] - drift_m[r1, c1]) ** 2
                for k in (0, 1) if n == 1 else range(1, n):
                    at = (r + k * dr, c + k * dc)
                    if known[at] and abs(rise) > float(step[at]):
                        step[at], variance[at] = abs(rise), doubt
    return step, variance


@given(
    seed=st.integers(0, 10_000),
    share=st.sampled_from([0.1, 0.6, 1.0]),
    reach=st.integers(1, 4),
    grain_m=st.sampled_from([0.0, 0.05]),
)
def test_every_step_and_variance_is_that_of_the_rule(
    seed: int, share: float, reach: int, grain_m: float
) -> None:
    """Also where coarse heights make many differences equal, so that their order decides the variance."""
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 13)), int(rng.integers(1, 13)))
    height = rng.normal(0.0, 0.1, shape) + 0.2 * np.arange(shape[1]) * rng.random()
    if grain_m > 0.0:
        height = np.round(height / grain_m) * grain_m
    height_m = height.astype(np.float32)
    single, drift_m = (rng.random(shape).astype(np.float32) for _ in range(2))
    known = rng.random(shape) < share
    step, variance = np.zeros_like(height_m), np.zeros_like(height_m)
    find_steps(height_m, single, drift_m, known, 0.1, reach, 0.45, step, variance)
    wanted, wanted_variance = _pair_by_pair(height_m, single, drift_m, known, 0.1, reach, 0.45)
    assert np.array_equal(step, wanted)
    assert np.array_equal(variance, wanted_variance)
