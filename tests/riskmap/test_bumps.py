"""Places where something stopped the robot that no ray had shown."""

from __future__ import annotations

import math

import numpy as np

from planning.footprint import clearance_m
from planning.grid import FREE, LETHAL, GridSpec
from schemas.base import Pose
from services.riskmap.bumps import Bumps, stamp_bumps
from services.riskmap.collision import RiskLayers

SECOND = 10**9
RADIUS_M = 0.3


def _bumped(times: int, yaw_rad: float = 0.0, speed_mps: float = 0.5) -> Bumps:
    """The robot comes to the origin, is blocked, and goes back a metre; so many times, 5 s apart."""
    bumps = Bumps(RADIUS_M, 60 * SECOND)
    back = (-math.cos(yaw_rad), -math.sin(yaw_rad))
    for k in range(times):
        now = 5 * k * SECOND
        bumps.observe(now, Pose(yaw_rad=yaw_rad), speed_mps, False)
        for tick in range(5):
            bumps.observe(now + tick * SECOND // 10, Pose(x_m=0.01 * tick, yaw_rad=yaw_rad), 0.0, tick != 2)
        bumps.observe(now + SECOND, Pose(x_m=back[0], y_m=back[1], yaw_rad=yaw_rad), -speed_mps, False)
    return bumps


def test_the_first_contact_is_passed_over_and_the_second_one_counts() -> None:
    assert len(_bumped(1).places(SECOND)) == 0
    assert np.allclose(_bumped(2).places(6 * SECOND), [[RADIUS_M, 0.0]])
    assert np.allclose(_bumped(2, math.pi / 2).places(6 * SECOND), [[0.0, RADIUS_M]])
    assert np.allclose(_bumped(2, 0.0, -0.4).places(6 * SECOND), [[-RADIUS_M, 0.0]]), "its back met it"


def test_contacts_at_other_places_are_first_contacts() -> None:
    bumps = Bumps(RADIUS_M, 60 * SECOND)
    for k in range(6):
        bumps.observe(k * SECOND, Pose(x_m=2.0 * k), 0.0, True)
    assert len(bumps.places(6 * SECOND)) == 0


def test_it_is_forgotten_and_survives_a_snapshot() -> None:
    bumps = _bumped(2)
    other = Bumps(RADIUS_M, 60 * SECOND)
    other.load(bumps.state())
    assert np.array_equal(other.places(6 * SECOND), bumps.places(6 * SECOND))
    assert len(bumps.places(64 * SECOND)) == 0


def test_the_place_is_lethal_and_the_clearance_around_it_is_the_distance_to_it() -> None:
    spec = GridSpec(0.1, -20, -20, 40, 40)
    mean, variance, cvar = (np.zeros(spec.shape, np.float32) for _ in range(3))
    state, clearance = np.full(spec.shape, FREE, np.uint8), np.full(spec.shape, 1.5, np.float32)
    layers = RiskLayers(state, mean, variance, cvar, clearance)
    stamp_bumps(layers, spec, np.array([[0.35, 0.05], [50.0, 0.0]]), 2.0)
    row, column = spec.cell_of(0.35, 0.05)
    assert layers.state[row, column] == LETHAL and (layers.state == LETHAL).sum() == 1
    assert layers.hazard_cvar[row, column] == 2.0
    assert np.allclose(
        layers.clearance_m, np.minimum(clearance_m(layers.state == LETHAL, None, None, spec), 1.5)
    )
