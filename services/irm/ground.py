"""The ground that was seen, kept with keyframes: patches of cells that move with them (DESIGN 3, irm).

A patch holds what the risk map showed while the robot was near one keyframe, as it lay in `map` when that keyframe was
where the patch was begun. The ground layer in `map` shows at every cell what was seen last. When SLAM moves keyframes,
the tiles that their patches touch are put together anew, from the patches as they were seen: a closure that is taken
back leaves no trace.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.frames import Planar
from planning.grid import GridSpec, overlap
from services.irm.keyframes import IDENTITY, NOBODY, Anchor
from services.irm.resample import bounds, moved, resample
from services.irm.tiles import TILE, TileLayer

_SPACING_M = 4.0
"""So far from its keyframe a patch goes on."""
_REACH_M = 12.0
"""Half a side of what a patch takes of each risk map: what lies farther off was seen long ago, or moves with the least
turn of the keyframe, while its footprints belong to keyframes that are nearer. Neighbouring patches overlap."""


@dataclass(slots=True)
class _Patch:
    """Cells (0: not seen) over `spec` in `map`, when the keyframe was at `pose`; placed: where it is. cells or bits."""

    pose: Planar
    placed: Planar
    spec: GridSpec
    cells: NDArray[np.uint8]
    turn: int
    bits: NDArray[np.uint8] | None = None

    @property
    def motion(self) -> Planar:
        """What SLAM has moved it by."""
        return IDENTITY if self.placed == self.pose else self.placed.compose(self.pose.inverse())

    def pack(self) -> None:
        """Two bits a cell: most patches are never touched again."""
        if self.bits is None:
            self.bits = np.packbits([self.cells & 1, self.cells >> 1])
            self.cells = np.zeros((0, 0), np.uint8)

    def unpacked(self) -> NDArray[np.uint8]:
        """The cells, (h, w)."""
        if self.bits is None:
            return self.cells
        planes = np.unpackbits(self.bits, count=2 * self.spec.height * self.spec.width)
        low, high = planes.reshape(2, *self.spec.shape)
        cells: NDArray[np.uint8] = low | (high << np.uint8(1))
        return cells


class GroundStore:
    """Keeps the patches, and the ground layer in `map` that they make."""

    def __init__(self, layer: TileLayer) -> None:
        self._layer = layer
        self._patches: dict[int, _Patch] = {}
        self._tiles_of_patch: dict[int, set[tuple[int, int]]] = {}
        self._patches_on: dict[tuple[int, int], set[int]] = {}
        self._current = NOBODY
        self._turn = 0
        self._changed: set[int] = set()
        self._written: GridSpec | None = None

    def write(self, spec: GridSpec, seen: NDArray[np.uint8], frame: Planar, anchor: Anchor) -> None:
        """Note what is seen now.

        spec: window in `odom`. seen: (h, w), 0 where nothing is seen now. frame: pose of `odom` in `map`. anchor: the
        keyframe that the robot is at.
        """
        target, cells = moved(spec, seen, frame)
        self._paint(target, cells)
        self._written = target if self._written is None else _around(self._written, target)
        if anchor.keyframe == NOBODY:
            return
        near, ours = _around_middle(spec, _REACH_M)
        target, cells = moved(near, seen[ours], frame)
        patch = self._patch(anchor, target)
        if patch.placed != patch.pose:
            target, cells = moved(near, seen[ours], patch.motion.inverse().compose(frame))
        _grow(patch, target)
        self._index(self._current)
        common = overlap(patch.spec, target)
        assert common is not None  # the patch has just grown over it
        known = cells != 0
        patch.cells[common[0]][known] = cells[known]

    def _patch(self, anchor: Anchor, target: GridSpec) -> _Patch:
        """The patch to go on with: the one of before while its keyframe is near."""
        self._turn += 1
        held = self._patches.get(self._current)
        far = held is None or math.dist(held.placed[:2], anchor.pose[:2]) > _SPACING_M
        if far:
            if held is not None:
                held.pack()
            self._current = anchor.keyframe
            held = self._patches.get(anchor.keyframe)
            if held is None:
                empty = np.zeros(target.shape, np.uint8)
                held = self._patches[anchor.keyframe] = _Patch(anchor.pose, anchor.pose, target, empty, 0)
            held.cells, held.bits = held.unpacked(), None
        assert held is not None
        held.turn = self._turn
        self._changed.add(self._current)
        return held

    def _index(self, keyframe: int) -> set[tuple[int, int]]:
        """Note which tiles a patch touches now. Returns them, and those that it touched before."""
        patch, before = self._patches[keyframe], self._tiles_of_patch.get(keyframe, set())
        now = self._tiles_of_patch[keyframe] = _tiles_of(bounds(patch.spec, patch.motion))
        for tile in before - now:
            self._patches_on[tile].discard(keyframe)
        for tile in now - before:
            self._patches_on.setdefault(tile, set()).add(keyframe)
        return before | now

    def _touching(self, tiles: set[tuple[int, int]]) -> list[tuple[int, _Patch]]:
        """(keyframe, patch) of those that may touch these tiles, in the order in which they were seen."""
        keyframes = {k for tile in tiles for k in self._patches_on.get(tile, ())}
        return sorted(((k, self._patches[k]) for k in keyframes), key=lambda item: item[1].turn)

    def _paint(self, target: GridSpec, cells: NDArray[np.uint8]) -> None:
        layer = self._layer.read(target)
        self._layer.write(target, np.where(cells != 0, cells, layer))

    def window(self, spec: GridSpec, frame: Planar, doubtful: frozenset[int]) -> NDArray[np.uint8]:
        """The ground in a window in `odom`, (h, w), without what was seen from doubtful keyframes.

        Before a loop is closed, the ground of long ago lies beside where it is: ghosts behind the walls.
        """
        out = np.zeros(spec.shape, np.uint8)
        there = bounds(spec, frame)
        for keyframe, patch in self._touching(_tiles_of(there)):
            if keyframe in doubtful or overlap(bounds(patch.spec, patch.motion), there) is None:
                continue
            to_odom = frame.inverse().compose(patch.motion)
            cells = resample(patch.unpacked(), patch.spec, spec, to_odom, 0)
            out[cells != 0] = cells[cells != 0]
        return out

    def has(self, keyframes: frozenset[int]) -> bool:
        """Whether one of these keyframes has a patch."""
        return not keyframes.isdisjoint(self._patches)

    def follow(self, keyframes: dict[int, Planar]) -> int:
        """Move the patches of keyframes that SLAM has moved. Returns how many tiles were put together anew."""
        tiles: set[tuple[int, int]] = set()
        for keyframe in sorted(keyframes.keys() & self._patches.keys()):
            self._patches[keyframe].placed = keyframes[keyframe]
            self._changed.add(keyframe)
            tiles |= self._index(keyframe)
        if tiles:
            self._compose(tiles)
        return len(tiles)

    def _compose(self, tiles: set[tuple[int, int]]) -> None:
        self._layer.clear(tiles)
        for _, patch in self._touching(tiles):
            whole = bounds(patch.spec, patch.motion)
            touched = sorted(_tiles_of(whole) & tiles)
            if not touched:
                continue
            cells = resample(patch.unpacked(), patch.spec, whole, patch.motion, 0)
            for tx, ty in touched:
                common = overlap(whole, GridSpec(whole.resolution_m, tx * TILE, ty * TILE, TILE, TILE))
                assert common is not None
                rows, columns = common[0]
                size = (columns.stop - columns.start, rows.stop - rows.start)
                target = GridSpec(
                    whole.resolution_m, whole.ix0 + columns.start, whole.iy0 + rows.start, *size
                )
                self._paint(target, cells[common[0]])

    def state(self) -> dict[str, Any]:
        """For a snapshot; without the layer."""
        patches = [[k, *_pack(p)] for k, p in sorted(self._patches.items())]
        return {"patches": patches, "current": self._current, "turn": self._turn}

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot, with the layer as it was then."""
        self._patches = {int(k): _unpack(*packed) for k, *packed in state["patches"]}
        self._tiles_of_patch, self._patches_on = {}, {}
        for keyframe in self._patches:
            self._index(keyframe)
        self._go_on(state)

    def _go_on(self, state: dict[str, Any]) -> None:
        self._current, self._turn = state["current"], state["turn"]
        for keyframe, patch in self._patches.items():
            if keyframe == self._current:
                patch.cells, patch.bits = patch.unpacked(), None
            else:
                patch.pack()

    def take_changes(self) -> dict[str, Any]:
        """The patches that have grown or moved, and the layer where it was written since the last call: a record."""
        changed, self._changed = self._changed, set()
        written, self._written = self._written, None
        return {
            "patches": [[k, *_pack(self._patches[k])] for k in sorted(changed)],
            "current": self._current,
            "turn": self._turn,
            "spec": None if written is None else list(written),
            "layer": None if written is None else self._layer.read(written),
        }

    def apply_changes(self, changes: dict[str, Any]) -> None:
        """Take in a record of the journal."""
        tiles: set[tuple[int, int]] = set()
        for k, *packed in changes["patches"]:
            old, new = self._patches.get(int(k)), _unpack(*packed)
            self._patches[int(k)] = new
            touched = self._index(int(k))
            if old is not None and old.placed != new.placed:
                tiles |= touched
        self._go_on(changes)
        if tiles:
            self._compose(tiles)
        if changes["spec"] is not None:
            self._layer.write(GridSpec(*changes["spec"]), changes["layer"])


