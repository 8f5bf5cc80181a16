"""What every test shares: a kernel cache, a Hypothesis profile, and the way to third-party data.

The environment is set at import time, before any test imports a kernel or matplotlib.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

_REPOSITORY = Path(__file__).resolve().parent.parent


def _writable(directory: Path) -> bool:
    """Whether a file can be made in `directory`, which is made if need be."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            return True
    except OSError:
        return False


def _prepare_environment() -> None:
    """Give compiled kernels and matplotlib a place to write, here and in every process that a test starts."""
    cache = Path(os.environ.get("PLGRIM_CACHE_DIR") or Path.home() / ".cache" / "plgrim")
    if not _writable(cache):  # numba refuses to compile cached kernels without a writable cache
        cache = Path(tempfile.gettempdir()) / f"plgrim-cache-{os.getuid()}"
    os.environ["PLGRIM_CACHE_DIR"] = str(cache)
    os.environ.setdefault("MPLCONFIGDIR", str(cache / "matplotlib"))
    os.environ.setdefault("MPLBACKEND", "Agg")


_prepare_environment()

# No deadline: a first call compiles, and the machine is shared. Derandomised, so that a red run is red again.
settings.register_profile(
    "plgrim", deadline=None, derandomize=True, max_examples=60, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile(
    "thorough", parent=settings.get_profile("plgrim"), derandomize=False, max_examples=1000
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "plgrim"))


@pytest.fixture(scope="session")
def third_party_data() -> Callable[[str], Path]:
    """Path of a third-party file by its name under the data folder, or a skip that names what is missing.

    The folder is `$PLGRIM_DATA_DIR`, else `shared/data` beside the clone. None of the data is part of the
    project: `third_party_data("maps2d/nav2_depot.yaml")`.
    """
    folder = Path(os.environ.get("PLGRIM_DATA_DIR") or _REPOSITORY.parent / "shared" / "data")

    def find(name: str) -> Path:
        path = folder / name
        if not path.exists():
            pytest.skip(f"third-party data {name} is not in {folder} (set PLGRIM_DATA_DIR)")
        return path

    return find
