"""Coverage over time, kept in a bounded number of points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict, Field


class CurvePoint(NamedTuple):
    """elapsed_s: of the mission. belief: share of the ground known. judge: the simulator's, nan on a real robot."""

    elapsed_s: float
    belief: float
    covered_area_m2: float
    distance_m: float
    judge: float


@dataclass(slots=True)
class Curve:
    """Points in time, thinned out by half when there are too many: the spacing doubles."""

    most: int = 4000
    spacing_s: float = 1.0
    points: list[CurvePoint] = field(default_factory=list)

    def add(self, point: CurvePoint) -> None:
        """Note a point, unless the last one is nearer than the spacing. Time that went back begins anew."""
        if self.points and point.elapsed_s < self.points[-1].elapsed_s:
            self.points.clear()
        if self.points and point.elapsed_s - self.points[-1].elapsed_s < self.spacing_s:
            return
        self.points.append(point)
        if len(self.points) > self.most:
            self.points = self.points[::2]
            self.spacing_s *= 2.0


class CoveragePoint(BaseModel):
    """One point of the curve."""

    elapsed_s: float
    belief: float = Field(
        description="Share of the ground known to be reachable that is covered, by the belief."
    )
    covered_area_m2: float
    distance_m: float
    judge: float | None = Field(description="The simulator's own; null on a real robot.")


class CoverageCurve(BaseModel):
    """Coverage over time, oldest first."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "points": [
                        {
                            "elapsed_s": 60.0,
                            "belief": 0.41,
                            "covered_area_m2": 97.3,
                            "distance_m": 31.8,
                            "judge": 0.28,
                        }
                    ]
                }
            ]
        }
    )

    points: list[CoveragePoint]
