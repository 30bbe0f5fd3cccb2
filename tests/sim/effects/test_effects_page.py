"""docs/effects.md is what the registry says."""

from pathlib import Path

from pipelines.effects_page import PAGE, text

ROOT = Path(__file__).resolve().parents[3]


def test_the_page_of_effects_is_current():
    assert (ROOT / PAGE).read_text(encoding="utf-8") == text(), "run make pictures"
