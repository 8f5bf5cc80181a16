"""Robots by name: what one body can stand, for the simulator that may break it and the risk map that must not."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RobotProfile:
    """One ground robot. Lengths in m, angles in rad; numbers rounded from public data sheets.

    footprint_radius_m: half its width; the planners take it for a disc. height_m: what passes above does not touch it.
    length_m, width_m: of the body's contact area. max_speed_mps: that the planners plan with.

    What the planners may ask of it: max_slope_rad, max_step_m (a ledge it climbs at planning speed).
    Where it breaks: tip_roll_rad, tip_pitch_rad (its support plane leans more), max_climb_m (a higher ledge is an
    obstacle, met with its body), max_drop_m (it falls off a higher ledge), belly_m (ground that stands higher between
    its wheels or feet holds it up: high-centred).
    """

    name: str
    footprint_radius_m: float
    length_m: float
    width_m: float
    height_m: float
    max_speed_mps: float
    max_slope_rad: float
    max_step_m: float
    tip_roll_rad: float
    tip_pitch_rad: float
    max_climb_m: float
    max_drop_m: float
    belly_m: float


HUSKY = RobotProfile(
    name="husky", footprint_radius_m=0.335, length_m=0.99, width_m=0.67, height_m=0.9, max_speed_mps=1.0,
    max_slope_rad=0.42, max_step_m=0.10, tip_roll_rad=0.61, tip_pitch_rad=0.70, max_climb_m=0.18, max_drop_m=0.25,
    belly_m=0.13,
)  # fmt: skip
"""Clearpath Husky A200: four wheels, clearance 0.13 m, climbs 45 degrees at the utmost, 30 degrees sideways."""

SPOT = RobotProfile(
    name="spot", footprint_radius_m=0.25, length_m=0.85, width_m=0.5, height_m=0.9, max_speed_mps=1.0,
    max_slope_rad=0.52, max_step_m=0.20, tip_roll_rad=0.70, tip_pitch_rad=0.79, max_climb_m=0.32, max_drop_m=0.40,
    belly_m=0.35,
)  # fmt: skip
"""Boston Dynamics Spot: four legs, slopes to 30 degrees, stairs to 0.22 m."""

PROFILES: dict[str, RobotProfile] = {profile.name: profile for profile in (HUSKY, SPOT)}
"""Profiles by name."""
