"""All worlds by name, and the world of a configuration."""

from __future__ import annotations

from collections.abc import Callable

from services.sim.cave import cave
from services.sim.config import SimConfig
from services.sim.lava_tube import lava_tube
from services.sim.map_server import load_map_server
from services.sim.maze import maze
from services.sim.subway import subway
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
    "load_map_server",
    "make_world",
    "maze",
    "subway",
    "with_start",
]

_MAKERS: dict[str, Callable[[int], World]] = {
    "subway_1x": lambda seed: subway(seed, 1),
    "subway_2x": lambda seed: subway(seed, 2),
    "subway_3x": lambda seed: subway(seed, 3),
    "maze": maze,
    "cave": cave,
    "lava_tube": lava_tube,
}
WORLD_NAMES: tuple[str, ...] = tuple(_MAKERS)


def make_world(name: str, seed: int) -> World:
    """A built-in world. Raises UnknownWorldError, which lists the names there are."""
    if name not in _MAKERS:
        raise UnknownWorldError(
            f"world {name!r} is not one of {', '.join(WORLD_NAMES)}; a map needs its file"
        )
    return _MAKERS[name](seed)


def build_world(config: SimConfig) -> World:
    """The world that a configuration asks for, with its start checked for its robot. Raises WorldError."""
    radius_m, start = config.robot.footprint_radius_m, config.start
    if config.map_file is not None:
        at = None if start is None else (start.x_m, start.y_m, start.yaw_rad)
        return load_map_server(config.map_file, at, radius_m)
    world = make_world(config.world, config.seed)
    if start is None:
        return with_start(world, *world.start, footprint_radius_m=radius_m)
    return with_start(world, start.x_m, start.y_m, start.yaw_rad, radius_m)
