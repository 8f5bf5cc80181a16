"""The configuration: where values come from, and unknown keys refused at any depth with a hint."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict

from plgrim import config as config_module
from plgrim.config import Config, check_service, environment_overrides, load_config, write_config
from plgrim.config_keys import check_keys
from plgrim.errors import ConfigError


class _Deep(BaseModel):
    model_config = ConfigDict(extra="forbid")
    rings: int = 16


class _Lidar(BaseModel):  # forgets to forbid unknown keys: the walk must find them all the same
    deep: _Deep = _Deep()
    optional: _Deep | None = None
    many: list[_Deep] = []


class _Service(BaseModel):
    model_config = ConfigDict(extra="forbid")
    world: str = "w"
    lidar: _Lidar = _Lidar()


@pytest.fixture(autouse=True)
def _service_config(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config_module, "service_config_class", lambda name: _Service)


def _file(folder: Path, text: str, name: str = "plgrim.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_file_environment_and_options_win_in_that_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _file(
        tmp_path,
        "seed: 2\nrobot: file\nclock: {speed: 3, origin_ns: 7}\nsim: {world: a, lidar: {deep: {rings: 8}}}\n",
    )
    monkeypatch.setenv("PLGRIM_ROBOT", "variable")
    monkeypatch.setenv("PLGRIM_SPEED", "4")
    monkeypatch.setenv("PLGRIM_SIM__LIDAR__DEEP__RINGS", "9")
    found = load_config(path, {"clock": {"speed": 5.0}, "sim": {"world": "b"}})
    assert (found.seed, found.robot, found.clock.speed, found.clock.origin_ns) == (2, "variable", 5.0, 7)
    assert found.sim == {"world": "b", "lidar": {"deep": {"rings": 9}}}
    assert found.router == Config().router


def test_toml_is_read_too(tmp_path: Path) -> None:
    assert load_config(_file(tmp_path, 'robot = "r2"\n[clock]\nspeed = 2.5\n', "p.toml")).clock.speed == 2.5


@pytest.mark.parametrize(
    ("text", "path", "hint"),
    [
        ("sead: 3", "sead", "seed"),
        ("clock: {sped: 3}", "clock.sped", "speed"),
        ("router: {endpont: x}", "router.endpont", "endpoint"),
        ("sim: {wrld: x}", "sim.wrld", "world"),
        ("sim: {lidar: {deap: {}}}", "sim.lidar.deap", "deep"),
        ("sim: {lidar: {deep: {ringz: 1}}}", "sim.lidar.deep.ringz", "rings"),
        ("sim: {lidar: {optional: {ringz: 1}}}", "sim.lidar.optional.ringz", "rings"),
        ("sim: {lidar: {many: [{rings: 1}, {ringz: 1}]}}", "sim.lidar.many.ringz", "rings"),
    ],
)
def test_an_unknown_key_is_refused_at_any_depth(tmp_path: Path, text: str, path: str, hint: str) -> None:
    file = _file(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        check_service(load_config(file), "sim")
    message = str(caught.value)
    assert str(file) in message
    assert f"'{path}'" in message
    assert f"'{hint}'" in message


@pytest.mark.parametrize("variable", ["PLGRIM_CLOCK__SPED", "PLGRIM_SIM__LIDAR__DEEP__RINGZ", "PLGRIM_SEEED"])
def test_an_unknown_variable_is_refused_by_name(monkeypatch: pytest.MonkeyPatch, variable: str) -> None:
    monkeypatch.setenv(variable, "3")
    with pytest.raises(ConfigError, match=variable):
        check_service(load_config(), "sim")


def test_foreign_variables_are_left_alone() -> None:
    assert environment_overrides({"PLGRIM_STATUS_PORT": "tcp://10.0.0.1:80", "PLGRIM_CACHE_DIR": "/x"}) == {}


@pytest.mark.parametrize(
    ("text", "path"), [("clock: {speed: -1}", "clock.speed"), ("seed: x", "seed"), ("robot: a/b", "robot")]
)
def test_a_bad_value_names_file_and_path(tmp_path: Path, text: str, path: str) -> None:
    file = _file(tmp_path, text)
    with pytest.raises(ConfigError, match=f"{file}: {path}:"):
        load_config(file)


def test_a_bad_value_of_a_service_names_file_and_path(tmp_path: Path) -> None:
    file = _file(tmp_path, "sim: {lidar: {deep: {rings: many}}}")
    with pytest.raises(ConfigError, match=f"{file}: sim.lidar.deep.rings:"):
        check_service(load_config(file), "sim")


@pytest.mark.parametrize("text", ["a: [", "- a\n- b\n"])
def test_a_file_that_is_no_configuration_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=r"plgrim\.yaml"):
        load_config(_file(tmp_path, text))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read"):
        load_config(tmp_path / "none.yaml")


def test_what_was_written_is_read_back(tmp_path: Path) -> None:
    wanted = load_config(None, {"seed": 9, "sim": {"lidar": {"deep": {"rings": 3}}}})
    write_config(wanted, tmp_path / "written.yaml")
    assert load_config(tmp_path / "written.yaml").model_dump() == wanted.model_dump()


def test_every_service_config_of_ours_refuses_unknown_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    for service in ("mission", "sim", "irm", "gcp", "lcp", "reconciler", "riskmap"):
        model = config_module.service_config_class(service)
        if model is not None:
            with pytest.raises(ConfigError, match=f"{service}.no_such_key"):
                check_keys({"no_such_key": 1}, model, "x", service)


@pytest.mark.parametrize(("profile", "radius_m"), [("spot", 0.25), ("husky", 0.335)])
def test_one_profile_for_the_simulator_and_all_planners(profile: str, radius_m: float) -> None:
    from services.reconciler.config import Config as Reconciler
    from services.riskmap.config import Config as RiskMap
    from services.sim.config import SimConfig

    config = load_config(None, {"profile": profile, "sim": {"world": "cave"}})
    assert SimConfig.model_validate(config.options("sim")).robot.footprint_radius_m == radius_m
    assert RiskMap.model_validate(config.options("riskmap")).footprint_radius_m == radius_m
    assert Reconciler.model_validate(config.options("reconciler")).footprint_radius_m == radius_m


@pytest.mark.parametrize(
    ("sim", "model", "lowest_deg"),
    [
        ({"world": "cave"}, "terrain", -45.0),
        ({"world": "maze"}, "flat", -15.0),
        ({"mesh_file": "a"}, "terrain", -45.0),
    ],
)
def test_rough_ground_gets_the_terrain_model_and_a_lidar_that_looks_down(
    sim: dict[str, str], model: str, lowest_deg: float
) -> None:
    from services.riskmap.config import Config as RiskMap
    from services.sim.config import SimConfig

    config = load_config(None, {"sim": sim})
    assert RiskMap.model_validate(config.options("riskmap")).model == model
    assert SimConfig.model_validate(config.options("sim")).lidar.elevation_min_deg == lowest_deg


def test_the_environment_names_the_robots_profile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLGRIM_PROFILE", "husky")
    assert load_config(None, {}).options("riskmap")["profile"] == "husky"
    monkeypatch.delenv("PLGRIM_PROFILE")
    monkeypatch.setenv("PLGRIM_PROFIL", "husky")
    with pytest.raises(ConfigError, match="PLGRIM_PROFILE"):
        load_config(None, {})


def test_the_papers_plain_planners_have_a_name_and_a_section_still_wins() -> None:
    from services.gcp.config import Config as Gcp
    from services.lcp.config import Config as Lcp
    from services.reconciler.config import Config as Reconciler

    config = load_config(None, {"planner": "paper", "sim": {"world": "cave"}, "lcp": {"macros": True}})
    lcp, gcp = Lcp.model_validate(config.options("lcp")), Gcp.model_validate(config.options("gcp"))
    assert (lcp.rollout_random, lcp.macros) == (1.0, True)
    assert (gcp.solver, gcp.switch_margin, gcp.switch_margin_relative) == ("qmdp", 0.0, 0.0)
    assert Reconciler.model_validate(config.options("reconciler")).profile == "paper"
    plain = load_config(None, {})
    assert Lcp.model_validate(plain.options("lcp")) == Lcp()
    assert Gcp.model_validate(plain.options("gcp")) == Gcp()
