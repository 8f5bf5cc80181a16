"""Worlds from ROS map_server files: a YAML header and an image (PGM, PNG or whatever Pillow reads).

Semantics of ROS `map_server` / nav2 `map_io`: occupancy = (255 - pixel) / 255, or pixel / 255 with `negate`;
free below `free_thresh`. Everything else, occupied or unknown, is solid here. Image row 0 is the top (max y),
`origin` the pose of the lower left pixel's corner. Unlike ROS, an alpha channel is not averaged with the
colours: a pixel that is not opaque is unknown.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from planning.grid import GridSpec
from services.sim.world import (
    DEFAULT_FOOTPRINT_RADIUS_M,
    MapFileError,
    StartError,
    World,
    deepest_free_point,
    with_start,
)

RESOLUTION_RANGE_M = (0.005, 2.0)
"""Metres per pixel of any map that a ground robot could use."""
LONGEST_SIDE_M = 5000.0
SHORTEST_SIDE_M = 1.0
MOST_PIXELS = 64_000_000


class _Header(NamedTuple):
    image: Path
    resolution_m: float
    origin: tuple[float, float]
    negate: bool
    free_thresh: float


def load_map_server(
    yaml_path: str | Path,
    start: tuple[float, float] | tuple[float, float, float | None] | None = None,
    footprint_radius_m: float = DEFAULT_FOOTPRINT_RADIUS_M,
) -> World:
    """Read a map; `start` is (x_m, y_m[, yaw_rad]), by default the deepest free cell, facing the longest ray.

    The grid's origin is moved to the nearest multiple of the resolution, by half a cell at most. Raises
    MapFileError, which names the file, the field and the mend, or StartError.
    """
    path = Path(yaml_path)
    header = _read_header(path)
    free = _read_free(path, header)
    height, width = free.shape
    ix0, iy0 = (round(value / header.resolution_m) for value in header.origin)
    spec = GridSpec(header.resolution_m, ix0, iy0, width, height)
    occupied = np.ascontiguousarray(~free[::-1])
    world = World(path.stem, spec, occupied, (0.0, 0.0, 0.0))
    try:
        x_m, y_m = deepest_free_point(spec, occupied) if start is None else (start[0], start[1])
    except StartError as error:
        raise _bad(
            path, "image", f"no pixel is below free_thresh {header.free_thresh:g}", str(error)
        ) from None
    yaw_rad = start[2] if start is not None and len(start) == 3 else None
    return with_start(world, x_m, y_m, yaw_rad, footprint_radius_m)


def _bad(path: Path, field: str, wrong: str, mend: str) -> MapFileError:
    return MapFileError(f"{path}: {field}: {wrong}; {mend}")


def _read_header(path: Path) -> _Header:
    fields = _read_yaml(path)
    for key in ("image", "resolution", "origin"):
        if key not in fields:
            raise _bad(path, key, "is missing", f"add a line `{key}: ...` as map_server writes it")
    mode = fields.get("mode", "trinary")
    if mode not in ("trinary", "scale"):  # scale tells more of what is not free; free is the same in both
        raise _bad(path, "mode", f"{mode!r} is not supported", "save the map with mode: trinary")
    occupied_thresh = _number(path, fields, "occupied_thresh", 0.65)
    free_thresh = _number(path, fields, "free_thresh", 0.196)
    if not 0.0 <= free_thresh < occupied_thresh <= 1.0:
        raise _bad(
            path,
            "occupied_thresh, free_thresh",
            f"{occupied_thresh:g} and {free_thresh:g} are not in order",
            "need 0 <= free_thresh < occupied_thresh <= 1, such as 0.65 and 0.196",
        )
    negate = fields.get("negate", 0)
    if negate not in (0, 1):
        raise _bad(
            path, "negate", f"{negate!r} is neither 0 nor 1", "write negate: 0 if dark pixels are walls"
        )
    image, resolution_m, origin = _image_path(path, fields), _resolution(path, fields), _origin(path, fields)
    return _Header(image, resolution_m, origin, bool(negate), free_thresh)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise MapFileError(f"{path}: no such file; give the path of a map_server YAML file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise MapFileError(
            f"{path}: cannot be read as text ({error}); give the map's YAML file, not its image"
        ) from None
    try:
        fields = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise MapFileError(f"{path}: is not valid YAML ({error}); mend the file") from None
    if not isinstance(fields, dict):
        raise MapFileError(f"{path}: holds no fields; need image, resolution and origin")
    return fields


def _number(path: Path, fields: dict[str, Any], key: str, default: float | None = None) -> float:
    value = fields.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _bad(path, key, f"{value!r} is not a finite number", "write a plain number such as 0.05")
    return float(value)


def _resolution(path: Path, fields: dict[str, Any]) -> float:
    value = _number(path, fields, "resolution")
    low, high = RESOLUTION_RANGE_M
    if not low <= value <= high:
        raise _bad(
            path, "resolution", f"{value:g} m per pixel", f"need between {low:g} and {high:g}, 0.05 is usual"
        )
    return value


def _origin(path: Path, fields: dict[str, Any]) -> tuple[float, float]:
    value = fields["origin"]
    if not isinstance(value, list) or len(value) not in (2, 3):
        raise _bad(path, "origin", f"{value!r} is not a list", "write origin: [x, y, 0.0] in metres")
    numbers = [_number(path, {"origin": item}, "origin") for item in value]
    if len(numbers) == 3 and numbers[2] != 0.0:
        raise _bad(path, "origin", f"has a yaw of {numbers[2]:g} rad", "turn the image and set the yaw to 0")
    if max(abs(numbers[0]), abs(numbers[1])) > 1e6:
        raise _bad(path, "origin", f"{value!r} lies beyond 1,000 km", "give a local origin in metres")
    return numbers[0], numbers[1]


def _image_path(path: Path, fields: dict[str, Any]) -> Path:
    value = fields["image"]
    if not isinstance(value, str) or not value:
        raise _bad(path, "image", f"{value!r} is not a file name", "write image: NAME.png")
    image = path.parent / value  # an absolute name replaces the folder
    if not image.is_file():
        raise _bad(path, "image", f"{image} does not exist", "put the image there or correct its name")
    return image


def _read_free(path: Path, header: _Header) -> NDArray[np.bool_]:
    """Free pixels, bool[height, width], image row 0 first."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(header.image) as picture:
                _check_size(path, header, picture.size)
                shade, opaque = _shades(picture)
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        wrong = f"{header.image} cannot be read ({error})"
        raise _bad(path, "image", wrong, "save it again as PNG or PGM") from None
    occupancy = shade if header.negate else 1.0 - shade
    return (occupancy < header.free_thresh) & opaque


