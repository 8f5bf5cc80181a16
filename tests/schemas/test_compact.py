"""The compact form: the same message types back, bounded errors, bounded memory, nothing damaged accepted."""

from __future__ import annotations

import struct

import msgpack
import numpy as np
import pytest
import xxhash
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from schemas.base import Message, Pose, columns_of
from schemas.codec import decode, encode
from schemas.compact import PREFIX, RULES, compact, is_compact
from schemas.errors import (
    MalformedError,
    MessageError,
    ShapeError,
    TooLargeError,
    ValueRangeError,
)
from schemas.topics import RISK_MAP
from schemas.world import GridHeader, RiskMap
from tests.schemas.examples import ENVELOPE, MESSAGES, encoded

LIMIT = RISK_MAP.max_bytes
_LAYERS = ("hazard_mean", "hazard_variance", "hazard_cvar", "clearance_m", "elevation_m", "top_m")


def _risk_map(values: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> RiskMap:
    h, w = values.shape
    layers = {name: values if name in ("elevation_m", "top_m") else np.abs(values) for name in _LAYERS}
    grid = GridHeader(resolution_m=0.2, ix0=-3, iy0=4, width=w, height=h)
    state = np.ones((h, w), np.uint8)
    return RiskMap(stamp_ns=5, grid=grid, robot_pose=Pose(), footprint_radius_m=0.5, state=state, **layers)


def _signed(body: object) -> bytes:
    frame = zstandard.ZstdCompressor().compress(msgpack.packb(body))
    return PREFIX + xxhash.xxh3_64_digest(frame) + frame


def _body(small: bytes) -> dict[str, object]:
    body: dict[str, object] = msgpack.unpackb(zstandard.ZstdDecompressor().decompress(small[10:]))
    return body


@given(
    hnp.arrays(np.float32, (16, 16), elements=st.floats(-300.0, 300.0, width=32)),
    st.sampled_from([1e-6, 1e-3, 1.0, 300.0]),
)
def test_grids_come_back_within_the_bound(
    values: np.ndarray[tuple[int, ...], np.dtype[np.float32]], scale: float
) -> None:
    sent = _risk_map((values * np.float32(scale)).astype(np.float32))
    small = compact(encode(sent, ENVELOPE))
    got, envelope = decode(small, RiskMap, LIMIT)
    assert envelope == ENVELOPE
    assert got.grid == sent.grid
    assert np.array_equal(got.state, sent.state)
    for name, rule in RULES["risk_map"].items():
        before, after = getattr(sent, name).astype(np.float64), getattr(got, name).astype(np.float64)
        bound = np.vectorize(rule.bound, otypes=[float])(before) * 1.001 + np.abs(before) * 1e-6 + 1e-9
        assert (np.abs(after - before) <= bound).all(), name


def test_the_bounds_that_are_documented() -> None:
    for name in ("clearance_m", "elevation_m", "top_m"):
        assert RULES["risk_map"][name].bound(123.0) == pytest.approx(0.01)
    assert RULES["risk_map"]["hazard_cvar"].bound(1.0) == pytest.approx(0.02 * 1.001, rel=0.01)


def test_a_smooth_map_becomes_several_times_smaller() -> None:
    y, x = np.mgrid[0:200, 0:200] * 0.2
    rough = np.random.default_rng(1).normal(0.0, 0.02, (200, 200))
    payload = encode(_risk_map((np.sin(x / 5) + np.cos(y / 7) + rough).astype(np.float32)), ENVELOPE)
    small = compact(payload)
    assert is_compact(small)
    assert len(payload) > 5 * len(small)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.schema_name)
def test_every_message_comes_back_as_the_same_type(message: type[Message]) -> None:
    plain = encoded(message)
    wanted, _ = decode(plain, message, 1 << 20)
    got, envelope = decode(compact(plain), message, 1 << 20)
    assert envelope == ENVELOPE
    for name in columns_of(message):
        if name not in RULES.get(message.schema_name, {}):
            assert np.array_equal(getattr(got, name), getattr(wanted, name)), name


def test_small_messages_stay_as_they_are() -> None:
    for message in MESSAGES:
        plain = encoded(message)
        assert len(plain) >= 512 or compact(plain) == plain
        assert len(compact(plain)) <= len(plain)


@given(st.integers(0, 10_000), st.integers(1, 255))
def test_a_damaged_byte_is_never_accepted(at: int, flip: int) -> None:
    small = bytearray(compact(encode(_risk_map(np.zeros((16, 16), np.float32)), ENVELOPE)))
    small[at % len(small)] ^= flip
    with pytest.raises(MessageError):
        decode(bytes(small), RiskMap, LIMIT)


def test_cut_short_is_refused() -> None:
    small = compact(encode(_risk_map(np.zeros((16, 16), np.float32)), ENVELOPE))
    for size in (0, 1, 2, 9, 10, 11, len(small) - 1):
        with pytest.raises(MessageError):
            decode(small[:size], RiskMap, LIMIT)


def test_bombs_are_refused_before_anything_is_allocated() -> None:
    frame = zstandard.ZstdCompressor().compress(bytes(50_000_000))
    with pytest.raises(TooLargeError):
        decode(PREFIX + xxhash.xxh3_64_digest(frame) + frame, RiskMap, LIMIT)
    silent = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1_000_000))
    with pytest.raises(MalformedError):
        decode(PREFIX + xxhash.xxh3_64_digest(silent) + silent, RiskMap, LIMIT)
    body = _body(compact(encode(_risk_map(np.zeros((16, 16), np.float32)), ENVELOPE)))
    columns = body["columns"]
    assert isinstance(columns, dict)
    for name in _LAYERS:  # 3 MB each as bytes, 12 MB each when restored
        columns[name] = ["uint8", [1024, 3072], bytes(1024 * 3072), "linear", 0.0, 0.02]
    with pytest.raises(TooLargeError):
        decode(_signed(body), RiskMap, 40_000_000)


@pytest.mark.parametrize(
    ("column", "error"),
    [
        (["uint8", [4, 4], bytes(15), "linear", 0.0, 0.02], ShapeError),
        (["uint8", [-4, -4], bytes(16), "linear", 0.0, 0.02], ShapeError),
        (["uint8", [2] * 5, bytes(32), "linear", 0.0, 0.02], ShapeError),
        (["uint32", [2, 2], bytes(16), "linear", 0.0, 0.02], MalformedError),
        (["uint8", [4, 4], bytes(16), "cubic", 0.0, 0.02], MalformedError),
        (["uint8", [4, 4], bytes(16), "linear", float("nan"), 0.02], MalformedError),
        (["uint8", [4, 4], "text", "linear", 0.0, 0.02], MalformedError),
        (["uint16", [16, 16], b"\xff" * 512, "log", 1.0, 1e3], ValueRangeError),
    ],
)
def test_crafted_columns_are_refused_by_name(column: list[object], error: type[MessageError]) -> None:
    body = _body(compact(encode(_risk_map(np.zeros((16, 16), np.float32)), ENVELOPE)))
    columns = body["columns"]
    assert isinstance(columns, dict)
    columns["hazard_mean"] = column
    with pytest.raises(error):
        decode(_signed(body), RiskMap, LIMIT)


@given(st.binary(max_size=200))
def test_any_bytes_under_a_good_checksum_are_refused(content: bytes) -> None:
    frame = zstandard.ZstdCompressor().compress(content)
    with pytest.raises(MessageError):
        decode(PREFIX + struct.pack(">Q", xxhash.xxh3_64_intdigest(frame)) + frame, RiskMap, LIMIT)
