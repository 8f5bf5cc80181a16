"""Parameters of the status service."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from schemas.topics import SERVICES


class Config(BaseModel):
    """Where the status is served and what counts as ready. Unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    host: str = Field(
        "127.0.0.1", min_length=1, description="Address to listen on; 0.0.0.0: every interface."
    )
    port: int = Field(8080, ge=0, le=65535, description="TCP port; 0: any free one.")
    expected_services: tuple[str, ...] = Field(
        tuple(name for name in SERVICES if name != "status"),
        description="Services without which the robot is not ready; leave sim out on a real one.",
    )
    expected_topics: tuple[str, ...] = Field(
        (
            "sim/odometry",
            "riskmap/risk_map",
            "irm/local_irm",
            "irm/coverage",
            "mission/state",
            "reconciler/plan",
        ),
        description="Topics without which the robot is not ready; stale ones count as missing.",
    )
    map_size_px: int = Field(
        1000, ge=64, le=4000, description="Longer side of the picture of the map, pixels."
    )
    trajectory_spacing_m: float = Field(
        0.2, gt=0, le=10, description="Distance of the trajectory's points, m."
    )
    max_trajectory_points: int = Field(
        20_000, ge=10, le=1_000_000, description="Beyond it every second point of the trajectory is dropped."
    )
    ask_again_s: float = Field(5.0, gt=0, le=60, description="Time between requests for the whole graph, s.")
