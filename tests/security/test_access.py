"""Access control over mutual TLS, with real sessions: every pair of process and topic, both ways."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh

from plgrim.config import Config
from plgrim.deployment import ROLES, Role
from plgrim.errors import NoRouterError
from plgrim.runtime.router import router_settings
from plgrim.runtime.zenoh_session import Link, connect
from plgrim.security.access import (
    COMMAND_QUERY,
    OPERATOR,
    RECORDER,
    ROBOT_RECORDER,
    SEGMENTS_QUERY,
    TOOLS,
    every_topic,
)
from plgrim.security.certificates import Authority
from plgrim.security.policy import clients_of, router_grants
from schemas.base import Message
from schemas.contract import Topic, root_of
from schemas.topics import INSTANCES, LINK, SUPERVISOR, health_topic
from schemas.world import GraphRequest
from tests.runtime.helpers import eventually
from tests.security.conftest import ROBOT
from tests.security.helpers import free_port, joined, routing, secured

Heard = list[tuple[str, bytes]]


AT_BASE = ("gcp", "status")
"""The usual split, of which gcp has a standby on the robot."""
QUIET = (TOOLS, OPERATOR, RECORDER, ROBOT_RECORDER)
"""They write no topic."""
INSTANCE: dict[Role, str] = {"all": "", "robot": "standby", "base": "base"}


def may_put(role: Role, process: str, topic: Topic[Message], instance: str) -> bool:
    """Who may write which key, in the words of the design and not of the code that is tested.

    Each service writes its own topics; gcp, which has two instances, under that of its host. The link writes at the
    robot what it says itself, what gcp is obeyed in, and what status says; at the base all that crosses but that.
    """
    if process == LINK:
        if instance or not (topic.crosses_link or topic.writer == LINK):
            return False
        from_base = topic.writer in AT_BASE
        request = topic.message is GraphRequest
        if role == "base":
            return topic.writer != "status" and not request
        return topic.writer == LINK or from_base
    wanted = INSTANCE[role] if process == "gcp" else ""
    return topic.writer == process and instance == wanted


def keys() -> dict[str, tuple[Topic[Message], str]]:
    """Every key of every topic, with its topic and instance."""
    return {topic.key(ROBOT, i): (topic, i) for topic in every_topic() for i in ("", *INSTANCES)}


@dataclass
class Host:
    """A router with a session for each process that may come to it; heard: all that goes over it."""

    role: Role
    config: Config
    links: dict[str, Link]
    heard: Heard

    def health_key(self, process: str) -> str:
        """A key that a process may write here."""
        if process == SUPERVISOR.writer:
            return SUPERVISOR.key(ROBOT)
        instance = INSTANCE[self.role] if process == "gcp" else ""
        name = "gcp" if process == LINK and self.role != "all" else process
        return health_topic("riskmap" if process == LINK and self.role == "base" else name).key(
            ROBOT, instance
        )

    def last_words(self) -> None:
        """Wait until all that was put before is through: from each session, in order."""
        for process in self.links:
            if process not in QUIET:
                word = f"last word of {process}".encode()
                key = self.health_key(process)
                self.links[process].session.put(key, word)
                eventually(lambda key=key, word=word: (key, word) in self.heard, f"{process} is heard")  # type: ignore[misc]
        self.links[TOOLS].tokens(
            f"{root_of(ROBOT)}/**"
        )  # it writes nothing: a question makes the round instead
        self.heard[:] = [entry for entry in self.heard if not entry[1].startswith(b"last word")]


@contextmanager
def host(role: Role, certificates: Path) -> Iterator[Host]:
    config = secured(ROBOT, certificates, role)
    with routing(config), ExitStack() as stack:
        links = {process: stack.enter_context(joined(config, process)) for process in clients_of(config)}
        made = Host(role, config, links, [])
        # A session of its own: what a session says itself, it hears without any router.
        _listen(stack.enter_context(joined(config, TOOLS)), f"{root_of(ROBOT)}/**", made.heard)
        first = next(process for process in links if process not in QUIET)
        eventually(lambda: made.heard, "heard", lambda: links[first].session.put(made.health_key(first), b""))
        yield made


@pytest.fixture(scope="module")
def everything(certificates: Path) -> Iterator[Host]:
    """A host on which everything runs."""
    with host("all", certificates) as made:
        yield made


@pytest.fixture(scope="module")
def config(everything: Host) -> Config:
    return everything.config


@pytest.fixture(scope="module")
def links(everything: Host) -> dict[str, Link]:
    return everything.links


@pytest.fixture(scope="module")
def heard(everything: Host) -> Heard:
    return everything.heard


def _listen(link: Link, expression: str, into: Heard) -> None:
    """Subscribe plainly: what the router lets through, in the order in which it comes."""
    link.session.declare_subscriber(
        expression, lambda sample: into.append((str(sample.key_expr), sample.payload.to_bytes()))
    )


def _say(links: dict[str, Link], topic: Topic[Message], payload: bytes) -> None:
    if topic.writer in links:
        links[topic.writer].session.put(topic.key(ROBOT), payload)


def said(links: dict[str, Link]) -> list[Topic[Message]]:
    """The topics that somebody writes on a host without a link."""
    return [topic for topic in every_topic() if topic.writer in links]


@pytest.mark.parametrize("role", ROLES)
def test_exactly_the_puts_that_the_table_allows_go_through(
    role: Role, certificates_by_role: dict[Role, Path]
) -> None:
    """Every process and every key of every topic: some 2000 puts a router, and as many deletes."""
    with host(role, certificates_by_role[role]) as here:
        allowed, refused = set(), 0
        for process, link in here.links.items():
            for key, (topic, instance) in keys().items():
                payload = f"{process} {key}".encode()
                if process not in QUIET and may_put(role, process, topic, instance):
                    allowed.add((key, payload))
                else:
                    refused += 1
                    link.session.delete(key)
                link.session.put(key, payload)
        here.last_words()
        assert len(allowed) >= 8 and refused > 200
        found = {entry for entry in here.heard if entry[1] != b""}
        assert {payload.decode() for _, payload in found - allowed} == set()
        assert {payload.decode() for _, payload in allowed - found} == set()


def test_every_process_reads_what_the_table_gives_it_and_nothing_else(everything: Host) -> None:
    links = everything.links
    ears: dict[str, Heard] = {process: [] for process in links if process not in QUIET}
    for process, into in ears.items():
        for expression in ("**", f"{root_of(ROBOT)}/**", *(topic.key(ROBOT) for topic in every_topic())):
            _listen(links[process], expression, into)
    own = {p: {topic.key(ROBOT) for topic in every_topic() if topic.writer == p} for p in ears}
    allowed = {p: {t.key(ROBOT) for t in said(links) if p in t.readers} - own[p] for p in ears}
    looks_on = SUPERVISOR.writer  # it hears all that the result is made of
    allowed[looks_on] = {t.key(ROBOT) for t in said(links)} - own[looks_on]

    def foreign(process: str) -> set[str]:
        """What a process hears from others; its own words it hears without any router."""
        return {key for key, _ in ears[process]} - own[process]

    def say() -> None:
        for topic in every_topic():
            _say(links, topic, b"to all")

    eventually(lambda: all(allowed[p] <= foreign(p) for p in ears), "all readers hear", say)
    everything.last_words()
    assert {p: sorted(foreign(p) - allowed[p]) for p in ears if foreign(p) - allowed[p]} == {}


def test_the_link_reads_what_crosses(certificates_by_role: dict[Role, Path]) -> None:
    """At the base what its instances say; at the robot what crosses, and what the standbys say; no cloud."""
    for role, wanted in (
        ("robot", {"irm/global_irm", "mission/state", "standby/gcp/global_policy"}),
        ("base", {"base/gcp/global_policy", "status/command"}),
    ):
        config = secured(ROBOT, certificates_by_role["robot"], "robot" if role == "robot" else "base")
        reads = {key.removeprefix(f"{root_of(ROBOT)}/") for key in router_grants(config)[LINK].reads}
        assert wanted <= reads
        assert not reads & {"sim/cloud", "sim/world_picture", "riskmap/moving", "mission/graph_request"}


def test_the_robots_recorder_hands_out_its_segments_at_the_base_and_no_more(
    certificates_by_role: dict[Role, Path],
) -> None:
    segments, ears = f"{root_of(ROBOT)}/{SEGMENTS_QUERY}", []  # type: tuple[str, Heard]
    with host("base", certificates_by_role["base"]) as here:
        robots, base = here.links[ROBOT_RECORDER], here.links[RECORDER]
        base.answer(segments, lambda: b"not the robot's")
        eventually(lambda: here.links[TOOLS].ask(segments, 1.0) == b"not the robot's", "the base may, too")
        assert here.links["gcp"].ask(segments, 1.0) is None
        base._keep.clear()
        robots.answer(segments, lambda: b"the robot's")
        eventually(lambda: here.links[TOOLS].ask(segments, 1.0) == b"the robot's", "they are handed out")
        _listen(robots, f"{root_of(ROBOT)}/**", ears)
        here.last_words()
        assert ears == []


@pytest.mark.parametrize("role", ["all", "base"])
def test_of_all_processes_the_operator_alone_commands_the_mission(
    role: Role, certificates_by_role: dict[Role, Path]
) -> None:
    """The status service carries out whatever the query brings: who may read everything may not therefore ask it."""
    command, heard = f"{root_of(ROBOT)}/{COMMAND_QUERY}", []  # type: tuple[str, list[bytes]]

    def carry_out(payload: bytes) -> bytes:
        heard.append(payload)
        return b"carried out"

    with host(role, certificates_by_role[role]) as here:
        here.links["status"].serve(command, carry_out)
        ask = here.links[OPERATOR].ask
        eventually(lambda: ask(command, 1.0, b"operator") == b"carried out", "the operator's is carried out")
        others = [process for process in here.links if process not in (OPERATOR, "status")]
        for process in others:
            for key in (command, f"{root_of(ROBOT)}/mission/*", f"{root_of(ROBOT)}/**"):
                assert here.links[process].ask(key, 0.2, process.encode()) is None, (process, key)
        assert ask(command, 1.0, b"operator") == b"carried out"
    assert len(others) > 5 and set(heard) == {b"operator"}


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
        for topic in said(links):
            stranger.session.put(topic.key(ROBOT), b"stranger")
            _say(links, topic, b"known")
        wanted = {(topic.key(ROBOT), b"known") for topic in said(links)}
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
