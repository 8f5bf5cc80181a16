"""The map_server loader on images that the test writes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from PIL import Image

from services.sim.map_server import load_map_server
from services.sim.world import MapFileError, StartError

FREE, UNKNOWN, WALL = 254, 205, 0


def _pixels() -> NDArray[np.uint8]:
    """40 x 30 pixels (width x height), free, with a wall in the upper left and unknown in the lower right."""
    pixels = np.full((30, 40), FREE, dtype=np.uint8)
    pixels[:5, :10] = WALL
    pixels[-3:, -7:] = UNKNOWN
    return pixels


def _write(folder: Path, pixels: NDArray[Any] | None = None, name: str = "map.png", **fields: object) -> Path:
    picture = Image.fromarray(_pixels() if pixels is None else pixels)
    picture.save(folder / name)
    header: dict[str, object] = {
        "image": name, "resolution": 0.1, "origin": [0.0, 0.0, 0.0], "negate": 0,
        "occupied_thresh": 0.65, "free_thresh": 0.196,
    }  # fmt: skip
    header.update(fields)
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in header.items() if v is not ...}))
    return path


@pytest.mark.parametrize("name", ["map.png", "map.pgm"])
def test_the_top_row_of_the_image_is_the_greatest_y(tmp_path: Path, name: str) -> None:
    world = load_map_server(_write(tmp_path, name=name))
    assert world.occupied.shape == (30, 40)
    assert world.occupied[25:, :10].all()  # wall: high y, low x
    assert world.occupied[:3, 33:].all()  # unknown counts as solid: low y, high x
    assert np.count_nonzero(world.occupied) == 50 + 21


def test_negate_and_thresholds(tmp_path: Path) -> None:
    negated = load_map_server(_write(tmp_path, (255 - _pixels()).astype(np.uint8), negate=1))
    plain = load_map_server(_write(tmp_path))
    # The unknown grey 205 means 50 of 255 when negated, so both have the same occupancy.
    assert (negated.occupied == plain.occupied).all()
    lenient = load_map_server(_write(tmp_path, free_thresh=0.2))
    assert np.count_nonzero(lenient.occupied) == 50  # (255 - 205) / 255 = 0.19608 < 0.2: grey is free now
    strict = _write(tmp_path, free_thresh=0.003)
    with pytest.raises(MapFileError, match=r"image: no pixel is below free_thresh 0\.003"):
        load_map_server(strict)


def test_the_origin_moves_to_the_nearest_multiple(tmp_path: Path) -> None:
    world = load_map_server(_write(tmp_path, origin=[-3.04, 7.06, 0.0]))
    assert (world.spec.ix0, world.spec.iy0) == (-30, 71)
    assert world.spec.resolution_m == 0.1


def test_the_default_start_is_the_deepest_cell_and_faces_the_longest_ray(tmp_path: Path) -> None:
    pixels = np.full((40, 100), WALL, dtype=np.uint8)
    pixels[5:35, 5:35] = FREE  # a square room with its centre at 2.0 m
    pixels[18:22, 35:95] = FREE  # and a corridor to the east
    world = load_map_server(_write(tmp_path, pixels))
    assert world.start[0] == pytest.approx(2.0, abs=0.11)
    assert world.start[1] == pytest.approx(2.0, abs=0.11)
    assert abs(world.start[2]) < 0.06
    chosen = load_map_server(_write(tmp_path, pixels), (1.2, 3.0, 0.5))
    assert chosen.start == (1.2, 3.0, 0.5)


def test_colours_depth_and_opacity(tmp_path: Path) -> None:
    grey = _pixels()
    plain = load_map_server(_write(tmp_path)).occupied
    colours = np.repeat(grey[..., None], 3, axis=2)
    assert (load_map_server(_write(tmp_path, colours)).occupied == plain).all()
    deep = grey.astype(np.uint16) * 257
    assert (load_map_server(_write(tmp_path, deep)).occupied == plain).all()
    veiled = np.dstack([colours, np.full(grey.shape, 255, dtype=np.uint8)])
    veiled[10, 20, 3] = 0
    expected = plain.copy()
    expected[30 - 1 - 10, 20] = True
    assert (load_map_server(_write(tmp_path, veiled)).occupied == expected).all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"resolution": -0.05}, r"map\.yaml: resolution: -0\.05 m per pixel; need between"),
        ({"resolution": 0.0}, "resolution: 0 m per pixel"),
        ({"resolution": 50.0}, "resolution: 50 m per pixel"),
        ({"resolution": 0.01}, r"resolution: 0\.01 m per pixel makes 40 x 30 pixels 0\.4 x 0\.3 m"),
        ({"resolution": "fine"}, "resolution: 'fine' is not a finite number"),
        ({"resolution": float("nan")}, "resolution: nan is not a finite number"),
        ({"resolution": True}, "resolution: True is not a finite number"),
        ({"resolution": ...}, "resolution: is missing; add a line"),
        ({"image": ...}, "image: is missing"),
        ({"origin": ...}, "origin: is missing"),
        ({"image": "elsewhere.png"}, r"image: .*elsewhere\.png does not exist"),
        ({"image": 3}, "image: 3 is not a file name"),
        ({"image": "map.yaml"}, r"image: .*map\.yaml cannot be read"),
        ({"origin": [0.0, 0.0, 0.3]}, r"origin: has a yaw of 0\.3 rad; turn the image"),
        ({"origin": 3.0}, r"origin: 3\.0 is not a list"),
        ({"origin": [0.0, float("inf"), 0.0]}, "origin: inf is not a finite number"),
        ({"origin": [1e9, 0.0, 0.0]}, r"origin: .* beyond 1,000 km"),
        ({"free_thresh": 0.7}, r"occupied_thresh, free_thresh: 0\.65 and 0\.7 are not in order"),
        ({"occupied_thresh": 1.5}, "are not in order"),
        ({"free_thresh": -0.1}, "are not in order"),
        ({"free_thresh": "low"}, "free_thresh: 'low' is not a finite number"),
        ({"mode": "raw"}, "mode: 'raw' is not supported; save the map with mode: trinary"),
        ({"negate": 2}, "negate: 2 is neither 0 nor 1"),
    ],
)
def test_bad_fields_are_named_with_their_mend(tmp_path: Path, fields: dict[str, Any], message: str) -> None:
    with pytest.raises(MapFileError, match=message) as caught:
        load_map_server(_write(tmp_path, **fields))
    assert str(tmp_path / "map.yaml") in str(caught.value)


def test_too_large_a_map_is_refused_before_it_is_read(tmp_path: Path) -> None:
    wide = np.full((2, 3000), FREE, dtype=np.uint8)
    with pytest.raises(MapFileError, match=r"resolution: 2 m per pixel makes 3000 x 2 pixels 6000 x 4 m"):
        load_map_server(_write(tmp_path, wide, resolution=2.0))


def test_bad_files(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match="no such file"):
        load_map_server(tmp_path / "none.yaml")
    path = _write(tmp_path)
    with pytest.raises(MapFileError, match=r"cannot be read as text .* not its image"):
        load_map_server(tmp_path / "map.png")
    with pytest.raises(MapFileError, match="cannot be read"):
        load_map_server(tmp_path)
    path.write_text("image: [unclosed")
    with pytest.raises(MapFileError, match="is not valid YAML"):
        load_map_server(path)
    path.write_text("just words")
    with pytest.raises(MapFileError, match="holds no fields"):
        load_map_server(path)
    path = _write(tmp_path)
    whole = (tmp_path / "map.png").read_bytes()
    (tmp_path / "map.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(MapFileError, match=r"map\.png cannot be read"):
        load_map_server(path)


def test_a_start_in_a_wall_or_too_near_to_one(tmp_path: Path) -> None:
    path = _write(tmp_path)
    with pytest.raises(StartError, match=r"start \(0\.5, 2\.8\) in world map lies inside a wall"):
        load_map_server(path, (0.5, 2.8))
    with pytest.raises(StartError, match="inside a wall or unknown ground"):
        load_map_server(path, (3.8, 0.1))
    with pytest.raises(StartError, match="outside the map: x runs from"):
        load_map_server(path, (-1.0, 0.5))
    with pytest.raises(StartError, match=r"footprint of radius 0\.335 m does not fit"):
        load_map_server(path, (0.2, 1.0))
    assert math.isfinite(load_map_server(path, (0.2, 1.0), footprint_radius_m=0.1).start[2])


def test_a_map_that_no_footprint_fits(tmp_path: Path) -> None:
    pixels = np.full((30, 40), WALL, dtype=np.uint8)
    pixels[10:13, :] = FREE
    with pytest.raises(StartError, match="does not fit"):
        load_map_server(_write(tmp_path, pixels))
