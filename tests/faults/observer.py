"""Listens to a running system as one more client and judges what a restart has cost."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, field

from planning.graph_mirror import GraphMirror
from plgrim.runtime.zenoh_session import Link
from schemas.base import Message
from schemas.codec import Envelope, decode
from schemas.contract import Topic
from schemas.operation import JudgeReport, MissionState, StageHealth
from schemas.sensing import Odometry
from schemas.topics import (
    COVERAGE,
    GLOBAL_IRM,
    GLOBAL_POLICY,
    JUDGE,
    LOCAL_IRM,
    LOCAL_POLICY,
    MISSION,
    ODOMETRY,
    PLAN,
    RISK_MAP,
    health_topic,
)
from schemas.world import CoverageSummary, GlobalIrm

MAIN_TOPIC: dict[str, Topic[Message]] = {
    "riskmap": RISK_MAP,
    "irm": LOCAL_IRM,
    "gcp": GLOBAL_POLICY,
    "lcp": LOCAL_POLICY,
    "reconciler": PLAN,
    "mission": MISSION,
    "status": health_topic("status"),
    "sim": ODOMETRY,
}
"""By what a service is known to be at work again. status publishes nothing else while all is well."""


@dataclass(frozen=True, slots=True)
class Handover:
    """What a restarted irm said first, against what it had acknowledged.

    nodes, edges: acknowledged before. lost_nodes, lost_edges: of these, missing or changed in the first message.
    version_step: versions from the last message heard to the first of the new life; 1 when none was journaled in vain,
    less when a version was given twice: the journal has lost records that were acknowledged.
    """

    nodes: int
    edges: int
    lost_nodes: int
    lost_edges: int
    version_step: int
    whole: bool

    def faults(self) -> list[str]:
        """In plain words, what is not as it must be."""
        found = []
        # Beyond one step, a record that was written but not published may have changed what was acknowledged.
        if self.version_step <= 1 and self.lost_nodes + self.lost_edges > 0:
            found.append(f"acknowledged and lost: {self}")
        if self.version_step < 1:
            found.append(f"the journal lost its last records, a version was given twice: {self}")
        if not self.whole:
            found.append(f"the first graph of a new life is not whole: {self}")
        return found


@dataclass(slots=True)
class Heard:
    """Of one writer: its newest life, and when the first message of that life came (monotonic seconds)."""

    epoch: int = 0
    first_s: float = 0.0
    ready_s: float | None = None


@dataclass(slots=True)
class Observer:
    """Call `attach`; everything is updated by the threads of the subscriptions."""

    outputs: dict[str, Heard] = field(default_factory=dict)
    health: dict[str, Heard] = field(default_factory=dict)
    handovers: list[Handover] = field(default_factory=list)
    judge_setbacks: list[float] = field(default_factory=list)
    belief_setbacks_m2: list[float] = field(default_factory=list)
    jumps_m: list[float] = field(default_factory=list)
    clock_setbacks_s: list[float] = field(default_factory=list)
    mission: MissionState | None = None
    judge: JudgeReport | None = None
    gaps: int = 0
    _coverage: CoverageSummary | None = None
    _place: Odometry | None = None
    _graph: GraphMirror = field(default_factory=GraphMirror)
    _lives: dict[str, int] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def attach(self, link: Link) -> None:
        """Subscribe to every message that is judged."""
        for service, topic in MAIN_TOPIC.items():
            self.outputs[service], self.health[service] = Heard(), Heard()
            if topic is not health_topic(service):
                link.subscribe(topic, self._receive, every=True)
            link.subscribe(health_topic(service), self._receive, every=True)
        for topic in (JUDGE, COVERAGE, GLOBAL_IRM):
            link.subscribe(topic, self._receive, every=True)

    def _receive(self, topic: Topic[Message], payload: bytes) -> None:
        message, envelope = decode(payload, topic.message, topic.max_bytes)
        with self._lock:
            newer = self._is_new_life(topic, envelope)
            if newer is None:
                return
            self._note(topic, message, envelope)
            self._judge_message(message, newer)

    def _is_new_life(self, topic: Topic[Message], envelope: Envelope) -> bool | None:
        """Whether the topic's writer has begun a new life; None for what comes late from an old one."""
        last = self._lives.get(topic.name, 0)
        if envelope.epoch < last:
            return None
        self._lives[topic.name] = envelope.epoch
        return 0 < last < envelope.epoch

    def _note(self, topic: Topic[Message], message: Message, envelope: Envelope) -> None:
        now = time.monotonic()
        if isinstance(message, StageHealth):
            heard = self.health[message.service]
            if envelope.epoch > heard.epoch:
                heard.epoch, heard.first_s, heard.ready_s = envelope.epoch, now, None
            if message.ready and heard.ready_s is None:
                heard.ready_s = now
            if message.service != "status" or not message.ready:
                return
        main = MAIN_TOPIC.get(envelope.writer)
        if (
            main is not None
            and main.name == topic.name
            and envelope.epoch > self.outputs[envelope.writer].epoch
        ):
            self.outputs[envelope.writer] = Heard(envelope.epoch, now)

    def _judge_message(self, message: Message, new_life: bool) -> None:
        match message:
            case GlobalIrm():
                if new_life:
                    self.handovers.append(compare(self._graph, message))
                self.gaps += not self._graph.apply(message)
            case JudgeReport():
                if new_life and self.judge is not None:
                    self.judge_setbacks.append(self.judge.coverage - message.coverage)
                self.judge = message
            case CoverageSummary():
                if new_life and self._coverage is not None:
                    self.belief_setbacks_m2.append(self._coverage.covered_area_m2 - message.covered_area_m2)
                self._coverage = message
            case Odometry():
                if new_life and self._place is not None:
                    self.jumps_m.append(
                        math.hypot(
                            message.pose.x_m - self._place.pose.x_m, message.pose.y_m - self._place.pose.y_m
                        )
                    )
                self._place = message
            case MissionState():
                if new_life and self.mission is not None:
                    self.clock_setbacks_s.append(self.mission.elapsed_s - message.elapsed_s)
                self.mission = message

    def graph_size(self) -> tuple[int, int]:
        """(nodes, edges) acknowledged so far."""
        with self._lock:
            columns = self._graph.snapshot()["columns"]
        return int(columns["node_id"].size), int(columns["edge"].shape[0])

    @property
    def finish(self) -> str:
        """Why the mission has ended; empty while it goes on."""
        return self.mission.finish.value if self.mission else ""


