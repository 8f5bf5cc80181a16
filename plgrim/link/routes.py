"""Which topic goes which way on which lane: derived from the table of topics and the section `link` alone."""

from __future__ import annotations

from plgrim.link.config import LinkConfig
from schemas.base import Message
from schemas.contract import Topic
from schemas.topics import (
    ANSWER,
    GLOBAL_IRM,
    LINK,
    SERVICES,
    TOPICS,
    health_topic,
    read_by,
    written_by,
)
from schemas.world import GraphRequest

COMMANDS, MAPS = "commands", "maps"
LANES = (COMMANDS, MAPS)
_LARGE_BYTES = 1024 * 1024
_PLANS = ("global_policy", "local_policy")


def lane_of(topic: Topic[Message]) -> str:
    """Maps are what may be larger than 1 MiB; what the planners say is not among them, however large it may be."""
    plan = topic.message.schema_name in _PLANS
    return MAPS if topic.max_bytes > _LARGE_BYTES and not plan else COMMANDS


def is_request(topic: Topic[Message]) -> bool:
    """Whether a topic asks irm for the whole graph: it is passed on whoever of two instances asks."""
    return topic.message is GraphRequest


def down(config: LinkConfig) -> list[Topic[Message]]:
    """Robot to base: all that crosses and is not written at the base; of leased stages what is obeyed."""
    only_base = set(config.at_base) - set(config.leased)
    health = [health_topic(name) for name in (*SERVICES, LINK)]
    return [
        topic
        for topic in (*TOPICS, *health)
        if topic.crosses_link and topic.writer not in only_base and not is_request(topic)
    ]


def needs_every(topic: Topic[Message], config: LinkConfig) -> bool:
    """Whether every message must go over the link: a reader at the base counts on it. status shows, but it waits for
    the answer to each command.
    """
    if topic in (GLOBAL_IRM, ANSWER):
        return True
    return topic.keep_all and bool(set(topic.readers) & set(config.leased))


def leased_outputs(service: str) -> list[Topic[Message]]:
    """What both instances of a stage write under keys of their own: its topics that cross, and its health."""
    return [topic for topic in written_by(service) if topic.crosses_link] + [health_topic(service)]


def up_plain(config: LinkConfig) -> list[Topic[Message]]:
    """Base to robot, as it is: what services write that run at the base alone."""
    only_base = [name for name in config.at_base if name not in config.leased]
    topics = [topic for name in only_base for topic in (*written_by(name), health_topic(name))]
    return [topic for topic in topics if topic.crosses_link]


def needed_by(service: str) -> list[str]:
    """Periodic topics that cross and that a stage reads: by them it is judged whether it is in step."""
    return [
        topic.name
        for topic in read_by(service)
        if topic.crosses_link and topic.period_ns > 0 and topic.writer != service
    ]


def keys_written(config: LinkConfig, robot: str, host: str) -> list[str]:
    """All keys that the link process writes at the router of one host (`robot`, `base`), for access control."""
    if host == "base":
        return [topic.key(robot) for topic in down(config)]
    mine = [topic for topic in TOPICS if topic.writer == LINK] + [health_topic(LINK)]
    leased = [topic for name in config.leased for topic in leased_outputs(name)]
    return [topic.key(robot) for topic in (*mine, *leased, *up_plain(config))]
