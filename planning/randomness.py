"""Random streams: every one is a function of the mission's seed and of what it is for."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """A generator that depends on the seed and the names alone (not on PYTHONHASHSEED, time or order of use)."""
    words = [seed & 0xFFFFFFFF, (seed >> 32) & 0xFFFFFFFF]
    for name in names:
        words.append(name & 0xFFFFFFFF if isinstance(name, int) else zlib.crc32(name.encode()))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))
