"""How fast the robot may drive with somebody moving near it: speed and separation monitoring (ISO/TS 15066, 5.5.4).

The robot must be able to stop before anybody who walks at a bounded speed in any direction can be where it stops.
Somebody who walks into a robot that stands is not its fault: passive safety (Macek et al., IROS 2008).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.contract import SECOND_NS, Stamp
from services.reconciler.config import Config
from services.reconciler.path import arc_lengths

_LEVELS = 10
"""Speeds that are tried, as shares of the top speed."""
_TICK_S = 0.05
_SILENCE_NS = 2 * SECOND_NS
"""Clouds that stop coming hold the robot by then, as the risk map is stale; a robot that has grids alone goes on."""


class Separation(NamedTuple):
    """distance_m: from the robot's centre to the surface of others, kept at least. mover_mps: nobody walks faster.

    reaction_s: from when a cloud was taken until the robot brakes. braking_mps2: what it then brakes with.
    """

    distance_m: float
    mover_mps: float
    reaction_s: float
    braking_mps2: float


def safe_share(
    line: NDArray[np.float64], moving: NDArray[np.float64], top_mps: float, rules: Separation
) -> float:
    """The greatest share of the top speed at which the robot may follow the line now; 0: it must stand.

    line: (k, 2) m, from the robot on, k >= 1. moving: (m, 2) m, points of what moves. A share is safe when the robot,
    going on at that speed until it reacts and braking then, stays out of reach of every point, or comes no nearer to
    it than it is: driving off is always allowed.
    """
    if not len(moving):
        return 1.0
    s = arc_lengths(line)
    now_m = np.hypot(*(moving - line[0]).T)
    for level in range(_LEVELS, 0, -1):
        share = level / _LEVELS
        time_s, way_m = _braking(share * top_mps, rules)
        at = np.stack([np.interp(way_m, s, line[:, 0]), np.interp(way_m, s, line[:, 1])], axis=1)
        away_m = np.hypot(*(at[:, None, :] - moving).transpose(2, 0, 1))
        reach_m = rules.distance_m + rules.mover_mps * time_s[:, None]
        if ((away_m >= reach_m) | (away_m >= now_m)).all():
            return share
    return 0.0


def _braking(speed_mps: float, rules: Separation) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(time, way) at ticks while the robot goes on until it reacts and brakes to a stand."""
    stands_s = rules.reaction_s + speed_mps / rules.braking_mps2
    time_s = np.linspace(0.0, stands_s, max(2, math.ceil(stands_s / _TICK_S) + 1))
    braked_s = np.maximum(time_s - rules.reaction_s, 0.0)
    return time_s, speed_mps * time_s - 0.5 * rules.braking_mps2 * braked_s**2


class Guard:
    """Watches what moves. share: of the top speed that is allowed now, in tenths; 0: the robot must stand.

    It falls at once and rises no faster than the robot may speed up: a sweep that misses somebody starts nothing.
    """

    def __init__(self, config: Config) -> None:
        self._top_mps = config.max_speed_mps
        self._rise_per_s = config.max_acceleration_mps2 / config.max_speed_mps
        self._rules = Separation(
            config.footprint_radius_m + config.separation_margin_m,
            config.mover_speed_mps,
            config.reaction_s,
            config.max_acceleration_mps2,
        )
        self._most, self._watched_ns, self._told_ns = 1.0, -1, -1

    @property
    def share(self) -> float:
        """Of the top speed, in tenths rounded down."""
        return math.floor(self._most * _LEVELS + 1e-9) / _LEVELS

    def watch(self, now: Stamp, moving: NDArray[np.float32] | None, line: NDArray[np.float64]) -> None:
        """Look at the newest points of what moves, (m, 2) m; None: not known now, the share stays for `_SILENCE_NS`.

        line: ahead of the robot, (k, 2) m.
        """
        elapsed_s = (now - self._watched_ns) / SECOND_NS if self._watched_ns >= 0 else 0.0
        self._watched_ns = now
        if moving is not None:
            self._told_ns = now
        elif now - self._told_ns < _SILENCE_NS and self._told_ns >= 0:
            return  # what was told last still holds
        found = 1.0
        if moving is not None:
            found = safe_share(line, moving.astype(np.float64), self._top_mps, self._rules)
        self._most = min(found, self._most + self._rise_per_s * elapsed_s)

    def state(self) -> list[float | int]:
        """For a snapshot."""
        return [self._most, self._watched_ns, self._told_ns]

    def load(self, state: list[float | int]) -> None:
        """Go on from `state`."""
        self._most, self._watched_ns, self._told_ns = float(state[0]), int(state[1]), int(state[2])
