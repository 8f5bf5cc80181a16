"""The map of the whole mission, put together from pictures of the robot's neighbourhood."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.grid import GridSpec

TILE = 256
"""Cells a side of a tile."""

Cells = NDArray[np.uint8]


class TileCanvas:
    """Sparse tiles of cells, so that a long mission costs memory only where the robot has been.

    Cells as in `schemas.world.CoverageWindow`: 0 unknown, 1 to cover, 2 covered, 3 obstacle, 4 out of reach.
    """

    def __init__(self) -> None:
        self.resolution_m = 0.0
        self._tiles: dict[tuple[int, int], Cells] = {}
        self._pastes = 0
        self._pasted: dict[tuple[int, int], int] = {}

    def paste(self, spec: GridSpec, cells: NDArray[Any]) -> None:
        """Lay a window (height, width) over the canvas; its unknown cells leave what was known.

        A window of another resolution starts a new canvas.
        """
        if spec.resolution_m != self.resolution_m:
            self.resolution_m = spec.resolution_m
            self._tiles.clear()
            self._pasted.clear()
        for ty in range(spec.iy0 // TILE, (spec.iy0 + spec.height - 1) // TILE + 1):
            for tx in range(spec.ix0 // TILE, (spec.ix0 + spec.width - 1) // TILE + 1):
                self._paste_tile(tx, ty, spec, cells)

    def _paste_tile(self, tx: int, ty: int, spec: GridSpec, cells: NDArray[Any]) -> None:
        x0, x1 = max(tx * TILE, spec.ix0), min((tx + 1) * TILE, spec.ix0 + spec.width)
        y0, y1 = max(ty * TILE, spec.iy0), min((ty + 1) * TILE, spec.iy0 + spec.height)
        part = cells[y0 - spec.iy0 : y1 - spec.iy0, x0 - spec.ix0 : x1 - spec.ix0]
        if not part.any():
            return
        tile = self._tiles.setdefault((tx, ty), np.zeros((TILE, TILE), np.uint8))
        inside = tile[y0 - ty * TILE : y1 - ty * TILE, x0 - tx * TILE : x1 - tx * TILE]
        part = part.astype(np.uint8)
        fresh = (part != 0) & (part != inside)
        if fresh.any():
            inside[fresh] = part[fresh]
            self._touch((tx, ty))

    def _touch(self, tile: tuple[int, int]) -> None:
        self._pastes += 1
        self._pasted[tile] = self._pastes

    def changed(self, since: int) -> tuple[int, dict[tuple[int, int], Cells]]:
        """Copies of the tiles that changed after `since` (0: all), and the number to ask with the next time."""
        tiles = {tile: self._tiles[tile].copy() for tile, paste in self._pasted.items() if paste > since}
        return self._pastes, tiles

    def tiles(self) -> set[tuple[int, int]]:
        """The tiles that hold something, by (x, y) in tiles."""
        return set(self._tiles)

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        tiles = sorted(self._tiles.items())
        return {"resolution_m": self.resolution_m, "tiles": [[tx, ty, tile] for (tx, ty), tile in tiles]}

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self.resolution_m = state["resolution_m"]
        self._tiles = {(tx, ty): tile for tx, ty, tile in state["tiles"]}
        self._pasted.clear()
        for tile in self._tiles:
            self._touch(tile)

    def whole(self) -> tuple[GridSpec, Cells] | None:
        """Everything known, cut to its bounding box; None when nothing is."""
        if not self._tiles:
            return None
        tx0, ty0 = min(tx for tx, _ in self._tiles), min(ty for _, ty in self._tiles)
        tx1, ty1 = max(tx for tx, _ in self._tiles), max(ty for _, ty in self._tiles)
        cells = np.zeros(((ty1 - ty0 + 1) * TILE, (tx1 - tx0 + 1) * TILE), np.uint8)
        for (tx, ty), tile in self._tiles.items():
            cells[(ty - ty0) * TILE : (ty - ty0 + 1) * TILE, (tx - tx0) * TILE : (tx - tx0 + 1) * TILE] = tile
        rows, columns = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
        y0, y1, x0, x1 = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
        spec = GridSpec(self.resolution_m, tx0 * TILE + x0, ty0 * TILE + y0, x1 - x0, y1 - y0)
        return spec, cells[y0:y1, x0:x1]
