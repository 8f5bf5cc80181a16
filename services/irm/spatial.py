"""Points by place: what lies near a point, whatever else there is."""

from __future__ import annotations

import math
from collections.abc import Iterator

_SIDE_M = 4.0


class SpatialHash:
    """Ids in square buckets of the plane."""

    def __init__(self) -> None:
        self._bucket_of: dict[int, tuple[int, int]] = {}
        self._buckets: dict[tuple[int, int], set[int]] = {}

    def put(self, item: int, x_m: float, y_m: float) -> None:
        """Add an item or move it."""
        key = (math.floor(x_m / _SIDE_M), math.floor(y_m / _SIDE_M))
        before = self._bucket_of.get(item)
        if before == key:
            return
        if before is not None:
            self.drop(item)
        self._bucket_of[item] = key
        self._buckets.setdefault(key, set()).add(item)

    def drop(self, item: int) -> None:
        """Remove an item; nothing happens when it is not there."""
        key = self._bucket_of.pop(item, None)
        if key is None:
            return
        bucket = self._buckets[key]
        bucket.discard(item)
        if not bucket:
            del self._buckets[key]

    def around(self, x_m: float, y_m: float, radius_m: float) -> Iterator[int]:
        """The items of all buckets that a disc touches, in no order that may be relied on."""
        low_x, high_x = math.floor((x_m - radius_m) / _SIDE_M), math.floor((x_m + radius_m) / _SIDE_M)
        low_y, high_y = math.floor((y_m - radius_m) / _SIDE_M), math.floor((y_m + radius_m) / _SIDE_M)
        for ix in range(low_x, high_x + 1):
            for iy in range(low_y, high_y + 1):
                yield from self._buckets.get((ix, iy), ())
