"""Coverage belief W_c: probabilities, Bayes updates and entropy (paper, Generalized Coverage Reward)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

LOG_2: float = math.log(2.0)
"""Entropy of a cell that was never looked at (p = 0.5), in nats."""


def look_log_odds(detection_probability: float) -> float:
    """What one look at a cell adds to its log-odds: log(p / (1 - p)). Needs 0.5 < p < 1."""
    if not 0.5 < detection_probability < 1.0:
        raise ValueError(f"detection probability {detection_probability} is not between 0.5 and 1")
    return math.log(detection_probability / (1.0 - detection_probability))


def probability(log_odds: NDArray[np.float32]) -> NDArray[np.float32]:
    """Coverage probability from log-odds; 0.5 where nothing was seen (log-odds 0). Any shape."""
    result: NDArray[np.float32] = (1.0 / (1.0 + np.exp(-log_odds))).astype(np.float32)
    return result


def entropy(p: NDArray[np.float32]) -> NDArray[np.float32]:
    """Entropy in nats of Bernoulli variables, H = -p log p - (1 - p) log(1 - p); 0 at p = 0 and 1. Any shape."""
    clipped = np.clip(p.astype(np.float64), 1e-12, 1.0 - 1e-12)
    result: NDArray[np.float32] = (
        -(clipped * np.log(clipped) + (1.0 - clipped) * np.log1p(-clipped))
    ).astype(np.float32)
    return result


def information_gain(p_before: NDArray[np.float32], p_after: NDArray[np.float32]) -> float:
    """I = H(W_c) - H(W_c | a): the entropy that goes when the probabilities change as given, in nats."""
    return float(entropy(p_before).sum(dtype=np.float64) - entropy(p_after).sum(dtype=np.float64))
