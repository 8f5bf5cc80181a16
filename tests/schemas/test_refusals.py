"""Messages that must not be used are refused by name, whatever is wrong with them."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plgrim.runtime.mailbox import Mailbox, Outbox
from schemas.base import Message
from schemas.codec import Envelope, decode, encode
from schemas.contract import Output
from schemas.errors import (
    ChecksumError,
    MalformedError,
    MessageError,
    ShapeError,
    TooLargeError,
    UnknownSchemaError,
    UnknownVersionError,
    ValueRangeError,
)
from schemas.operation import MissionCommand
from schemas.sensing import Odometry, PointCloud, PoseGraph
from schemas.topics import CLOUD, COMMAND, MISSION, ODOMETRY
from schemas.world import GlobalIrm, RiskMap
from tests.schemas.examples import ENVELOPE, MESSAGES, body_of, encoded, example, sign

LIMIT = 1 << 20


def tampered(message: type[Message], change: Callable[[Any], None]) -> bytes:
    """The example with something changed, and a checksum that fits."""
    body = body_of(encoded(message))
    change(body)
    return sign(body)


def header(name: str, value: Any) -> Callable[[Any], None]:
    def change(body: Any) -> None:
        body["header"][name] = value

    return change


def column(name: str, index: int, value: Any) -> Callable[[Any], None]:
    def change(body: Any) -> None:
        body["columns"][name][index] = value

    return change


def raw(values: Any, dtype: str) -> bytes:
    return np.asarray(values, dtype).tobytes()


def drop(part: str, name: str) -> Callable[[Any], None]:
    def change(body: Any) -> None:
        del body[part][name]

    return change


def put(name: str, value: Any) -> Callable[[Any], None]:
    def change(body: Any) -> None:
        body[name] = value

    return change


@given(st.data())
def test_flipped_bits_are_never_accepted(data: st.DataObject) -> None:
    message = data.draw(st.sampled_from(MESSAGES))
    payload = bytearray(encoded(message))
    flips = data.draw(st.sets(st.integers(0, len(payload) * 8 - 1), min_size=1, max_size=12))
    for bit in flips:
        payload[bit // 8] ^= 1 << (bit % 8)
    with pytest.raises((ChecksumError, MalformedError)):
        decode(bytes(payload), message, LIMIT)


@pytest.mark.parametrize("message", [PointCloud, MissionCommand], ids=lambda m: m.schema_name)
def test_no_single_flipped_bit_is_accepted(message: type[Message]) -> None:
    payload = encoded(message)
    for bit in range(len(payload) * 8):
        damaged = bytearray(payload)
        damaged[bit // 8] ^= 1 << (bit % 8)
        with pytest.raises((ChecksumError, MalformedError)):
            decode(bytes(damaged), message, LIMIT)


@given(st.data())
def test_cut_or_extended_bytes_are_never_accepted(data: st.DataObject) -> None:
    message = data.draw(st.sampled_from(MESSAGES))
    payload = encoded(message)
    cut = data.draw(st.integers(0, len(payload) - 1))
    tail = data.draw(st.binary(min_size=1, max_size=20))
    for damaged in (payload[:cut], payload + tail, payload[cut + 1 :]):
        with pytest.raises((ChecksumError, MalformedError)):
            decode(damaged, message, LIMIT)


@given(st.binary(max_size=200))
def test_noise_with_a_fitting_checksum_is_refused(noise: bytes) -> None:
    with pytest.raises(MessageError):
        decode(sign(noise), Odometry, LIMIT)


def test_too_large_is_refused_before_anything_else() -> None:
    payload = encoded(PointCloud)
    decode(payload, PointCloud, len(payload))
    with pytest.raises(TooLargeError):
        decode(payload, PointCloud, len(payload) - 1)
    with pytest.raises(TooLargeError):
        decode(b"\x00" * 100, PointCloud, 99)


def test_another_schema_or_version() -> None:
    with pytest.raises(UnknownSchemaError, match="odometry"):
        decode(encoded(PointCloud), Odometry, LIMIT)
    for version in (0, 2, 1.5, "1", None):
        with pytest.raises(UnknownVersionError):
            decode(tampered(Odometry, put("version", version)), Odometry, LIMIT)


@pytest.mark.parametrize(
    ("message", "change", "error"),
    [
        (PointCloud, header("range_m", math.nan), ValueRangeError),
        (PointCloud, header("range_m", math.inf), ValueRangeError),
        (PointCloud, header("range_m", 0.0), ValueRangeError),
        (PointCloud, header("stamp_ns", -1), ValueRangeError),
        (PointCloud, header("range_m", "20.0"), MalformedError),
        (PointCloud, header("stamp_ns", 1.5), MalformedError),
        (PointCloud, header("surprise", 1), MalformedError),
        (PointCloud, drop("header", "range_m"), MalformedError),
        (PointCloud, drop("header", "stamp_ns"), MalformedError),
        (PointCloud, drop("columns", "points_m"), MalformedError),
        (PointCloud, put("header", []), MalformedError),
        (PointCloud, put("columns", None), MalformedError),
        (PointCloud, header("sensor_in_odom", {"x_m": math.nan}), ValueRangeError),
        (PointCloud, header("sensor_in_odom", {"x_m": 1.0, "w_m": 2.0}), MalformedError),
        (PointCloud, column("points_m", 2, raw([math.nan] * 9, "float32")), ValueRangeError),
        (PointCloud, column("points_m", 2, raw([-math.inf] * 9, "float32")), ValueRangeError),
        (PointCloud, column("points_m", 2, b""), ShapeError),
        (PointCloud, column("points_m", 1, [9]), ShapeError),
        (PointCloud, column("points_m", 1, [1, 9]), ShapeError),
        (PointCloud, column("points_m", 1, [-3, -3]), ShapeError),
        (PointCloud, column("points_m", 1, [3, 3, 1, 1, 1]), ShapeError),
        (PointCloud, column("points_m", 1, [2**40, 3]), ShapeError),
        (PointCloud, column("points_m", 1, "33"), ShapeError),
        (PointCloud, column("points_m", 0, "object"), ShapeError),
        (PointCloud, column("points_m", 0, "int32"), ShapeError),
        (PointCloud, column("points_m", 2, "text"), MalformedError),
        (RiskMap, column("state", 2, raw([3] * 16, "uint8")), ValueRangeError),
        (RiskMap, column("hazard_mean", 2, raw([-1e-3] * 16, "float32")), ValueRangeError),
        (RiskMap, column("state", 1, [2, 8]), ShapeError),
        (GlobalIrm, column("edge_risk", 2, raw([1.01] * 4, "float64")), ValueRangeError),
    ],
)
def test_what_is_wrong_is_named(
    message: type[Message], change: Callable[[Any], None], error: type[MessageError]
) -> None:
    with pytest.raises(error) as caught:
        decode(tampered(message, change), message, LIMIT)
    assert caught.value.reason == error.reason
    assert message.schema_name in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("robot", None),
        ("writer", 7),
        ("epoch", -1),
        ("sequence", "1"),
        ("sent_ns", 1.5),
        ("consumed", []),
        ("consumed", {"sim/odometry": 3}),
        ("consumed", {"sim/odometry": [3]}),
        ("consumed", {"sim/odometry": [math.inf, 3]}),
    ],
)
def test_a_wrong_envelope_is_refused(field: str, value: Any) -> None:
    with pytest.raises(MalformedError):
        decode(tampered(Odometry, put(field, value)), Odometry, LIMIT)


_LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(),
    st.text(max_size=8),
    st.binary(max_size=16),
)
_ANYTHING = st.recursive(
    _LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to everything inside a body."""
    keys: list[Any] = []
    if isinstance(value, dict):
        keys = list(value)
    elif isinstance(value, list):
        keys = list(range(len(value)))
    found = [(*path, key) for key in keys]
    return found + [below for key in keys for below in places(value[key], (*path, key))]


