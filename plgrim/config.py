"""The configuration: one optional YAML or TOML file, `PLGRIM_...` in the environment, options of the command line.

Later ones win: defaults, file, environment, command line. A key that no section knows is refused at any depth, with
the file (or variable), the path of the key and the nearest key there is. `PLGRIM_SIM__LIDAR__RINGS=8` sets
`sim.lidar.rings`; `PLGRIM_ROUTER`, `PLGRIM_SPEED` and `PLGRIM_CLOCK_ORIGIN_NS` are short for `router.endpoint`,
`clock.speed` and `clock.origin_ns`.
"""

from __future__ import annotations

import importlib
import os
import tomllib
from collections.abc import Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict

from planning.robot_profile import PROFILES
from plgrim.config_keys import check_env_name, check_keys, describe
from plgrim.errors import ConfigError
from plgrim.link.config import LinkConfig
from plgrim.registry import STAGES
from schemas.hosts import is_loopback

PREFIX = "PLGRIM_"
_FILE: ContextVar[str] = ContextVar("configuration_file", default="")
_SHORT = {"ROUTER": "router.endpoint", "SPEED": "clock.speed", "CLOCK_ORIGIN_NS": "clock.origin_ns"}


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class RouterConfig(_Section):
    """The Zenoh router of this host, and how clients reach it."""

    endpoint: str = Field("tcp/127.0.0.1:7457", pattern=r"^(tcp|tls|quic|ws|unixsock-stream)/.+")
    """Where the router listens and clients connect. `tcp/0.0.0.0:7457` listens on every interface."""
    listen: tuple[str, ...] = ()
    """Where else the router listens, as `tls/0.0.0.0:7447` for the link of a robot. Beyond this host only with TLS."""
    certificates: str = ""
    """Folder with `cert.pem`, `key.pem` and `trusted.pem` of a process, or a folder of such folders, one a process
    (`router/`, `gcp/`, `link/`, ...). `plgrim certs issue` makes it. For endpoints with TLS."""
    connect: str = ""
    """Where clients connect when it is not `endpoint` (in containers: `tcp/router:7457`). Empty: `endpoint`."""
    shared_memory: bool = False
    """Zenoh's shared memory transport: less copying of large maps; leaves files in /dev/shm after a kill -9."""
    lease_ms: int = Field(2000, ge=200, le=60_000)
    """Silence after which a connection counts as lost, ms. Lower finds a dead peer sooner."""

    @property
    def client_endpoint(self) -> str:
        """The endpoint that a client connects to; a router that listens everywhere is reached on this host."""
        return self.connect or self.endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


class ClockConfig(_Section):
    """The mission clock: stamp = (clock - origin_ns) * speed, the same in all processes."""

    speed: float = Field(1.0, gt=0, le=100)
    """Mission seconds a wall second. Above what the machine can compute, planners fall behind."""
    origin_ns: int = 0
    """Reading of `source` at mission clock 0, ns. Negative where a mission goes on after a reboot, in which
    CLOCK_MONOTONIC has begun anew."""
    source: Literal["monotonic", "realtime"] = "monotonic"
    """monotonic: one host, shared by its processes and containers. realtime: several hosts with synchronised clocks;
    the time of day is read once a boot, later steps of it are ignored."""


