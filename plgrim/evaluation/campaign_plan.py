"""What a campaign consists of: worlds x variants x seeds, each a configuration of its own with an identity.

A variant is a part of a configuration that is laid over the base one; all variants meet the same worlds with the same
seeds, so that they can be compared in pairs.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import yaml

from plgrim.config import PAPER, Config, check_all, load_config
from plgrim.errors import ConfigError
from plgrim.registry import STAGES

Overlay = Mapping[str, Any]

_NO_K_RISK: Overlay = {
    "gcp": {"reward": {"k_risk": 0.0}},
    "lcp": {"weights": {"k_risk": 0.0}},
    "reconciler": {"weights": {"k_risk": 0.0}},
}

BUILT_IN_VARIANTS: Mapping[str, Overlay] = {
    "default": {},
    "paper": {"planner": "paper"},
    "uniform_rollouts": {"lcp": {"rollout_random": 1.0}},
    "single_moves": {"lcp": {"macros": False}},
    "best_frontier": {"gcp": PAPER["gcp"]},
    "qmdp": {"gcp": {"solver": "qmdp"}},
    "literal_tau": {"reconciler": PAPER["reconciler"]},
    "risk_neutral": {"riskmap": {"cvar_alpha": 0.0}, **_NO_K_RISK},
    "risk_blind": {"riskmap": {"risk_blind": True}, **_NO_K_RISK},
}
"""Variants by name that need no file. `paper`: the paper's plain planners; those after it: one difference alone, for
ablation. `risk_neutral`: k_rho = 0 in every planner, the mean instead of CVaR in the risk map; what is lethal stays so.
`risk_blind`: the same, and the risk map leaves out slope, step, roughness and drop, lethal ones too, and obstacles
below the knee."""

_NAME = re.compile(r"[A-Za-z0-9_.+-]{1,64}")
_FILE_KEYS = ("map_file", "mesh_file", "dem_file")
_ROOT = Path(__file__).resolve().parents[2]
_MOVES_THE_ROBOT = (
    "schemas", "planning", "services", "plgrim/runtime", "plgrim/config.py", "plgrim/registry.py", "plgrim/missions.py",
)  # fmt: skip


@dataclass(frozen=True)
class World:
    """A world by the name under which results are filed. sim: what the simulator is told to use.

    limit_s: mission time here; 0: that of the campaign.
    """

    name: str
    sim: Mapping[str, Any]
    limit_s: float = 0.0

    @classmethod
    def built_in(cls, name: str, limit_s: float = 0.0) -> World:
        """A built-in world; its shape follows the seed."""
        return cls(name, {"world": name}, limit_s)

    @classmethod
    def file(cls, key: str, path: Path) -> World:
        """A user's file. key: `map_file`, `mesh_file` or `dem_file`."""
        return cls(path.stem, {key: str(path.resolve())})


@dataclass(frozen=True)
class Variant:
    """A named part of a configuration, laid over the base one."""

    name: str
    overlay: Overlay

    @classmethod
    def parse(cls, text: str) -> Variant:
        """From `NAME` of a built-in variant, or `NAME=FILE.yaml`. Raises ConfigError."""
        name, separator, file = text.partition("=")
        if not _NAME.fullmatch(name):
            raise ConfigError(f"variant {text!r}: a name has letters, digits and ._+- only")
        if separator:
            return cls(name, read_overlay(Path(file)))
        if name not in BUILT_IN_VARIANTS:
            known = ", ".join(BUILT_IN_VARIANTS)
            raise ConfigError(
                f"variant {name!r} is not built in ({known}); give NAME=FILE.yaml for one of your own"
            )
        return cls(name, BUILT_IN_VARIANTS[name])


