"""What every message is made of: a frozen header, and array columns with a declared type, shape and range."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, ClassVar, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from schemas.errors import ShapeError, ValueRangeError

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class ColumnSpec:
    """Declares an array column.

    dtype: numpy name, little endian on the wire. shape: one entry an axis: an int, the name of an integer field of
    the header, or a free name that must be equal wherever it stands in the message. minimum, maximum: range of
    every element (None: no bound). Elements are always finite.
    """

    dtype: str
    shape: tuple[int | str, ...]
    minimum: float | None = None
    maximum: float | None = None


def column(
    dtype: str, *shape: int | str, minimum: float | None = None, maximum: float | None = None
) -> ColumnSpec:
    """Short form of `ColumnSpec`, for use in `Annotated[Array, column(...)]`."""
    return ColumnSpec(dtype, shape, minimum, maximum)


class Header(BaseModel):
    """A frozen pydantic model that refuses unknown keys and numbers that are not finite."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
        ser_json_bytes="base64",
    )


class Message(Header):
    """A message: subclasses set `schema_name` and `schema_version` and declare header fields and columns."""

    schema_name: ClassVar[str] = ""
    schema_version: ClassVar[int] = 1

    stamp_ns: int = Field(ge=0, description="Mission clock when the content was true, ns.")

    @model_validator(mode="after")
    def _check_columns(self) -> Message:
        bound: dict[str, int] = {}
        for name, spec in columns_of(type(self)).items():
            _check_column(self, name, spec, bound)
        return self


@cache
def columns_of(message: type[Message]) -> dict[str, ColumnSpec]:
    """The array columns of a message class by field name, in the order of declaration."""
    found: dict[str, ColumnSpec] = {}
    for name, hint in get_type_hints(message, include_extras=True).items():
        for extra in get_args(hint)[1:]:
            if isinstance(extra, ColumnSpec):
                found[name] = extra
    return found


def _check_column(message: Message, name: str, spec: ColumnSpec, bound: dict[str, int]) -> None:
    array = getattr(message, name)
    label = f"{message.schema_name}.{name}"
    if not isinstance(array, np.ndarray) or array.dtype != np.dtype(spec.dtype):
        got = getattr(array, "dtype", type(array).__name__)
        raise ShapeError(f"{label}: type {got}, expected an array of {spec.dtype}")
    if array.ndim != len(spec.shape):
        raise ShapeError(f"{label}: {array.ndim} axes, expected {len(spec.shape)}")
    for axis, (size, wanted) in enumerate(zip(array.shape, spec.shape, strict=True)):
        if isinstance(wanted, str):
            header = getattr(message, wanted, None)
            wanted = header if isinstance(header, int) else bound.setdefault(wanted, size)
        if size != wanted:
            raise ShapeError(f"{label}: axis {axis} has {size} entries, expected {wanted}")
    _check_range(label, array, spec)


def _check_range(label: str, array: Array, spec: ColumnSpec) -> None:
    if array.size == 0:
        return
    if array.dtype.kind == "f":
        low, high = float(array.min()), float(array.max())
        if not (np.isfinite(low) and np.isfinite(high)):
            raise ValueRangeError(f"{label}: holds numbers that are not finite")
    elif spec.minimum is None and spec.maximum is None:
        return
    else:
        low, high = int(array.min()), int(array.max())
    if spec.minimum is not None and low < spec.minimum:
        raise ValueRangeError(f"{label}: {low} is below {spec.minimum}")
    if spec.maximum is not None and high > spec.maximum:
        raise ValueRangeError(f"{label}: {high} is above {spec.maximum}")


class Pose(Header):
    """A pose (REP-103): metres and radians, z up, yaw counter-clockwise from x; the frame is the field's."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    yaw_rad: float = 0.0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0


F32Points = Annotated[Array, column("float32", "n", 3)]
