"""Finding recordings: what is there is read, what is not read is told, and a way out is named."""

import json
import shutil
from pathlib import Path

import pytest

from taccorl.cli.main import main
from taccorl.data.recording import find_sources
from taccorl.errors import RecordingError
from tests.recordings.stand_in import StandInConfig, write_cobot_magic_hdf5, write_mcap

V21 = "is a LeRobot v2.1 dataset, but only v3 is supported. Convert it"


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as people have them: two MCAP files among all sorts of things."""
    folder = tmp_path_factory.mktemp("finding") / "mixed"
    (folder / "v21/meta").mkdir(parents=True)
    (folder / "v21/meta/info.json").write_text(json.dumps({"codebase_version": "v2.1", "fps": 30, "features": {}}))
    (folder / "days/one").mkdir(parents=True)
    config = StandInConfig(duration_s=2.0, camera_size=(96, 128))
    write_mcap(folder / "days/one/a.mcap", config)
    write_cobot_magic_hdf5(folder / "aloha1.hdf5", config)
    for name in ("good.mcap", "odd.bin"):
        shutil.copy(folder / "days/one/a.mcap", folder / name)
    (folder / "notes.txt").write_text("tried again after lunch")
    (folder / "cover.jpg").write_bytes(b"\xff\xd8\xff\xe0" + bytes(20))
    (folder / ".hidden").touch()
    return folder


def test_everything_that_a_folder_holds_is_read_or_told(mixed: Path) -> None:
    skipped: list[str] = []
    found = find_sources(mixed, reader="mcap", skipped=skipped)
    assert [source.path.name for _, source in found] == ["good.mcap"]
    told = dict(line.rstrip(")").split(" (", 1) for line in skipped)
    assert set(told) == {"aloha1.hdf5", "cover.jpg", "days", "notes.txt", "odd.bin", "v21"}
    assert told["aloha1.hdf5"] == "an HDF5 file; this spec reads mcap"
    assert told["cover.jpg"] == "a JPEG picture, no recording"
    assert told["days"] == f"there are recordings in {mixed / 'days/one'}: give that folder"
    assert told["notes.txt"] == "no recording"
    assert told["odd.bin"] == "an MCAP file with another ending: give the file itself"
    assert told["v21"].startswith(V21) and told["v21"].endswith("; this spec reads mcap")


def test_a_bad_entry_keeps_the_others_only_from_those_who_do_not_ask(mixed: Path) -> None:
    skipped: list[str] = []
    assert [name for name, _ in find_sources(mixed, skipped=skipped)] == ["hdf5", "mcap"]
    assert any(line.startswith(f"v21 ({V21}") for line in skipped)
    with pytest.raises(RecordingError, match=f"v21: {V21}"):
        find_sources(mixed)


@pytest.mark.parametrize(
    ("name", "reader", "said"),
    [
        ("aloha1.hdf5", "mcap", "an HDF5 file; this spec reads mcap (cobot_magic_hdf5 reads hdf5)"),
        ("good.mcap", "hdf5", "an MCAP file; this spec reads hdf5 (piper_flexitac_mcap reads mcap)"),
        ("cover.jpg", "mcap", "a JPEG picture, no recording"),
        ("cover.jpg", None, "a JPEG picture, no recording"),
        ("notes.txt", None, "no recording here; readers db3, hdf5, lerobot, mcap, rosbag1 open .bag, .db3, .h5, .hdf5, .mcap"),
        ("days", "mcap", "no recording here, but there are some in {mixed}/days/one: give that folder"),
        ("v21", "mcap", V21),
        ("v21", None, V21),
        ("days/one", "db3", "no recording here; the reader db3 opens .db3; not read: a.mcap (an MCAP file; this spec reads db3)"),
    ],
)  # fmt: skip
def test_a_path_without_a_recording_says_what_it_is(mixed: Path, name: str, reader: str | None, said: str) -> None:
    with pytest.raises(RecordingError) as error:
        find_sources(mixed / name, reader=reader)
    assert str(error.value).startswith(f"{mixed / name}: {said.format(mixed=mixed)}")
    assert str(error.value).count(str(mixed / name) + ":") == 1


def test_a_known_file_with_an_odd_ending_is_opened_by_what_it_is(mixed: Path) -> None:
    for reader in (None, "mcap"):
        [(name, source)] = find_sources(mixed / "odd.bin", reader=reader)
        assert (name, source.path) == ("mcap", mixed / "odd.bin")


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
TAR = bytes(257) + b"ustar\x0000" + bytes(248)


@pytest.mark.parametrize(
    ("name", "content", "what", "command"),
    [
        ("p.mcap", POINTER, "a Git LFS pointer", "git -C {folder} lfs pull"),
        ("p.hdf5", POINTER, "a Git LFS pointer", "git -C {folder} lfs pull"),
        ("p.db3", POINTER, "a Git LFS pointer", "git -C {folder} lfs pull"),
        ("p.bag", POINTER, "a Git LFS pointer", "git -C {folder} lfs pull"),
        ("day 1.zip", b"PK\x03\x04" + bytes(30), "a ZIP archive", "unzip '{folder}/day 1.zip' -d {folder}"),
        ("really_zipped.mcap", b"PK\x03\x04" + bytes(30), "a ZIP archive", "unzip {folder}/really_zipped.mcap"),
        ("a.bag.gz", b"\x1f\x8b\x08" + bytes(30), "a gzip archive", "gunzip --keep {folder}/a.bag.gz"),
        ("a.mcap.zst", b"\x28\xb5\x2f\xfd" + bytes(30), "a zstd archive", "unzstd {folder}/a.mcap.zst"),
        ("days.tar", TAR, "a tar archive", "tar -xf {folder}/days.tar -C {folder}"),
    ],
)
def test_what_only_stands_for_a_recording_is_named_with_the_command_that_gives_it(
    name: str, content: bytes, what: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    for words in (["ingest", "inspect", path], ["ingest", tmp_path, "--spec=piper_flexitac_mcap", "--dry_run=true"]):
        assert main([str(word) for word in words]) != 0
        shown = "".join(capsys.readouterr())
        assert name in shown
        if "inspect" in words or path.suffix not in (".hdf5", ".db3", ".bag"):  # another reader's: not looked into
            for part in (what, command.format(folder=tmp_path)):
                assert part in shown


@pytest.mark.parametrize("file", ["meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet"])
def test_a_dataset_of_git_lfs_pointers_is_named(file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    info = {"codebase_version": "v3.0", "fps": 30, "features": {}, "total_episodes": 0, "data_path": "data/x"}
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_bytes(POINTER)
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    for words in (["check"], ["view"], ["ingest", "inspect"]):
        assert main([*words, str(tmp_path)]) == 2
        shown = capsys.readouterr().err
        assert f"{tmp_path / file}: a Git LFS pointer" in shown
        assert f"git -C {(tmp_path / file).parent} lfs pull" in shown
