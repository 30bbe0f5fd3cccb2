"""Origin of data: stated, kept through every step, never made real."""

import json
import shutil
from pathlib import Path

import h5py
import pytest

from taccorl.alignment.measurements.folder import read_measurements
from taccorl.data.cutting import Cutter
from taccorl.data.dataset import Dataset
from taccorl.data.ingest import Job, ingest_one
from taccorl.data.origin import Origin
from taccorl.data.recording import find_sources, load_recording
from taccorl.data.spec import load_recording_spec
from taccorl.errors import DatasetError, TaccorlError
from tests.recordings.stand_in import StandInConfig, write_cobot_magic_hdf5

SPEC = "piper_flexitac_mcap"
TABLE = "t,q,u\n" + "".join(
    f"{0.01 * k:.2f},{0.001 * k:.4f},{0.001 * k:.4f}\n" for k in range(50)
)
COLUMNS = """
time: {column: t, unit: s}
signals:
  left_joint5: {q: {column: q, unit: rad}, q_target: {column: u, unit: rad}}
"""


def job(path: Path, store: Path, domain: str | None, spec: str = SPEC) -> Job:
    loaded = load_recording_spec(spec)
    [(_, source)] = find_sources(path, reader=loaded.reader)
    return Job(source, loaded, spec, store, dry_run=True, domain=domain)  # pyright: ignore


@pytest.fixture
def hdf5(tmp_path: Path) -> Path:
    """A stand-in that states domain and origin."""
    path = tmp_path / "episode_0.hdf5"
    write_cobot_magic_hdf5(path, StandInConfig(duration_s=3.0, camera_size=(96, 128)))
    return path


# ---- the value ----


def test_a_simulator_s_columns_are_of_the_twin_where_nothing_is_stated() -> None:
    assert Origin.read({}, ["action", "sim.state"]) == Origin("twin", "")
    assert Origin.read({}, ["action"]) == Origin()
    assert (
        Origin.read({"domain": None, "origin": ""}, ["sim.state"]) == Origin()
    )  # stated: not known


def test_what_is_stated_is_read_back_as_it_was_and_no_text_overrules_it() -> None:
    for origin in (
        Origin("real", "arm 2"),
        Origin("surrogate", "MuJoCo twin"),
        Origin("twin", "x"),
        Origin(),
    ):
        assert Origin.read(json.loads(json.dumps(origin.record()))) == origin


def test_a_domain_that_does_not_exist_or_contradicts_the_data_is_refused() -> None:
    with pytest.raises(TaccorlError, match=r"'reel'.*real"):
        Origin.read({"domain": "reel"})
    with pytest.raises(TaccorlError, match="contradicts the data"):
        Origin("real", "stand-in recording, not a robot")
    with pytest.raises(TaccorlError, match=r"sim\.\*"):
        Origin.read({"domain": "real", "origin": ""}, ["action", "sim.state"])
    assert (
        Origin.read({"domain": "surrogate", "origin": ""}, ["sim.state"]).domain
        == "surrogate"
    )


# ---- a stand-in never becomes real ----


def test_a_stand_in_cannot_be_ingested_as_real(
    recordings: Path, hdf5: Path, tmp_path: Path
) -> None:
    [first, *_] = sorted(recordings.glob("*.mcap"))
    for domain in ("real", "twin"):
        entry = ingest_one(job(first, tmp_path, domain))
        assert entry["outcome"] == "refused"
        assert (
            domain in entry["reason"]
            and "surrogate: stand-in recording" in entry["reason"]
        )
    assert (
        ingest_one(job(hdf5, tmp_path, "real", "cobot_magic_hdf5"))["outcome"]
        == "refused"
    )


def test_a_stand_in_with_an_edited_label_is_refused(hdf5: Path, tmp_path: Path) -> None:
    with h5py.File(hdf5, "a") as file:
        assert file.attrs["domain"] == "surrogate"
        file.attrs["domain"] = "real"
    entry = ingest_one(job(hdf5, tmp_path, None, "cobot_magic_hdf5"))
    assert entry["outcome"] == "refused" and "contradicts the data" in entry["reason"]


def test_a_recording_that_states_two_domains_is_refused(
    hdf5: Path, tmp_path: Path
) -> None:
    spec = load_recording_spec("cobot_magic_hdf5")
    recording = load_recording(
        find_sources(hdf5, reader=spec.reader)[0][1], spec, tmp_path
    )
    recording.reader.metadata = {
        "joined": {"domain": "real"},
        **recording.reader.metadata,
    }
    with pytest.raises(TaccorlError, match=r"episode_0.*real, surrogate"):
        _ = recording.origin


def test_a_dataset_of_a_stand_in_keeps_its_domain_through_another_ingest(
    dataset: Path, tmp_path: Path
) -> None:
    assert {Dataset(dataset).episode_facts(k)["origin"].domain for k in (0, 1)} == {
        "surrogate"
    }
    spec = load_recording_spec("taccorl_lerobot")
    source = find_sources(dataset, reader=spec.reader)[0][1]
    assert load_recording(source, spec, tmp_path).origin == Origin(
        "surrogate", "stand-in recording, not a robot"
    )


def test_an_edited_record_of_a_dataset_is_refused_with_its_file(
    dataset: Path, tmp_path: Path
) -> None:
    edited = tmp_path / "edited"
    shutil.copytree(dataset, edited)
    path = edited / "meta/taccorl/episodes.json"
    path.write_text(
        json.dumps([r | {"domain": "real"} for r in json.loads(path.read_text())])
    )
    with pytest.raises(
        DatasetError, match=r"edited/meta/taccorl/episodes\.json.*contradicts the data"
    ):
        Dataset(edited)


def test_a_folder_of_stand_ins_cannot_be_stated_real_for_compare(
    recordings: Path, tmp_path: Path
) -> None:
    for path in recordings.glob("*.mcap"):
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "measurements.yaml").write_text("domain: real\n")
    with pytest.raises(TaccorlError, match=r"measurements\.yaml.*'real'.*surrogate"):
        read_measurements(tmp_path, spec=SPEC)


# ---- what is a robot's ----


def test_a_recording_that_states_nothing_is_real_only_if_its_user_says_so(
    hdf5: Path, tmp_path: Path
) -> None:
    with h5py.File(hdf5, "a") as file:  # as a robot's recorder leaves it
        del file.attrs["domain"], file.attrs["origin"]
    spec = load_recording_spec("cobot_magic_hdf5")
    recording = load_recording(
        find_sources(hdf5, reader=spec.reader)[0][1], spec, tmp_path
    )
    assert Cutter(recording).cut().episodes[0].origin == Origin()
    assert Cutter(recording, "real").cut().episodes[0].origin == Origin("real")


def test_a_table_s_user_states_its_domain_in_the_columns_file_or_for_the_folder(
    tmp_path: Path,
) -> None:
    (tmp_path / "run.csv").write_text(TABLE)
    for columns, index, expected in (
        ("", "", Origin()),
        ("domain: real\norigin: bench 4\n", "", Origin("real", "bench 4")),
        ("origin: bench 4\n", "domain: real\n", Origin("real", "bench 4")),
        ("origin: bench 4\n", "", Origin(None, "bench 4")),
    ):
        (tmp_path / "columns.yaml").write_text(COLUMNS + columns)
        (tmp_path / "measurements.yaml").write_text("columns: columns.yaml\n" + index)
        assert [m.origin for m in read_measurements(tmp_path).all] == [expected]
