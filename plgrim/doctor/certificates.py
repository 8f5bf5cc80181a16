"""Certificates: there, readable by their owner alone, of the right authority's time, not about to end."""

from __future__ import annotations

import datetime as dt
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

from plgrim.doctor.finding import Finding

_SOON_DAYS = 14


def certificates(folder: Path) -> list[Finding]:
    """Of a folder with `cert.pem` and `key.pem`, or of such folders (`plgrim certs issue` makes them)."""
    found = sorted({path.parent for path in folder.rglob("cert.pem")})
    if not found:
        mend = "plgrim certs init, then plgrim certs issue; or correct router.certificates"
        return [Finding("certificates", "error", f"no cert.pem in {folder}", mend)]
    findings = [finding for place in found for finding in _of(place, folder)]
    bad = [finding for finding in findings if finding.level != "ok"]
    return bad or [Finding("certificates", "ok", f"{len(found)} in {folder}, keys private, none ends soon")]


def page_certificate(file: Path, key: Path) -> list[Finding]:
    """Of the status page's HTTPS: the certificate's dates, and that others cannot read its key."""
    name = "page certificate"
    renew = "issue it anew, or correct status.tls_certificate_file and status.tls_key_file"
    found = [replace(one, mend=one.mend and renew) for one in [_expiry(name, file)]]
    if not key.is_file():
        found.append(Finding(name, "error", f"status.tls_key_file: {key} is missing", renew))
    elif key.stat().st_mode & 0o077:
        mode = oct(key.stat().st_mode & 0o777)[2:]
        found.append(Finding(name, "error", f"others may read {key} (mode {mode})", f"chmod 600 {key}"))
    return found


def _of(place: Path, folder: Path) -> list[Finding]:
    name = f"certificate {place.relative_to(folder).as_posix()}" if place != folder else "certificate"
    found = [_expiry(name, place / "cert.pem")]
    key = place / "key.pem"
    if not key.exists():
        found.append(Finding(name, "error", f"{key} is missing", "plgrim certs issue"))
    elif key.stat().st_mode & 0o077:
        mode = oct(key.stat().st_mode & 0o777)[2:]
        found.append(Finding(name, "error", f"others may read {key} (mode {mode})", f"chmod 600 {key}"))
    if not (place / "trusted.pem").exists():
        found.append(Finding(name, "error", f"{place / 'trusted.pem'} is missing", "plgrim certs issue"))
    return found


def _expiry(name: str, path: Path) -> Finding:
    begins, ends = _dates(path)
    now = dt.datetime.now(dt.UTC)
    if ends is None or begins is None:
        return Finding(name, "error", f"{path} is no certificate", "plgrim certs issue")
    if begins > now:
        return Finding(
            name, "error", f"not valid before {begins:%Y-%m-%d %H:%M} UTC", "set this host's clock"
        )
    days = (ends - now).days
    if ends <= now:
        return Finding(name, "error", f"ended on {ends:%Y-%m-%d}", "plgrim certs issue")
    if days < _SOON_DAYS:
        return Finding(name, "warning", f"ends in {days} days, on {ends:%Y-%m-%d}", "plgrim certs issue")
    return Finding(name, "ok", f"until {ends:%Y-%m-%d}")


def _dates(path: Path) -> tuple[dt.datetime | None, dt.datetime | None]:
    """From and until when a certificate holds; by the cryptography package, else by the openssl program."""
    try:
        from cryptography import x509
    except ImportError:
        return _dates_by_openssl(path)
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError):
        return None, None
    return certificate.not_valid_before_utc, certificate.not_valid_after_utc


def _dates_by_openssl(path: Path) -> tuple[dt.datetime | None, dt.datetime | None]:
    program = shutil.which("openssl")
    if program is None:
        return None, None
    command = [program, "x509", "-in", str(path), "-noout", "-startdate", "-enddate"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = dict(line.split("=", 1) for line in answer.stdout.splitlines() if "=" in line)
    try:
        begins, ends = (
            dt.datetime.strptime(lines[key], "%b %d %H:%M:%S %Y %Z").replace(tzinfo=dt.UTC)
            for key in ("notBefore", "notAfter")
        )
    except (KeyError, ValueError):
        return None, None
    return begins, ends
