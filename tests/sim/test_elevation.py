"""Worlds from height images: units, orientation, no-data, formats and refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from services.sim.config import ElevationConfig, RobotConfig, SimConfig
from services.sim.elevation import load_elevation_world
from services.sim.world import MapFileError, World
from services.sim.worlds import build_world


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLGRIM_CACHE_DIR", str(tmp_path / "cache"))


def _load(path: Path, config: ElevationConfig | None = None, cell_m: float = 0.2) -> World:
    return load_elevation_world(path, config or ElevationConfig(), cell_m, None, RobotConfig())


def _slope(rows: int = 40, columns: int = 60) -> np.ndarray:
    """Heights that fall by 1 a row downwards in the image (to lower y), and rise by 2 a column."""
    return np.asarray(np.add.outer(np.arange(rows)[::-1], 2.0 * np.arange(columns)))


def test_rows_run_from_the_top(tmp_path: Path) -> None:
    np.save(tmp_path / "dem.npy", _slope() * 0.02)
    world = _load(tmp_path / "dem.npy", ElevationConfig(resolution_m=0.2))
    assert world.floor_m is not None and world.ceiling_m is not None
    assert world.spec[1:] == (0, 0, 60, 40)
    assert world.floor_m[0, 0] == pytest.approx(0.0)
    assert world.floor_m[1, 0] == pytest.approx(0.02)
    assert world.floor_m[0, 1] == pytest.approx(0.04)
    assert np.isinf(world.ceiling_m).all()


def test_a_png_with_its_yaml(tmp_path: Path) -> None:
    values = (1000 + 10 * _slope()).astype(np.uint16)
    values[5, 7] = 0
    Image.fromarray(values).save(tmp_path / "dem.png")
    (tmp_path / "dem.yaml").write_text(
        "resolution: 0.2\nheight_scale: 0.002\nheight_offset: -2\norigin: [4.0, -2.0]\nnodata: 0\n"
    )
    world = _load(tmp_path / "dem.png")
    assert world.floor_m is not None
    assert world.spec.ix0 == 20 and world.spec.iy0 == -10
    assert world.floor_m[0, 3] == pytest.approx(1060 * 0.002 - 2.0, abs=1e-6)
    assert world.occupied[39 - 5, 7]
    assert np.count_nonzero(world.occupied) == 1
    changed = _load(tmp_path / "dem.png", ElevationConfig(height_scale_m=0.004))
    assert changed.floor_m is not None
    assert changed.floor_m[0, 3] == pytest.approx(1060 * 0.004 - 2.0, abs=1e-6)


def test_a_geotiff_with_its_own_tags(tmp_path: Path) -> None:
    values = (_slope() * 0.02).astype(np.float32)
    values[0, 0] = -9999.0
    tags = ImageFileDirectory_v2()
    tags[33550] = (0.5, 0.5, 0.0)
    tags.tagtype[33550] = 12
    tags[42113] = "-9999"
    tags.tagtype[42113] = 2
    Image.fromarray(values).save(tmp_path / "dem.tif", tiffinfo=tags)
    world = _load(tmp_path / "dem.tif", cell_m=0.2)
    assert world.spec.resolution_m == pytest.approx(0.5 / 3)  # cut in three by interpolation
    assert world.floor_m is not None
    assert world.spec.shape == (120, 180)
    # On the plane between the outermost centres, whatever the cutting.
    y, x = world.spec.centres_y()[5:100, None], world.spec.centres_x()[5:170]
    plane = 0.02 * (y / 0.5 - 0.5) + 0.04 * (x / 0.5 - 0.5)
    assert world.floor_m[5:100, 5:170] == pytest.approx(plane, abs=1e-4)
    assert world.occupied[-1, 0]


def test_fine_pixels_are_joined(tmp_path: Path) -> None:
    np.save(tmp_path / "dem.npy", _slope(80, 80) * 0.002)
    world = _load(tmp_path / "dem.npy", ElevationConfig(resolution_m=0.05))
    assert world.spec.resolution_m == pytest.approx(0.2)
    assert world.spec.shape == (20, 20)
    assert world.floor_m is not None
    assert world.floor_m[0, 0] == pytest.approx((1.5 + 3.0) * 0.002)


def test_refusals_name_the_file_the_field_and_the_mend(tmp_path: Path) -> None:
    np.save(tmp_path / "dem.npy", _slope())
    with pytest.raises(MapFileError, match=r"dem\.npy: resolution: is missing; write .* into dem\.yaml"):
        _load(tmp_path / "dem.npy")
    (tmp_path / "dem.yaml").write_text("resolution: 0.2\nheigth_scale: 2\n")
    with pytest.raises(MapFileError, match=r"dem\.yaml: heigth_scale: is unknown; the fields are resolution"):
        _load(tmp_path / "dem.npy")
    (tmp_path / "dem.yaml").write_text("resolution: true\n")
    with pytest.raises(MapFileError, match=r"dem\.npy: resolution: True is not a finite number"):
        _load(tmp_path / "dem.npy")
    np.save(tmp_path / "cube.npy", np.zeros((3, 3, 3)))
    with pytest.raises(MapFileError, match=r"cube\.npy: heights: has shape \(3, 3, 3\)"):
        _load(tmp_path / "cube.npy")
    (tmp_path / "bad.tif").write_bytes(b"no")
    with pytest.raises(MapFileError, match=r"bad\.tif: image: cannot be read"):
        _load(tmp_path / "bad.tif")
    (tmp_path / "dem.asc").write_text("1 2")
    with pytest.raises(MapFileError, match=r"dem\.asc: name: ends in '\.asc'"):
        _load(tmp_path / "dem.asc")
    np.save(tmp_path / "steep.npy", _slope())
    with pytest.raises(MapFileError, match=r"steep\.npy: heights: .* stand nowhere .*; check resolution"):
        _load(tmp_path / "steep.npy", ElevationConfig(resolution_m=0.2))


def test_a_configuration_takes_a_height_image(tmp_path: Path) -> None:
    np.save(tmp_path / "dem.npy", _slope() * 0.01)
    config = SimConfig(dem_file=str(tmp_path / "dem.npy"), elevation=ElevationConfig(resolution_m=0.5))
    world = build_world(config)
    assert world.name == "dem"
    assert world.has_terrain
