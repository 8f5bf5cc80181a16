"""The services by name. Imported only when asked for, so that a process loads its own stage and no other."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from plgrim.errors import ConfigError
from schemas.contract import Stage, StageSetup, StageSpec

STAGES = ("riskmap", "irm", "gcp", "lcp", "reconciler", "mission", "sim")
"""Services that are stages, in the order in which lock-step runs those that are due together."""


def stage_module(name: str) -> Any:
    """The module `services.<name>.stage`, which has SPEC, Config and create(config, setup)."""
    if name not in STAGES:
        raise KeyError(f"no stage {name!r}; there are {', '.join(STAGES)}")
    return importlib.import_module(f"services.{name}.stage")


def make_stage(name: str, options: Mapping[str, Any], setup: StageSetup) -> tuple[StageSpec, Stage]:
    """A stage and how to run it. options: its part of the configuration; unknown keys are refused."""
    module = stage_module(name)
    config = module.Config.model_validate(dict(options))
    stage: Stage = module.create(config, setup)
    return module.spec(config), stage


@contextmanager
def world_errors(name: str) -> Iterator[None]:
    """A world that cannot be built is the user's to mend: ConfigError, which no supervisor restarts."""
    if name != "sim":
        yield
        return
    worlds = importlib.import_module("services.sim.worlds")
    try:
        yield
    except worlds.WorldError as error:
        raise ConfigError(f"sim: {error}") from error


def check_world(config: Any) -> None:
    """Build the simulator's world once from its `Config`, to learn whether it can be. Raises ConfigError."""
    with world_errors("sim"):
        importlib.import_module("services.sim.worlds").build_world(config)
