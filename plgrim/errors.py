"""What can go wrong when the program is started: one exception tree, each kind with its exit code."""

from __future__ import annotations


class PlgrimError(Exception):
    """An error that the user can mend; the text says how. `exit_code` is what the process ends with."""

    exit_code = 1


class ConfigError(PlgrimError):
    """A configuration that names an unknown key or holds a value out of its range."""

    exit_code = 2


class AlreadyRunningError(PlgrimError):
    """A second instance of a service was started for the same robot."""

    exit_code = 3


class PortTakenError(PlgrimError):
    """Another program listens on the port."""

    exit_code = 4


class NoRouterError(PlgrimError):
    """No Zenoh router answered in time."""

    exit_code = 5


class ServiceFailedError(PlgrimError):
    """A service could not be started, or crashed more often than the budget allows."""

    exit_code = 6


class JournalError(PlgrimError):
    """A journal cannot be written: no space, no permission."""

    exit_code = 7


class NoAnswerError(PlgrimError):
    """A command was sent and nobody answered; whether it was carried out is not known."""

    exit_code = 8


class CommandRefusedError(PlgrimError):
    """The mission refused a command; the text is its reason."""

    exit_code = 1


class ExplorerInputError(PlgrimError, ValueError):
    """A grid, a cloud or a pose that the `Explorer` cannot use; the text names the field."""

    exit_code = 2


FATAL_EXIT_CODES = frozenset(
    error.exit_code for error in (ConfigError, AlreadyRunningError, PortTakenError, JournalError)
)
"""Exit codes of a service that a restart cannot mend."""
