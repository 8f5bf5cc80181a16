"""What can be wrong with an input file."""

from __future__ import annotations

from plgrim.errors import PlgrimError


class FeedError(PlgrimError):
    """A file that cannot be used as input; the text names the file, the place in it, and the mend."""

    exit_code = 7


class StackedFloorsError(FeedError):
    """Floors above one another: the belief has one layer."""
