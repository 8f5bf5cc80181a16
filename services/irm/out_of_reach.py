"""Ground that is seen and that the robot does not get to: a room behind a gap that its body does not fit through."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planning.clusters import label_components
from planning.coverage import LOG_2
from planning.fences import Placed
from planning.frames import Planar
from planning.grid import FREE, LETHAL, GridSpec
from services.irm.keyframes import NOBODY, Anchor
from services.irm.window import Window, connected_free_space, dilate_disc, without_slivers

TOO_NARROW = "out of reach: no way to it that the robot fits through"
FENCED = "behind a fence of the operator"
_LEAST_M2 = 1.0
"""Less is a corner that the body does not get into."""
_SAME_M = 3.0
_BESIDE_M = 0.8
"""Ground behind a fence begins so near to it."""
_MOST = 64


@dataclass(slots=True)
class Place:
    """The nearest point of such ground, in `map`, and what it would be worth, nats of whole patches.

    keyframe: what it belongs to; local_*: its place in that keyframe's frame. fenced: only a fence is in the way.
    """

    x_m: float
    y_m: float
    gain: float
    keyframe: int = NOBODY
    local_x_m: float = 0.0
    local_y_m: float = 0.0
    fenced: bool = False

    @property
    def reason(self) -> str:
        """Why the robot does not get there."""
        return FENCED if self.fenced else TOO_NARROW


class OutOfReach:
    """The places where the robot has seen such ground, largest first. Told, not planned with: they are no frontiers."""

    def __init__(self, spacing_m: float) -> None:
        self._spacing_m = spacing_m
        self.places: list[Place] = []

    def update(self, window: Window, needed_m: float, radius_m: float, anchor: Anchor) -> None:
        """Look at the window again; what was found elsewhere stays. needed_m: clearance of the robot's centre."""
        kept = [p for p in self.places if not window.spec.contains(*window.cell(p.x_m, p.y_m))]
        for x_m, y_m, area_m2, fenced in closed_off(window, needed_m, radius_m):
            at = window.to_map(x_m, y_m)
            if all(math.dist(at, (p.x_m, p.y_m)) > _SAME_M for p in kept):
                gain = area_m2 * LOG_2 / self._spacing_m**2
                kept.append(Place(*at, gain, anchor.keyframe, *anchor.local(*at), fenced))
        self.places = sorted(kept, key=lambda p: (-p.gain, p.x_m, p.y_m))[:_MOST]

    def reopened(self, placed: Placed) -> list[Place]:
        """Other fences hold now: the places that none of them is beside any more, which are no longer kept here."""
        free = [p for p in self.places if p.fenced and not _beside(placed, p)]
        self.places = [p for p in self.places if p not in free]
        return free

    def follow(self, keyframes: dict[int, Planar]) -> None:
        """Move what belongs to keyframes that SLAM has moved."""
        for place in self.places:
            if place.keyframe in keyframes:
                place.x_m, place.y_m = keyframes[place.keyframe].apply(place.local_x_m, place.local_y_m)

    def state(self) -> list[list[Any]]:
        """For a snapshot."""
        return [list(astuple(place)) for place in self.places]

    def set_state(self, state: list[list[Any]]) -> None:
        """From a snapshot."""
        self.places = [Place(*values) for values in state]


def _beside(placed: Placed, place: Place) -> bool:
    return placed.forbids(place.x_m, place.y_m) or placed.border_m(place.x_m, place.y_m) < _BESIDE_M


def closed_off(window: Window, needed_m: float, radius_m: float) -> list[tuple[float, float, float, bool]]:
    """(x, y, area m2, only by fences) in `odom` of each piece of free ground that the robot cannot touch, as far as is
    known.

    Where nothing is known there may be a way. x, y: the cell of the piece that is nearest to ground within reach.
    """
    free = window.state == FREE
    if window.shut is None or window.open_clearance_m is None:
        touched = _touched(window, window.clearance_m, needed_m, radius_m)
        return [(*piece, False) for piece in _pieces(window.spec, free & ~touched, touched)]
    touched = _touched(window, window.open_clearance_m, needed_m, radius_m)
    inside = _touched(window, window.clearance_m, needed_m, radius_m) & ~window.shut
    narrow = _pieces(window.spec, free & ~touched, touched)
    fenced = _pieces(window.spec, free & touched & ~inside, inside)
    return [*((*piece, False) for piece in narrow), *((*piece, True) for piece in fenced)]


def _touched(
    window: Window, clearance_m: NDArray[np.float32], needed_m: float, radius_m: float
) -> NDArray[np.bool_]:
    """What the body may touch by any way that is left open."""
    perhaps = connected_free_space((window.state != LETHAL) & (clearance_m >= needed_m), window.robot_cell)
    touched = np.zeros(window.spec.shape, dtype=np.bool_)
    dilate_disc(perhaps | window.reachable, radius_m / window.spec.resolution_m, touched)
    return touched


def _pieces(
    s: GridSpec, cells: NDArray[np.bool_], touched: NDArray[np.bool_]
) -> list[tuple[float, float, float]]:
    closed: NDArray[np.bool_] = without_slivers(cells)
    least = round(_LEAST_M2 / s.resolution_m**2)
    if np.count_nonzero(closed) < least:
        return []
    labels = np.zeros(s.shape, np.int32)
    pieces = label_components(closed, labels)
    sizes = np.bincount(labels.ravel(), minlength=pieces + 1)
    away = ndimage.distance_transform_edt(~touched)
    found = []
    for piece in range(1, pieces + 1):
        if sizes[piece] >= least:
            nearest = int(np.argmin(np.where(labels == piece, away, np.inf)))
            found.append((*s.centre_of(*divmod(nearest, s.width)), float(sizes[piece]) * s.resolution_m**2))
    return found
