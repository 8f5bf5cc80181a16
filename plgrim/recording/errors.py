"""What can be wrong with a recording."""

from __future__ import annotations

from plgrim.errors import PlgrimError


class RecordingError(PlgrimError):
    """A recording that cannot be read, or holds nothing that can be used; the text says which file and why."""

    exit_code = 2