@given(st.data())
def test_a_changed_body_is_refused_by_name_or_is_valid(data: st.DataObject) -> None:
    """Whatever stands anywhere in the body, the decoder raises nothing but a `MessageError`."""
    message = data.draw(st.sampled_from(MESSAGES))
    body = copy.deepcopy(body_of(encoded(message)))
    *parents, last = data.draw(st.sampled_from(places(body)))
    inside = body
    for key in parents:
        inside = inside[key]
    inside[last] = data.draw(_ANYTHING)
    try:
        decoded, _ = decode(sign(msgpack.packb(body)), message, LIMIT)
    except MessageError:
        return
    assert isinstance(decoded, message)


def mailbox() -> Mailbox:
    return Mailbox("husky1", (ODOMETRY, CLOUD, COMMAND))


def payload_of(message: type[Message], **changes: Any) -> bytes:
    values: dict[str, Any] = {"robot": "husky1", "writer": "sim", "epoch": 2, "sequence": 5, "sent_ns": 0}
    return encode(example(message), Envelope(**{**values, **changes}))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"robot": "husky2"}, "husky2"),
        ({"writer": "lcp"}, "belongs to 'sim'"),
        ({"epoch": 1}, "epoch 1 is over"),
        ({"sequence": 5}, "sequence 5"),
        ({"sequence": 4}, "sequence 4"),
    ],
)
def test_wrong_senders_are_counted(changes: dict[str, Any], says: str) -> None:
    box = mailbox()
    assert box.accept(ODOMETRY, payload_of(Odometry), 0)
    assert not box.accept(ODOMETRY, payload_of(Odometry, **changes), 0)
    assert box.dropped == {"sim/odometry:wrong_sender": 1}
    assert says in box.last_refusal
    held = box.inputs(0).latest(ODOMETRY)
    assert held is not None
    assert (held.epoch, held.sequence) == (2, 5)


