"""What a configuration may expose: beyond this host nothing without mutual TLS. Checked before anything listens."""

from __future__ import annotations

from pathlib import Path

from plgrim.config import Config, RouterConfig, check_service
from plgrim.errors import ConfigError
from plgrim.hosts import SECURE, is_local, options, protocol
from plgrim.security.access import TOOLS
from plgrim.security.certificates import CERTIFICATE, KEY, TRUSTED, CertificateError, check_private
from schemas.hosts import is_loopback
from schemas.topics import LINK
from services.status.config import Config as StatusConfig

_HARMLESS_OPTIONS = frozenset({"so_sndbuf", "so_rcvbuf", "iface", "bind", "dscp"})
"""Of endpoints. Zenoh takes all others there too, over its configuration: `#enable_mtls=false` lets anybody in."""
_PLAIN = (
    "and has no TLS: strangers on that network could read the maps and drive the robot. Use a tls/ endpoint with "
    "router.certificates (`plgrim certs issue` makes them), or stay on 127.0.0.1"
)


class ExposedError(ConfigError):
    """A configuration that would open a port, or make a connection, beyond this host without TLS."""


def check_router(config: Config) -> None:
    """Refuse a router that listens beyond this host without TLS. Raises ExposedError, CertificateError."""
    router = config.router
    for name, endpoint in (("endpoint", router.endpoint), *(("listen", one) for one in router.listen)):
        _check_options(f"router.{name}", endpoint)
        if not is_safe(endpoint, config.deployment.private_network):
            raise ExposedError(f"router.{name}: {endpoint} can be reached from other hosts {_PLAIN}")
    if any(protocol(endpoint) in SECURE for endpoint in (router.endpoint, *router.listen)):
        certificate_folder(router, "router")


def check_client(config: Config, process: str = TOOLS) -> None:
    """Refuse a connection to another host's router without TLS. Raises ExposedError, CertificateError."""
    endpoint = config.router.client_endpoint
    key = "connect" if config.router.connect else "endpoint"
    _check_options(f"router.{key}", endpoint)
    if not is_safe(endpoint, config.deployment.private_network):
        raise ExposedError(f"router.{key}: {endpoint} leaves this host {_PLAIN}")
    if protocol(endpoint) in SECURE:
        certificate_folder(config.router, process)


def check_link(config: Config) -> None:
    """Refuse a link to the base without TLS. Raises ExposedError, CertificateError."""
    _check_options("link.endpoint", config.link.endpoint)
    if not is_safe(config.link.endpoint, config.deployment.private_network):
        raise ExposedError(f"link.endpoint: {config.link.endpoint} leaves this host {_PLAIN}")
    if protocol(config.link.endpoint) in SECURE:
        certificate_folder(config.router, LINK)


def check_listen(host: str, config: Config) -> None:
    """Refuse an address for a server without TLS and tokens that others can reach. Raises ExposedError."""
    if not (is_loopback(host) or config.deployment.private_network):
        raise ExposedError(
            f"--host {host}: can be reached from other hosts, and there is neither TLS nor a token: whoever comes "
            "reads maps and plans. Stay on 127.0.0.1; from another computer: ssh -L 8765:127.0.0.1:8765 HOST"
        )


def check_host(config: Config) -> None:
    """Refuse, before anything starts, whatever of this host's processes would refuse. Raises ExposedError."""
    check_router(config)
    if config.link.host == "robot" and config.link.endpoint:
        check_link(config)
    status = check_service(config, "status")
    if isinstance(status, StatusConfig) and (reason := status.exposed()):
        raise ExposedError(reason)


def _check_options(key: str, endpoint: str) -> None:
    for name in options(endpoint):
        if name not in _HARMLESS_OPTIONS:
            raise ExposedError(
                f"{key}: {endpoint}: the option {name} could take the protection away; allowed behind an endpoint are "
                f"{', '.join(sorted(_HARMLESS_OPTIONS))}"
            )


def is_safe(endpoint: str, private_network: bool) -> bool:
    """Whether an endpoint has TLS, or no stranger on its way."""
    return protocol(endpoint) in SECURE or is_local(endpoint) or private_network


def certificate_folder(router: RouterConfig, process: str) -> Path:
    """The folder with the certificate, key and trusted issuers of a process. Raises CertificateError."""
    if not router.certificates:
        raise CertificateError(
            "router.certificates: an endpoint with TLS needs the folder of the certificates: `plgrim certs issue`"
        )
    root = Path(router.certificates)
    folder = root if (root / CERTIFICATE).is_file() else root / process
    for name in (CERTIFICATE, KEY, TRUSTED):
        if not (folder / name).is_file():
            raise CertificateError(
                f"router.certificates: {folder / name} is missing or cannot be read: make it with `plgrim certs issue`"
            )
    check_private(folder / KEY)
    return folder
