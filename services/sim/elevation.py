"""Worlds from heights: NumPy arrays (npy), GeoTIFF, or 16-bit images, with a YAML file beside them or options.

Row 0 is the top (greatest y), as in any image; values that are not finite, or are the file's no-data value, are solid.
The YAML file has the image's name with the ending `.yaml`:

    resolution: 0.5        # metres a pixel
    height_scale: 0.01     # metres a unit of the pixels
    height_offset: 0.0     # metres, added
    origin: [0.0, 0.0]     # of the lower left pixel's corner, metres
    nodata: 0              # solid
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from planning.grid import GridSpec
from services.sim.config import ElevationConfig, RobotConfig
from services.sim.raster_cache import Arrays, cached
from services.sim.terrain import resample
from services.sim.terrain_start import deepest_standing_point, with_terrain_start
from services.sim.world import MapFileError, StartError, World

ELEVATION_SUFFIXES = (".npy", ".tif", ".tiff", ".png")
RESOLUTION_RANGE_M = (0.01, 50.0)
LONGEST_SIDE_M = 2000.0
MOST_CELLS = 64_000_000
_KEYS = ("resolution", "height_scale", "height_offset", "origin", "nodata")
_PIXEL_SCALE, _TIE_POINT, _GEO_KEYS, _NO_DATA = 33550, 33922, 34735, 42113
_MODEL_TYPE, _GEOGRAPHIC = 1024, 2
_RECIPE = "elevation 1"


class _Header(NamedTuple):
    resolution_m: float
    scale_m: float
    offset_m: float
    origin_m: tuple[float, float]
    nodata: float | None


def load_elevation_world(
    path: str | Path,
    config: ElevationConfig,
    resolution_m: float,
    start: tuple[float, float, float | None] | None,
    robot: RobotConfig,
) -> World:
    """The world of a height image, under an open sky; `start` as for a mesh.

    Raises MapFileError, which names the file, the field and the mend, or StartError.
    """
    path = Path(path)
    if path.suffix.lower() not in ELEVATION_SUFFIXES:
        raise _bad(
            path, "name", f"ends in {path.suffix!r}", f"height files end in {', '.join(ELEVATION_SUFFIXES)}"
        )
    try:
        content = path.read_bytes()
        beside = path.with_suffix(".yaml")
        text = beside.read_text(encoding="utf-8") if beside.is_file() else ""
    except (OSError, UnicodeDecodeError) as error:
        raise _bad(path, "file", f"cannot be read ({error})", "give the path of a height image") from None
    recipe = f"{_RECIPE} {path.suffix.lower()} {resolution_m!r} {config.model_dump_json()} {text}"
    arrays = cached(content, recipe, lambda: _rasterise(path, content, text, config, resolution_m))
    spec = GridSpec(float(arrays["cell"]), *(int(value) for value in arrays["spec"]))
    floor_m = np.asarray(arrays["floor_m"], dtype=np.float32)
    solid = ~np.isfinite(floor_m)
    world = World(path.stem, spec, solid, (0.0, 0.0, 0.0), np.where(solid, np.float32(0.0), floor_m))
    if start is None:
        try:
            start = (*deepest_standing_point(world, robot), None)
        except StartError as error:
            raise _bad(path, "heights", str(error), "check resolution and height_scale") from None
    return with_terrain_start(world, *start, robot)


def _bad(path: Path, field: str, wrong: str, mend: str) -> MapFileError:
    return MapFileError(f"{path}: {field}: {wrong}; {mend}")


def _rasterise(path: Path, content: bytes, text: str, config: ElevationConfig, resolution_m: float) -> Arrays:
    """Heights on cells of about `resolution_m`; row 0 the lowest y, nan where solid."""
    values, tags = _read_values(path, content)
    header = _header(path, text, tags, config)
    heights = values * header.scale_m + header.offset_m
    solid = ~np.isfinite(values)
    if header.nodata is not None:
        solid |= values == header.nodata
    heights[solid] = np.nan
    heights, cell = _fit(np.ascontiguousarray(heights[::-1]), header.resolution_m, resolution_m)
    if heights.size == 0 or np.isnan(heights).all():
        raise _bad(path, "heights", "no pixel has one", "check nodata")
    height, width = heights.shape
    if max(height, width) * cell > LONGEST_SIDE_M or height * width > MOST_CELLS:
        raise _bad(path, "resolution", f"makes it {width * cell:.0f} x {height * cell:.0f} m", "crop it")
    ix0, iy0 = (round(value / cell) for value in header.origin_m)
    return {
        "spec": np.array([ix0, iy0, width, height]), "cell": np.array(cell), "floor_m": heights.astype(np.float32)
    }  # fmt: skip


def _fit(heights_m: NDArray[np.float64], own_m: float, wanted_m: float) -> tuple[NDArray[np.float64], float]:
    """Cut coarse pixels by interpolation, join fine ones by their mean; returns heights and the cell size."""
    if own_m > wanted_m * 1.001:
        cuts = math.ceil(own_m / wanted_m - 1e-6)
        return resample(heights_m.astype(np.float32), cuts).astype(np.float64), own_m / cuts
    joined = max(1, math.floor(wanted_m / own_m + 1e-6))
    rows, columns = heights_m.shape[0] // joined, heights_m.shape[1] // joined
    blocks = heights_m[: rows * joined, : columns * joined].reshape(rows, joined, columns, joined)
    return blocks.mean(axis=(1, 3)), own_m * joined


def _read_values(path: Path, content: bytes) -> tuple[NDArray[np.float64], dict[int, Any]]:
    """Pixel values (h, w) and, of a TIFF, its tags."""
    if path.suffix.lower() == ".npy":
        try:
            values = np.load(io.BytesIO(content), allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise _bad(path, "file", f"is not a NumPy array ({error})", "write it with numpy.save") from None
        tags: dict[int, Any] = {}
    else:
        try:
            with Image.open(io.BytesIO(content)) as picture:
                values = np.asarray(picture)
                tags = dict(getattr(picture, "tag_v2", {}))
        except (
            UnidentifiedImageError,
            Image.DecompressionBombError,
            OSError,
            ValueError,
            SyntaxError,
        ) as error:
            raise _bad(
                path, "image", f"cannot be read ({error})", "save it as 16-bit PNG or float TIFF"
            ) from None
    if values.ndim != 2 or values.dtype.kind not in "fiu" or min(values.shape) < 2:
        wrong = f"has shape {values.shape} of {values.dtype}"
        raise _bad(path, "heights", wrong, "give one number a pixel: rows times columns of int or float")
    return values.astype(np.float64), tags


def _header(path: Path, text: str, tags: dict[int, Any], config: ElevationConfig) -> _Header:
    """Options first, then the YAML file, then the TIFF's own tags."""
    fields = {**_of_tags(path, tags), **_of_yaml(path, text)}
    if config.resolution_m is not None:
        fields["resolution"] = config.resolution_m
    if config.height_scale_m is not None:
        fields["height_scale"] = config.height_scale_m
    if "resolution" not in fields:
        raise _bad(
            path,
            "resolution",
            "is missing",
            f"write `resolution: 0.5` (m a pixel) into {path.stem}.yaml beside it",
        )
    resolution_m = _number(path, fields, "resolution", 0.0)
    low, high = RESOLUTION_RANGE_M
    if not low <= resolution_m <= high:
        raise _bad(path, "resolution", f"{resolution_m:g} m a pixel", f"need between {low:g} and {high:g} m")
    origin = fields.get("origin", [0.0, 0.0])
    if not isinstance(origin, list) or len(origin) not in (2, 3):
        raise _bad(path, "origin", f"{origin!r} is not a list", "write origin: [x, y] in metres")
    x_m, y_m = (_number(path, {"origin": value}, "origin", 0.0) for value in origin[:2])
    if max(abs(x_m), abs(y_m)) > 1e6:
        raise _bad(path, "origin", f"{origin!r} lies beyond 1,000 km", "give a local origin in metres")
    nodata = _number(path, fields, "nodata", 0.0) if "nodata" in fields else None
    scale_m = _number(path, fields, "height_scale", 1.0)
    if scale_m == 0.0:
        raise _bad(path, "height_scale", "is 0", "write the metres a unit of the pixels stands for")
    return _Header(resolution_m, scale_m, _number(path, fields, "height_offset", 0.0), (x_m, y_m), nodata)


