"""The table of topics."""

from __future__ import annotations

import pytest

from schemas.topics import (
    SERVICES,
    TOPICS,
    WRITERS,
    health_topic,
    read_by,
    recorder_topics,
    topic_named,
    written_by,
)
from tests.schemas.examples import MESSAGES

ALL = (*TOPICS, *(t for s in SERVICES for t in (health_topic(s), *recorder_topics(s))))


def test_names_and_schema_names_are_unique() -> None:
    assert len({topic.name for topic in ALL}) == len(ALL)
    assert len({topic.key("husky1") for topic in ALL}) == len(ALL)
    assert len({message.schema_name for message in MESSAGES}) == len(MESSAGES)
    assert all(message.schema_name and message.schema_version >= 1 for message in MESSAGES)


def test_writers_and_readers_are_services() -> None:
    for topic in ALL:
        assert topic.writer in WRITERS
        assert topic.name.split("/")[0] == topic.writer
        assert set(topic.readers) <= set(SERVICES), topic.name
        assert len(set(topic.readers)) == len(topic.readers), topic.name


def test_who_writes_the_mission_and_the_motion() -> None:
    assert [topic.name for topic in written_by("mission")][-3:] == [
        "mission/fences",
        "mission/state",
        "mission/answer",
    ]
    assert {topic.writer for topic in TOPICS if topic.message.schema_name == "plan"} == {"reconciler"}


def test_limits_make_sense() -> None:
    for topic in ALL:
        assert topic.max_bytes > 0
        assert topic.period_ns >= 0
        assert topic.says
        if topic.stale_after_ns:
            assert topic.stale_after_ns >= 2 * topic.period_ns, f"{topic.name} is stale before it is late"


def test_no_planner_reads_the_truth() -> None:
    planners = {"riskmap", "irm", "gcp", "lcp", "reconciler", "mission"}
    for name in ("sim/judge", "sim/world_picture"):
        assert not planners & set(topic_named(name).readers)


def test_look_ups() -> None:
    assert topic_named("irm/global_irm").key("husky1") == "plgrim/@v1/husky1/irm/global_irm"
    assert topic_named("irm/global_irm").key("husky1", "base") == "plgrim/@v1/husky1/base/irm/global_irm"
    assert topic_named("gcp/health") == health_topic("gcp")
    assert {topic.name for topic in read_by("status")} >= {f"{service}/health" for service in SERVICES}
    with pytest.raises(StopIteration):
        topic_named("no/such")
