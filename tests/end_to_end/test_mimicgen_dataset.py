"""pipelines/mimicgen_dataset.py on a small number: sources, new episodes, report; and again without making anything anew."""

import json
from pathlib import Path

import pytest

from pipelines.mimicgen_dataset import main, make
from taccorl.data.dataset import Dataset


@pytest.mark.slow
def test_the_pipeline_makes_a_dataset_with_its_report_and_goes_on_where_it_was(tmp_path: Path) -> None:
    options = {"episodes": "1", "workers": "1", "images": "false"}
    new = make("assembly_2", options, tmp_path, sources=2)
    assert Dataset(new).num_episodes == 1
    told = json.loads((tmp_path / "assembly_2.augment_report.json").read_text())
    assert told["source"] == str(tmp_path / "assembly_2_sources")
    assert told["yield"]["successes"] == 1
    before = sorted((tmp_path / "store").rglob("entry.json"))
    make("assembly_2", options, tmp_path, sources=2)
    assert sorted((tmp_path / "store").rglob("entry.json")) == before


@pytest.mark.parametrize("words", [["asembly_2"], ["--epsiodes=3"]])
def test_what_the_pipeline_does_not_know_is_named(words: list[str]) -> None:
    with pytest.raises(SystemExit, match=r"no '(asembly_2|epsiodes)'; tasks: assembly_1"):
        main(words)