def _pack(patch: _Patch) -> list[Any]:
    bits = np.packbits([patch.cells & 1, patch.cells >> 1]) if patch.bits is None else patch.bits
    return [list(patch.pose), list(patch.placed), list(patch.spec), bits, patch.turn]


def _unpack(
    pose: list[float], placed: list[float], spec: list[Any], bits: NDArray[np.uint8], turn: int
) -> _Patch:
    none = np.zeros((0, 0), np.uint8)
    return _Patch(Planar(*pose), Planar(*placed), GridSpec(*spec), none, turn, bits)


def _around(a: GridSpec, b: GridSpec) -> GridSpec:
    """The grid that holds both."""
    ix0, iy0 = min(a.ix0, b.ix0), min(a.iy0, b.iy0)
    width = max(a.ix0 + a.width, b.ix0 + b.width) - ix0
    height = max(a.iy0 + a.height, b.iy0 + b.height) - iy0
    return GridSpec(a.resolution_m, ix0, iy0, width, height)


def _around_middle(spec: GridSpec, reach_m: float) -> tuple[GridSpec, tuple[slice, slice]]:
    """The part of a window up to a distance from its middle, where the robot is, along rows and columns."""
    reach = round(reach_m / spec.resolution_m)
    rows = slice(max(0, spec.height // 2 - reach), min(spec.height, spec.height // 2 + reach + 1))
    columns = slice(max(0, spec.width // 2 - reach), min(spec.width, spec.width // 2 + reach + 1))
    size = (columns.stop - columns.start, rows.stop - rows.start)
    return GridSpec(spec.resolution_m, spec.ix0 + columns.start, spec.iy0 + rows.start, *size), (
        rows,
        columns,
    )


def _grow(patch: _Patch, target: GridSpec) -> None:
    a, grown = patch.spec, _around(patch.spec, target)
    if grown == a:
        return
    cells = np.zeros(grown.shape, np.uint8)
    row, column = a.iy0 - grown.iy0, a.ix0 - grown.ix0
    cells[row : row + a.height, column : column + a.width] = patch.cells
    patch.spec, patch.cells = grown, cells


def _tiles_of(spec: GridSpec) -> set[tuple[int, int]]:
    return {
        (tx, ty)
        for ty in range(spec.iy0 // TILE, (spec.iy0 + spec.height - 1) // TILE + 1)
        for tx in range(spec.ix0 // TILE, (spec.ix0 + spec.width - 1) // TILE + 1)
    }
