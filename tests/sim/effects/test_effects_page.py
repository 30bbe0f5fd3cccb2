"""docs/effects.md is what the registry says, and what effects say of themselves is there."""

from pathlib import Path

import pytest

from pipelines.effects_page import PAGE, text
from taccorl.errors import TaccorlError
from taccorl.sim.effects import effects, prose


def test_the_page_of_effects_is_current():
    assert PAGE.read_text(encoding="utf-8") == text(), "run make pictures"


def test_a_section_of_another_form_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    texts = prose.PAGE.read_text(encoding="utf-8")
    monkeypatch.setattr(prose, "PAGE", tmp_path / "effects.md")
    for old, new, told in (
        ("- **Record:** One slow sweep", "One", "cogging: its section"),
        ("| cable_spring | end_stop |", "| cable_string | end_stop |", "the last table names cable_string"),
    ):
        prose.PAGE.write_text(texts.replace(old, new))
        prose._sections.cache_clear()
        with pytest.raises(TaccorlError, match=told):
            _ = effects.get("armature").equation
    prose._sections.cache_clear()
