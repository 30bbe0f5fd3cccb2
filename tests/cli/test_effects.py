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
def test_a_written_example_passes_its_own_test_and_fails_it_once_its_law_is_broken(
    said, tmp_path, kind
):
    code, shown = said("effects", "new", "my_effect", "--out=mine.py", f"--for={kind}")
    assert code == 0
    assert 'my_effect = "mine"' in shown
    pytest_words = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "mine.py")
    done = fresh_python(*pytest_words, cwd=tmp_path, path=tmp_path)
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout
    text = (tmp_path / "mine.py").read_text()
    law = {"joint": "self.stiffness_nm_per_rad, ", "cells": "self.curvature)"}[kind]
    assert law in text
    (tmp_path / "mine.py").write_text(
        text.replace(
            law,
            law.replace("self.stiffness_nm_per_rad", "1.0").replace(
                "self.curvature", "0.3"
            ),
        )
    )
    broken = fresh_python(*pytest_words, cwd=tmp_path, path=tmp_path)
    assert broken.returncode == 1
    assert (
        "my_effect: its absent numbers do something" in broken.stdout
        or "near its absent values" in broken.stdout
    )


def test_a_written_example_joins_the_registry_by_its_entry_point(
    said, tmp_path: Path
) -> None:
    said("effects", "new", "my_effect")
    info = tmp_path / "mine-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[taccorl.plugins]\nmy_effect = my_effect\n")
    done = fresh_python(
        "-m", "taccorl.cli.main", "effects", "my_effect", cwd=tmp_path, path=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "stiffness_nm_per_rad [N·m/rad]" in done.stdout


def test_nothing_is_overwritten_and_no_name_taken_twice(said, tmp_path: Path) -> None:
    (tmp_path / "my_effect.py").write_text("precious")
    code, shown = said("effects", "new", "my_effect")
    assert code == 2
    assert "my_effect.py: already exists" in shown
    assert (tmp_path / "my_effect.py").read_text() == "precious"
    assert (
        "the effect taxel_creep exists already"
        in said("effects", "new", "taxel_creep")[1]
    )
    for name in ("My-Effect", "class", "2nd"):
        assert "is not a valid name of an effect" in said("effects", "new", name)[1]
    assert (
        "must be a Python module"
        in said("effects", "new", "other", "--out=other.txt")[1]
    )