def _of_tags(path: Path, tags: dict[int, Any]) -> dict[str, Any]:
    """Resolution and no-data value of a GeoTIFF. The origin stays local: map coordinates are too large."""
    fields: dict[str, Any] = {}
    keys = tags.get(_GEO_KEYS, ())
    model = [keys[k + 3] for k in range(4, len(keys) - 3, 4) if keys[k] == _MODEL_TYPE]
    if _PIXEL_SCALE in tags and _GEOGRAPHIC not in model:
        x, y = tags[_PIXEL_SCALE][:2]
        if abs(x - y) > 1e-3 * abs(x):
            raise _bad(
                path, "ModelPixelScale", f"{x:g} x {y:g} is not square", "reproject it to square pixels"
            )
        fields["resolution"] = float(x)
    if _NO_DATA in tags:
        try:
            nodata = float(str(tags[_NO_DATA]).strip("\0 "))
        except ValueError:
            nodata = math.nan
        if math.isfinite(nodata):
            fields["nodata"] = nodata
    return fields


def _of_yaml(path: Path, text: str) -> dict[str, Any]:
    beside = path.with_suffix(".yaml")
    try:
        fields = yaml.safe_load(text) or {}
    except yaml.YAMLError as error:
        raise MapFileError(f"{beside}: is not valid YAML ({error}); mend the file") from None
    if not isinstance(fields, dict):
        raise MapFileError(f"{beside}: holds no fields; need resolution")
    for key in fields:
        if key not in _KEYS:
            raise _bad(beside, str(key), "is unknown", f"the fields are {', '.join(_KEYS)}")
    return fields


def _number(path: Path, fields: dict[str, Any], key: str, default: float) -> float:
    value = fields.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _bad(path, key, f"{value!r} is not a finite number", "write a plain number such as 0.5")
    return float(value)
