"""Coverage belief and reward against their formulas: entropy, Bayes updates, information gain, discount."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from planning.coverage import LOG_2, entropy, information_gain, look_log_odds, probability
from planning.frames import Planar, wrap_angle
from planning.reward import RewardWeights, action_cost, parameters, reward, travel_discount

unit = st.floats(0, 1, width=32)
WEIGHTS = parameters(
    RewardWeights(
        k_information=1.3, k_cost=0.7, k_distance_per_m=0.2, k_risk=4.0, k_turn=0.3, gamma_per_m=0.9
    )
)


def _entropy(p: float) -> float:
    return -sum(v * math.log(v) for v in (p, 1 - p) if v > 0)


@given(p=st.lists(unit, min_size=1, max_size=20))
def test_entropy_is_that_of_the_formula(p: list[float]) -> None:
    array = np.array(p, np.float32)
    result = entropy(array)
    assert result == pytest.approx([_entropy(float(v)) for v in array], abs=1e-6)
    assert (result >= 0).all() and (result <= LOG_2 + 1e-6).all()
    assert entropy(np.float32(1.0) - array) == pytest.approx(result, abs=1e-6)


def test_what_was_never_looked_at_has_the_entropy_of_a_coin() -> None:
    unseen = probability(np.zeros(3, np.float32))
    assert unseen.tolist() == [0.5] * 3
    assert entropy(unseen) == pytest.approx(math.log(2.0))
    assert entropy(np.array([0.0, 1.0], np.float32)) == pytest.approx(0.0, abs=1e-9)


@given(detections=st.lists(st.floats(0.51, 0.95), max_size=5), prior=st.floats(0.05, 0.95))
def test_looks_in_log_odds_equal_explicit_bayes(detections: list[float], prior: float) -> None:
    """P(covered | look) = q P / (q P + (1 - q) (1 - P)), look after look."""
    p, log_odds = prior, math.log(prior / (1 - prior))
    for q in detections:
        p = q * p / (q * p + (1 - q) * (1 - p))
        log_odds += look_log_odds(q)
    assert float(probability(np.array([log_odds], np.float32))[0]) == pytest.approx(p, abs=1e-5)


@pytest.mark.parametrize("q", [0.0, 0.5, 1.0, 1.2, math.nan])
def test_a_detection_that_tells_nothing_or_all_is_refused(q: float) -> None:
    with pytest.raises(ValueError, match="detection probability"):
        look_log_odds(q)


@given(seed=st.integers(0, 10_000), q=st.floats(0.6, 0.99))
def test_information_gain_is_the_entropy_that_goes_in_random_footprints(seed: int, q: float) -> None:
    rng = np.random.default_rng(seed)
    log_odds = rng.normal(0, 2, (9, 12)).astype(np.float32)
    footprint = rng.random((9, 12)) < 0.4
    after = np.where(footprint, log_odds + np.float32(look_log_odds(q)), log_odds).astype(np.float32)
    gain = information_gain(probability(log_odds), probability(after))
    exact = sum(
        _entropy(1 / (1 + math.exp(-float(a)))) - _entropy(1 / (1 + math.exp(-float(b))))
        for a, b in zip(log_odds[footprint], after[footprint], strict=True)
    )
    assert gain == pytest.approx(exact, abs=1e-4)
    assert information_gain(probability(log_odds), probability(log_odds)) == 0.0


@given(d=st.floats(0, 50), e=st.floats(0, 50), rho=unit, turn=unit, information=st.floats(0, 100))
def test_reward_and_cost_are_those_of_the_paper(
    d: float, e: float, rho: float, turn: float, information: float
) -> None:
    cost = 0.7 * (0.2 * d + 4.0 * rho + 0.3 * turn)
    assert action_cost(WEIGHTS, d, rho, turn) == pytest.approx(cost)
    assert reward(WEIGHTS, information, d, rho, turn) == pytest.approx(1.3 * information - cost)
    assert travel_discount(WEIGHTS, d + e) == pytest.approx(
        travel_discount(WEIGHTS, d) * travel_discount(WEIGHTS, e)
    )
    assert travel_discount(WEIGHTS, 0.0) == 1.0
    assert travel_discount(WEIGHTS, d) == pytest.approx(0.9**d)


poses = st.builds(Planar, st.floats(-20, 20), st.floats(-20, 20), st.floats(-3.14, 3.14))


@given(a=poses, b=poses, x=st.floats(-9, 9), y=st.floats(-9, 9))
def test_poses_compose_and_invert_like_their_matrices(a: Planar, b: Planar, x: float, y: float) -> None:
    def matrix(p: Planar) -> NDArray[np.float64]:
        c, s = math.cos(p.yaw_rad), math.sin(p.yaw_rad)
        return np.array([[c, -s, p.x_m], [s, c, p.y_m], [0, 0, 1]])

    assert (*a.apply(x, y), 1.0) == pytest.approx(tuple(matrix(a) @ (x, y, 1.0)), abs=1e-9)
    assert matrix(a.compose(b)) == pytest.approx(matrix(a) @ matrix(b), abs=1e-9)
    assert matrix(a.compose(a.inverse())) == pytest.approx(np.eye(3), abs=1e-9)
    assert Planar(0.0, 0.0, 0.0).is_identity and a.is_identity == (a == Planar(0.0, 0.0, 0.0))


@given(angle=st.floats(-100, 100))
def test_angles_are_wrapped_into_one_turn(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)
