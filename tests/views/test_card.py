"""The card states what the dataset's files state, is no part of the dataset, and never takes the place of a user's README.md."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from huggingface_hub import DatasetCard
from PIL import Image

from taccorl.cli.card import add_card
from taccorl.cli.main import main
from taccorl.data.dataset import Dataset
from taccorl.lineage.manifest import read_manifest, verify
from taccorl.lineage.store import Store
from taccorl.views.card import card_text, write_card


@pytest.fixture
def copy(dataset: Path, tmp_path: Path) -> Path:
    """The dataset of ``taccorl ingest``, with the card that it wrote."""
    return Path(shutil.copytree(dataset, tmp_path / "my data"))


def without_card(root: Path) -> Path:
    (root / "README.md").unlink()
    shutil.rmtree(root / ".card")
    return root


def test_ingest_writes_a_card_that_the_hub_can_read(dataset: Path):
    card = DatasetCard.load(dataset / "README.md")
    assert card.data.tags == [
        "LeRobot",
        "taccorl",
        "tactile",
        "surrogate",
        "bi_piper_flexitac",
    ]
    assert card.data.task_categories == ["robotics"]
    assert card.data.configs == [
        {"config_name": "default", "data_files": "data/*/*.parquet"}
    ]
    assert card.data.license is None, "nobody stated one"
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", card.text)
    assert pictures == [".card/episode_0.jpg"]
    for name in pictures:
        with Image.open(dataset / name) as image:
            assert np.asarray(image).std() > 20


def test_card_states_size_units_origin_and_checks(dataset: Path):
    text = (dataset / "README.md").read_text()
    read = Dataset(dataset)
    rows = sum(read.num_rows(i) for i in range(2))
    assert (
        f"2 episodes, {rows} rows at 30 a second, {rows / 30 / 60:.1f} minutes; outcomes: 2 success"
        in text
    )
    assert "**Data: surrogate: stand-in recording, not a robot**" in text
    assert "| surrogate: stand-in recording, not a robot | 2 |" in text
    assert (
        "| `action` | float32 [14] | 6 rad, 1 m, 6 rad, 1 m | left_joint_1.pos … right_gripper.pos |"
        in text
    )
    assert (
        "flexitac_v2: 4 pads (left_a, left_b, right_a, right_b) of 32 × 12 taxels"
        in text
    )
    assert "reading = counts × 0.01333 (fixed_scale)" in text
    assert (
        "recordings: 2 written, 0 split, 0 quarantined, 0 refused; 0 episodes quarantined"
        in text
    )
    assert str(dataset.parent) not in text, (
        "the folders of this machine are nobody's business"
    )


def test_an_instruction_cannot_put_markup_or_links_into_the_card(copy: Path):
    text = "<img src=x onerror=alert(1)> [x](javascript:alert(1)) **now**"
    path = copy / "meta/tasks.parquet"
    tasks = pq.read_table(path)
    number = tasks.column_names.index("task")
    changed = pa.array([text] * len(tasks), tasks["task"].type)
    pq.write_table(tasks.set_column(number, "task", changed), path)
    card = card_text(Dataset(copy))
    line = next(x for x in card.splitlines() if x.startswith("- instruction"))
    assert line == (
        r"- instruction: *\<img src=x onerror=alert(1)\> [x\]\(javascript:alert(1)) "
        r"\*\*now\*\**"
    )


def test_origin_that_nobody_stated_stays_unstated(copy: Path):
    path = without_card(copy) / "meta/taccorl/episodes.json"
    records = json.loads(path.read_text())
    path.write_text(
        json.dumps([record | {"origin": "", "domain": None} for record in records])
    )
    text = (write_card(copy) or Path()).read_text()
    assert "**Data: origin not stated**" in text
    assert yaml.safe_load(text.split("---")[1])["tags"] == [
        "LeRobot",
        "taccorl",
        "tactile",
        "bi_piper_flexitac",
    ]


def test_card_is_in_no_digest_and_check_accepts_it_edited(copy: Path, tmp_path: Path):
    store, written = Store(tmp_path / "store"), read_manifest(copy)["digest"]
    assert not [
        name
        for name in read_manifest(copy)["files"]
        if "README" in name or "card" in name
    ]
    assert store.dataset(copy).digest == written
    (copy / "README.md").write_text("---\nlicense: cc-by-4.0\n---\nmine\n")
    assert store.dataset(copy).digest == written
    found = verify(copy)
    assert found is not None and not (
        found.changed or found.missing or found.unreadable
    )
    before = main(["check", str(copy), "--pictures=false"])
    without_card(copy)
    assert main(["check", str(copy), "--pictures=false"]) == before


@pytest.mark.parametrize("is_link", [False, True])
def test_a_users_readme_stays_as_it_is(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], is_link: bool
):
    without_card(copy)
    (tmp_path / "mine.md").write_text("mine\n")
    if is_link:
        (copy / "README.md").symlink_to(tmp_path / "mine.md")
    else:
        (copy / "README.md").write_text("mine\n")
    add_card(copy)
    assert (copy / "README.md").read_text() == "mine\n" and not (
        copy / ".card"
    ).exists()
    assert capsys.readouterr().out == ""


def test_what_the_card_says_to_type_loads_the_dataset(
    copy: Path, monkeypatch: pytest.MonkeyPatch
):
    write_card(without_card(copy))
    (code,) = re.findall(
        r"```python\n(.*?)```", (copy / "README.md").read_text(), re.DOTALL
    )
    monkeypatch.chdir(copy.parent)
    names: dict = {}
    exec(code, names)
    assert names["dataset"].num_episodes == 2


def test_the_card_of_data_without_pictures_proposes_no_policy_that_refuses_them(
    copy: Path,
):
    assert "--policy.type=act" in card_text(Dataset(copy))
    for path in (copy / "meta/info.json", copy / "meta/taccorl/dataset_spec.json"):
        own = json.loads(path.read_text())
        own["features"] = {
            key: f for key, f in own["features"].items() if "images" not in key
        }
        path.write_text(json.dumps(own))
    assert "lerobot-train" not in card_text(Dataset(copy))