class RuntimeConfig(_Section):
    """How processes are run, watched and restarted. Wall time throughout."""

    health_period_s: float = Field(0.5, gt=0, le=10)
    max_consecutive_errors: int = Field(20, ge=1)
    """So many steps in a row that raise end the process; the supervisor starts it anew."""
    start_timeout_s: float = Field(300.0, gt=0)
    """Until all services are ready; the first start compiles kernels."""
    router_timeout_s: float = Field(30.0, gt=0)
    """How long a service started by itself waits for a router."""
    unresponsive_after_s: float = Field(15.0, gt=0)
    """A service of whose health nothing is heard for so long, while its process lives, is killed and restarted."""
    silent_after_s: float = Field(2.5, gt=0)
    """A process that steps and whose heartbeat stops for so long (stopped, or locked up) is killed and restarted.
    Several times `health_period_s`."""
    stuck_after_s: float = Field(10.0, gt=0)
    """A service whose step does not end for so long is killed and restarted. It is flagged as late, and not ready,
    after 2.5 of its periods."""
    watchdog: bool = False
    """Where nobody watches a service, as in a container: it ends itself `stuck_after_s` after it was last seen to make
    steps and heartbeats, so that it is started anew. A supervisor's own services leave that to it."""
    hold_failed_s: float = Field(0.0, ge=0)
    """A service that has used up its restarts is FAILED, and the robot holds: end the run after so long. 0: never,
    until somebody does; `explore` and `demo` take 10 s then."""
    spare: bool = True
    """Keep one process warm (about 300 MB) that becomes the next service that dies: back in a second, not several."""
    restarts: int = Field(5, ge=0)
    """Restarts of one service allowed within `restart_window_s`; after one more it is FAILED."""
    restart_window_s: float = Field(120.0, gt=0)
    backoff_s: float = Field(0.5, ge=0)
    """Wait before a restart of what failed soon after its start; doubles with each further failure in a row."""
    stable_after_s: float = Field(10.0, ge=0)
    """A service that was ready for so long is restarted at once when it ends; `restarts` counts it all the same."""
    state_dir: str = ""
    """Where services keep their journals, to go on after a crash: `<state_dir>/<robot>/<service>.*`. Empty: a service
    started by itself keeps none; `up`, `explore` and `demo` use a fresh folder `state` in their result folder."""
    snapshot_period_s: float = Field(5.0, gt=0, le=600)
    """Between two snapshots of a stage's state; longer of itself where snapshots are expensive. What is acknowledged is
    journaled in between; the rest (frames of the risk map, a plan) is at most so much older after a restart."""
    recorder_snapshot_period_s: float = Field(30.0, gt=0, le=3600)
    """Between two snapshots of a stage's state for a recorder that listens: a replay can begin at each."""
    stop_timeout_s: float = Field(3.0, gt=0)
    """Grace between SIGTERM and SIGKILL."""


DEFAULT_PROFILE: Literal["spot"] = "spot"
"""Also that of the services' own defaults."""


class DeploymentConfig(_Section):
    """What a host runs, and who can reach it. docs/deployment.md."""

    simulated: bool = True
    """Whether a simulator is the robot's body. False: a gateway of your own writes the `sim/...` topics."""
    published_on: str = ""
    """In a container: the address of its host at which its ports are published, or `none`. What listens without TLS is
    then reached by its own compose project and, with a loopback address, by the host alone. Empty: no container."""

    @property
    def private_network(self) -> bool:
        """Whether the interfaces that this process sees lead to no stranger."""
        return self.published_on == "none" or (bool(self.published_on) and is_loopback(self.published_on))


