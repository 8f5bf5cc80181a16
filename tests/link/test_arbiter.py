"""The arbiter and what it knows of the base, by stepping time: who is passed on, and that nothing stale ever is."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plgrim.config import RuntimeConfig
from plgrim.link.arbiter import Arbiter, ToPublish, note_robot
from plgrim.link.config import LinkConfig
from plgrim.link.in_step import UNKNOWN_NS, Seen
from plgrim.link.lease import BASE, STANDBY
from plgrim.runtime.keeper import next_epoch
from plgrim.runtime.mailbox import Mailbox
from schemas.base import Message
from schemas.codec import Envelope, decode, encode
from schemas.contract import SECOND_NS, Topic
from schemas.operation import StageHealth
from schemas.policy import GlobalPolicy
from schemas.topics import GCP_GRAPH_REQUEST, GLOBAL_IRM, GLOBAL_POLICY, ODOMETRY, health_topic, read_by
from schemas.world import GraphRequest
from tests.link.fakes import global_irm, global_policy
from tests.runtime.fake_services import odometry

MS = SECOND_NS // 1000
HEALTH = health_topic("gcp")
CONFIG = LinkConfig(host="robot", endpoint="tcp/base:1", at_base=("gcp", "status"))


def _health(now_ns: int, ready: bool = True) -> StageHealth:
    return StageHealth(
        stamp_ns=now_ns, service="gcp", ready=ready, steps=1, step_p50_ms=1, step_p99_ms=1, rate_hz=1, memory_mb=1,
        pid=1, errors=0, last_error="", dropped={}, waiting_for=[],
    )  # fmt: skip


class _World:
    """A robot that says odometry and graphs, and two instances that answer; time in ms."""

    def __init__(self) -> None:
        self.seen = Seen()
        self.arbiter = Arbiter.of("gcp", "robot", CONFIG, self.seen, epoch=1000)
        self.now_ms = 0
        self.version = 0
        self.odometry = 0
        self.graph_at_ms: dict[int, int] = {}
        self.sequence: dict[tuple[str, str, int], int] = {}
        self.readers = Mailbox("robot", tuple(read_by("lcp")))
        self.passed: list[tuple[int, int]] = []
        """(version of the graph, ms) of each policy that readers accepted."""

    def restart_link(self) -> None:
        """A new life of the link process: it knows nothing of what was said."""
        self.seen = Seen()
        self.arbiter = Arbiter.of("gcp", "robot", CONFIG, self.seen, epoch=2000)

    def robot(self, irm_epoch: int = 3) -> None:
        """The robot says where it is, and a new graph."""
        now_ns = self.now_ms * MS
        self.odometry += 1
        self.version += 1
        self.graph_at_ms[self.version] = self.now_ms
        graph = global_irm(now_ns, self.version, self.version - 1)
        moved = Envelope("robot", "sim", 3, self.odometry, now_ns)
        drawn = Envelope("robot", "irm", irm_epoch, self.version, now_ns)
        note_robot(self.seen, ODOMETRY, odometry(now_ns, 0.0), moved, now_ns)
        note_robot(self.seen, GLOBAL_IRM, graph, drawn, now_ns)

    def says(
        self,
        instance: str,
        topic: Topic[Message],
        message: Message,
        knows: tuple[int, int] | None = None,
        epoch: int = 1,
        irm_epoch: int = 3,
    ) -> None:
        """An instance says something. knows: (odometry, graph) heard by then; as new as can be without."""
        count = self.sequence[instance, topic.name, epoch] = (
            self.sequence.get((instance, topic.name, epoch), 0) + 1
        )
        heard = knows or (self.odometry, self.version)
        consumed = {"sim/odometry": (3, heard[0]), "irm/global_irm": (irm_epoch, heard[1])}
        payload = encode(message, Envelope("robot", "gcp", epoch, count, 0, consumed))
        self.hand_on(self.arbiter.receive(instance, topic, payload, self.now_ms * MS, 0))

    def hand_on(self, found: ToPublish) -> None:
        """What is published must suit the readers; policies are noted."""
        for topic, payload in found:
            if topic is not GLOBAL_POLICY:
                continue
            assert self.readers.accept(topic, payload, 0), self.readers.last_refusal
            self.passed.append((decode(payload, GlobalPolicy, topic.max_bytes)[0].irm_version, self.now_ms))

    def second(self, base: bool = True, standby: bool = True, base_late: int = 0) -> None:
        """One second: the robot speaks, then each instance that lives; base_late: graphs that it is behind."""
        self.robot()
        for _ in range(2):
            for instance, lives, late in ((STANDBY, standby, 0), (BASE, base, base_late)):
                if lives:
                    heard = (max(1, self.odometry - late), max(1, self.version - late))
                    self.says(instance, HEALTH, _health(0), heard)
                    self.says(instance, GLOBAL_POLICY, global_policy(0, heard[1]), heard)
            for _ in range(5):
                self.now_ms += 100
                self.hand_on(self.arbiter.tick(self.now_ms * MS, 0))


def test_only_the_holder_is_passed_on() -> None:
    world = _World()
    for _ in range(10):
        world.second()
    assert world.arbiter.lease.holder == BASE
    assert len(world.passed) <= 2 * 10 + 1  # each policy once, and the last word at the change of holder
    epoch = world.arbiter.lease.epoch
    assert epoch == 1001


def test_silence_of_the_base_gives_way_to_a_warm_standby() -> None:
    world = _World()
    for _ in range(15):
        world.second()
    cut_ms = world.now_ms
    for _ in range(6):
        world.second(base=False)
    assert world.arbiter.lease.holder == STANDBY
    after = [at for _, at in world.passed if at > cut_ms]
    assert after[0] - cut_ms <= 2500
    assert max(b - a for a, b in pairwise(after)) <= 600


def test_a_base_that_hears_late_is_not_obeyed() -> None:
    """It speaks on time, but of a world that is four seconds old: frozen inputs, or a link with a long queue."""
    world = _World()
    for _ in range(15):
        world.second()
    for _ in range(10):
        world.second(base_late=4)
    assert world.arbiter.lease.holder == STANDBY
    assert world.arbiter.dropped["base/gcp/global_policy:behind"] > 5
    for _ in range(3):
        world.second()
    assert world.arbiter.lease.holder == BASE


def test_a_base_whose_graph_alone_is_old_is_not_obeyed() -> None:
    world = _World()
    for _ in range(15):
        world.second()
    for _ in range(8):
        world.robot()
        world.says(STANDBY, GLOBAL_POLICY, global_policy(0, world.version))
        world.says(STANDBY, HEALTH, _health(0))
        world.says(BASE, GLOBAL_POLICY, global_policy(0, 15))
        world.says(BASE, HEALTH, _health(0))
        world.now_ms += 1000
        world.hand_on(world.arbiter.tick(world.now_ms * MS, 0))
    assert world.arbiter.lease.holder == STANDBY


def test_a_base_that_lives_but_does_not_answer_loses_the_lease() -> None:
    world = _World()
    for _ in range(15):
        world.second()
    for _ in range(6):
        world.robot()
        for _ in range(2):
            world.says(BASE, HEALTH, _health(0))
            world.says(STANDBY, HEALTH, _health(0))
            world.says(STANDBY, GLOBAL_POLICY, global_policy(0, world.version))
            world.now_ms += 500
            world.hand_on(world.arbiter.tick(world.now_ms * MS, 0))
    assert world.arbiter.lease.holder == STANDBY


def test_what_has_aged_by_the_hand_back_is_not_passed_on_with_it() -> None:
    """Its only policy was in order when it came; when the base is obeyed, the robot has known better for long."""
    world = _World()
    for _ in range(5):
        world.second(base=False)
    old = world.version - 2
    world.says(BASE, GLOBAL_POLICY, global_policy(0, old), (old, old))
    assert world.arbiter.dropped == {}
    for _ in range(4):
        world.robot()
        world.says(BASE, HEALTH, _health(0))
        world.says(STANDBY, HEALTH, _health(0))
        world.now_ms += 500
        world.hand_on(world.arbiter.tick(world.now_ms * MS, 0))
    assert world.arbiter.lease.holder == BASE
    assert old not in {version for version, at_ms in world.passed if at_ms > 5000}
    world.says(BASE, GLOBAL_POLICY, global_policy(0, world.version))
    assert world.passed[-1][0] == world.version


def test_an_instance_that_is_not_ready_gets_nothing() -> None:
    world = _World()
    for _ in range(10):
        world.robot()
        world.says(BASE, HEALTH, _health(0, ready=False))
        world.now_ms += 500
        world.hand_on(world.arbiter.tick(world.now_ms * MS, 0))
    assert world.arbiter.lease.holder == STANDBY


def _with_a_base_at(world: _World, version: int, seconds: int = 8) -> None:
    """The base hears odometry, says that it is well, and holds a graph of its own."""
    for _ in range(2 * seconds):
        world.robot()
        for instance, graph in ((STANDBY, world.version), (BASE, version)):
            heard = (world.odometry, min(graph, world.version))
            world.says(instance, HEALTH, _health(0))
            world.says(instance, GLOBAL_POLICY, global_policy(0, graph), heard)
        for _ in range(5):
            world.now_ms += 100
            world.hand_on(world.arbiter.tick(world.now_ms * MS, 0))


@pytest.mark.parametrize("version", [5, 250, 5000])
def test_a_link_that_restarts_passes_on_nothing_that_it_cannot_date(version: int) -> None:
    """The base's graph is far behind, within what irm's cache tells a new reader, or of the mission before."""
    world = _World()
    world.odometry = world.version = 300
    world.restart_link()
    for old in range(240, 301):  # the cache of irm
        drawn = Envelope("robot", "irm", 3, old, 0)
        note_robot(world.seen, GLOBAL_IRM, global_irm(0, old, old - 1), drawn, old * 1000)
    _with_a_base_at(world, version)
    assert world.passed and version not in {passed for passed, _ in world.passed}
    for _ in range(6):
        world.second()
    assert world.arbiter.lease.holder == BASE


def test_a_life_of_irm_that_counts_anew_is_followed() -> None:
    """What the base says of the new graph is passed on, what it says of the old one is not."""
    world = _World()
    world.version = 300
    for _ in range(5):
        world.second()
    assert world.arbiter.lease.holder == BASE
    world.version, before_ms = 0, world.now_ms
    for _ in range(10):
        world.robot(irm_epoch=4)
        for instance in (STANDBY, BASE):
            for topic, message in ((HEALTH, _health(0)), (GLOBAL_POLICY, global_policy(0, world.version))):
                world.says(instance, topic, message, irm_epoch=4)
        world.now_ms += 1000
        world.hand_on(world.arbiter.tick(world.now_ms * MS, 0))
    assert world.arbiter.lease.holder == BASE
    assert world.arbiter.dropped == {}
    world.says(BASE, GLOBAL_POLICY, global_policy(0, 305), irm_epoch=4)
    assert world.arbiter.dropped == {"base/gcp/global_policy:behind": 1}
    assert {version for version, at_ms in world.passed if at_ms >= before_ms} == set(range(1, 11))


def test_old_lives_and_repetitions_are_dropped_and_counted() -> None:
    world = _World()
    world.robot()
    world.says(BASE, GLOBAL_POLICY, global_policy(0, 1), epoch=5)
    world.says(BASE, GLOBAL_POLICY, global_policy(0, 1), epoch=4)
    repeated = encode(global_policy(0, 1), Envelope("robot", "gcp", 5, 1, 0))
    world.hand_on(world.arbiter.receive(BASE, GLOBAL_POLICY, repeated, 0, 0))
    foreign = encode(global_policy(0, 1), Envelope("other", "gcp", 6, 1, 0))
    world.hand_on(world.arbiter.receive(BASE, GLOBAL_POLICY, foreign, 0, 0))
    world.hand_on(world.arbiter.receive(BASE, GLOBAL_POLICY, b"\xc1Zdamaged", 0, 0))
    assert world.arbiter.dropped == {
        "base/gcp/global_policy:wrong_sender": 3,
        "base/gcp/global_policy:malformed": 1,
    }
    assert world.passed == []


def test_a_base_that_was_replaced_is_obeyed_whatever_its_clock_says() -> None:
    """Its epochs are earlier than those of the one before it, which is silent now; the one that speaks is not
    displaced."""
    world = _World()
    for _ in range(10):
        world.second()
    assert world.arbiter.lease.holder == BASE
    world.says(BASE, GLOBAL_POLICY, global_policy(0, world.version), epoch=0)
    assert world.arbiter.dropped == {"base/gcp/global_policy:wrong_sender": 1}
    replaced_ms, obeyed_ms = world.now_ms, -1
    for _ in range(12):
        world.robot()
        for instance, epoch in ((STANDBY, 1), (BASE, 0)):
            world.says(instance, HEALTH, _health(0), epoch=epoch)
            world.says(instance, GLOBAL_POLICY, global_policy(0, world.version), epoch=epoch)
        world.now_ms += 500
        world.hand_on(world.arbiter.tick(world.now_ms * MS, 0))
        if world.arbiter.lease.holder == BASE and world.arbiter.lease.epoch > 1001 and obeyed_ms < 0:
            obeyed_ms = world.now_ms
    assert world.arbiter.lease.holder == BASE
    assert 2000 < obeyed_ms - replaced_ms <= 5500


def test_requests_for_the_graph_pass_whoever_asks() -> None:
    world = _World()
    request = encode(GraphRequest(stamp_ns=0, have_version=3), Envelope("robot", "gcp", 9, 1, 0))
    irm = Mailbox("robot", tuple(read_by("irm")))
    for instance in (BASE, STANDBY):
        ((topic, payload),) = world.arbiter.receive(instance, GCP_GRAPH_REQUEST, request, 0, 0)
        assert topic is GCP_GRAPH_REQUEST
        assert irm.accept(topic, payload, 0)


_Seconds = st.lists(
    st.tuples(st.booleans(), st.booleans(), st.sampled_from([0, 0, 0, 1, 4])), min_size=1, max_size=40
)


@given(_Seconds)
@settings(max_examples=40)
def test_whatever_happens_nothing_stale_is_passed(seconds: list[tuple[bool, bool, int]]) -> None:
    """No policy from a graph that was replaced more than the limit ago; readers refuse nothing that is published."""
    world = _World()
    for base, standby, late in seconds:
        world.second(base, standby, late)
    limit_ms = (
        int(1000 * CONFIG.behind_after_s) + 2000
    )  # as a last word of up to 2 s ago at a change of holder
    for version, at_ms in world.passed:
        replaced_ms = world.graph_at_ms.get(version + 1, at_ms)
        assert at_ms - replaced_ms <= limit_ms
    assert not world.readers.dropped


def test_behind_is_measured_by_the_clock_of_the_robot_alone() -> None:
    seen = Seen()
    for number in range(2000):
        seen.note("a", (1, number), 10 * MS * number)
    now_ns = 30_000 * MS
    assert seen.behind_ns("a", (1, 1999), now_ns) == 0
    assert seen.behind_ns("a", (1, 1998), now_ns) == now_ns - 19_990 * MS
    for unseen in ((0, 5), (1, 3), (2, 0)):  # of another life, older than what is kept, of the future
        assert seen.behind_ns("a", unseen, now_ns) == UNKNOWN_NS
    assert seen.behind_ns("b", (1, 1), now_ns) == UNKNOWN_NS
    seen.note("a", (1, 7), 40_000 * MS)
    assert seen.behind_ns("a", (1, 1999), 50_000 * MS) == 0


def test_of_a_cache_that_is_told_at_once_only_the_newest_is_new() -> None:
    """A reader that joins late hears what was said before all at once: when each was new it does not know."""
    seen = Seen()
    for number in range(64):
        seen.note("a", (1, number), number * MS)
    seen.note("a", (1, 64), 1000 * MS)
    seen.note("a", (1, 65), 1050 * MS)
    assert seen.behind_ns("a", (1, 62), 1100 * MS) == UNKNOWN_NS
    assert seen.behind_ns("a", (1, 63), 1100 * MS) == 100 * MS
    assert seen.behind_ns("a", (1, 64), 1100 * MS) == 50 * MS


def test_a_link_that_restarts_after_the_clock_was_set_back_is_heard(tmp_path: Path) -> None:
    """Its leases went on counting where the file of epochs does not: the next life must come after all of them."""
    config = RuntimeConfig(state_dir=str(tmp_path))
    epoch = next_epoch(config, "robot", "link", 3_600_000)
    arbiter = Arbiter.of("gcp", "robot", CONFIG, Seen(), epoch)
    for minute in range(40):
        for second in (0, 1, 2, 20):
            now_ns = (60 * minute + second) * SECOND_NS
            if second < 20:
                arbiter.lease.good(BASE, now_ns)
            arbiter.lease.tick(now_ns)
    assert arbiter.lease.epoch == epoch + 80
    assert next_epoch(config, "robot", "link", 60_000) > arbiter.lease.epoch
