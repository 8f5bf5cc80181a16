"""Messages made small for a radio: grids quantised, everything compressed (zstd).

`compact` turns the bytes of a message (`schemas.codec.encode`) into fewer; `schemas.codec.decode` takes either form
and gives the same message type. What is lost is bounded for each column by `RULES`; all other columns, the header and
the envelope come back as they were. Nothing larger than the topic allows is ever allocated.

Wire: two bytes, an unsigned 64-bit checksum (xxh3) of the rest, then one zstd frame that holds the body in msgpack.
A quantised column is `[dtype, shape, bytes, transform, offset, step]`.
"""

from __future__ import annotations

import math
import struct
from typing import Any, NamedTuple

import msgpack
import numpy as np
import xxhash
import zstandard
from numpy.typing import NDArray

from schemas.errors import ChecksumError, MalformedError, ShapeError, TooLargeError

PREFIX = b"\xc1Z"
"""0xc1 begins no msgpack object, so that no message in the plain form begins so."""
_HEAD_BYTES = 10
_SMALLEST_BYTES = 512
_LEVEL = 1
_MAX_AXES = 4
_LINEAR, _LOGARITHMIC = "linear", "log"


class Rule(NamedTuple):
    """How a column of float32 is quantised, and what that may cost.

    linear: `x = lowest + step q`; |error| <= step / 2. log: `x = offset (exp(step q) - 1)`, for x >= 0;
    |error| <= (exp(step / 2) - 1) (x + offset). q takes 8 bits where the range allows, else 16; a column that needs
    more is not quantised.
    """

    transform: str
    step: float
    offset: float = 0.0

    def bound(self, value: float) -> float:
        """Largest error at a value, without the rounding of float32."""
        if self.transform == _LINEAR:
            return self.step / 2
        return math.expm1(self.step / 2) * (abs(value) + self.offset)


_HAZARD = Rule(_LOGARITHMIC, step=0.0396, offset=1e-3)
RULES: dict[str, dict[str, Rule]] = {
    "risk_map": {
        "hazard_mean": _HAZARD,
        "hazard_cvar": _HAZARD,
        "hazard_variance": Rule(_LOGARITHMIC, step=0.0396, offset=1e-4),
        "clearance_m": Rule(_LINEAR, step=0.02),
        "elevation_m": Rule(_LINEAR, step=0.02),
        "top_m": Rule(_LINEAR, step=0.02),
    },
}
"""By schema and column. Hazards within 2 % and 0.00002 1/m (variance 0.000002 1/m2), lengths within 1 cm."""


def is_compact(payload: bytes) -> bool:
    """Whether the bytes are in the compact form."""
    return payload[:2] == PREFIX


def compact(payload: bytes, level: int = _LEVEL) -> bytes:
    """The compact form of an encoded message; as it was when it is small already or would not become smaller.

    payload: from `schemas.codec.encode`, of a message that is known to be good.
    """
    if len(payload) < _SMALLEST_BYTES or is_compact(payload):
        return payload
    body = msgpack.unpackb(memoryview(payload)[_HEAD_BYTES:], raw=False)
    columns = body["columns"]
    for name, rule in RULES.get(body["schema"], {}).items():
        if name in columns:
            columns[name] = _quantise(columns[name], rule)
    packed = msgpack.packb(body, use_bin_type=True)
    frame = zstandard.ZstdCompressor(level=level).compress(packed)
    small = PREFIX + struct.pack(">Q", xxhash.xxh3_64_intdigest(frame)) + frame
    return small if len(small) < len(payload) else payload


