"""The solver's random streams against published numbers and simple statistics."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit
from planning.pomcp_random import random_below, random_bits, random_stream, random_uniform


@njit
def _draw(rng: NDArray[np.uint64], n: int, uniform: NDArray[np.float64], below: NDArray[np.int64]) -> None:
    for i in range(uniform.size):
        uniform[i] = random_uniform(rng)
        below[i] = random_below(rng, n)


def test_seeding_is_splitmix64() -> None:
    """The reference outputs of splitmix64 for the seed 1234567."""
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    assert random_stream(1234567).tolist() == expected


def test_stream_is_xoshiro256_plus_plus() -> None:
    """The reference outputs for the state (1, 2, 3, 4)."""
    rng = np.array([1, 2, 3, 4], dtype=np.uint64)
    drawn = [int(random_bits(rng)) for _ in range(4)]
    assert drawn == [41943041, 58720359, 3588806011781223, 3591011842654386]


def test_streams_depend_on_the_seed_alone() -> None:
    assert random_stream(7).tobytes() == random_stream(7).tobytes() != random_stream(8).tobytes()
    assert random_stream(-1).tobytes() == random_stream(2**64 - 1).tobytes()


def test_numbers_are_uniform() -> None:
    uniform, below = np.zeros(70000), np.zeros(70000, dtype=np.int64)
    _draw(random_stream(3), 7, uniform, below)
    assert uniform.min() >= 0.0 and uniform.max() < 1.0
    assert abs(uniform.mean() - 0.5) < 0.005
    assert abs(np.corrcoef(uniform[:-1], uniform[1:])[0, 1]) < 0.02
    counts = np.bincount(below, minlength=8)
    assert counts[7] == 0
    assert np.all(np.abs(counts[:7] - 10000) < 400)
