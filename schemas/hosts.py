"""Addresses, as they stand in configurations: which of them leave this host."""

from __future__ import annotations

import ipaddress


def is_loopback(host: str) -> bool:
    """Whether a listening address can be reached from this host alone. Names other than `localhost` cannot tell."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]").partition("%")[0]).is_loopback
    except ValueError:
        return False
