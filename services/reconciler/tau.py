"""tau*: how much of the previous policy to keep (paper, Receding-Horizon Policy Reconciliation)."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.coverage_model import CoverageModel, evaluate_moves, follow_rule, rollout_value, turn_share
from planning.lattice_graph import neighbour
from planning.pomcp import random_stream
from planning.reward import travel_discount

Profile = Literal["default", "paper", "always_new", "always_old"]


class TauTerms(NamedTuple):
    """The terms of the choice for each candidate: keeping i steps of the old policy, i = 0..k.

    kept: discounted expected reward of the kept steps, re-evaluated under the current belief (Eq. 17; half-open: step
    i belongs to the new policy). replanned: discounted value of replanning from the junction. mismatch: R at the
    junction, 0 to 1. All (k + 1,). possible: how many steps can be made at all under the current belief.
    """

    kept: NDArray[np.float64]
    replanned: NDArray[np.float64]
    mismatch: NDArray[np.float64]
    possible: int


def tau_terms(
    model: CoverageModel,
    node: int,
    heading: int,
    moves: NDArray[np.int64],
    rollouts: int,
    value_ratio: float,
    seed: int,
) -> TauTerms:
    """Evaluate every prefix of the old policy under the current belief.

    node, heading: where the robot will be when the first of `moves` begins. value_ratio: lcp's last root value over
    the rollouts' value at the same place: what planning gains over its own rollout rule.
    """
    k = len(moves)
    reward, distance, alive = np.zeros(k), np.zeros(k), np.zeros(k)
    possible = int(evaluate_moves(model, node, heading, moves, model.covered.copy(), reward, distance, alive))
    kept, replanned, mismatch = np.zeros(possible + 1), np.zeros(possible + 1), np.zeros(possible + 1)
    covered, rng, discount = model.covered.copy(), random_stream(seed), 1.0
    scratch = (np.zeros(1), np.zeros(1), np.zeros(1))
    for i in range(possible + 1):
        survived = float(alive[i - 1]) if i else 1.0
        value = rollout_value(model, node, heading, covered, rng, rollouts)
        replanned[i] = discount * survived * value * value_ratio
        mismatch[i] = _mismatch(model, node, heading, covered)
        if i < possible:
            kept[i + 1] = kept[i] + discount * reward[i]
            evaluate_moves(model, node, heading, moves[i : i + 1], covered, *scratch)
            discount *= travel_discount(model.weights, float(distance[i]))
            heading = int(moves[i])
            node = neighbour(node, heading, model.size)
    return TauTerms(kept, replanned, mismatch, possible)


def _mismatch(model: CoverageModel, node: int, heading: int, covered: NDArray[np.uint64]) -> float:
    """R: the turn that a policy made anew would probably begin with at this junction, as a share of half a turn."""
    first = np.zeros(1, np.int64)
    if follow_rule(model, node, heading, covered.copy(), first) == 0:
        return 0.0
    return float(turn_share(heading, int(first[0])))


def choose_tau(
    terms: TauTerms, at_least: int, at_most: int, regulariser: float, profile: Profile = "default"
) -> int:
    """The number of steps to keep: argmax over at_least..at_most (clipped to what is possible; ties keep less).

    paper: the literal rule, kept reward alone. default: kept + replanned - lambda R. always_new and always_old: the
    ends of the range, whatever they are worth, to show what the choice is good for.
    """
    high = max(0, min(at_most, terms.possible))
    low = min(at_least, high)
    if profile in ("always_new", "always_old"):
        return low if profile == "always_new" else high
    score = terms.kept
    if profile == "default":
        score = terms.kept + terms.replanned - regulariser * terms.mismatch
    return low + int(np.argmax(score[low : high + 1]))
