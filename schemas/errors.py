"""What can be wrong with a message: one exception tree, one short reason a kind (the reasons are counted)."""

from __future__ import annotations


class MessageError(Exception):
    """A message that must not be used. `reason` is the name that drop counters carry."""

    reason = "invalid"


class MalformedError(MessageError):
    """The bytes are not a message at all, or a field is missing, unknown or of the wrong type."""

    reason = "malformed"


class TooLargeError(MessageError):
    """More bytes than the topic allows; nothing was parsed."""

    reason = "too_large"


class ChecksumError(MessageError):
    """The content is not what was sent."""

    reason = "bad_checksum"


class UnknownSchemaError(MessageError):
    """A schema that this program does not know, or not the one of the topic."""

    reason = "unknown_schema"


class UnknownVersionError(MessageError):
    """A version of the schema that this program does not read."""

    reason = "unknown_version"


class WrongSenderError(MessageError):
    """Another robot's message, or a writer that does not own the topic."""

    reason = "wrong_sender"


class ValueRangeError(MessageError):
    """A number that is not finite, or out of its range."""

    reason = "out_of_range"


class ShapeError(MessageError):
    """An array of another type or shape than the schema says."""

    reason = "wrong_shape"
