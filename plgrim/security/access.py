"""Access control of a router, derived from the table of topics: a process may do what the table says, nothing else.

Zenoh checks each message twice: as it comes in from a process, and as it goes out to one. Keys of Zenoh's own that hang
below a topic's (`KEY/@adv/...`: late joiners, missed samples) follow the topic.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

from schemas.base import Message
from schemas.contract import Topic, root_of
from schemas.topics import LINK, SERVICES, TOPICS, health_topic, recorder_topics

TOOLS = "tools"
"""The name under which `plgrim watch`, `healthcheck`, `fetch` and their like read along. They write no topic."""
RECORDER = "recorder"
"""The name of `plgrim record`: it reads along, asks for snapshots, and hands out its segments."""
ROBOT_RECORDER = "robot_recorder"
"""The robot's recorder as the base's router knows it."""
OPERATOR = "operator"
"""The name under which `plgrim pause`, `home`, `geofence` and their like steer the mission."""
COMMAND_QUERY = "mission/command"
"""What they ask; the status service answers it, after the mission has."""
SEGMENTS_QUERY = "record/segments"
"""What `plgrim fetch` asks; the robot's recorder answers it."""
ROUTER = "router"


@dataclass(frozen=True, slots=True)
class Grant:
    """What one process may do. All are Zenoh key expressions.

    puts, reads: keys of topics. answers, asks: keys of queries. declares, watches: keys of liveliness tokens.
    """

    puts: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()
    declares: tuple[str, ...] = ()
    watches: tuple[str, ...] = ()

    def __or__(self, other: Grant) -> Grant:
        """What either allows."""
        parts = (getattr(self, f.name) + getattr(other, f.name) for f in fields(self))
        return Grant(*(tuple(dict.fromkeys(part)) for part in parts))


def every_topic() -> list[Topic[Message]]:
    """All topics, those of the drivers (health, steps, snapshots) included."""
    told = (topic for service in SERVICES for topic in recorder_topics(service))
    return [*TOPICS, *(health_topic(service) for service in (*SERVICES, LINK)), *told]


def writers() -> tuple[str, ...]:
    """The services, and whoever else writes a topic."""
    return tuple(dict.fromkeys((*SERVICES, *(topic.writer for topic in every_topic()))))


def service_grant(service: str, robot: str, instance: str = "") -> Grant:
    """What the table of topics lets a service do. instance: `base` or `standby` of a service that has two."""
    own = f"{root_of(robot)}/{instance}/{service}" if instance else f"{root_of(robot)}/{service}"
    topics = every_topic()
    commands = (f"{root_of(robot)}/{COMMAND_QUERY}",) if service == "status" else ()
    return Grant(
        puts=tuple(f"{own}/{topic.name.partition('/')[2]}" for topic in topics if topic.writer == service),
        reads=tuple(topic.key(robot) for topic in topics if service in topic.readers),
        answers=(f"{own}/health_now", f"{own}/snapshot_now", *commands),
        asks=(f"{own}/health_now",),
        declares=(f"{own}/alive/*",),
        watches=(f"{own}/alive/*",),
    )


def tools_grant(robot: str) -> Grant:
    """Of those who look on: they read everything and write nothing."""
    root = root_of(robot)
    asked = tuple(f"{root}/**/{query}" for query in ("health_now", "snapshot_now"))
    segments = f"{root}/{SEGMENTS_QUERY}"
    return Grant(reads=(f"{root}/**",), asks=(*asked, segments), watches=(f"{root}/**",))


def recorder_grant(robot: str) -> Grant:
    """Of a host's recorder: it reads everything; of what it says, nothing is a topic."""
    root = root_of(robot)
    answers = (f"{root}/{SEGMENTS_QUERY}", *(f"{root}/{i}{RECORDER}/health_now" for i in ("", "base/")))
    return Grant(reads=(f"{root}/**",), answers=answers, asks=(f"{root}/**/snapshot_now",))


def robot_recorder_grant(robot: str) -> Grant:
    """Of the robot's recorder at the base's router: it hands out its segments there, no more."""
    return Grant(answers=(f"{root_of(robot)}/{SEGMENTS_QUERY}",))


def operator_grant(robot: str) -> Grant:
    """Of who steers the mission from the command line: reads along, and asks the mission."""
    return tools_grant(robot) | Grant(asks=(f"{root_of(robot)}/{COMMAND_QUERY}",))


def certificate_name(process: str, role: str, robot: str) -> str:
    """The name in a process's certificate, as `gcp.base.husky1`. role: `robot`, `base`, or `all` for one host."""
    return f"{process}.{role}.{robot}"


def everything_grant(robot: str) -> Grant:
    """All that can be done below a robot's keys."""
    keys = (f"{root_of(robot)}/**",)
    return Grant(puts=keys, reads=keys, answers=keys, asks=keys, declares=keys, watches=keys)


def access_control(grants: dict[str, Grant], subjects: dict[str, dict[str, list[str]]]) -> dict[str, Any]:
    """Zenoh's `access_control`: default deny; subjects: of each process, as `{"cert_common_names": [...]}`.

    grants and subjects have the same keys.
    """
    rules, policies = [], []
    for process, given in grants.items():
        own = _rules(process, given)
        rules += own
        policies.append({"subjects": [process], "rules": [rule["id"] for rule in own]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": process, **subject} for process, subject in subjects.items()],
        "policies": policies,
    }


def _below(keys: Iterable[str]) -> list[str]:
    """Zenoh's own keys below those of topics: of cached samples, tokens and heartbeats of publishers."""
    return [f"{key}/@adv/**" for key in keys]


def _rules(process: str, given: Grant) -> list[dict[str, Any]]:
    puts, reads = list(given.puts), list(given.reads)
    rules = [
        # As a writer: what it sends, and what the router must tell it so that it does send.
        _rule("puts", "ingress", ["put"], puts + _below(puts)),
        _rule("serves", "ingress", ["declare_queryable", "reply"], puts + _below(puts) + list(given.answers)),
        _rule("is_heard", "egress", ["declare_subscriber"], puts + _below(puts)),
        _rule("is_asked", "egress", ["query"], puts + _below(puts) + list(given.answers)),
        # As a reader.
        _rule("subscribes", "ingress", ["declare_subscriber"], reads + _below(reads)),
        _rule("gets", "egress", ["put"], reads + _below(reads)),
        # Of what it reads it may ask for cached and missed samples alone: a query on a key itself may be a command, and
        # who reads everything would give it. The samples come back under the keys of their topics.
        _rule("asks", "ingress", ["query"], _below(reads) + list(given.asks)),
        _rule("is_offered", "egress", ["declare_queryable"], _below(reads) + list(given.asks)),
        _rule("is_answered", "egress", ["reply"], reads + _below(reads) + list(given.asks)),
        # Liveliness tokens.
        _rule("lives", "ingress", ["liveliness_token"], _below(puts) + list(given.declares)),
        _rule(
            "watches",
            "ingress",
            ["liveliness_query", "declare_liveliness_subscriber"],
            _below(reads) + list(given.watches),
        ),
        _rule("sees", "egress", ["liveliness_token", "reply"], _below(reads) + list(given.watches)),
    ]
    return [{**rule, "id": f"{process}_{rule['id']}"} for rule in rules if rule["key_exprs"]]


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
