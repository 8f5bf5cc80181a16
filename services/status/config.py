"""Parameters of the status service."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from schemas.hosts import is_loopback
from schemas.topics import SERVICES


class Config(BaseModel):
    """Where the status is served and what counts as ready. Unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    host: str = Field(
        "127.0.0.1",
        min_length=1,
        description="Address to listen on; 0.0.0.0: every interface. Other than loopback only with TLS.",
    )
    port: int = Field(8080, ge=0, le=65535, description="TCP port; 0: any free one.")
    tokens_file: str = Field(
        "",
        description="File of tokens, a line each: `viewer NAME SECRET` or `operator NAME SECRET`. See security.py.",
    )
    read_token: Literal["auto", "always"] = Field(
        "auto",
        description="auto: reading needs a token unless `host` is loopback or `trusted_network`; always: everywhere.",
    )
    tls_certificate_file: str = Field("", description="PEM certificate, for HTTPS. Empty: HTTP.")
    tls_key_file: str = Field("", description="PEM key of the certificate.")
    trusted_network: bool = Field(
        False,
        description="The network of `host` has no strangers (that of one compose project): no TLS there, and reading "
        "is open as on loopback. Not for a network that others can join.",
    )
    allowed_hosts: tuple[str, ...] = Field(
        (),
        description="Names, without port, under which it may be asked, beside those of loopback. None, and `host` is "
        "neither loopback nor in a `trusted_network`: any.",
    )
    allowed_origins: tuple[str, ...] = Field(
        (), description="Other sites whose pages may change things, as https://desk:8443."
    )
    max_body_bytes: int = Field(1_048_576, ge=1024, le=67_108_864, description="Of one request, bytes.")
    max_connections: int = Field(
        256, ge=8, le=10_000, description="At the same time; further ones are answered with 503."
    )
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
    command_timeout_s: float = Field(
        3.0, gt=0, le=60, description="So long the mission's answer to a command is waited for, wall s."
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

    def exposed(self) -> str:
        """Why this address must not be listened on, with the mend; empty: it may."""
        if bool(self.tls_certificate_file) != bool(self.tls_key_file):
            return "status.tls_certificate_file and status.tls_key_file: set both, or neither"
        if self.tls_certificate_file or self.trusted_network or is_loopback(self.host):
            return ""
        return (
            f"status.host: {self.host} can be reached from other hosts, and there is no TLS: tokens and data would "
            "cross the network in the clear. Set status.tls_certificate_file and status.tls_key_file "
            "(`plgrim certs issue` makes them), or listen on 127.0.0.1"
        )
