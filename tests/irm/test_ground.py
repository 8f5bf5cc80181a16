"""The patches of the ground are found by place, whatever else was driven."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.frames import Planar
from planning.grid import GridSpec, overlap, window_around
from services.irm.ground import GroundStore, _tiles_of
from services.irm.keyframes import Anchor
from services.irm.resample import bounds, resample
from services.irm.tiles import TileLayer

RES = 0.5
HERE = Planar(0.0, 0.0, 0.0)


def drive(keyframes: int) -> GroundStore:
    """To and fro over lanes of 180 m, 36 m apart, a patch every 4.5 m; random ground."""
    rng = np.random.default_rng(5)
    store = GroundStore(TileLayer("uint8", 0, RES))
    for k in range(keyframes):
        x, y = 4.5 * (k % 40), 36.0 * (k // 40)
        spec = window_around(x, y, 40.0, RES)
        store.write(spec, rng.integers(0, 3, spec.shape).astype(np.uint8), HERE, Anchor(k, Planar(x, y, 0.0)))
    return store


def everything(store: GroundStore, spec: GridSpec, frame: Planar) -> NDArray[np.uint8]:
    """What a window shows, by going through all patches."""
    out = np.zeros(spec.shape, np.uint8)
    for patch in sorted(store._patches.values(), key=lambda p: p.turn):
        if overlap(bounds(patch.spec, patch.motion), bounds(spec, frame)) is not None:
            cells = resample(patch.unpacked(), patch.spec, spec, frame.inverse().compose(patch.motion), 0)
            out[cells != 0] = cells[cells != 0]
    return out


def test_a_window_looks_at_the_patches_around_it_and_misses_none() -> None:
    store = drive(160)
    again = GroundStore(store._layer)
    again.set_state(store.state())
    moved = {k: Planar(4.5 * (k % 40) + 30.0, 36.0 * (k // 40) - 40.0, 0.3) for k in (5, 60, 61)}
    for one in (store, again):
        one.follow(moved)
    frame = Planar(0.3, 0.1, 0.01)
    for x, y in ((0.0, 0.0), (50.0, 0.0), (120.0, 36.0), (-500.0, 0.0)):
        spec = window_around(x, y, 40.0, RES)
        wanted = everything(store, spec, frame)
        for one in (store, again):
            assert np.array_equal(one.window(spec, frame, frozenset()), wanted)


def test_how_many_patches_a_window_looks_at_does_not_grow_with_the_way() -> None:
    looked = []
    for keyframes in (120, 240):
        store = drive(keyframes)
        spec = window_around(90.0, 0.0, 40.0, RES)
        looked.append(len(store._touching(_tiles_of(spec))))
    assert 0 < looked[0] == looked[1] < 80
