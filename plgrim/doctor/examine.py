"""All that `plgrim doctor` looks at, in order."""

from __future__ import annotations

from pathlib import Path

from plgrim.config import Config
from plgrim.doctor import machine
from plgrim.doctor.certificates import certificates, page_certificate
from plgrim.doctor.finding import Finding
from plgrim.doctor.system import system
from plgrim.errors import PlgrimError
from plgrim.hosts import host_and_port
from plgrim.missions import status_address, status_page
from plgrim.status_client import get_json, tls_context


def examine(config: Config, listen_s: float) -> list[Finding]:
    """Findings about the machine, the certificates and the system that runs here, if one does."""
    found = [
        machine.cores(),
        machine.memory(),
        machine.disk(config),
        machine.clock(config),
        machine.kernels(),
    ]
    running, heard = system(config, listen_s)
    place = host_and_port(config.router.endpoint)
    if place is not None:
        found.append(
            machine.port("router port", *place, "the router's own" if running else "", "PLGRIM_ROUTER")
        )
    host, number = status_address(config)
    served = "serves the page" if _page_answers(config) else ""
    found.append(machine.port("status port", host, number, served, "PLGRIM_STATUS__PORT"))
    folder = str(getattr(config.router, "certificates", ""))
    if folder:
        found += certificates(Path(folder))
    elif config.router.client_endpoint.startswith(("tls/", "quic/")):
        mend = "name their folder with router.certificates; plgrim certs issue makes it"
        found.append(
            Finding("certificates", "error", "the endpoint wants TLS, and none are configured", mend)
        )
    page_file = str(config.status.get("tls_certificate_file") or "")
    if page_file:
        found += page_certificate(Path(page_file), Path(str(config.status.get("tls_key_file") or "")))
    return [*found, *heard]


def _page_answers(config: Config) -> bool:
    try:
        answer = get_json(f"{status_page(config)}healthz", tls_context(config))
    except (PlgrimError, OSError, ValueError):
        return False
    return bool(answer == {"status": "ok"})
