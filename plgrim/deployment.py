"""Which process runs where: one description, from which `plgrim up --role`, certificates, compose files and systemd
units are derived or against which they are checked.
"""

from __future__ import annotations

from typing import Literal

from plgrim.config import Config
from plgrim.errors import ConfigError
from plgrim.link.config import LinkConfig
from plgrim.security.access import OPERATOR, RECORDER, ROUTER, TOOLS, writers
from schemas.topics import LINK, MAY_RUN_AT_BASE, SERVICES

Role = Literal["all", "robot", "base"]
ROLES: tuple[Role, ...] = ("all", "robot", "base")
USUAL_AT_BASE: tuple[str, ...] = LinkConfig().at_base


def role_named(name: str) -> Role:
    """Raises ConfigError for a role that there is not."""
    for role in ROLES:
        if role == name:
            return role
    raise ConfigError(f"no role {name!r}: there are {', '.join(ROLES)}")


def role_of(config: Config) -> Role:
    """What this host is: `link.host`, or everything at once."""
    return config.link.host or "all"


def services_of(
    role: Role, at_base: tuple[str, ...] = USUAL_AT_BASE, simulated: bool = True
) -> tuple[str, ...]:
    """The services of a host. A planner that runs at the base has a standby on the robot; status has none.

    simulated: False leaves out the simulator, whose topics a gateway of the robot's own then writes.
    """
    found = SERVICES if simulated else tuple(name for name in SERVICES if name != "sim")
    if role == "base":
        return tuple(name for name in found if name in at_base)
    if role == "robot":
        return tuple(name for name in found if name not in at_base or name in MAY_RUN_AT_BASE)
    return found


def processes_of(role: Role, at_base: tuple[str, ...] = USUAL_AT_BASE) -> tuple[str, ...]:
    """Whoever needs a certificate on a host; `sim` also stands for the gateway that writes its topics."""
    link = (LINK,) if role == "robot" else ()
    others = tuple(name for name in writers() if name not in (*SERVICES, LINK))
    return (ROUTER, *services_of(role, at_base), *link, *others, RECORDER, TOOLS, OPERATOR)


def started_by_up(config: Config) -> tuple[str, ...]:
    """What `plgrim up` starts beside the router, as this host's role says. Raises ConfigError."""
    role, link = role_of(config), config.link
    if role == "robot" and not link.endpoint:
        raise ConfigError(
            "link.endpoint: where is the base's router? As tls/base:7447, or PLGRIM_LINK__ENDPOINT"
        )
    services = services_of(role, link.at_base, config.deployment.simulated)
    return (*services, LINK) if role == "robot" else services
