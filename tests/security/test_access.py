"""Access control over mutual TLS, with real sessions: every pair of process and topic, both ways."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from plgrim.config import Config
from plgrim.errors import NoRouterError
from plgrim.runtime.router import router_settings
from plgrim.runtime.zenoh_session import Link, connect
from plgrim.security.access import TOOLS, every_topic, root_of, writers
from plgrim.security.certificates import Authority
from schemas.base import Message
from schemas.contract import Topic
from schemas.topics import health_topic
from tests.runtime.helpers import eventually
from tests.security.conftest import ROBOT
from tests.security.helpers import free_port, joined, routing, secured

Heard = list[tuple[str, bytes]]


@pytest.fixture(scope="module")
def config(certificates: Path) -> Config:
    return secured(ROBOT, certificates)


@pytest.fixture(scope="module")
def links(config: Config) -> Iterator[dict[str, Link]]:
    """A session for each process, all at one router."""
    with routing(config):
        opened = {process: joined(config, process) for process in (*writers(), TOOLS)}
        yield opened
        for link in opened.values():
            link.close()


@pytest.fixture(scope="module")
def heard(links: dict[str, Link]) -> Heard:
    """All that goes over the router, as `tools` hears it."""
    found: Heard = []
    _listen(links[TOOLS], f"{root_of(ROBOT)}/**", found)
    eventually(lambda: found, "the subscription is known", lambda: _say(links, health_topic("gcp"), b"hello"))
    return found


def _listen(link: Link, expression: str, into: Heard) -> None:
    """Subscribe plainly: what the router lets through, in the order in which it comes."""
    link.session.declare_subscriber(
        expression, lambda sample: into.append((str(sample.key_expr), sample.payload.to_bytes()))
    )


def _say(links: dict[str, Link], topic: Topic[Message], payload: bytes) -> None:
    links[topic.writer].session.put(topic.key(ROBOT), payload)


def _last_word(links: dict[str, Link], process: str, heard: Heard) -> None:
    """Wait until what a process has put before this is through: same session, same priority, in order."""
    word = f"last word of {process}".encode()
    links[process].session.put(health_topic(process).key(ROBOT), word)
    eventually(lambda: (health_topic(process).key(ROBOT), word) in heard, f"{process} is heard")


def test_every_put_that_the_table_does_not_allow_is_dropped(links: dict[str, Link], heard: Heard) -> None:
    pairs = [(process, topic) for process in writers() for topic in every_topic()]
    forbidden = [(process, topic) for process, topic in pairs if topic.writer != process]
    assert len(forbidden) > 150
    for process, topic in forbidden:
        links[process].session.put(topic.key(ROBOT), b"forbidden")
        links[process].session.delete(topic.key(ROBOT))
    for process in writers():
        if health_topic(process).writer == process:
            _last_word(links, process, heard)
    assert [key for key, payload in heard if payload == b"forbidden"] == []


def test_every_put_that_the_table_allows_arrives(links: dict[str, Link], heard: Heard) -> None:
    for topic in every_topic():
        _say(links, topic, topic.name.encode())
    wanted = {(topic.key(ROBOT), topic.name.encode()) for topic in every_topic()}
    eventually(lambda: wanted <= set(heard), "all that is allowed is heard")


def test_every_process_reads_what_the_table_gives_it_and_nothing_else(
    links: dict[str, Link], heard: Heard
) -> None:
    ears: dict[str, Heard] = {process: [] for process in writers()}
    for process, into in ears.items():
        for expression in ("**", f"{root_of(ROBOT)}/**", *(topic.key(ROBOT) for topic in every_topic())):
            _listen(links[process], expression, into)
    own = {p: {topic.key(ROBOT) for topic in every_topic() if topic.writer == p} for p in ears}
    allowed = {p: {t.key(ROBOT) for t in every_topic() if p in t.readers} - own[p] for p in ears}

    def foreign(process: str) -> set[str]:
        """What a process hears from others; its own words it hears without any router."""
        return {key for key, _ in ears[process]} - own[process]

    def say() -> None:
        for topic in every_topic():
            _say(links, topic, b"to all")

    eventually(lambda: all(allowed[p] <= foreign(p) for p in ears), "all readers hear", say)
    for process in writers():
        _last_word(links, process, heard)
    assert {p: sorted(foreign(p) - allowed[p]) for p in ears if foreign(p) - allowed[p]} == {}


def test_nobody_answers_or_lives_for_another(links: dict[str, Link]) -> None:
    root, tools = root_of(ROBOT), links[TOOLS]
    links["gcp"].answer(f"{root}/gcp/health_now", lambda: b"own")
    links["gcp"].answer(f"{root}/mission/health_now", lambda: b"forged")
    links["gcp"].token(f"{root}/gcp/alive/1")
    links["gcp"].token(f"{root}/mission/alive/1")
    eventually(lambda: tools.ask(f"{root}/gcp/health_now", 1.0) == b"own", "the own answer")
    eventually(lambda: tools.tokens(f"{root}/gcp/alive/*") == [f"{root}/gcp/alive/1"], "the own token")
    assert tools.ask(f"{root}/mission/health_now", 1.0) is None
    assert tools.tokens(f"{root}/mission/alive/*") == []
    assert links["lcp"].ask(f"{root}/gcp/health_now", 1.0) is None
    assert links["lcp"].tokens(f"{root}/gcp/alive/*") == []


def test_whoever_looks_on_writes_nothing(links: dict[str, Link], heard: Heard) -> None:
    ears: Heard = []
    for topic in every_topic():
        for reader in topic.readers:
            _listen(links[reader], topic.key(ROBOT), ears)
    for topic in every_topic():
        links[TOOLS].session.put(topic.key(ROBOT), b"from tools")
    _last_word(links, "gcp", heard)
    before = len(ears)
    eventually(lambda: len(ears) > before, "readers hear", lambda: _say(links, health_topic("gcp"), b"x"))
    assert b"from tools" not in {payload for _, payload in ears}


def test_late_joiners_get_the_last_word_through_access_control(
    links: dict[str, Link], config: Config
) -> None:
    judge = next(topic for topic in every_topic() if topic.name == "sim/judge")
    links["sim"].publish(judge, b"judged before")
    got: list[bytes] = []
    with joined(config, "status") as late:
        late.subscribe(judge, lambda _, payload: got.append(payload))
        eventually(lambda: got == [b"judged before"], "the last word comes late")


def test_a_certificate_of_another_name_is_let_in_to_nothing(
    authority: Authority,
    certificates: Path,
    config: Config,
    links: dict[str, Link],
    heard: Heard,
    tmp_path: Path,
) -> None:
    """A valid certificate of this authority, but of another robot: it connects, and may do nothing."""
    authority.issue("gcp.all.husky2", tmp_path)
    authority.trust(certificates)  # the router begins anew with it
    own = config.router.model_copy(update={"certificates": str(tmp_path)})
    with connect(own, ROBOT, threading.Event(), 30.0, "gcp") as stranger:
        ears: Heard = []
        _listen(stranger, f"{root_of(ROBOT)}/**", ears)
        eventually(lambda: heard[-1:] and heard[-1][1] == b"back", "the router is back", lambda: _back(links))
        heard.clear()
        for topic in every_topic():
            stranger.session.put(topic.key(ROBOT), b"stranger")
            _say(links, topic, b"known")
        wanted = {(topic.key(ROBOT), b"known") for topic in every_topic()}
        eventually(lambda: wanted <= set(heard), "the known are heard")
        assert b"stranger" not in {payload for _, payload in heard}
        assert {key for key, payload in ears if payload == b"known"} == set()


def _back(links: dict[str, Link]) -> None:
    _say(links, health_topic("gcp"), b"back")


def test_who_comes_over_loopback_is_trusted_where_that_is_opened(certificates: Path) -> None:
    """A base whose own services come over loopback without TLS, and robots with it."""
    port = free_port()
    both = secured(ROBOT, certificates, listen=(f"tcp/127.0.0.1:{port}",))
    local = both.model_copy(
        update={"router": both.router.model_copy(update={"connect": f"tcp/127.0.0.1:{port}"})}
    )
    topic = health_topic("mission")
    ears: Heard = []
    with routing(both), joined(both, "gcp") as remote, joined(local, "mission") as here:
        _listen(here, f"{root_of(ROBOT)}/**", ears)
        policy = next(topic for topic in every_topic() if topic.name == "gcp/global_policy")
        eventually(lambda: ears, "heard", lambda: remote.session.put(policy.key(ROBOT), b"policy"))
        remote.session.put(topic.key(ROBOT), b"forged")
        remote.session.put(health_topic("gcp").key(ROBOT), b"after")
        eventually(lambda: ears[-1][1] == b"after", "heard to the end")
        assert b"forged" not in {payload for _, payload in ears}


def test_the_routers_file_is_one_that_zenoh_reads(config: Config) -> None:
    """JSON is JSON5: `plgrim router --print-config` is what a stock zenohd takes with `-c`."""
    settings = router_settings(config)
    read = zenoh.Config.from_json5(json.dumps(settings))
    assert json.loads(read.get_json("access_control"))["default_permission"] == "deny"
    assert json.loads(read.get_json("transport/link/tls"))["enable_mtls"] is True
    assert json.loads(read.get_json("adminspace"))["enabled"] is False
    assert json.loads(read.get_json("scouting/multicast/enabled")) is False
    assert json.loads(read.get_json("scouting/gossip/enabled")) is False


def test_no_session_without_a_router(config: Config) -> None:
    elsewhere = config.router.model_copy(update={"endpoint": f"tls/127.0.0.1:{free_port()}"})
    with pytest.raises(NoRouterError):
        joined(config.model_copy(update={"router": elsewhere}), "gcp", 0.1)
