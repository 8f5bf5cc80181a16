"""Sparse layers over an unbounded plane: square tiles, made when first written."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec

TILE = 128
"""Cells a side of a tile."""


class TileLayer:
    """One layer of cells in `map`, aligned to multiples of the resolution."""

    def __init__(self, dtype: str, fill: float, resolution_m: float) -> None:
        self.dtype = np.dtype(dtype)
        self.resolution_m = resolution_m
        self.fill = fill
        self._tiles: dict[tuple[int, int], NDArray[Any]] = {}
        self._touched: set[tuple[int, int]] = set()

    def read(self, spec: GridSpec) -> NDArray[Any]:
        """A copy of the window, shape (height, width); the fill value where no tile is."""
        out = np.full(spec.shape, self.fill, dtype=self.dtype)
        for key, of_tile, of_window in _pieces(spec):
            tile = self._tiles.get(key)
            if tile is not None:
                out[of_window] = tile[of_tile]
        return out

    def write(self, spec: GridSpec, values: NDArray[Any]) -> None:
        """Write a window, shape (height, width); tiles that would hold only the fill value are not made."""
        for key, of_tile, of_window in _pieces(spec):
            piece = values[of_window]
            tile = self._tiles.get(key)
            if tile is None:
                if not np.any(piece != self.fill):
                    continue
                tile = self._tiles[key] = np.full((TILE, TILE), self.fill, dtype=self.dtype)
            tile[of_tile] = piece
            self._touched.add(key)

    def clear(self, keys: set[tuple[int, int]]) -> None:
        """Forget all cells of these tiles."""
        for key in keys & self._tiles.keys():
            del self._tiles[key]
            self._touched.add(key)

    def tile(self, key: tuple[int, int]) -> NDArray[Any] | None:
        """The cells of a tile; None where nothing was written."""
        return self._tiles.get(key)

    def take_touched(self) -> set[tuple[int, int]]:
        """The tiles written or cleared since the last call."""
        touched, self._touched = self._touched, set()
        return touched

    def tiles(self) -> Iterator[tuple[tuple[int, int], NDArray[Any]]]:
        """(tile index (x, y), cells) in a fixed order."""
        for key in sorted(self._tiles):
            yield key, self._tiles[key]

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {"keys": [list(k) for k, _ in self.tiles()], "tiles": [t for _, t in self.tiles()]}

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self._tiles = {(k[0], k[1]): t for k, t in zip(state["keys"], state["tiles"], strict=True)}
        self._touched = set(self._tiles)


def _pieces(spec: GridSpec) -> Iterator[tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]]:
    for ty in range(spec.iy0 // TILE, (spec.iy0 + spec.height - 1) // TILE + 1):
        y0, y1 = max(spec.iy0, ty * TILE), min(spec.iy0 + spec.height, (ty + 1) * TILE)
        for tx in range(spec.ix0 // TILE, (spec.ix0 + spec.width - 1) // TILE + 1):
            x0, x1 = max(spec.ix0, tx * TILE), min(spec.ix0 + spec.width, (tx + 1) * TILE)
            of_tile = (slice(y0 - ty * TILE, y1 - ty * TILE), slice(x0 - tx * TILE, x1 - tx * TILE))
            of_window = (slice(y0 - spec.iy0, y1 - spec.iy0), slice(x0 - spec.ix0, x1 - spec.ix0))
            yield (tx, ty), of_tile, of_window
