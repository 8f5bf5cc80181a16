"""A certificate authority and the certificates of one host, made once; routers and sessions that use them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from plgrim.deployment import ROLES, Role, processes_of
from plgrim.security.access import ROUTER, certificate_name
from plgrim.security.certificates import Authority
from plgrim.security.policy import FROM_ROBOT
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
def certificates_by_role(authority: Authority, tmp_path_factory: pytest.TempPathFactory) -> dict[Role, Path]:
    """A folder for each kind of host; the routers are known as 127.0.0.1; the robot's link has one for both."""
    folders = {role: tmp_path_factory.mktemp(f"certs-{role}") for role in ROLES}
    for role, folder in folders.items():
        for process in processes_of(role):
            hosts = ("127.0.0.1",) if process == ROUTER else ()
            authority.issue(certificate_name(process, role, ROBOT), folder / process, hosts)
    for known_as, process in FROM_ROBOT.items():
        shutil.copytree(folders["robot"] / process, folders["base"] / known_as)
    for folder in folders.values():
        authority.trust(folder)
    return folders


@pytest.fixture(scope="session")
def certificates(certificates_by_role: dict[Role, Path]) -> Path:
    """Of a host on which everything runs."""
    return certificates_by_role["all"]
