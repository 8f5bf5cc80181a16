"""A small certificate authority in a folder, for mutual TLS between the hosts of a deployment.

    root (ca.pem, ca.key)
      issuer of one certificate: its key is used once and never kept
        cert.pem: the name of a process, as `gcp.base.husky1`

Zenoh knows no revocation lists. So every certificate has an issuer of its own, and a host trusts not the root but the
issuers of the certificates that are valid: `trusted.pem`. To revoke is to leave an issuer out, and the handshake then
fails. What has to be done: the new `trusted.pem` must reach the hosts (`plgrim certs trust`); the router reads it
again by itself, a stock zenohd when it is restarted.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import json
import os
import re
import tempfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from plgrim.errors import ConfigError

CERTIFICATE, KEY, TRUSTED = "cert.pem", "key.pem", "trusted.pem"
"""The files of a process: its certificate with the issuer's, its key (0600), the issuers that it trusts."""
_CA, _CA_KEY, _INDEX = "ca.pem", "ca.key", "issued.json"
_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}(\.[A-Za-z0-9_-]{1,32}){0,3}")
_NOT_BEFORE = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
"""A robot without a battery-backed clock may start at zero, and its processes must find one another all the same. That
a certificate has begun protects nothing: what bounds it are its end and `trusted.pem`."""


class CertificateError(ConfigError):
    """A certificate folder that cannot be used as asked."""


@dataclass(frozen=True, slots=True)
class Record:
    """One certificate that was issued. Times in ISO 8601, UTC. revoked: when, or empty."""

    name: str
    serial: str
    hosts: tuple[str, ...]
    valid_until: str
    revoked: str = ""

    def state(self, now: dt.datetime) -> str:
        """valid, expired or revoked."""
        if self.revoked:
            return "revoked"
        return "expired" if dt.datetime.fromisoformat(self.valid_until) <= now else "valid"


def utc_now() -> dt.datetime:
    """Wall time."""
    return dt.datetime.now(dt.UTC)


