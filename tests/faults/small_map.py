"""A map that is explored in less than a minute: two rooms with a door, as a map_server file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from PIL import Image

RESOLUTION_M = 0.1
WIDTH_M, HEIGHT_M = 16.0, 9.0
START = {"x_m": 3.0, "y_m": 4.5, "yaw_rad": 0.0}


def write_small_map(folder: Path) -> Path:
    """Write `map.png` and `map.yaml`; gives the path of the latter. A door of 1.6 m in the wall at 8 m."""
    columns, rows = round(WIDTH_M / RESOLUTION_M), round(HEIGHT_M / RESOLUTION_M)
    free = np.zeros((rows, columns), dtype=np.bool_)
    free[5 : rows - 5, 5 : columns - 5] = True
    free[:, 78:82] = False
    free[37:53, 78:82] = True
    Image.fromarray(np.where(free, 254, 0).astype(np.uint8)).save(folder / "map.png")
    header = {
        "image": "map.png", "resolution": RESOLUTION_M, "origin": [0.0, 0.0, 0.0], "negate": 0,
        "occupied_thresh": 0.65, "free_thresh": 0.25,
    }  # fmt: skip
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump(header), encoding="utf-8")
    return path