def read_overlay(path: Path) -> Overlay:
    """A part of a configuration from a YAML file. Raises ConfigError."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: cannot be read as YAML: {error}") from error
    if not isinstance(content, dict | None):
        raise ConfigError(f"{path}: expected sections and keys, found {type(content).__name__}")
    return content or {}


@dataclass(frozen=True)
class Run:
    """One mission of a campaign. limit_s: it is stopped after so much mission time; 0: not."""

    world: str
    variant: str
    seed: int
    config: Config
    limit_s: float = 0.0

    @property
    def name(self) -> str:
        """`world/variant/seed`: also its folder below `runs`."""
        return run_name(self.world, self.variant, self.seed)

    @property
    def budget_s(self) -> float:
        """Mission time that coverage curves are judged over; 0: no limit was set."""
        return self.limit_s or float(self.config.mission.get("time_budget_s", 0.0))

    @cached_property
    def identity(self) -> dict[str, Any]:
        """Everything that fixes the bytes of the run: code, options of every stage, seed, limit, files of the world."""
        options = {service: self.config.options(service) for service in STAGES}
        files = (options["sim"].get(key) for key in _FILE_KEYS)
        return {
            "code": code_version(),
            "robot": self.config.robot,
            "seed": self.seed,
            "limit_s": self.limit_s,
            "files": [file_hash(Path(path)) for path in files if path],
            **options,
        }

    @property
    def fingerprint(self) -> str:
        """Hash of the identity."""
        return hashlib.sha256(json.dumps(self.identity, sort_keys=True, default=str).encode()).hexdigest()[
            :16
        ]


@dataclass(frozen=True)
class Campaign:
    """Worlds x variants x seeds. The first variant is what the others are compared with.

    common: options that hold for every run and win over variants (robot profile, start).
    """

    worlds: Sequence[World]
    variants: Sequence[Variant]
    seeds: Sequence[int]
    limit_s: float = 0.0
    config_file: Path | None = None
    common: Overlay = field(default_factory=dict)

    def runs(self) -> list[Run]:
        """Every run, its configuration checked; seed by seed, so that pairs are complete early. Raises ConfigError."""
        _refuse_twice("world", [world.name for world in self.worlds])
        _refuse_twice("variant", [variant.name for variant in self.variants])
        return [
            Run(
                world.name,
                variant.name,
                seed,
                self._config(world, variant, seed),
                world.limit_s or self.limit_s,
            )
            for seed in self.seeds
            for world in self.worlds
            for variant in self.variants
        ]

    def _config(self, world: World, variant: Variant, seed: int) -> Config:
        own = {"seed": seed, "sim": {**dict.fromkeys(_FILE_KEYS), **world.sim}}
        config = load_config(self.config_file, merged(merged(variant.overlay, self.common), own))
        try:
            check_all(config)
        except ConfigError as error:
            raise ConfigError(f"variant {variant.name} in {world.name}: {error}") from error
        return config


def run_name(world: str, variant: str, seed: int) -> str:
    """What a run is called, and its folder below `runs`."""
    return f"{world}/{variant}/seed_{seed:03d}"


def _refuse_twice(what: str, names: Iterable[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise ConfigError(f"{what} {name!r} is given twice: results are filed by this name")
        seen.add(name)


def merged(base: Overlay, over: Overlay) -> dict[str, Any]:
    """Both, key by key at every depth; where both have a value, that of `over`."""
    found = dict(base)
    for key, value in over.items():
        below = found.get(key)
        found[key] = (
            merged(below, value) if isinstance(below, Mapping) and isinstance(value, Mapping) else value
        )
    return found


def parse_seeds(text: str) -> list[int]:
    """Seeds from `1-10`, `1,3,5` or a mixture, in this order and each once. Raises ConfigError."""
    found: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", part)
        if match is None:
            raise ConfigError(f"seeds {text!r}: expected such as 1-10 or 1,3,5")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ConfigError(f"seeds {text!r}: {part.strip()} runs backwards")
        if last - first >= 10_000:
            raise ConfigError(f"seeds {text!r}: {part.strip()} are more than 10,000")
        found += [seed for seed in range(first, last + 1) if seed not in found]
    return found


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Paths of keys in which two identities differ, with both values, sorted."""
    before, after = dict(_flat(old, "")), dict(_flat(new, ""))
    return [
        f"{key}: {before.get(key, '-')} -> {after.get(key, '-')}"
        for key in sorted({*before, *after})
        if before.get(key) != after.get(key)
    ]


def _flat(value: Any, path: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _flat(inner, f"{path}.{key}" if path else str(key))
    else:
        yield path, json.dumps(value, default=str)


@cache
def code_version() -> str:
    """Version of the package and hash of the sources that decide what the robot does; no git is needed."""
    digest = hashlib.sha256()
    for place in _MOVES_THE_ROBOT:
        path = _ROOT / place
        for source in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(source.relative_to(_ROOT).as_posix().encode() + source.read_bytes())
    try:
        version = importlib.metadata.version("plgrim")
    except importlib.metadata.PackageNotFoundError:
        version = "0"
    return f"{version}+{digest.hexdigest()[:12]}"


@cache
def file_hash(path: Path) -> str:
    """Of a world's file, with what a map's YAML file names. Raises ConfigError when it cannot be read."""
    try:
        content = path.read_bytes()
        if path.suffix in (".yaml", ".yml"):
            image = path.parent / str((yaml.safe_load(content) or {}).get("image", ""))
            content += image.read_bytes() if image.is_file() else b""
    except (OSError, yaml.YAMLError, AttributeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    return hashlib.sha256(content).hexdigest()[:16]
