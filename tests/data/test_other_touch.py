"""Touch of other people's LeRobot datasets, of any shape and type: read, checked, drafted and ingested, never skipped."""

from pathlib import Path

import numpy as np
import pytest
from by_lerobot import write_with_lerobot
from test_draft import inspect_and_ingest

from taccorl.cli.main import main
from taccorl.data.checks import check_episode
from taccorl.data.dataset import Dataset

ROWS, FPS = 90, 30
KINDS: dict[str, tuple[str, tuple[int, ...]]] = {
    "observation.tactile.primary": ("float32", (12, 32)),  # LeFlexiTac
    "observation.tactile.left": ("uint8", (2, 16, 16)),  # two pads
    "observation.tactile.magnets": ("float32", (15,)),  # eFlesh, AnySkin
    "observation.tactile": ("int32", (4, 3)),
}


def touch(dtype: str, shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    values = np.random.default_rng(seed).uniform(0, 200, (ROWS, *shape))
    return values.astype(dtype)


def build(root: Path, values: dict[str, np.ndarray]) -> Path:
    phase = np.arange(ROWS) / 30
    state = np.stack([np.sin(phase), np.cos(phase)], axis=1).astype(np.float32)
    columns = {"observation.state": state, "action": np.float32(0.9) * state, **values}
    rows = [{key: column[k] for key, column in columns.items()} | {"task": "press"} for k in range(ROWS)]
    joints = {key: ["pan.pos", "lift.pos"] for key in ("observation.state", "action")}
    return write_with_lerobot(root, [rows], fps=FPS, robot_type="arm", names=joints)


@pytest.mark.parametrize("key", KINDS)
def test_touch_of_any_shape_and_type_is_read_to_the_number(tmp_path: Path, key: str) -> None:
    values = touch(*KINDS[key])
    dataset = Dataset(build(tmp_path / "d", {key: values}))
    assert dataset.skipped == {}
    episode = dataset.episode(0)
    assert np.array_equal(episode.arrays[key], values.reshape(ROWS, -1))
    shape = KINDS[key][1]
    assert episode.spec.features[key].layout == (shape if len(shape) > 1 else ())


def checks(root: Path) -> dict[str, str]:
    return {f.check: f.severity for f in check_episode(Dataset(root).episode(0)) if "tactile" in f.feature}


@pytest.mark.parametrize("key", KINDS)
def test_faults_of_touch_are_found_without_a_sensor_spec(tmp_path: Path, key: str) -> None:
    good = touch(*KINDS[key])
    assert checks(build(tmp_path / "good", {key: good})) == {"touch_range": "note"}
    dead = good.copy()
    dead.reshape(ROWS, -1)[:, 3] = 7
    assert checks(build(tmp_path / "dead", {key: dead})).get("dead_taxel") == "warning"
    frozen = good.copy()
    frozen[30:60] = frozen[30]
    assert checks(build(tmp_path / "frozen", {key: frozen})).get("frozen_touch") == "warning"
    assert checks(build(tmp_path / "silent", {key: np.full_like(good, 5)})).get("silent_pad") == "warning"


def test_a_draft_ingests_touch_with_its_layout(tmp_path: Path) -> None:
    key = "observation.tactile.primary"
    values = touch(*KINDS[key])
    ingested = inspect_and_ingest(
        build(tmp_path / "d", {key: values}), tmp_path, unit="unknown", frame="pad", range="[-1000, 1000]"
    )
    assert ingested.spec.features[key].layout == (12, 32)
    assert ingested.info["features"][key]["layout"] == [12, 32]
    stored = ingested.episode(0).arrays[key]
    assert np.array_equal(stored, values.reshape(ROWS, -1)[: len(stored)])
    assert len(stored) >= ROWS - 1


def test_view_of_a_dataset_says_what_the_sheet_leaves_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = {key: touch(*kind) for key, kind in KINDS.items() if key != "observation.tactile"}
    root, out = build(tmp_path / "d", values), tmp_path / "episode.rrd"
    assert main(["view", str(root), f"--save={out}"]) == 0
    assert out.is_file() and "not shown" not in capsys.readouterr().out
    assert main(["view", str(root), f"--sheet={tmp_path / 'sheet.png'}"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("not shown with --sheet: ")]
    assert [line.split(": ")[1] for line in lines] == ["observation.tactile.primary", "observation.tactile.left"]
