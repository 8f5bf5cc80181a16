"""All worlds by name, and the world of a configuration."""

from __future__ import annotations

from collections.abc import Callable

from services.sim.blocks import subway_blocks
from services.sim.cave import cave
from services.sim.config import SimConfig
from services.sim.elevation import load_elevation_world
from services.sim.lava_tube import lava_tube, short_lava_tube
from services.sim.map_server import load_map_server
from services.sim.maze import maze
from services.sim.mesh import load_mesh_world
from services.sim.regression_worlds import (
    closing_door,
    dead_end,
    loop,
    map_edge,
    maze_bend,
    moving_person,
    narrow_sensor,
    unknown_start,
    unreachable_slit,
)
from services.sim.subway import subway
from services.sim.terrain_start import with_terrain_start
from services.sim.world import (
    DEFAULT_FOOTPRINT_RADIUS_M,
    MapFileError,
    StartError,
    UnknownWorldError,
    World,
    WorldError,
    with_start,
)

__all__ = [
    "DEFAULT_FOOTPRINT_RADIUS_M",
    "WORLD_NAMES",
    "MapFileError",
    "StartError",
    "UnknownWorldError",
    "World",
    "WorldError",
    "build_world",
    "cave",
    "lava_tube",
    "load_elevation_world",
    "load_map_server",
    "load_mesh_world",
    "make_world",
    "maze",
    "short_lava_tube",
    "subway",
    "with_start",
]

_MAKERS: dict[str, Callable[[int], World]] = {
    "subway_1x": lambda seed: subway(seed, 1),
    "subway_2x": lambda seed: subway(seed, 2),
    "subway_3x": lambda seed: subway(seed, 3),
    "subway_blocks": subway_blocks,
    "maze": maze,
    "cave": cave,
    "lava_tube": lava_tube,
    "short_lava_tube": short_lava_tube,
    "unreachable_slit": lambda seed: unreachable_slit(),
    "unknown_start": lambda seed: unknown_start(),
    "maze_bend": lambda seed: maze_bend(),
    "dead_end": lambda seed: dead_end(),
    "narrow_sensor": lambda seed: narrow_sensor(),
    "moving_person": lambda seed: moving_person(),
    "closing_door": lambda seed: closing_door(),
    "map_edge": lambda seed: map_edge(),
    "loop": lambda seed: loop(),
}
WORLD_NAMES: tuple[str, ...] = tuple(_MAKERS)


def make_world(name: str, seed: int) -> World:
    """A built-in world. Raises UnknownWorldError, which lists the names there are."""
    if name not in _MAKERS:
        raise UnknownWorldError(
            f"world {name!r} is not one of {', '.join(WORLD_NAMES)}; a map, mesh or height image needs its file"
        )
    return _MAKERS[name](seed)


def build_world(config: SimConfig) -> World:
    """The world that a configuration asks for, with its start checked for its robot. Raises WorldError."""
    robot, start = config.robot, config.start
    at = None if start is None else (start.x_m, start.y_m, start.yaw_rad)
    if config.map_file is not None:
        return load_map_server(config.map_file, at, robot.footprint_radius_m)
    if config.mesh_file is not None:
        return load_mesh_world(config.mesh_file, config.raster_resolution_m, at, robot)
    if config.dem_file is not None:
        return load_elevation_world(config.dem_file, config.elevation, config.raster_resolution_m, at, robot)
    world = make_world(config.world, config.seed)
    at = at or world.start
    if world.has_terrain:
        return with_terrain_start(world, *at, robot)
    return with_start(world, *at, robot.footprint_radius_m)