def _check_size(path: Path, header: _Header, size: tuple[int, int]) -> None:
    width, height = size
    if width * height > MOST_PIXELS:
        raise _bad(
            path, "image", f"{width} x {height} pixels are over {MOST_PIXELS}", "crop it or save it coarser"
        )
    x_m, y_m = width * header.resolution_m, height * header.resolution_m
    if max(x_m, y_m) > LONGEST_SIDE_M or max(x_m, y_m) < SHORTEST_SIDE_M:
        raise _bad(
            path,
            "resolution",
            f"{header.resolution_m:g} m per pixel makes {width} x {height} pixels {x_m:g} x {y_m:g} m",
            f"no side may be over {LONGEST_SIDE_M:g} m and the longer one not under {SHORTEST_SIDE_M:g} m",
        )


def _shades(picture: Image.Image) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Shade 0 (black) to 1 (white) and opacity per pixel."""
    if picture.mode.startswith("I"):
        deep = np.asarray(picture)
        return (deep / np.float32(65535.0)).astype(np.float32), np.ones(deep.shape, dtype=np.bool_)
    if picture.mode in ("L", "1"):
        grey = np.asarray(picture.convert("L"))
        return (grey / np.float32(255.0)).astype(np.float32), np.ones(grey.shape, dtype=np.bool_)
    colours = np.asarray(picture.convert("RGBA"))
    return (colours[..., :3].mean(axis=-1) / 255.0).astype(np.float32), colours[..., 3] == 255
