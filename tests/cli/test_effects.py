"""``taccorl effects``: the list, one effect, and an example of one's own whose test passes as it is written."""

from pathlib import Path

import pytest

from taccorl.sim.effects import effects
from tests.fresh_python import fresh_python

ROOT = Path(__file__).parents[2]


def test_the_list_has_every_effect_with_equation_units_and_what_shows_it(said) -> None:
    code, shown = said("effects")
    assert code == 0
    for name in effects:
        cls = effects.get(name)
        entry = shown.split(f"{name}  (", 1)[1].split("\n\n", 1)[0]
        assert cls.equation in entry and cls.to_record in entry
        for p in cls.parameters():
            assert f"{p.symbol}: {p.name} [{p.unit}]" in entry


@pytest.mark.parametrize(
    ("kind", "there", "not_there"),
    [
        (
            "joint",
            {"coulomb_friction", "payload"},
            {"taxel_creep", "camera_pose", "contact_friction"},
        ),
        (
            "pads",
            {"taxel_creep", "pad_shift", "taxel_gain_map"},
            {"coulomb_friction", "camera_pose"},
        ),
        (
            "cells",
            {"taxel_creep", "taxel_saturation", "touch_delay"},
            {"pad_shift", "taxel_gain_map", "dead_taxels"},
        ),
        ("camera", {"camera_pose"}, {"taxel_creep"}),
    ],
)
def test_a_kind_lists_its_effects_only(
    said, kind: str, there: set[str], not_there: set[str]
) -> None:
    code, shown = said("effects", f"--for={kind}")
    names = {
        line.split("  (")[0]
        for line in shown.splitlines()
        if line and not line.startswith(" ")
    }
    assert code == 0 and there <= names
    assert not not_there & names


def test_one_effect_says_what_it_is_and_what_tells_it_from_its_near_twins(said) -> None:
    code, shown = said("effects", "taxel_creep")
    cls = effects.get("taxel_creep")
    assert code == 0
    for sentence in (
        cls.in_words,
        cls.at_a_policy,
        *cls.near_twins.values(),
        cls.parameters()[0].source,
    ):
        assert sentence in shown


def test_a_wrong_kind_or_name_is_said_with_the_nearest(said) -> None:
    assert (
        "--for=cell: no effect acts on that; did you mean 'cells'"
        in said("effects", "--for=cell")[1]
    )
    assert (
        "no effect 'taxel_crep'; did you mean 'taxel_creep'"
        in said("effects", "taxel_crep")[1]
    )
    assert (
        "camera_pose acts on camera, not on joint"
        in said("effects", "camera_pose", "--for=joint")[1]
    )


@pytest.mark.parametrize(
    "kind", [pytest.param("joint", marks=pytest.mark.slow), "cells"]
)
def test_a_written_package_passes_its_own_test_and_fails_it_once_its_law_is_broken(
    said, tmp_path, kind
):
    code, shown = said("effects", "new", "stiffer", "--out=mine", f"--for={kind}")
    assert code == 0
    assert "pip install --editable mine" in shown
    module = tmp_path / "mine" / "stiffer" / "__init__.py"
    assert "my_effect" not in module.read_text()
    pytest_words = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "mine")
    path = tmp_path / "mine"
    done = fresh_python(*pytest_words, cwd=tmp_path, path=path)
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout
    text = module.read_text()
    law = {"joint": "self.stiffness_nm_per_rad, ", "cells": "self.curvature)"}[kind]
    assert law in text
    broken_law = {"joint": "1.0, ", "cells": "0.3)"}[kind]
    module.write_text(text.replace(law, broken_law))
    broken = fresh_python(*pytest_words, cwd=tmp_path, path=path)
    assert broken.returncode == 1
    assert (
        "stiffer: its absent numbers do something" in broken.stdout
        or "near its absent values" in broken.stdout
    )


@pytest.mark.slow
def test_a_written_package_is_installed_and_then_known(said, tmp_path: Path) -> None:
    """pip builds the package into a folder of its own; no index is asked."""
    assert said("effects", "new", "my_effect")[0] == 0
    site = tmp_path / "site"
    words = ["-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation"]
    words += ["--no-index", f"--target={site}", "./my_effect"]
    built = fresh_python(*words, cwd=tmp_path)
    assert built.returncode == 0, built.stderr
    done = fresh_python(
        "-m", "taccorl.cli.main", "effects", "my_effect", cwd=tmp_path, path=site
    )
    assert done.returncode == 0, done.stderr
    assert "stiffness_nm_per_rad [N·m/rad]" in done.stdout


def test_nothing_is_overwritten_and_no_name_taken_twice(said, tmp_path: Path) -> None:
    (tmp_path / "my_effect").mkdir()
    (tmp_path / "my_effect" / "pyproject.toml").write_text("precious")
    code, shown = said("effects", "new", "my_effect")
    assert code == 2
    assert "pyproject.toml: is there already" in shown
    assert (tmp_path / "my_effect" / "pyproject.toml").read_text() == "precious"
    assert not (tmp_path / "my_effect" / "my_effect").exists()
    assert (
        "the effect taxel_creep exists already"
        in said("effects", "new", "taxel_creep")[1]
    )
    for name in ("My-Effect", "class", "2nd"):
        assert "is not a valid name of an effect" in said("effects", "new", name)[1]
    (tmp_path / "file").touch()
    assert "cannot be made" in said("effects", "new", "other", "--out=file")[1]