class Authority:
    """The authority in a folder: `ca.pem`, `ca.key` (0600), `issued.json`, `issuers/`. Keep it off robots and bases."""

    def __init__(self, folder: Path) -> None:
        """Open it. Raises CertificateError."""
        self.folder = folder
        try:
            self._certificate = x509.load_pem_x509_certificate((folder / _CA).read_bytes())
            key = serialization.load_pem_private_key((folder / _CA_KEY).read_bytes(), None)
        except (OSError, ValueError) as error:
            raise CertificateError(
                f"{folder}: no certificate authority ({error}): make one with `plgrim certs init {folder}`"
            ) from error
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise CertificateError(f"{folder / _CA_KEY}: not an elliptic curve key")
        self._key = key

    @classmethod
    def create(cls, folder: Path, days: float = 3650, now: dt.datetime | None = None) -> Authority:
        """Make a new one. Raises CertificateError when there is one already."""
        if (folder / _CA_KEY).exists():
            raise CertificateError(
                f"{folder}: there is a certificate authority already: choose another folder"
            )
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.chmod(0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        name = _name(f"PLGRIM {os.urandom(4).hex()}")
        builder = _builder(name, name, key, days, now or utc_now())
        certificate = _as_authority(builder, 1).sign(key, hashes.SHA256())
        write_private(folder / _CA_KEY, _key_pem(key))
        write_public(folder / _CA, _pem(certificate))
        write_public(folder / _INDEX, b"[]\n")
        return cls(folder)

    def records(self) -> list[Record]:
        """All certificates, in the order of issue. Raises CertificateError."""
        try:
            found = json.loads((self.folder / _INDEX).read_text(encoding="utf-8"))
            return [Record(**{**entry, "hosts": tuple(entry["hosts"])}) for entry in found]
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise CertificateError(f"{self.folder / _INDEX}: cannot be read: {error}") from error

    def issue(
        self,
        name: str,
        out: Path,
        hosts: Iterable[str] = (),
        days: float = 365,
        renew: bool = False,
        now: dt.datetime | None = None,
    ) -> Record:
        """Write `cert.pem`, `key.pem` and `trusted.pem` of a new certificate into `out`.

        hosts: DNS names and addresses under which others connect to this process; none for one that only connects.
        renew: revoke the valid certificates of that name. Raises CertificateError.
        """
        now = now or utc_now()
        if _NAME.fullmatch(name) is None:
            raise CertificateError(
                f"{name!r} is no name for a certificate: letters, digits, - and _, parted by dots"
            )
        same = [record for record in self.records() if record.name == name and record.state(now) == "valid"]
        if same and not renew:
            raise CertificateError(f"{name} has a valid certificate: revoke it first, or issue with --renew")
        issuer_key, key = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
        issuer_name = _name(f"PLGRIM issuer {os.urandom(8).hex()}")
        issuer = _as_authority(
            _builder(issuer_name, self._certificate.subject, issuer_key, days, now), 0
        ).sign(self._key, hashes.SHA256())
        names = _alternative_names(hosts)
        leaf = _as_leaf(_builder(_name(name), issuer_name, key, days, now), names).sign(
            issuer_key, hashes.SHA256()
        )
        record = Record(name, f"{leaf.serial_number:x}", tuple(hosts), _iso(leaf.not_valid_after_utc))
        issuers = self.folder / "issuers"
        issuers.mkdir(exist_ok=True)
        write_public(issuers / f"{record.serial}.pem", _pem(issuer))
        self._write([*(replace(r, revoked=_iso(now)) if r in same else r for r in self.records()), record])
        out.mkdir(parents=True, exist_ok=True)
        write_private(out / KEY, _key_pem(key))
        write_public(out / CERTIFICATE, _pem(leaf) + _pem(issuer))
        self.trust(out, now)
        return record

    def revoke(self, name: str, now: dt.datetime | None = None) -> list[Record]:
        """Revoke the valid certificates of a name. Raises CertificateError when there is none."""
        now = now or utc_now()
        records = self.records()
        found = [record for record in records if record.name == name and record.state(now) == "valid"]
        if not found:
            raise CertificateError(f"{name} has no valid certificate: see `plgrim certs list {self.folder}`")
        self._write([replace(r, revoked=_iso(now)) if r in found else r for r in records])
        return found

    def trusted(self, now: dt.datetime | None = None) -> bytes:
        """The issuers of the valid certificates, PEM."""
        now = now or utc_now()
        valid = [record for record in self.records() if record.state(now) == "valid"]
        return b"".join((self.folder / "issuers" / f"{r.serial}.pem").read_bytes() for r in valid)

    def trust(self, out: Path, now: dt.datetime | None = None) -> list[Path]:
        """Renew `trusted.pem` in a folder, or in the folders below it that have one. Gives the files written."""
        folders = [path.parent for path in sorted(out.rglob(TRUSTED))] or [out]
        for folder in folders:
            write_public(folder / TRUSTED, self.trusted(now))
        return [folder / TRUSTED for folder in folders]

    def _write(self, records: list[Record]) -> None:
        text = json.dumps([asdict(record) for record in records], indent=1)
        write_public(self.folder / _INDEX, text.encode() + b"\n")


def common_name(path: Path) -> str:
    """The name in a certificate. Raises CertificateError."""
    try:
        subject = x509.load_pem_x509_certificate(path.read_bytes()).subject
        return str(subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
    except (OSError, ValueError, IndexError) as error:
        raise CertificateError(f"{path}: no certificate: {error}") from error


def check_private(path: Path) -> None:
    """Refuse a key that others may read. Raises CertificateError."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise CertificateError(f"{path}: the key cannot be read: {error.strerror}") from error
    if mode & 0o077:
        raise CertificateError(f"{path}: others may read this key: chmod 600 {path}")


def write_private(path: Path, content: bytes) -> None:
    """Write a file for its owner alone, in one go."""
    _write_atomically(path, content, 0o600)


def write_public(path: Path, content: bytes) -> None:
    """Write a file that all may read, in one go: a reader sees the old or the new one."""
    _write_atomically(path, content, 0o644)


def _write_atomically(path: Path, content: bytes, mode: int) -> None:
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(handle, "wb") as file:  # mkstemp makes it 0600
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, mode)
        os.replace(temporary, path)
    except OSError as error:
        raise CertificateError(f"{path}: cannot be written: {error.strerror}") from error


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _iso(moment: dt.datetime) -> str:
    return moment.replace(microsecond=0).isoformat()


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, days: float, now: dt.datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, _NOT_BEFORE))
        .not_valid_after(now + dt.timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _usage(signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _as_authority(builder: x509.CertificateBuilder, path_length: int) -> x509.CertificateBuilder:
    constraints = x509.BasicConstraints(ca=True, path_length=path_length)
    return builder.add_extension(constraints, critical=True).add_extension(_usage(True), critical=True)


def _as_leaf(builder: x509.CertificateBuilder, names: list[x509.GeneralName]) -> x509.CertificateBuilder:
    """Of a process: it may listen only under names that it has."""
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if names else [])]
    builder = (
        builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    )
    return builder.add_extension(x509.SubjectAlternativeName(names), critical=False) if names else builder


def _alternative_names(hosts: Iterable[str]) -> list[x509.GeneralName]:
    names: list[x509.GeneralName] = []
    for host in hosts:
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(host)))
        except ValueError:
            if re.fullmatch(r"[A-Za-z0-9*]([A-Za-z0-9.-]{0,252})", host) is None:
                raise CertificateError(f"{host!r} is neither a DNS name nor an address") from None
            names.append(x509.DNSName(host))
    return names
