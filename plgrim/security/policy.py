"""The access control of this host's router: what the table grants, for the names in certificates."""

from __future__ import annotations

from typing import Any

from plgrim.config import Config
from plgrim.deployment import Role, processes_of, role_of
from plgrim.hosts import SECURE, protocol
from plgrim.link.config import LinkConfig
from plgrim.link.routes import down, keys_written, leased_outputs, up_plain
from plgrim.security.access import (
    OPERATOR,
    RECORDER,
    ROBOT_RECORDER,
    ROUTER,
    TOOLS,
    Grant,
    access_control,
    certificate_name,
    everything_grant,
    operator_grant,
    recorder_grant,
    robot_recorder_grant,
    service_grant,
    tools_grant,
)
from schemas.topics import LINK, SERVICES

FROM_ROBOT = {LINK: LINK, ROBOT_RECORDER: RECORDER}
"""Who comes to the base's router from the robot, and by what process's certificate."""
_PLAIN_PROTOCOLS = ["tcp", "ws", "unixsock-stream"]


def router_access(config: Config) -> dict[str, Any]:
    """Zenoh's `access_control` for the router of this host.

    Who shows a certificate may do what the table of topics says, by the name in it. Who comes without TLS, where the
    router listens so, is on this host (`check_router`) and may do everything below the robot's keys: for a host all
    of whose users are trusted.
    """
    given = router_grants(config)
    subjects = {process: {"cert_common_names": [name]} for process, name in certificate_names(config).items()}
    endpoints = (config.router.endpoint, *config.router.listen)
    if any(protocol(endpoint) not in SECURE for endpoint in endpoints):
        given["this_host"] = everything_grant(config.robot)
        subjects["this_host"] = {"link_protocols": _PLAIN_PROTOCOLS}
    return access_control(given, subjects)


def clients_of(config: Config) -> tuple[str, ...]:
    """Whoever may connect to this host's router; the link comes to both hosts, and a recorder may."""
    role = role_of(config)
    found = [name for name in processes_of(role, config.link.at_base) if name != ROUTER]
    return (*found, *(FROM_ROBOT if role == "base" else ()))


def certificate_names(config: Config) -> dict[str, str]:
    """The names of those certificates that this host's router knows, by process."""
    role = role_of(config)
    return {
        process: certificate_name(FROM_ROBOT[process], "robot", config.robot)
        if process in FROM_ROBOT and role == "base"
        else certificate_name(process, role, config.robot)
        for process in clients_of(config)
    }


def router_grants(config: Config) -> dict[str, Grant]:
    """What each of them may do at this host's router."""
    return {process: grant_of(process, config) for process in clients_of(config)}


def grant_of(process: str, config: Config) -> Grant:
    """What one process may do at this host's router."""
    robot, role = config.robot, role_of(config)
    if process == TOOLS:
        return tools_grant(robot)
    if process == RECORDER:
        return recorder_grant(robot)
    if process == ROBOT_RECORDER:
        return robot_recorder_grant(robot)
    if process == OPERATOR:
        return operator_grant(robot)
    if process == LINK:
        return link_grant(config.link, robot, role)
    own = service_grant(process, robot, config.link.instance(process))
    return own if process in SERVICES else own | tools_grant(robot)


def link_grant(link: LinkConfig, robot: str, role: Role) -> Grant:
    """What the link process may do at the router of the robot or of the base."""
    written = Grant(puts=tuple(keys_written(link, robot, role)))
    instance = "base" if role == "base" else "standby"
    leased = [topic for name in link.leased for topic in leased_outputs(name)]
    reads = [topic.key(robot, instance) for topic in leased]
    reads += [topic.key(robot) for topic in (up_plain(link) if role == "base" else down(link))]
    own = Grant() if role == "base" else service_grant(LINK, robot)
    return written | Grant(reads=tuple(reads)) | own
