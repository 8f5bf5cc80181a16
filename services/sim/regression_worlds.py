"""Small worlds, each from a complaint of people who use exploration planners: what once went wrong stays tried.

Flat but where said. They do not depend on a seed.
"""

from __future__ import annotations

import math

import numpy as np

from planning.grid import GridSpec
from services.sim.polygons import Polygon, band, draw, regular
from services.sim.world import Door, Mover, World, with_start

_CELL_M = 0.1


def unreachable_slit() -> World:
    """Complaint: "the robot keeps choosing a frontier behind a gap that it does not fit through".

    Two rooms joined by a slit of 0.4 m: beams pass, no robot does. The second room must be given up for good.
    """
    rooms = [_box(0.0, 0.0, 12.0, 10.0), _box(12.6, 0.0, 20.0, 10.0), _box(11.0, 4.8, 13.0, 5.2)]
    return _walled("unreachable_slit", rooms, (3.0, 5.0))


def unknown_start() -> World:
    """Complaint: "the planner does not start, the robot stands in unknown space".

    The robot starts 0.45 m off three walls of a niche 1.1 m wide: rings that look down meet the walls before the
    ground, so that no scan shows the ground around it; only the way ahead is seen.
    """
    return _walled("unknown_start", [_box(0.0, 0.0, 2.6, 1.1), _box(2.0, -4.0, 14.0, 6.0)], (0.45, 0.55), 0.0)


def maze_bend() -> World:
    """Complaint: "at sharp bends no frontier is detected and it turns back" (the paper saw it with HFE in the maze).

    Corridors of 1.4 m that fold back on themselves twice with thin walls between, then a room.
    """
    legs = [_box(0.0, 0.0, 14.0, 1.4), _box(12.6, 0.0, 14.0, 3.4), _box(2.0, 2.0, 14.0, 3.4)]
    legs += [_box(2.0, 2.0, 3.4, 5.4), _box(2.0, 4.0, 14.0, 5.4), _box(13.0, 2.6 + 1.4, 20.0, 9.0)]
    return _walled("maze_bend", legs, (1.0, 0.7))


def dead_end() -> World:
    """Complaint: "it oscillates in a long dead end and forgets what it passed".

    A corridor of 40 m without an outlet leaves a hall; the way back is all that is left at its end.
    """
    parts = [_box(0.0, 0.0, 10.0, 10.0), _box(9.5, 4.2, 50.0, 5.8), _box(4.2, 9.5, 5.8, 24.0)]
    return _walled("dead_end", parts, (5.0, 5.0))


def narrow_sensor() -> World:
    """Complaint: "with a camera of 90 degrees it leaves what lies beside its path and calls the map done".

    Rooms off both sides of a corridor, to be tried with `coverage_sensor.fov_deg` 90: turning on the spot pays.
    """
    parts = [_box(0.0, 0.0, 24.0, 2.4)]
    for k in range(4):
        low = 1.0 + 6.0 * k
        parts += [_box(low, 3.0, low + 4.5, 7.5), _box(low + 1.5, 2.0, low + 3.0, 3.4)]
        parts += [_box(low, -5.1, low + 4.5, -0.6), _box(low + 1.5, -1.0, low + 3.0, 0.4)]
    return _walled("narrow_sensor", parts, (1.2, 1.2))


def moving_person() -> World:
    """Complaint: "a person who walks through leaves ghosts in the map, or is driven into".

    Two people walk to and fro across a hall; there is always room to let them pass.
    """
    world = _walled("moving_person", [_box(0.0, 0.0, 22.0, 9.0), _box(21.0, 3.0, 30.0, 6.0)], (2.0, 4.5))
    walkers = (Mover((8.0, 1.0), (8.0, 8.0), 0.5), Mover((12.0, 7.5), (19.0, 1.5), 0.6))
    return _with(world, movers=walkers)


def closing_door() -> World:
    """Complaint: "an edge of the graph that was once free is kept for ever".

    A ring of corridors between two halls; the short one closes for good after 60 s. Nothing else is lost by it.
    """
    parts = [_box(0.0, 0.0, 8.0, 8.0), _box(16.0, 0.0, 24.0, 8.0), _box(7.5, 3.2, 16.5, 4.8)]
    parts += [_box(3.2, 7.5, 4.8, 14.0), _box(3.2, 12.4, 20.8, 14.0), _box(19.2, 7.5, 20.8, 14.0)]
    world = _walled("closing_door", parts, (4.0, 4.0))
    return _with(world, doors=(Door((11.8, 3.0, 12.2, 5.0), 60.0),))


def map_edge() -> World:
    """Complaint: "frontiers at the edge of the map are never done with, or it reads beyond the array".

    Ground that ends at the border of the grid with nothing behind: no wall that returns a beam.
    """
    spec = GridSpec(_CELL_M, -80, -60, 160, 120)
    occupied = np.zeros(spec.shape, dtype=np.bool_)
    occupied[40:80, 90:94] = True
    world = World("map_edge", spec, occupied, (0.0, 0.0, 0.0), open_border=True)
    return with_start(world, -5.0, 0.0, 0.0)


def loop() -> World:
    """Complaint: "when SLAM closes a loop the planner loses its graph or leaps".

    A ring corridor of 75 m, two metres wide: where it closes, a drifting estimate is some two metres off.
    """
    corners = regular(np.zeros(2), 12.0, 24)
    ring = [band(corners[k - 1], corners[k], 2.0) for k in range(24)]
    ring += [regular(corner, 1.0, 16) for corner in corners]
    x_m, y_m = corners[0].tolist()
    return _walled("loop", ring, (x_m, y_m), math.pi / 2.0)


def _box(x_low: float, y_low: float, x_high: float, y_high: float) -> Polygon:
    return np.array([[x_low, y_low], [x_high, y_low], [x_high, y_high], [x_low, y_high]])


def _walled(
    name: str, parts: list[Polygon], start: tuple[float, float], yaw_rad: float | None = None
) -> World:
    spec, occupied = draw(parts, _CELL_M, margin_m=0.5)
    return with_start(World(name, spec, occupied, (0.0, 0.0, 0.0)), *start, yaw_rad)


def _with(world: World, movers: tuple[Mover, ...] = (), doors: tuple[Door, ...] = ()) -> World:
    return World(world.name, world.spec, world.occupied, world.start, movers=movers, doors=doors)