class Config(BaseSettings):
    """Everything. The sections of services are checked by the service's own `Config`, loaded when asked for."""

    model_config = SettingsConfigDict(frozen=True, extra="forbid")

    robot: str = Field("robot", pattern=r"^[A-Za-z0-9_-]{1,32}$")
    """Name of the robot: part of every key on the wire."""
    profile: Literal["husky", "spot"] = DEFAULT_PROFILE
    """The robot's body: what the simulator moves and what the planners take it for."""
    planner: Literal["default", "paper"] = "default"
    """paper: the paper's plain planners, for comparison (`PAPER`). What a section says itself holds all the same."""
    seed: int = Field(1, ge=0, lt=2**63)
    """The mission's seed; every random stream is derived from it."""
    router: RouterConfig = RouterConfig()
    clock: ClockConfig = ClockConfig()
    runtime: RuntimeConfig = RuntimeConfig()
    deployment: DeploymentConfig = DeploymentConfig()
    link: LinkConfig = LinkConfig()
    riskmap: dict[str, Any] = Field(default_factory=dict)
    irm: dict[str, Any] = Field(default_factory=dict)
    gcp: dict[str, Any] = Field(default_factory=dict)
    lcp: dict[str, Any] = Field(default_factory=dict)
    reconciler: dict[str, Any] = Field(default_factory=dict)
    mission: dict[str, Any] = Field(default_factory=dict)
    sim: dict[str, Any] = Field(default_factory=dict)
    status: dict[str, Any] = Field(default_factory=dict)

    _source: str = PrivateAttr("configuration")

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Command line, environment, file: each checked for unknown keys before they are merged."""
        return (init_settings, _EnvironmentSource(settings_cls), _FileSource(settings_cls))

    def options(self, service: str) -> dict[str, Any]:
        """The section of a service, with what is said once for all: seed, robot, planner; a section may differ.

        In a simulated world of rough ground the risk map is one of terrain, the LiDAR looks down at it, irm and
        reconciler keep off what may tip the robot, and irm passes over crumbs.
        """
        section: dict[str, Any] = dict(getattr(self, service))
        if self.planner == "paper":
            section = {**PAPER.get(service, {}), **section}
        rough, other = is_rough(self.sim), self.profile != DEFAULT_PROFILE
        if service == "sim":
            section.setdefault("seed", self.seed)
            if other:
                section["robot"] = {"profile": self.profile, **section.get("robot", {})}
            if rough:
                section["lidar"] = {**DOWNWARD_LIDAR, **section.get("lidar", {})}
        elif service == "riskmap" and other:
            section.setdefault("profile", self.profile)
        elif service == "reconciler":
            section = {"footprint_radius_m": PROFILES[self.profile].footprint_radius_m, **section}
            if rough:
                own = {"clearance_margin_m": self.options("irm")["clearance_margin_m"]}
                section = {
                    **own,
                    "comfort_clearance_m": ROUGH_COMFORT_M,
                    "turn_room_m": ROUGH_TURN_ROOM_M,
                    **section,
                }
        if service == "status" and self.deployment.private_network:
            section.setdefault("trusted_network", True)
        if service == "riskmap" and rough:
            section.setdefault("model", "terrain")
        elif service == "gcp" and rough:
            section = {"crumb_times": ROUGH_CRUMB_TIMES, **section}
        elif service == "irm" and rough:
            section = {
                "clearance_margin_m": ROUGH_MARGIN_M,
                "comfort_clearance_m": ROUGH_COMFORT_M,
                "sensor_height_m": sensor_height_m(self.sim),
                **ROUGH_CRUMBS,
                **section,
            }
        return section


def sensor_height_m(sim: Mapping[str, Any]) -> float:
    """Height of the simulator's sensors over the ground, m."""
    lidar = sim.get("lidar")
    return float(lidar.get("height_m", SENSOR_HEIGHT_M)) if isinstance(lidar, Mapping) else SENSOR_HEIGHT_M


def is_rough(sim: Mapping[str, Any]) -> bool:
    """Whether this section of the simulator asks for a world with heights."""
    if sim.get("map_file"):
        return False
    return bool(sim.get("mesh_file") or sim.get("dem_file")) or sim.get("world") in ROUGH_WORLDS


PAPER: Mapping[str, Mapping[str, Any]] = {
    "lcp": {"rollout_random": 1.0, "macros": False},
    "gcp": {"solver": "qmdp", "switch_margin": 0.0, "switch_margin_relative": 0.0, "crumb_margin": 0.0},
    "reconciler": {"profile": "paper"},
}
"""`planner: paper`: uniform rollouts and single moves in the POMCP, the QMDP's best frontier at every step, tau* by
the literal rule."""

DOWNWARD_LIDAR = {"rings": 24, "elevation_min_deg": -45.0, "elevation_max_deg": 15.0}
"""For rough ground: with the default, no ring meets the ground nearer than 3 m, nor any way down at all."""

ROUGH_MARGIN_M = 0.1
"""Beside a stone, a foot that is so far off its place tips the robot; on flat ground a wall only stops it."""
ROUGH_TURN_ROOM_M = 0.1
"""The edge of a stone is known to a cell: beside it a turn on the spot may put a foot on it."""
ROUGH_COMFORT_M = 0.6
"""Where there is room, paths keep so far off what may tip the robot."""

SENSOR_HEIGHT_M = 0.8
"""The simulator's default."""

ROUGH_CRUMBS = {"min_node_entropy": 0.2, "frontier_min_gain": 0.3, "max_edge_risk": 0.9}
"""For irm on rough ground, where every stone leaves a corner that is hard to look into, and no way is without risk."""

ROUGH_CRUMB_TIMES = 8.0
"""For gcp on rough ground: what is left of a target gives way to eight times as much, for the robot cannot look into
every corner there."""

ROUGH_WORLDS = ("cave", "lava_tube", "short_lava_tube")
"""Built-in worlds whose ground is not flat."""


