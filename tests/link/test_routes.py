"""Which way topics go, what the section of the configuration refuses, and the sessions' endpoints."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from plgrim.config import load_config
from plgrim.link.config import LinkConfig
from plgrim.link.routes import COMMANDS, MAPS, down, keys_written, lane_of, needs_every, up_plain
from plgrim.link.uplink import base_router
from schemas.topics import (
    ANSWER,
    COMMAND,
    EPISODE,
    GLOBAL_IRM,
    GLOBAL_POLICY,
    LOCAL_IRM,
    MISSION,
    PLAN,
    RISK_MAP,
    TOPICS,
    topic_named,
)  # fmt: skip


def _config(*at_base: str, host: str = "robot") -> LinkConfig:
    return LinkConfig.model_validate({"host": host, "endpoint": "tcp/base:7447", "at_base": at_base})


@pytest.mark.parametrize("at_base", [("gcp", "status"), ("status",), ("lcp",), ("lcp", "gcp", "status")])
def test_nothing_crosses_that_the_table_does_not_mark(at_base: tuple[str, ...]) -> None:
    config = _config(*at_base)
    for topic in (*down(config), *up_plain(config)):
        assert topic.crosses_link, topic.name
    named = {topic.name for topic in down(config)}
    assert not named & {"sim/cloud", "sim/ready_grid", "riskmap/moving", "sim/world_picture", "sim/follower"}


def test_no_key_is_written_on_both_sides_by_others_and_the_link() -> None:
    """What comes from the base is never sent back to it under the same key: no message can go round."""
    config = _config("gcp", "status")
    assert not set(keys_written(config, "r", "base")) & {t.key("r") for t in up_plain(config)}
    assert "plgrim/@v1/r/gcp/global_policy" in keys_written(config, "r", "robot")
    assert "plgrim/@v1/r/status/command" in keys_written(config, "r", "robot")
    assert "plgrim/@v1/r/reconciler/plan" not in keys_written(config, "r", "robot")
    assert "plgrim/@v1/r/status/command" not in keys_written(config, "r", "base")


def test_lanes() -> None:
    assert {
        lane_of(t) for t in (COMMAND, PLAN, MISSION, GLOBAL_POLICY, EPISODE, topic_named("irm/health"))
    } == {COMMANDS}
    assert {lane_of(t) for t in (RISK_MAP, LOCAL_IRM, GLOBAL_IRM)} == {MAPS}


def test_every_message_only_where_a_reader_counts_on_it() -> None:
    assert needs_every(GLOBAL_IRM, _config("status"))
    assert not needs_every(LOCAL_IRM, _config("gcp", "status"))
    assert needs_every(LOCAL_IRM, _config("lcp"))
    assert needs_every(ANSWER, _config("gcp", "status")), "an operator waits for each"


def test_instances() -> None:
    assert LinkConfig().instance("gcp") == ""
    assert _config("gcp").instance("gcp") == "standby"
    assert _config("gcp", host="base").instance("gcp") == "base"
    assert _config("gcp", "status", host="base").instance("status") == ""
    assert _config("gcp").instance("lcp") == ""


@pytest.mark.parametrize(
    ("section", "says"),
    [
        ({"at_base": ["riskmap"]}, "at_base"),
        ({"at_base": ["reconciler"]}, "at_base"),
        ({"at_base": ["irm"]}, "irm cannot run at the base yet"),
        ({"topic_kb_per_s": {"sim/cloud": 5}}, "no topic that crosses"),
        ({"topic_kb_per_s": {"sim/odometry": 0}}, "cannot be shut off"),
        ({"endpoint": "base:7447"}, "endpoint"),
        ({"hots": "robot"}, "hots"),
    ],
)
def test_a_wrong_section_is_refused_by_name(section: dict[str, object], says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        LinkConfig.model_validate(section)


def test_the_lane_of_maps_has_a_small_send_buffer() -> None:
    config = load_config(overrides={"link": {"host": "robot", "endpoint": "tls/base:7447#iface=wlan0"}})
    assert base_router(config, COMMANDS).client_endpoint == "tls/base:7447#iface=wlan0"
    assert base_router(config, MAPS).client_endpoint == "tls/base:7447#iface=wlan0;so_sndbuf=8192"
    assert not base_router(config, MAPS).shared_memory


def test_every_topic_that_crosses_has_a_lane() -> None:
    assert {lane_of(topic) for topic in TOPICS if topic.crosses_link} == {COMMANDS, MAPS}
