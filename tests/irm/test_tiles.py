"""Sparse tiles against one dense array."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from planning.grid import GridSpec
from schemas.snapshot import pack_snapshot, unpack_snapshot
from services.irm.tiles import TILE, TileLayer

SIDE = 5 * TILE
ORIGIN = -2 * TILE - 40

windows = st.tuples(
    st.integers(0, SIDE - 1), st.integers(0, SIDE - 1), st.integers(1, 300), st.integers(1, 300)
).map(lambda w: GridSpec(0.1, ORIGIN + w[0], ORIGIN + w[1], min(w[2], SIDE - w[0]), min(w[3], SIDE - w[1])))


def part(spec: GridSpec) -> tuple[slice, slice]:
    """The window as slices of the dense array."""
    row, column = spec.iy0 - ORIGIN, spec.ix0 - ORIGIN
    return slice(row, row + spec.height), slice(column, column + spec.width)


@given(
    writes=st.lists(st.tuples(windows, st.integers(0, 3)), max_size=6),
    reads=st.lists(windows, min_size=1, max_size=3),
    fill=st.sampled_from([0.0, -1.0]),
)
def test_reads_and_writes_equal_a_dense_array(
    writes: list[tuple[GridSpec, int]], reads: list[GridSpec], fill: float
) -> None:
    layer = TileLayer("float32", fill, 0.1)
    dense = np.full((SIDE, SIDE), fill, np.float32)
    for k, (spec, kind) in enumerate(writes):
        values = np.random.default_rng(k).normal(size=spec.shape).astype(np.float32)
        values = np.full(spec.shape, fill, np.float32) if kind == 0 else values
        layer.write(spec, values)
        dense[part(spec)] = values
    again = TileLayer("float32", fill, 0.1)
    again.set_state(unpack_snapshot(pack_snapshot(layer.state())))
    for spec in reads:
        assert np.array_equal(layer.read(spec), dense[part(spec)])
        assert np.array_equal(again.read(spec), dense[part(spec)])
    for (tx, ty), cells in layer.tiles():
        assert np.array_equal(cells, layer.read(GridSpec(0.1, tx * TILE, ty * TILE, TILE, TILE)))
    assert [key for key, _ in layer.tiles()] == sorted(key for key, _ in layer.tiles())


def test_a_read_is_a_copy_and_nothing_is_made_for_the_fill_value() -> None:
    layer = TileLayer("uint8", 0, 0.1)
    spec = GridSpec(0.1, -3, -3, 6, 6)
    layer.write(spec, np.zeros(spec.shape, np.uint8))
    assert list(layer.tiles()) == []
    layer.write(spec, np.ones(spec.shape, np.uint8))
    layer.read(spec)[:] = 7
    assert (layer.read(spec) == 1).all()
    assert len(list(layer.tiles())) == 4
