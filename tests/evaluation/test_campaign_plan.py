"""What a campaign consists of, and when two runs are the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plgrim.config import check_service
from plgrim.errors import ConfigError
from plgrim.evaluation.campaign_plan import (
    BUILT_IN_VARIANTS,
    Campaign,
    Variant,
    World,
    code_version,
    differences,
    file_hash,
    merged,
    parse_seeds,
)

DEFAULT = Variant("default", {})


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("1-3", [1, 2, 3]), ("1,3,5", [1, 3, 5]), ("7", [7]), ("5-6, 1,6-7", [5, 6, 1, 7]), ("0", [0])],
)
def test_seeds_are_read(text: str, seeds: list[int]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "3-1", "1-", "-1", "1,,2", "1.5", "0-99999"])
def test_what_are_no_seeds_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="seeds"):
        parse_seeds(text)


@given(st.lists(st.integers(0, 1000), min_size=1, unique=True))
def test_a_list_of_seeds_is_read_as_written(seeds: list[int]) -> None:
    assert parse_seeds(",".join(map(str, seeds))) == seeds


def test_every_world_meets_every_variant_with_every_seed() -> None:
    variants = [DEFAULT, Variant("v", {"lcp": {"weights": {"k_risk": 1.0}}})]
    campaign = Campaign([World.built_in("maze"), World.built_in("cave")], variants, [1, 2], 30.0)
    runs = campaign.runs()
    assert len({run.name for run in runs}) == 8
    assert {run.seed for run in runs[:4]} == {1}  # pairs are complete early
    assert {run.config.options("sim")["seed"] for run in runs} == {1, 2}
    assert {run.config.options("sim")["world"] for run in runs} == {"maze", "cave"}
    assert [run.config.lcp for run in runs if run.variant == "v"] == [{"weights": {"k_risk": 1.0}}] * 4


def test_the_worlds_of_a_campaign_win_over_file_and_variant(tmp_path: Path) -> None:
    file = tmp_path / "base.yaml"
    file.write_text("sim: {mesh_file: /nowhere.ply, slip_fraction: 0.2}\nprofile: spot\n", encoding="utf-8")
    variant = Variant("v", {"seed": 5, "sim": {"world": "loop", "slip_fraction": 0.1}, "profile": "spot"})
    campaign = Campaign(
        [World.built_in("maze")], [variant], [3], config_file=file, common={"profile": "husky"}
    )
    (run,) = campaign.runs()
    assert run.config.seed == 3
    assert run.config.profile == "husky"
    assert run.config.sim["world"] == "maze"
    assert run.config.sim["mesh_file"] is None
    assert run.config.sim["slip_fraction"] == 0.1


def test_built_in_variants_are_valid_and_blind() -> None:
    variants = [Variant.parse(name) for name in BUILT_IN_VARIANTS]
    runs = {run.variant: run for run in Campaign([World.built_in("cave")], variants, [1]).runs()}
    for name in ("risk_neutral", "risk_blind"):
        blind = runs[name].config
        riskmap: Any = check_service(blind, "riskmap")
        assert riskmap.alpha == 0.0, "no CVaR"
        assert riskmap.risk_blind is (name == "risk_blind"), "terrain hazard goes with one of them only"
        assert check_service(blind, "gcp").reward.k_risk == 0.0  # type: ignore[union-attr]
        assert check_service(blind, "lcp").weights.k_risk == 0.0  # type: ignore[union-attr]
        assert check_service(blind, "reconciler").weights.k_risk == 0.0  # type: ignore[union-attr]
    assert len({runs[name].fingerprint for name in ("default", "risk_neutral", "risk_blind")}) == 3


def test_variants_are_read_from_files(tmp_path: Path) -> None:
    file = tmp_path / "v.yaml"
    file.write_text("lcp: {weights: {k_risk: 2.0}}\n", encoding="utf-8")
    assert Variant.parse(f"bold={file}") == Variant("bold", {"lcp": {"weights": {"k_risk": 2.0}}})
    (tmp_path / "empty.yaml").write_text("", encoding="utf-8")
    assert Variant.parse(f"e={tmp_path / 'empty.yaml'}").overlay == {}


@pytest.mark.parametrize("text", ["unknown", "a/b=x.yaml", "=x.yaml", "v=missing.yaml", "..=x.yaml"])
def test_wrong_variants_are_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        Variant.parse(text)


def test_a_misspelt_key_of_a_variant_is_found_before_anything_starts() -> None:
    variant = Variant("v", {"lcp": {"weights": {"k_rsk": 1.0}}})
    with pytest.raises(ConfigError, match=r"variant v in maze.*k_risk"):
        Campaign([World.built_in("maze")], [variant], [1]).runs()


def test_names_are_given_once() -> None:
    worlds = [World.file("mesh_file", Path("a/mine.ply")), World.file("mesh_file", Path("b/mine.ply"))]
    with pytest.raises(ConfigError, match="'mine' is given twice"):
        Campaign(worlds, [DEFAULT], [1]).runs()


def test_whatever_moves_the_robot_changes_the_fingerprint() -> None:
    def fingerprint(limit_s: float = 0.0, seed: int = 1, **overlay: object) -> str:
        (run,) = Campaign([World.built_in("maze")], [Variant("v", overlay)], [seed], limit_s).runs()
        return run.fingerprint

    assert fingerprint() == fingerprint()
    assert fingerprint(status={"port": 9000}, runtime={"restarts": 1}) == fingerprint()
    others = [
        fingerprint(limit_s=5.0),
        fingerprint(seed=2),
        fingerprint(irm={}, lcp={"weights": {"k_risk": 1}}),
    ]
    assert len({fingerprint(), *others}) == 4


def test_the_content_of_a_map_counts_with_its_image(tmp_path: Path) -> None:
    image, file = tmp_path / "m.pgm", tmp_path / "m.yaml"
    file.write_text("image: m.pgm\n", encoding="utf-8")
    image.write_bytes(b"a")
    before = file_hash(file)
    file_hash.cache_clear()
    image.write_bytes(b"b")
    assert file_hash(file) != before
    with pytest.raises(ConfigError, match="cannot be read"):
        file_hash(tmp_path / "none.ply")


def test_the_version_of_the_code_is_that_of_its_sources() -> None:
    version, _, digest = code_version().partition("+")
    assert version
    assert len(digest) == 12


def test_differences_are_named_by_their_keys() -> None:
    old, new = {"a": {"b": 1, "c": 2}, "code": "x"}, {"a": {"b": 1, "c": 3, "d": 4}, "code": "x"}
    assert differences(old, new) == ["a.c: 2 -> 3", "a.d: - -> 4"]
    assert merged(old, {"a": {"c": 9}}) == {"a": {"b": 1, "c": 9}, "code": "x"}
    assert old["a"] == {"b": 1, "c": 2}
