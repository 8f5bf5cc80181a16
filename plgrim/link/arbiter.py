"""Passes on what the obeyed one of two instances of a stage says, as the stage's own word: one writer, one epoch.

Readers know nothing of instances: to them a change of holder is a new life of the writer (a later epoch), and what an
earlier holder still says is refused by their mailboxes as well. Pure: no transport, no clock.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from plgrim.link.config import LinkConfig
from plgrim.link.in_step import Seen
from plgrim.link.lease import BASE, STANDBY, Lease, LeaseTimes
from plgrim.link.routes import is_request, leased_outputs, needed_by
from schemas.base import Message
from schemas.codec import Envelope, decode, encode
from schemas.contract import SECOND_NS, Stamp, Topic
from schemas.errors import MessageError, WrongSenderError
from schemas.operation import StageHealth
from schemas.policy import GlobalPolicy
from schemas.world import GlobalIrm

_GRAPH_VERSION = "irm_version"
_WARM_NS = 2 * SECOND_NS
ToPublish = list[tuple[Topic[Message], bytes]]


class _Word(NamedTuple):
    """What an instance has said last on a topic."""

    topic: Topic[Message]
    message: Message
    envelope: Envelope
    heard_ns: int


@dataclass(slots=True)
class Arbiter:
    """Of one stage. Not thread safe. seen: what the robot has said, shared by the arbiters of all stages.

    Times `now_ns` are of a local monotonic clock; `stamp` is the mission clock, for envelopes alone.
    """

    service: str
    robot: str
    config: LinkConfig
    seen: Seen
    lease: Lease
    dropped: Counter[str] = field(default_factory=Counter)
    _marks: dict[tuple[str, str], tuple[int, int]] = field(default_factory=dict)
    _taken_ns: dict[str, int] = field(default_factory=dict)
    _last: dict[tuple[str, str], _Word] = field(default_factory=dict)
    _sequence: Counter[str] = field(default_factory=Counter)
    _unanswered_ns: int | None = None
    _base_output_ns: int | None = None

    @classmethod
    def of(cls, service: str, robot: str, config: LinkConfig, seen: Seen, epoch: int) -> Arbiter:
        """An arbiter whose standby holds the lease. epoch: later than that of any life before."""
        times = LeaseTimes(config.ns("silent_after_s"), config.ns("hand_back_after_s"))
        return cls(service, robot, config, seen, Lease(times, epoch))

    @property
    def topics(self) -> list[Topic[Message]]:
        """What it takes from both instances and passes on from one."""
        return leased_outputs(self.service)

    def receive(
        self, instance: str, topic: Topic[Message], payload: bytes, now_ns: int, stamp: Stamp
    ) -> ToPublish:
        """Take in a message of an instance; what is to be published at once. Bad ones are counted by reason."""
        try:
            word = self._read(instance, topic, payload, now_ns)
        except MessageError as error:
            self.dropped[f"{instance}/{topic.name}:{error.reason}"] += 1
            return []
        if isinstance(word.message, StageHealth):
            self._judge_health(instance, word, now_ns)
        elif is_request(topic):
            return [self._sealed(word, stamp)]
        elif not self._judge_output(instance, word, now_ns):
            return self.tick(now_ns, stamp)
        self._last[instance, topic.name] = word
        changed = self.tick(now_ns, stamp)
        if self.lease.holder != instance:
            return changed
        return changed or [self._sealed(word, stamp)]

    def tick(self, now_ns: int, stamp: Stamp) -> ToPublish:
        """Step the lease; on a change, the last words of the new holder: it was warm."""
        waited = self._unanswered_ns is not None and now_ns - self._unanswered_ns > self._silent_ns
        if not self.lease.tick(now_ns, base_lags=waited):
            return []
        words = [self._last[key] for key in sorted(self._last) if key[0] == self.lease.holder]
        return [self._sealed(word, stamp) for word in words if self._is_warm(word, now_ns)]

    def _is_warm(self, word: _Word, now_ns: int) -> bool:
        """Whether a word from before the change of holder still holds: the base's may have aged since it was judged."""
        if now_ns - word.heard_ns > _WARM_NS:
            return False
        return self.lease.holder == STANDBY or self._lag_ns(word, now_ns) <= self.config.ns("behind_after_s")

    @property
    def _silent_ns(self) -> int:
        return self.config.ns("silent_after_s")

    def _read(self, instance: str, topic: Topic[Message], payload: bytes, now_ns: int) -> _Word:
        message, envelope = decode(payload, topic.message, topic.max_bytes)
        if envelope.robot != self.robot or envelope.writer != self.service:
            raise WrongSenderError(f"from {envelope.writer!r} of {envelope.robot!r}")
        self._forget_the_silent(instance, now_ns)
        mark, last = (envelope.epoch, envelope.sequence), self._marks.get((instance, topic.name))
        if last is not None and mark <= last:
            raise WrongSenderError(f"{mark} is not newer than {last}")
        self._marks[instance, topic.name] = mark
        self._taken_ns[instance] = now_ns
        return _Word(topic, message, envelope, now_ns)

    def _forget_the_silent(self, instance: str, now_ns: int) -> None:
        """An instance of which nothing was taken for so long has no lease: its next life may have an earlier clock."""
        if now_ns - self._taken_ns.get(instance, now_ns) > self._silent_ns:
            self._marks = {key: mark for key, mark in self._marks.items() if key[0] != instance}

    def _judge_health(self, instance: str, word: _Word, now_ns: int) -> None:
        assert isinstance(word.message, StageHealth)
        if word.message.ready and (instance == STANDBY or self._knows(word.envelope, now_ns)):
            self.lease.good(instance, now_ns)
        else:
            self.lease.bad(instance)

    def _knows(self, envelope: Envelope, now_ns: int) -> bool:
        """Whether the sender has heard all that the robot has said, not long ago at least."""
        needed = needed_by(self.service)
        if any(self.seen.has(name) and name not in envelope.consumed for name in needed):
            return False
        return self.seen.lag_ns(envelope.consumed, needed, now_ns) <= self.config.ns("behind_after_s")

    def _judge_output(self, instance: str, word: _Word, now_ns: int) -> bool:
        """Whether it may be passed on, were its sender the holder; notes who answers and who does not."""
        if instance == STANDBY:
            base_ns = self._base_output_ns
            if self._unanswered_ns is None and (base_ns is None or now_ns - base_ns > self._silent_ns // 2):
                self._unanswered_ns = now_ns
            return True
        if self._lag_ns(word, now_ns) > self.config.ns("behind_after_s"):
            self.dropped[f"{instance}/{word.topic.name}:behind"] += 1
            self.lease.bad(instance)
            if self._unanswered_ns is None:
                self._unanswered_ns = self._base_output_ns if self._base_output_ns is not None else now_ns
            return False
        self._base_output_ns, self._unanswered_ns = now_ns, None
        return True

    def _lag_ns(self, word: _Word, now_ns: int) -> int:
        """For how long the robot has known better than what this output was made from."""
        lag_ns = self.seen.lag_ns(word.envelope.consumed, needed_by(self.service), now_ns)
        if isinstance(word.message, GlobalPolicy):
            lag_ns = max(lag_ns, self.seen.behind_ns(_GRAPH_VERSION, (0, word.message.irm_version), now_ns))
        return lag_ns

    def _sealed(self, word: _Word, stamp: Stamp) -> tuple[Topic[Message], bytes]:
        """The message under the epoch of the lease."""
        self._sequence[word.topic.name] += 1
        sequence = self._sequence[word.topic.name]
        envelope = Envelope(
            self.robot, self.service, self.lease.epoch, sequence, stamp, word.envelope.consumed
        )
        return word.topic, encode(word.message, envelope)

    def base_age_s(self, now_ns: int) -> float:
        """Since the last good word of the base's instance; -1: none yet."""
        age_ns = self.lease.good_age_ns(BASE, now_ns)
        return -1.0 if age_ns < 0 else age_ns / SECOND_NS


def note_robot(seen: Seen, topic: Topic[Message], message: Message, envelope: Envelope, now_ns: int) -> None:
    """Note what the robot has said; of the Global IRM also its version, which a new life of irm may begin anew."""
    last = seen.newest(topic.name)
    seen.note(topic.name, (envelope.epoch, envelope.sequence), now_ns)
    if isinstance(message, GlobalIrm):
        version, known = (0, message.irm_version), seen.newest(_GRAPH_VERSION)
        new_life = last is None or last[0] != envelope.epoch
        if new_life and known is not None and version < known:
            seen.forget(_GRAPH_VERSION)
        seen.note(_GRAPH_VERSION, version, now_ns)