def compare(before: GraphMirror, message: GlobalIrm) -> Handover:
    """Every node and edge that was acknowledged against the first message of the new life."""
    after = GraphMirror()
    whole = message.base_version == 0 and after.apply(message)
    old_nodes, old_edges = _contents(before)
    new_nodes, new_edges = _contents(after)
    return Handover(
        nodes=len(old_nodes),
        edges=len(old_edges),
        lost_nodes=sum(new_nodes.get(key) != value for key, value in old_nodes.items()),
        lost_edges=sum(new_edges.get(key) != value for key, value in old_edges.items()),
        version_step=message.irm_version - before.version,
        whole=whole,
    )


def _contents(graph: GraphMirror) -> tuple[dict[int, bytes], dict[tuple[int, int], bytes]]:
    """Nodes and edges with all that is said of them."""
    c = graph.snapshot()["columns"]
    nodes = {
        int(node): b"".join(
            c[name][i].tobytes() for name in ("node_kind", "node_xyz_m", "node_gain", "node_coverage")
        )
        for i, node in enumerate(c["node_id"])
    }
    edges = {
        (int(a), int(b)): b"".join(
            c[name][i].tobytes() for name in ("edge_distance_m", "edge_risk", "edge_driven")
        )
        for i, (a, b) in enumerate(c["edge"])
    }
    return nodes, edges
