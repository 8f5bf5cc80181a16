"""Where the robot may go, and where it shall go first: drawn by the operator, kept by the mission."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import ClassVar

from pydantic import Field, model_validator

from schemas.base import Header, Message

MAX_FENCES = 64
"""Polygons that a mission keeps."""
MAX_RINGS = 32
MAX_VERTICES = 1000
"""Of one polygon, all its rings together, the closing ones included."""
MAX_WEIGHT = 10.0


class FenceKind(StrEnum):
    """geofence: the robot stays inside (the union of them). no_go: it stays out. priority: it goes there first."""

    GEOFENCE = "geofence"
    NO_GO = "no_go"
    PRIORITY = "priority"


class FenceFrame(StrEnum):
    """Which frame the polygon stays in: `map` follows what SLAM makes of the past, `odom` stays where it was drawn."""

    MAP = "map"
    ODOM = "odom"


class Ring(Header):
    """A closed line: x and y of its points, m; the last is like the first."""

    x_m: list[float] = Field(max_length=MAX_VERTICES)
    y_m: list[float] = Field(max_length=MAX_VERTICES)

    @model_validator(mode="after")
    def _same_length(self) -> Ring:
        if len(self.x_m) != len(self.y_m):
            raise ValueError(f"x_m has {len(self.x_m)} entries, y_m {len(self.y_m)}")
        return self

    @classmethod
    def of(cls, points: Iterable[tuple[float, float]]) -> Ring:
        """From points (x, y)."""
        pairs = list(points)
        return cls(x_m=[float(x) for x, _ in pairs], y_m=[float(y) for _, y in pairs])

    @property
    def points(self) -> list[tuple[float, float]]:
        """(x, y) of each point, m."""
        return list(zip(self.x_m, self.y_m, strict=True))


class Fence(Header):
    """A polygon.

    rings: in its frame; the first is the outer one, the others are holes.
    weight: priority only, so many times the ground inside counts. fence_id: empty in a command for a new one.
    """

    fence_id: str = Field("", max_length=64)
    kind: FenceKind
    frame: FenceFrame
    name: str = Field("", max_length=128)
    weight: float = Field(1.0, ge=1, le=MAX_WEIGHT)
    rings: list[Ring] = Field(max_length=MAX_RINGS)


class Fences(Message):
    """All polygons of the mission. Its writer has checked them (`planning.polygons.check_rings`).

    version: grows with every change; `MissionState.fences_version` names the one that holds.
    """

    schema_name: ClassVar[str] = "fences"

    version: int = Field(ge=0)
    fences: list[Fence] = Field(max_length=MAX_FENCES)