def restore_body(payload: bytes, max_bytes: int) -> dict[str, Any]:
    """The body of a compact message, with columns as in the plain form.

    max_bytes: of what may be allocated, restored columns included. Raises TooLargeError, ChecksumError,
    MalformedError, ShapeError.
    """
    view = memoryview(payload)
    if len(view) <= _HEAD_BYTES:
        raise MalformedError("compact message: cut short")
    (checksum,) = struct.unpack(">Q", view[2:_HEAD_BYTES])
    frame = bytes(view[_HEAD_BYTES:])
    if xxhash.xxh3_64_intdigest(frame) != checksum:
        raise ChecksumError("checksum does not match the content")
    body = _unpack(_decompress(frame, max_bytes))
    columns = body.get("columns")
    if isinstance(columns, dict):
        left = max_bytes - sum(_restored_bytes(c) for c in columns.values())
        if left < 0:
            raise TooLargeError(f"columns would take {-left} bytes more than the {max_bytes} allowed")
        body["columns"] = {name: _restore(str(name), c) for name, c in columns.items()}
    return body


def _decompress(frame: bytes, max_bytes: int) -> bytes:
    try:
        size = zstandard.frame_content_size(frame)
        if size > max_bytes:
            raise TooLargeError(f"{size} bytes when restored, at most {max_bytes} allowed")
        if size <= 0:
            raise MalformedError("compact message: the frame does not say its size")
        return zstandard.ZstdDecompressor().decompress(frame, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise MalformedError(f"compact message: {error}") from error


def _unpack(packed: bytes) -> dict[str, Any]:
    try:
        body = msgpack.unpackb(packed, raw=False, strict_map_key=True)
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        raise MalformedError(f"not msgpack: {error}") from error
    if not isinstance(body, dict):
        raise MalformedError("the body is not a map")
    return body


def _quantise(column: list[Any], rule: Rule) -> list[Any]:
    """A float32 column as numbers of 8 or 16 bits; as it was when it is empty or its range is too large."""
    name, shape, raw = column
    values: NDArray[np.float64] = np.frombuffer(raw, "<f4").astype(np.float64)
    if name != "float32" or values.size == 0:
        return column
    offset = float(values.min()) if rule.transform == _LINEAR else rule.offset
    steps = np.rint(
        (values - offset) / rule.step
        if rule.transform == _LINEAR
        else np.log1p(values / rule.offset) / rule.step
    )
    largest = float(steps.max())
    if largest > 65535:
        return column
    kind = "uint8" if largest <= 255 else "uint16"
    packed = steps.astype(np.dtype(kind).newbyteorder("<")).tobytes()
    return [kind, shape, packed, rule.transform, offset, rule.step]


def _restored_bytes(column: Any) -> int:
    """Bytes that restoring a quantised column allocates; 0 for every other."""
    if not (isinstance(column, list) and len(column) == 6 and isinstance(column[2], bytes)):
        return 0
    return 4 * len(column[2]) // (1 if column[0] == "uint8" else 2)


def _restore(label: str, column: Any) -> Any:
    if not (isinstance(column, list) and len(column) == 6):
        return column
    kind, shape, raw, transform, offset, step = column
    if kind not in ("uint8", "uint16") or transform not in (_LINEAR, _LOGARITHMIC):
        raise MalformedError(f"{label}: {kind!r}, {transform!r} is no quantised column")
    if not isinstance(raw, bytes) or not all(
        isinstance(v, float) and math.isfinite(v) for v in (offset, step)
    ):
        raise MalformedError(f"{label}: bytes, offset or step missing")
    dtype = np.dtype(kind).newbyteorder("<")
    if not _is_shape(shape) or math.prod(shape) * dtype.itemsize != len(raw):
        raise ShapeError(f"{label}: {len(raw)} bytes do not fit the shape {shape!r}")
    steps = np.frombuffer(raw, dtype).astype(np.float32) * np.float32(step)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused with the other columns
        values = steps + np.float32(offset) if transform == _LINEAR else np.expm1(steps) * np.float32(offset)
    return ["float32", shape, values.astype("<f4").tobytes()]


def _is_shape(shape: Any) -> bool:
    return (
        isinstance(shape, list)
        and len(shape) <= _MAX_AXES
        and all(isinstance(size, int) and size >= 0 for size in shape)
    )