class _FileSource(PydanticBaseSettingsSource):
    def get_field_value(self, field: Any, field_name: str) -> tuple[Any, str, bool]:
        raise NotImplementedError

    def __call__(self) -> dict[str, Any]:
        path = _FILE.get()
        if not path:
            return {}
        content = _read(Path(path))
        check_keys(content, Config, path, "")
        return content


class _EnvironmentSource(PydanticBaseSettingsSource):
    def get_field_value(self, field: Any, field_name: str) -> tuple[Any, str, bool]:
        raise NotImplementedError

    def __call__(self) -> dict[str, Any]:
        nested: dict[str, Any] = {}
        for variable, path in environment_overrides(os.environ).items():
            *parents, last = path.split(".")
            into = nested
            for part in parents:
                into = into.setdefault(part, {})
            into[last] = yaml.safe_load(os.environ[variable])
            check_keys(_nest(path), Config, variable, "")
        return nested


def _nest(path: str) -> dict[str, Any]:
    head, _, rest = path.partition(".")
    return {head: _nest(rest) if rest else None}


def environment_overrides(environment: Mapping[str, str]) -> dict[str, str]:
    """Variables that set a key of the configuration: name -> path of the key. ConfigError for a misspelt one."""
    found: dict[str, str] = {}
    for variable in sorted(environment):
        if not variable.startswith(PREFIX):
            continue
        name = variable.removeprefix(PREFIX)
        if name in _SHORT:
            found[variable] = _SHORT[name]
        elif "__" in name or name.lower() in ("robot", "seed", "profile"):
            found[variable] = name.lower().replace("__", ".")
        else:
            check_env_name(variable, ("ROBOT", "SEED", "PROFILE", *_SHORT))
    return found


def _read(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
        content = tomllib.loads(text) if path.suffix == ".toml" else yaml.safe_load(text)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: neither YAML nor TOML: {error}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected sections and keys, found {type(content).__name__}")
    return content


def load_config(path: Path | None = None, overrides: Mapping[str, Any] | None = None) -> Config:
    """The configuration from a file (default: `$PLGRIM_CONFIG`, or none), the environment and `overrides` (nested).

    Only the program's own sections are checked here; `check_service` checks a service's. Raises ConfigError.
    """
    file = str(path) if path is not None else os.environ.get("PLGRIM_CONFIG", "")
    token = _FILE.set(file)
    try:
        config = Config(**dict(overrides or {}))
    except ValidationError as error:
        raise ConfigError(describe(error, file or "configuration")) from error
    finally:
        _FILE.reset(token)
    config._source = file or "configuration"
    return config


def service_config_class(service: str) -> type[BaseModel] | None:
    """The `Config` of a service: in its `stage` module, or for status in its `config` module."""
    module = "stage" if service in STAGES else "config"
    try:
        found = importlib.import_module(f"services.{service}.{module}")
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith("services"):
            return None
        raise
    config: type[BaseModel] = getattr(found, "Config", None) or found.StatusConfig
    return config


def check_service(config: Config, service: str) -> BaseModel | None:
    """The service's own configuration, validated; None when the service has none.

    Raises ConfigError with file or variable, path of the key, and what is wrong.
    """
    model = service_config_class(service)
    options = config.options(service)
    if model is None:
        if getattr(config, service):
            raise ConfigError(f"{config._source}: {service}: this service has no configuration")
        return None
    if "seed" not in model.model_fields and "seed" not in getattr(config, service):
        options.pop("seed", None)
    for variable, key in environment_overrides(os.environ).items():
        if key.startswith(f"{service}."):
            check_keys(_nest(key.partition(".")[2]), model, f"environment: {variable}", service)
    check_keys(options, model, config._source, service)
    try:
        return model.model_validate(options)
    except ValidationError as error:
        raise ConfigError(describe(error, config._source, service)) from error


def check_all(config: Config) -> None:
    """Check every service's section that is not empty, so that a misspelt key is found before anything starts."""
    for service in (*STAGES, "status"):
        if getattr(config, service):
            check_service(config, service)


def write_config(config: Config, path: Path) -> None:
    """Write the whole configuration as YAML: what a child process reads instead of file, environment and options."""
    path.write_text(yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False), encoding="utf-8")
