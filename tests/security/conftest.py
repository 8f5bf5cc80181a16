"""A certificate authority and the certificates of one host, made once; routers and sessions that use them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from plgrim.security.access import ROUTER, TOOLS, certificate_name, writers
from plgrim.security.certificates import Authority
from tests.runtime.helpers import REPOSITORY

ROBOT = "husky1"


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("PLGRIM_")]:
        if name not in ("PLGRIM_CACHE_DIR", "PLGRIM_DATA_DIR"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))


@pytest.fixture(scope="session")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority.create(tmp_path_factory.mktemp("ca"))


@pytest.fixture(scope="session")
def certificates(authority: Authority, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a host on which everything runs; the router is known as 127.0.0.1."""
    folder = tmp_path_factory.mktemp("certs")
    for process in (ROUTER, *writers(), TOOLS):
        hosts = ("127.0.0.1",) if process == ROUTER else ()
        authority.issue(certificate_name(process, "all", ROBOT), folder / process, hosts)
    authority.trust(folder)
    return folder
