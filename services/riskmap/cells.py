"""What the terrain model knows of one cell: a record of float32, so that a point touches one line of memory."""

from __future__ import annotations

from typing import Final

MEAN: Final = 0
"""Height of the ground in odom, m; without meaning while VARIANCE is 0."""
VARIANCE: Final = 1
"""Of the ground's height when it was last looked at, m2; 0: nothing is known of the ground."""
SEEN: Final = 2
"""Points of ground that are in the mean; 0: the height is only supposed (interpolated, driven on, or at the start).

BELOW, with a variance of 0: no ground is known, but rays went over the cell; MEAN bounds it from above.
"""
BELOW: Final = -1.0
TRAVELLED: Final = 3
"""Distance that the robot had driven when the ground was last looked at, m: since then odometry's height drifts."""
LOG_ODDS: Final = 4
"""Of an obstacle."""
HIT_WEIGHT: Final = 5
"""Hits in the mean, at most 64; 0: the cell holds no obstacle's surface."""
HIT_X: Final = 6
HIT_Y: Final = 7
"""Mean hit, as an offset from the cell's centre, m."""
HIT_LOW: Final = 8
HIT_HIGH: Final = 9
"""Lowest and highest hit, z in odom, m."""
CEILING: Final = 10
"""Lowest point above the robot, z in odom, m; without meaning while CEILING_SEEN is 0."""
CEILING_SEEN: Final = 11
"""Points of the ceiling."""
HIT_AT: Final = 12
"""Distance that the robot had driven when an obstacle was last hit here, m; without meaning while there is none."""
CHANNELS: Final = 13
