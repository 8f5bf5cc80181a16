"""Explicit random streams for compiled kernels: xoshiro256++ seeded by splitmix64 (Blackman and Vigna 2021).

A stream is a uint64[4] array that a kernel changes in place. The same seed gives the same numbers on every machine.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.kernels import njit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_U11, _U17, _U23, _U27, _U30, _U31, _U32, _U45, _U64 = (
    np.uint64(n) for n in (11, 17, 23, 27, 30, 31, 32, 45, 64)
)
_TO_UNIT = 1.0 / 9007199254740992.0  # 2^-53


@njit
def _fill_stream(seed: np.uint64, rng: NDArray[np.uint64]) -> None:
    """Fill the four words with consecutive outputs of splitmix64."""
    x = seed
    for i in range(4):
        x = x + _GOLDEN
        z = x
        z = (z ^ (z >> _U30)) * _MIX_1
        z = (z ^ (z >> _U27)) * _MIX_2
        rng[i] = z ^ (z >> _U31)


def random_stream(seed: int) -> NDArray[np.uint64]:
    """A new stream, uint64[4], from any Python integer (taken modulo 2^64)."""
    rng = np.zeros(4, dtype=np.uint64)
    _fill_stream(np.uint64(seed & 0xFFFFFFFFFFFFFFFF), rng)
    return rng


@njit
def random_bits(rng: NDArray[np.uint64]) -> np.uint64:
    """The next 64 bits of the stream."""
    s0, s1, s2, s3 = rng[0], rng[1], rng[2], rng[3]
    total = s0 + s3
    result = ((total << _U23) | (total >> (_U64 - _U23))) + s0
    shifted = s1 << _U17
    s2 ^= s0
    s3 ^= s1
    s1 ^= s2
    s0 ^= s3
    s2 ^= shifted
    rng[0], rng[1], rng[2] = s0, s1, s2
    rng[3] = (s3 << _U45) | (s3 >> (_U64 - _U45))
    return result


@njit
def random_uniform(rng: NDArray[np.uint64]) -> float:
    """A float64 in [0, 1) with 53 random bits."""
    return np.float64(random_bits(rng) >> _U11) * _TO_UNIT


@njit
def random_below(rng: NDArray[np.uint64], n: int) -> int:
    """An int64 in [0, n), for 0 < n < 2^32; the bias is below n / 2^32 (multiply and shift)."""
    return int(((random_bits(rng) >> _U32) * np.uint64(n)) >> _U32)
