"""Explore a small map with the planner as a library: `python examples/explorer.py`."""

import numpy as np

from planning.rays import visible_cells
from plgrim import Explorer, Grid

world = np.zeros((60, 80), bool)  # True: wall; cells of 0.2 m
world[[0, -1]] = world[:, [0, -1]] = True
world[20, :60] = world[40, 20:] = True
known = np.full(world.shape, -1, np.int8)  # -1 unknown, 0 free, 100 occupied
x, y, yaw, steps = 1.5, 1.5, 0.0, 0
explorer = Explorer({"coverage": "known", "sensor_range_m": 5.0, "sensor_fov_deg": 360.0})
while steps < 200:
    steps += 1
    seen = np.zeros(world.shape, np.uint8)  # what the robot's own sensor sees from here
    visible_cells(world, x / 0.2, y / 0.2, 5.0 / 0.2, yaw, 2 * np.pi, seen)
    around = np.pad(seen, 1)
    surface = sum(around[r : r + 60, c : c + 80] for r in range(3) for c in range(3)) > 0
    known[surface & world], known[seen > 0] = 100, 0
    plan = explorer.step(Grid(known, resolution_m=0.2), (x, y, yaw))
    if plan.finished:
        break
    if plan.moves:  # drive for a second
        x, y, yaw, _ = plan.after(1.0)
print(f"{plan.finish}: {plan.covered_area_m2:.0f} m2 known after {steps} steps")
