"""Layers of the map as pictures and as ROS map_server files."""

from __future__ import annotations

import io
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from planning.grid import FREE, LETHAL, GridSpec
from schemas.world import RiskMap
from services.status.picture import COLOURS, coloured

_FREE_PX, _WALL_PX, _UNKNOWN_PX = 254, 0, 205
_OBSTACLE = 3
_FULL_HAZARD = 1.0
"""Hazard rate, 1/m, that is drawn in full red."""


class Layer(NamedTuple):
    """frame: `map` or `odom`. rgba: (h, w, 4) and occupancy: (h, w) pixels as map_server has them; row 0: lowest y."""

    name: str
    frame: str
    spec: GridSpec
    rgba: NDArray[np.uint8]
    occupancy: NDArray[np.uint8]


def coverage_layer(spec: GridSpec, cells: NDArray[np.uint8]) -> Layer:
    """From the canvas of the mission, in `map`: cells as in `schemas.world.CoverageWindow`."""
    clear = np.where(np.arange(len(COLOURS)) == 0, 0, 255).astype(np.uint8)
    rgba = coloured(cells, np.column_stack((COLOURS, clear)))
    occupancy = np.full(spec.shape, _FREE_PX, np.uint8)
    occupancy[cells == 0] = _UNKNOWN_PX
    occupancy[cells == _OBSTACLE] = _WALL_PX
    return Layer("coverage", "map", spec, rgba, occupancy)


def risk_layer(risk: RiskMap) -> Layer:
    """From the newest risk map, in `odom`: green to red by the hazard's CVaR, obstacles dark, unknown transparent."""
    g = risk.grid
    height, width = risk.state.shape
    spec = GridSpec(g.resolution_m, g.ix0, g.iy0, width, height)
    share = np.clip(risk.hazard_cvar / _FULL_HAZARD, 0.0, 1.0)
    rgba = np.zeros((*spec.shape, 4), np.uint8)
    rgba[..., 0] = (255 * np.minimum(1.0, 0.4 + 1.2 * share)).astype(np.uint8)
    rgba[..., 1] = (230 * (1.0 - share)).astype(np.uint8)
    rgba[..., 2] = 90
    rgba[..., 3] = 255
    rgba[risk.state == LETHAL] = (45, 52, 64, 255)
    rgba[(risk.state != LETHAL) & (risk.state != FREE)] = 0
    occupancy = np.full(spec.shape, _UNKNOWN_PX, np.uint8)
    occupancy[risk.state == FREE] = _FREE_PX
    occupancy[risk.state == LETHAL] = _WALL_PX
    return Layer("risk", "odom", spec, rgba, occupancy)


def layer_png(layer: Layer) -> bytes:
    """A pixel a cell, the highest y at the top."""
    return _saved(Image.fromarray(np.ascontiguousarray(layer.rgba[::-1])), "PNG")


def layer_pgm(layer: Layer) -> bytes:
    """The image of the map_server file."""
    return _saved(Image.fromarray(np.ascontiguousarray(layer.occupancy[::-1])), "PPM")


def layer_yaml(layer: Layer) -> str:
    """The map_server file: nav2's map_server and this project's simulator load it."""
    x_m, y_m = layer.spec.ix0 * layer.spec.resolution_m, layer.spec.iy0 * layer.spec.resolution_m
    return (
        f"# frame: {layer.frame}\n"
        f"image: {layer.name}.pgm\n"
        "mode: trinary\n"
        f"resolution: {layer.spec.resolution_m:.9g}\n"
        f"origin: [{x_m:.9g}, {y_m:.9g}, 0.0]\n"
        "negate: 0\n"
        "occupied_thresh: 0.65\n"
        "free_thresh: 0.196\n"
    )


def _saved(image: Image.Image, kind: str) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format=kind)
    return buffer.getvalue()
