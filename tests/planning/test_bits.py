"""Bits of 64-bit words against Python's integers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planning.bits import count_bits, lowest_bit

WORDS = st.integers(0, 2**64 - 1) | st.integers(0, 63).map(lambda bit: 1 << bit)


@given(WORDS)
def test_the_number_of_set_bits(word: int) -> None:
    assert count_bits(np.uint64(word)) == word.bit_count()


@given(WORDS.filter(bool))
def test_the_lowest_set_bit(word: int) -> None:
    assert lowest_bit(np.uint64(word)) == (word & -word).bit_length() - 1


@pytest.mark.parametrize("word", [0, 1, 2**63, 2**64 - 1, 2**32, 2**32 - 1])
def test_the_ends_of_the_range(word: int) -> None:
    assert count_bits(np.uint64(word)) == word.bit_count()
    if word:
        assert lowest_bit(np.uint64(word)) == (word & -word).bit_length() - 1
