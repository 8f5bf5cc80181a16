"""Reward and cost, the same for every planner (paper, Generalized Coverage Reward).

R = k_I I - k_C C and C = k_d d + k_rho rho + k_mu mu. I is in nats of whole 1 m2 patches, d in metres.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from planning.kernels import njit


class RewardWeights(BaseModel):
    """The constants of the coverage reward. The paper gives no values; these are starting choices."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    k_information: float = Field(1.0, ge=0, le=1000, description="k_I, per nat of a whole patch.")
    k_cost: float = Field(1.0, ge=0, le=1000, description="k_C, weight of the whole cost.")
    k_distance_per_m: float = Field(0.05, ge=0, le=100, description="k_d, per metre: more is lazier.")
    k_risk: float = Field(5.0, ge=0, le=1000, description="k_rho, per unit of rho: more is more careful.")
    k_turn: float = Field(0.1, ge=0, le=100, description="k_mu, for half a turn (mu = 1).")
    leftover_weight: float = Field(
        0.0,
        ge=0,
        le=100,
        description="A patch amid covered ones counts so much more: leaving it costs a way back.",
    )
    leftover_gain: float = Field(0.0, ge=0, le=0.7, description="Least that an uncovered patch counts, nats.")
    gamma_per_m: float = Field(0.985, gt=0, le=1, description="Discount for a metre travelled.")


class RewardParameters(NamedTuple):
    """`RewardWeights` as plain numbers for kernels."""

    k_information: float
    k_cost: float
    k_distance_per_m: float
    k_risk: float
    k_turn: float
    gamma_per_m: float


def parameters(weights: RewardWeights) -> RewardParameters:
    """The weights as numbers for kernels."""
    return RewardParameters(
        float(weights.k_information),
        float(weights.k_cost),
        float(weights.k_distance_per_m),
        float(weights.k_risk),
        float(weights.k_turn),
        float(weights.gamma_per_m),
    )


def leftover_entropy(
    entropy: NDArray[np.float64], known: NDArray[np.bool_], size: int, weights: RewardWeights
) -> NDArray[np.float64]:
    """Entropy of the nodes of a lattice as the local planners count it: leaving ground behind costs a way back.

    entropy: (n,), 0 where covered. known: (n,), traversable nodes. An uncovered patch counts at least leftover_gain,
    and (1 + leftover_weight f) times, f the share of its known neighbours that are covered. With both at 0, the
    default, it is the paper's reward.
    """
    if weights.leftover_weight == 0.0:
        return np.where(entropy > 0.0, np.maximum(entropy, weights.leftover_gain), 0.0)
    wanted, traversable = (entropy > 0.0).reshape(size, size), known.reshape(size, size)
    done, neighbours = np.zeros((size, size)), np.zeros((size, size))
    padded_done, padded_known = np.pad(traversable & ~wanted, 1), np.pad(traversable | wanted, 1)
    for dy in range(3):
        for dx in range(3):
            if (dy, dx) != (1, 1):
                done += padded_done[dy : dy + size, dx : dx + size]
                neighbours += padded_known[dy : dy + size, dx : dx + size]
    share = (done / np.maximum(neighbours, 1.0)).ravel()
    counted = np.maximum(entropy, weights.leftover_gain) * (1.0 + weights.leftover_weight * share)
    return np.where(entropy > 0.0, counted, 0.0)


@njit
def action_cost(weights: RewardParameters, distance_m: float, risk: float, turn: float) -> float:
    """k_C C(W_r, q, a) = k_C (k_d d + k_rho rho + k_mu mu). risk in [0, 1]; turn: mu in [0, 1]."""
    return weights.k_cost * (
        weights.k_distance_per_m * distance_m + weights.k_risk * risk + weights.k_turn * turn
    )


@njit
def reward(
    weights: RewardParameters, information: float, distance_m: float, risk: float, turn: float
) -> float:
    """R(s, a) = k_I I - k_C C. information in nats of whole patches."""
    return weights.k_information * information - action_cost(weights, distance_m, risk, turn)


@njit
def travel_discount(weights: RewardParameters, distance_m: float) -> float:
    """Discount for a step of this length: steps have unequal length, so the discount goes by travel."""
    return math.pow(weights.gamma_per_m, distance_m)
