"""Bits of coverage: one unsigned word a row of the lattice."""

from __future__ import annotations

import numpy as np

from planning.kernels import njit

_M1 = np.uint64(0x5555555555555555)
_M2 = np.uint64(0x3333333333333333)
_M4 = np.uint64(0x0F0F0F0F0F0F0F0F)
_H01 = np.uint64(0x0101010101010101)
_ONE = np.uint64(1)
_TWO = np.uint64(2)
_FOUR = np.uint64(4)
_TOP = np.uint64(56)


@njit
def count_bits(word: np.uint64) -> int:
    """Number of set bits of a 64-bit word."""
    x = word - ((word >> _ONE) & _M1)
    x = (x & _M2) + ((x >> _TWO) & _M2)
    x = (x + (x >> _FOUR)) & _M4
    return np.int64((x * _H01) >> _TOP)  # type: ignore[return-value]  # the compiler's int


@njit
def lowest_bit(word: np.uint64) -> int:
    """Index of the lowest set bit of a word that is not 0."""
    return count_bits((word & (~word + _ONE)) - _ONE)
