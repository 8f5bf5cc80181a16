"""The picture of the map: coverage, driven path, robot, plan, frontiers and target, drawn with Pillow."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from planning.grid import GridSpec

COLOURS = np.array(
    [
        (236, 236, 236),  # unknown
        (255, 214, 102),  # reachable, not covered
        (146, 205, 160),  # covered
        (45, 52, 64),  # obstacle
        (205, 208, 214),  # free, out of the robot's reach
    ],
    dtype=np.uint8,
)
_PATH = (33, 102, 172)
_PLAN = (230, 85, 13)
_ROUTE = (150, 110, 200)
_FRONTIER = (140, 45, 4)
_ROBOT = (178, 24, 43)
_MARGIN_PX = 8
_ROWS_AT_ONCE = 64
_TITLE_PX = 18

Point = tuple[float, float]
_ToPixel = Callable[[Point], Point]


class Picture(NamedTuple):
    """What to draw, in `map`, metres. canvas: cells as in `TileCanvas`; robot: x, y, yaw; None: not known."""

    canvas: tuple[GridSpec, NDArray[np.uint8]] | None
    trajectory: tuple[Point, ...] = ()
    robot: tuple[float, float, float] | None = None
    plan: tuple[Point, ...] = ()
    frontiers: tuple[Point, ...] = ()
    target: Point | None = None
    route: tuple[Point, ...] = ()
    title: str = ""


def coloured(cells: NDArray[np.uint8], colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(h, w, channels): each cell's colour of `colours` (n, channels), the last one for those beyond.

    A few rows at a time: numpy takes eight bytes for each cell that is looked up.
    """
    out = np.empty((*cells.shape, colours.shape[1]), np.uint8)
    for row in range(0, cells.shape[0], _ROWS_AT_ONCE):
        rows = slice(row, row + _ROWS_AT_ONCE)
        out[rows] = colours[np.minimum(cells[rows], len(colours) - 1)]
    return out


def render_png(picture: Picture, size_px: int) -> bytes:
    """The picture as PNG, its longer side about `size_px`; a placeholder when there is no map yet."""
    image = (
        _placeholder(picture.title) if picture.canvas is None else _draw(picture, *picture.canvas, size_px)
    )
    buffer = io.BytesIO()
    image.save(buffer, format="PNG")
    return buffer.getvalue()


def _placeholder(title: str) -> Image.Image:
    image = Image.new("RGB", (480, 240), tuple(COLOURS[0].tolist()))
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default()
    draw.text((16, 100), "no map yet", fill=(90, 90, 90), font=font)
    draw.text((16, 120), title, fill=(90, 90, 90), font=font)
    return image


def _draw(picture: Picture, spec: GridSpec, cells: NDArray[np.uint8], size_px: int) -> Image.Image:
    scale = size_px / max(spec.width, spec.height)
    if scale > 1:
        scale = float(math.floor(scale))  # whole pixels a cell: sharp edges
    width, height = max(1, round(spec.width * scale)), max(1, round(spec.height * scale))
    few = Image.fromarray(np.ascontiguousarray(cells[::-1])).resize((width, height), Image.Resampling.NEAREST)
    frame = (width + 2 * _MARGIN_PX, height + 2 * _MARGIN_PX + _TITLE_PX)
    image = Image.new("RGB", frame, tuple(COLOURS[0].tolist()))
    image.paste(Image.fromarray(coloured(np.asarray(few), COLOURS)), (_MARGIN_PX, _MARGIN_PX + _TITLE_PX))
    px_per_m = scale / spec.resolution_m
    x0_m, y1_m = spec.ix0 * spec.resolution_m, (spec.iy0 + spec.height) * spec.resolution_m

    def to_pixel(point: Point) -> Point:
        return (
            _MARGIN_PX + (point[0] - x0_m) * px_per_m,
            _MARGIN_PX + _TITLE_PX + (y1_m - point[1]) * px_per_m,
        )

    _overlay(ImageDraw.Draw(image), picture, to_pixel)
    return image


def _overlay(draw: ImageDraw.ImageDraw, picture: Picture, to_pixel: _ToPixel) -> None:
    lines = ((picture.route, _ROUTE, 2), (picture.trajectory, _PATH, 2), (picture.plan, _PLAN, 3))
    for points, colour, width in lines:
        if len(points) > 1:
            draw.line([to_pixel(point) for point in points], fill=colour, width=width, joint="curve")
    for point in picture.frontiers:
        x, y = to_pixel(point)
        draw.rectangle((x - 3, y - 3, x + 3, y + 3), outline=_FRONTIER, width=2)
    if picture.target is not None:
        x, y = to_pixel(picture.target)
        draw.ellipse((x - 9, y - 9, x + 9, y + 9), outline=_ROBOT, width=3)
    if picture.robot is not None:
        _robot(draw, picture.robot, to_pixel)
    draw.text((_MARGIN_PX, 4), picture.title, fill=(40, 40, 40), font=ImageFont.load_default())


def _robot(draw: ImageDraw.ImageDraw, robot: tuple[float, float, float], to_pixel: _ToPixel) -> None:
    """An arrow head at the robot, of a fixed size on the screen."""
    x, y = to_pixel((robot[0], robot[1]))
    corners = []
    for angle, length in ((0.0, 11.0), (2.5, 8.0), (-2.5, 8.0)):
        yaw = robot[2] + angle
        corners.append((x + length * math.cos(yaw), y - length * math.sin(yaw)))
    draw.polygon(corners, fill=_ROBOT, outline=(255, 255, 255))