def test_newer_sequences_and_new_lives_are_accepted() -> None:
    box = mailbox()
    for changes in ({}, {"sequence": 6}, {"epoch": 3, "sequence": 1}, {"epoch": 3, "sequence": 9}):
        assert box.accept(ODOMETRY, payload_of(Odometry, **changes), 0)
    assert not box.dropped


def test_damage_is_counted_by_kind() -> None:
    box = mailbox()
    payload = payload_of(Odometry)
    box.accept(ODOMETRY, payload[:-1] + bytes([payload[-1] ^ 1]), 0)
    box.accept(ODOMETRY, payload_of(PointCloud), 0)
    box.accept(ODOMETRY, b"", 0)
    box.accept(COMMAND, b"\x00" * (COMMAND.max_bytes + 1), 0)
    assert box.dropped == {
        "sim/odometry:bad_checksum": 1,
        "sim/odometry:unknown_schema": 1,
        "sim/odometry:malformed": 1,
        "status/command:too_large": 1,
    }
    assert box.inputs(0).latest(ODOMETRY) is None


def test_latest_only_and_keep_all() -> None:
    box = mailbox()
    for sequence in (1, 2, 3):
        box.accept(ODOMETRY, payload_of(Odometry, sequence=sequence), 0)
        box.accept(COMMAND, payload_of(MissionCommand, writer="status", sequence=sequence), 0)
    inputs = box.inputs(7)
    assert [received.sequence for received in inputs.new(ODOMETRY)] == [3]
    assert [received.sequence for received in inputs.new(COMMAND)] == [1, 2, 3]
    assert inputs.consumed == {"sim/odometry": (2, 3), "status/command": (2, 3)}
    box.stepped()
    assert box.inputs(7).new(COMMAND) == []
    assert box.inputs(7).latest(ODOMETRY) is not None


def test_age_makes_stale() -> None:
    box = mailbox()
    box.accept(ODOMETRY, payload_of(Odometry), 100)
    assert box.inputs(100 + ODOMETRY.stale_after_ns).current(ODOMETRY) is not None
    late = 101 + ODOMETRY.stale_after_ns
    assert box.inputs(late).current(ODOMETRY) is None
    assert box.inputs(late).latest(ODOMETRY) is not None
    assert box.missing(late) == ["sim/odometry", "sim/cloud"]
    assert box.missing(100) == ["sim/cloud"]


def test_a_service_may_write_its_own_topics_only() -> None:
    outbox = Outbox("husky1", "lcp", 1)
    with pytest.raises(ValueError, match="belongs to mission"):
        outbox.pack(Output(MISSION, example(MISSION.message)), 0, {})


def test_sequences_count_by_topic() -> None:
    outbox = Outbox("husky1", "sim", 4)
    for sequence in (1, 2):
        payload = outbox.pack(Output(ODOMETRY, example(Odometry)), 9, {"reconciler/plan": (1, 2)})
        _, envelope = decode(payload, Odometry, LIMIT)
        assert envelope == Envelope("husky1", "sim", 4, sequence, 9, {"reconciler/plan": (1, 2)})
    _, envelope = decode(outbox.pack(Output(CLOUD, example(PointCloud)), 9, {}), PointCloud, LIMIT)
    assert envelope.sequence == 1


@pytest.mark.parametrize("ids", [[5, 1, 3], [1, 1, 3], [1, 3, 3]])
def test_keyframes_whose_ids_do_not_increase_are_refused_by_name(ids: list[int]) -> None:
    """irm bisects them: an order of its own would silently hang what was seen on other keyframes."""

    def change(body: Any) -> None:
        body["columns"]["keyframe_id"][2] = raw(ids, "<i8")

    with pytest.raises(ValueRangeError, match=r"pose_graph\.keyframe_id: entry \d is \d after \d"):
        decode(tampered(PoseGraph, change), PoseGraph, LIMIT)


def test_no_keyframes_and_gaps_between_their_ids_are_fine() -> None:
    none = PoseGraph(
        stamp_ns=1, revision=0, keyframe_id=np.zeros(0, np.int64), pose_in_map=np.zeros((0, 4)),
        covariance=np.zeros((0, 3)),
    )  # fmt: skip
    assert decode(encode(none, ENVELOPE), PoseGraph, LIMIT)[0].keyframe_id.size == 0

    def change(body: Any) -> None:
        body["columns"]["keyframe_id"][2] = raw([3, 40, 41], "<i8")

    decoded, _ = decode(tampered(PoseGraph, change), PoseGraph, LIMIT)
    assert decoded.keyframe_id.tolist() == [3, 40, 41]
