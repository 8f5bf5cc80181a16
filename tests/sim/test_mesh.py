"""Worlds from meshes: floors, ceilings, walls and levels of small scenes, in every format; cache and refusals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from services.sim import mesh as mesh_module
from services.sim.config import RobotConfig, SimConfig
from services.sim.mesh import load_mesh_world
from services.sim.world import MapFileError, StartError, World
from services.sim.worlds import build_world

Mesh = Any  # trimesh.Trimesh; the package's types are partial


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLGRIM_CACHE_DIR", str(tmp_path / "cache"))


def _plate(corners: list[tuple[float, float, float]]) -> Mesh:
    """Two triangles; the corners counter-clockwise as seen from where it faces."""
    return trimesh.Trimesh(np.array(corners), [[0, 1, 2], [0, 2, 3]], process=False)


def _joined(parts: list[Mesh]) -> Mesh:
    return trimesh.util.concatenate(parts)


def _room(roof: bool = True) -> Mesh:
    """A room 10 x 6 m seen from inside: floor at 1 m that rises to 2 m from x = 6, walls, a roof at 4 m, a block."""
    parts = [
        _plate([(0, 0, 1), (6, 0, 1), (6, 6, 1), (0, 6, 1)]),
        _plate([(6, 0, 1), (10, 0, 2), (10, 6, 2), (6, 6, 1)]),
        _plate([(0, 0, 1), (0, 0, 4), (10, 0, 4), (10, 0, 1)]),
        _plate([(0, 6, 1), (10, 6, 1), (10, 6, 4), (0, 6, 4)]),
    ]
    if roof:
        parts.append(_plate([(0, 0, 4), (0, 6, 4), (10, 6, 4), (10, 0, 4)]))
    block = trimesh.creation.box((1.0, 1.0, 2.0))
    block.apply_translation((3.0, 3.0, 2.0))
    return _joined([*parts, block])


def _load(path: Path, start: tuple[float, float, float | None] | None = None) -> World:
    return load_mesh_world(path, 0.2, start, RobotConfig())


def _heights(world: World, x_m: float, y_m: float) -> tuple[Any, ...]:
    assert world.floor_m is not None and world.ceiling_m is not None
    cell = world.spec.cell_of(x_m, y_m)
    return bool(world.occupied[cell]), float(world.floor_m[cell]), float(world.ceiling_m[cell])


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".dae"])
def test_a_room_in_every_format(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"room{suffix}"
    _room().export(path)
    world = _load(path)
    assert world.name == "room"
    assert _heights(world, 1.5, 3.1) == (False, pytest.approx(1.0, abs=1e-4), pytest.approx(4.0, abs=1e-4))
    # Heights of the ramp are those of its plane at the cells' centres.
    x_m = world.spec.centres_x()[world.spec.cell_of(8.05, 3.0)[1]]
    assert _heights(world, 8.05, 4.5)[1] == pytest.approx(1.0 + (x_m - 6.0) / 4.0, abs=1e-4)
    assert _heights(world, 3.0, 3.0)[0]  # the block
    assert _heights(world, 5.0, -0.2)[0]  # outside
    free_m2 = np.count_nonzero(~world.occupied) * 0.04
    assert 60.0 - 1.0 - 8.0 < free_m2 < 60.0 - 1.0


def test_without_a_roof_the_sky_is_open(tmp_path: Path) -> None:
    _room(roof=False).export(tmp_path / "room.ply")
    assert _heights(_load(tmp_path / "room.ply"), 1.5, 3.1)[2] == math.inf


def test_transforms_and_units_of_a_scene_count(tmp_path: Path) -> None:
    room = _room()
    room.apply_scale(100.0)
    text = room.export(file_type="dae").decode()
    text = text.replace("<up_axis>", '<unit name="centimeter" meter="0.01"/><up_axis>')
    text = text.replace('name="node0">', 'name="node0"><translate>10000 -5000 700</translate>')
    (tmp_path / "scene.dae").write_text(text)
    assert _heights(_load(tmp_path / "scene.dae"), 101.5, -46.9)[1] == pytest.approx(8.0, abs=1e-3)


def test_thin_walls_between_cell_centres_block(tmp_path: Path) -> None:
    wall = _plate(
        [(5.0, 0, 1), (5.0, 6, 1), (5.0, 6, 4), (5.0, 0, 4)]
    )  # exactly between two columns of cells
    _joined([_room(), wall]).export(tmp_path / "room.ply")
    world = _load(tmp_path / "room.ply", (2.0, 1.0, None))
    columns = slice(world.spec.cell_of(4.7, 1)[1], world.spec.cell_of(5.3, 1)[1] + 1)
    rows = slice(world.spec.cell_of(0, 0.1)[0], world.spec.cell_of(0, 5.9)[0] + 1)
    assert world.occupied[rows, columns].any(axis=1).all()


def _two_storeys() -> Mesh:
    """Closed storeys over one another, floors at 0 and 3 m."""
    parts = []
    for z in (0.0, 3.0):
        parts += [_plate([(0, 0, z), (10, 0, z), (10, 6, z), (0, 6, z)])]
        parts += [_plate([(0, 0, z + 2.4), (0, 6, z + 2.4), (10, 6, z + 2.4), (10, 0, z + 2.4)])]
    return _joined(parts)


def test_of_storeys_the_lowest_with_the_start_is_taken(tmp_path: Path) -> None:
    _two_storeys().export(tmp_path / "house.ply")
    occupied, floor_m, ceiling_m = _heights(_load(tmp_path / "house.ply"), 5.0, 3.0)
    assert (occupied, floor_m) == (False, pytest.approx(0.0, abs=1e-5))
    assert ceiling_m == pytest.approx(2.4, abs=1e-5)


def test_an_upper_floor_that_leads_down_is_a_drop_not_a_wall(tmp_path: Path) -> None:
    parts = [
        _plate([(0, 0, 0), (5, 0, 0), (5, 6, 0), (0, 6, 0)]),
        _plate([(5, 0, -3), (8, 0, -3), (8, 6, -3), (5, 6, -3)]),
    ]
    _joined(parts).export(tmp_path / "edge.ply")
    world = _load(tmp_path / "edge.ply", (2.0, 3.0, None))
    assert _heights(world, 6.5, 3.0)[:2] == (False, pytest.approx(-3.0, abs=1e-5))


def test_seams_between_tiles_are_closed(tmp_path: Path) -> None:
    gap = 0.15
    parts = [
        _plate([(0, 0, 0), (5, 0, 0), (5, 6, 0), (0, 6, 0)]),
        _plate([(5 + gap, 0, 0), (10, 0, 0), (10, 6, 0), (5 + gap, 6, 0)]),
    ]
    _joined(parts).export(tmp_path / "tiles.ply")
    world = _load(tmp_path / "tiles.ply", (2.0, 3.0, None))
    row, low = world.spec.cell_of(4.0, 3.0)
    assert not world.occupied[row, low : world.spec.cell_of(6.0, 3.0)[1]].any()


def test_the_raster_is_cached_by_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, copy = tmp_path / "room.ply", tmp_path / "copy.ply"
    _room().export(path)
    made = _load(path)
    copy.write_bytes(path.read_bytes())

    def refuse(*_: object) -> None:
        raise AssertionError("rasterised again")

    monkeypatch.setattr(mesh_module, "levels_of", refuse)
    again = _load(copy)
    assert made.floor_m is not None and again.floor_m is not None
    assert again.floor_m.tobytes() == made.floor_m.tobytes()
    assert (again.occupied == made.occupied).all()
    with pytest.raises(AssertionError, match="rasterised again"):
        load_mesh_world(copy, 0.25, None, RobotConfig())
    _room(roof=False).export(copy)
    with pytest.raises(AssertionError, match="rasterised again"):
        _load(copy)


def test_a_broken_cache_is_made_anew(tmp_path: Path) -> None:
    path = tmp_path / "room.ply"
    _room().export(path)
    made = _load(path)
    (stored,) = (tmp_path / "cache" / "worlds").glob("*.npz")
    stored.write_bytes(stored.read_bytes()[:100])
    assert (_load(path).occupied == made.occupied).all()


def test_refusals_name_the_file_and_the_mend(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"none\.ply: file: cannot be read"):
        _load(tmp_path / "none.ply")
    (tmp_path / "room.fbx").write_bytes(b"x")
    with pytest.raises(MapFileError, match=r"room\.fbx: name: ends in '\.fbx'; meshes end in \.obj, \.stl"):
        _load(tmp_path / "room.fbx")
    (tmp_path / "bad.ply").write_bytes(b"not a mesh")
    with pytest.raises(MapFileError, match=r"bad\.ply: file: cannot be read as a mesh"):
        _load(tmp_path / "bad.ply")
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(MapFileError, match=r"empty\.obj: f"):
        _load(tmp_path / "empty.obj")
    huge = _room()
    huge.apply_scale(1000.0)
    huge.export(tmp_path / "huge.ply")
    with pytest.raises(MapFileError, match=r"huge\.ply: vertices: span 1000\d x 600\d m; scale the mesh"):
        _load(tmp_path / "huge.ply")
    tiny = _room()
    tiny.apply_scale(0.02)
    tiny.export(tmp_path / "tiny.ply")
    with pytest.raises(MapFileError, match=r"tiny\.ply: faces: no floor has room"):
        _load(tmp_path / "tiny.ply")


def test_a_configuration_takes_a_mesh_and_its_start(tmp_path: Path) -> None:
    _room().export(tmp_path / "room.stl")
    config = {"mesh_file": str(tmp_path / "room.stl"), "start": {"x_m": 8.0, "y_m": 2.0, "yaw_rad": 1.0}}
    assert build_world(SimConfig.model_validate(config)).start == (8.0, 2.0, 1.0)
    config["start"] = {"x_m": 3.0, "y_m": 3.0}
    with pytest.raises(StartError, match="the nearest that is not lies"):
        build_world(SimConfig.model_validate(config))
    with pytest.raises(ValueError, match="map_file and mesh_file exclude each other"):
        SimConfig(map_file="a.yaml", mesh_file="b.ply")
