"""Reward and cost, the same for every planner (paper, Generalized Coverage Reward).

R = k_I I - k_C C and C = k_d d + k_rho rho + k_mu mu. I is in nats of whole 1 m2 patches, d in metres.
"""

from __future__ import annotations

import math
from typing import NamedTuple

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
