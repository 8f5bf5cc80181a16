"""Worlds from triangle meshes (OBJ, STL, PLY, DAE), rasterised once to floor and ceiling.

Metres, but for the unit that a DAE file states; z is up, whatever a file states (exporters write y for z freely).
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from planning.grid import GridSpec
from services.sim.config import RobotConfig
from services.sim.levels import Levels, connected_levels, grid_of, level_world, levels_of, lowest
from services.sim.mesh_raster import Triangles
from services.sim.raster_cache import Arrays, cached
from services.sim.terrain_start import deepest_standing_point, with_terrain_start
from services.sim.world import MapFileError, StartError, World

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".dae")
LONGEST_SIDE_M = 2000.0
MOST_CELLS = 64_000_000
_RECIPE = "mesh levels 1"
"""Changes with the way meshes are rasterised: older rasters in the cache are then not used."""


def load_mesh_world(
    path: str | Path,
    resolution_m: float,
    start: tuple[float, float, float | None] | None,
    robot: RobotConfig,
) -> World:
    """The world of a mesh; `start` is (x_m, y_m, yaw_rad or None), by default the point with most room around.

    Raises MapFileError, which names the file, the field and the mend, or StartError.
    """
    path = Path(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise _bad(path, "name", f"ends in {path.suffix!r}", f"meshes end in {', '.join(MESH_SUFFIXES)}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise _bad(path, "file", f"cannot be read ({error.strerror})", "give the path of a mesh") from None
    recipe = f"{_RECIPE} {path.suffix.lower()} {resolution_m!r}"
    spec, levels = _unpack(cached(content, recipe, lambda: _rasterise(path, content, resolution_m)))
    return _world(path, spec, levels, start, robot)


def _bad(path: Path, field: str, wrong: str, mend: str) -> MapFileError:
    return MapFileError(f"{path}: {field}: {wrong}; {mend}")


def _world(
    path: Path,
    spec: GridSpec,
    levels: Levels,
    start: tuple[float, float, float | None] | None,
    robot: RobotConfig,
) -> World:
    """Choose among the levels by the start."""
    if start is None:
        try:
            x_m, y_m = deepest_standing_point(
                level_world(path.stem, spec, levels, lowest(levels, spec)), robot
            )
        except StartError as error:
            raise _bad(
                path, "faces", "no floor has room for the robot", f"check its units and its up axis ({error})"
            ) from None
        start = (x_m, y_m, None)
    row, column = spec.cell_of(start[0], start[1])
    if not spec.contains(row, column) or lowest(levels, spec)[row, column] < 0:
        world = level_world(path.stem, spec, levels, lowest(levels, spec))
    else:
        world = level_world(path.stem, spec, levels, connected_levels(levels, spec, row, column))
    return with_terrain_start(world, *start, robot)


def _rasterise(path: Path, content: bytes, resolution_m: float) -> Arrays:
    triangles = read_triangles(path, content)
    spec = grid_of(triangles, resolution_m)
    sides_m = (spec.width * resolution_m, spec.height * resolution_m)
    if max(sides_m) > LONGEST_SIDE_M or spec.width * spec.height > MOST_CELLS:
        raise _bad(
            path,
            "vertices",
            f"span {sides_m[0]:.0f} x {sides_m[1]:.0f} m",
            "scale the mesh to metres, or crop it",
        )
    head: Arrays = {"spec": np.array(spec[1:], dtype=np.int64), "cell": np.array(resolution_m)}
    return head | levels_of(triangles, spec)._asdict()


def _unpack(arrays: Arrays) -> tuple[GridSpec, Levels]:
    spec = GridSpec(float(arrays["cell"]), *(int(value) for value in arrays["spec"]))
    return spec, Levels(**{name: arrays[name] for name in Levels._fields})  # type: ignore[arg-type]


def _unit_m(units: str | None) -> float:
    """Metres of a unit as trimesh names it."""
    from trimesh.units import unit_conversion

    return 1.0 if units is None else float(unit_conversion(units, "meters"))


def read_triangles(path: Path, content: bytes) -> Triangles:
    """All triangles of a mesh file with its scene's transforms, float64[n, 3, 3]. Raises MapFileError."""
    import trimesh

    try:
        scene = trimesh.load_scene(io.BytesIO(content), file_type=path.suffix.lower()[1:])
        unit_m = _unit_m(scene.units) if path.suffix.lower() == ".dae" else 1.0
        parts = [
            unit_m * np.asarray(mesh.triangles) for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)
        ]
    except Exception as error:  # a parser of foreign files raises whatever it meets
        raise _bad(path, "file", f"cannot be read as a mesh ({error})", "export it again") from None
    triangles = np.concatenate(parts).astype(np.float64) if parts else np.empty((0, 3, 3))
    if len(triangles) == 0:
        raise _bad(path, "faces", "there are none", "export faces, not points or lines")
    if not np.isfinite(triangles).all():
        raise _bad(path, "vertices", "some are not finite", "mend the mesh")
    return triangles
