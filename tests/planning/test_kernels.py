"""The wrappers around numba: what they compile, what they refuse, and where compiled kernels are kept."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numba.core.errors import TypingError
from numpy.typing import NDArray

from planning.kernels import cache_directory, njit, njit_borrowing


class _Model(NamedTuple):
    weights: NDArray[np.float64]
    offsets: NDArray[np.int64]


@njit_borrowing
def _borrowed(model: _Model, index: int) -> float:
    return float(model.weights[index] * 2.0 + model.offsets[index])


@njit
def _sum_borrowed(model: _Model) -> float:
    total = 0.0
    for index in range(model.weights.shape[0]):
        total += _borrowed(model, index)
    return total


@njit_borrowing
def _allocates(n: int) -> float:
    return float(np.zeros(n).sum())


@njit
def _allocates_and_owns(n: int) -> float:
    return float(np.zeros(n).sum())


@njit
def _divides(a: float, b: float) -> float:
    return a / b


def test_a_borrowing_kernel_gives_what_plain_python_gives() -> None:
    rng = np.random.default_rng(1)
    model = _Model(rng.normal(size=20), rng.integers(-5, 5, 20, dtype=np.int64))
    assert _sum_borrowed(model) == pytest.approx(float((2.0 * model.weights + model.offsets).sum()))
    held = _Model(np.ones(3), np.ones(3, np.int64))
    for _ in range(1000):  # a reference counted wrongly would free or leak the arrays
        _sum_borrowed(held)
    assert held.weights.tolist() == [1.0] * 3 and held.offsets.tolist() == [1] * 3


def test_a_borrowing_kernel_that_makes_arrays_is_refused() -> None:
    with pytest.raises(TypingError, match="zeros"):
        _allocates(3)
    assert _allocates_and_owns(3) == 0.0


def test_division_by_zero_is_as_in_numpy() -> None:
    assert _divides(1.0, 0.0) == np.inf
    assert np.isnan(_divides(0.0, 0.0))


def test_the_cache_stands_below_the_chosen_directory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLGRIM_CACHE_DIR", "/somewhere/else")
    assert cache_directory().parent.as_posix() == "/somewhere/else/numba"
    assert cache_directory() == cache_directory()
