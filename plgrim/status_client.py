"""Asks this configuration's status service over HTTP or HTTPS, as the programs of its own host do."""

from __future__ import annotations

import json
import ssl
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

from plgrim.config import Config
from plgrim.errors import ConfigError, PlgrimError
from services.status.security import HASHED

_TIMEOUT_S = 5.0


class StatusRefusedError(PlgrimError):
    """The status service answers, and wants a token, or another one."""


def tls_context(config: Config) -> ssl.SSLContext | None:
    """What to trust when asking over HTTPS: the service's own certificate, by itself; None when it serves HTTP.

    The name is not compared: the address is this host's, the certificate is for those that come from elsewhere.
    Raises OSError when it cannot be read.
    """
    certificate = str(config.status.get("tls_certificate_file") or "")
    if not certificate:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # itself is trusted, not its issuer
    context.load_verify_locations(cafile=certificate)
    return context


def secret_of(file: Path) -> str:
    """The first secret in a file of tokens (`status.tokens_file`), or the only word in it. Raises ConfigError."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: the token cannot be read: {error}") from error
    rows = [line.split("#")[0].split() for line in lines]
    secrets = [row[-1] for row in rows if len(row) in (1, 3) and not row[-1].startswith(HASHED)]
    if not secrets:
        raise ConfigError(f"{file}: holds no token, only hashes: give a file with the secret by --token-file")
    return secrets[0]


def own_secret(config: Config) -> str:
    """A secret of the service's own file of tokens, when this user may read it and it holds one; else empty."""
    file = str(config.status.get("tokens_file") or "")
    try:
        return secret_of(Path(file)) if file else ""
    except ConfigError:
        return ""


def get_json(address: str, context: ssl.SSLContext | None = None, secret: str = "") -> Any:
    """The JSON at an address. Raises StatusRefusedError, OSError and ValueError."""
    headers = {"Authorization": f"Bearer {secret}"} if secret else {}
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S, context=context) as response:
            return json.load(response)
    except urllib.error.HTTPError as error:
        with error:
            if error.code not in (401, 403):
                raise
            said = _detail(error)
        mend = "name a file with a token by --token-file"
        raise StatusRefusedError(f"{address}: {said}; {mend}") from error


def _detail(error: urllib.error.HTTPError) -> str:
    try:
        return str(json.load(error)["detail"])
    except (ValueError, KeyError, TypeError):
        return f"refused ({error.code})"
