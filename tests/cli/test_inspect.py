"""``taccorl ingest inspect`` over folders, and over files of other people's kinds."""

import pytest
from edited import rewrite

from taccorl.cli.main import main
from taccorl.surrogate.drivers import CAMERA_TOPICS
from tests.recordings.stand_in import StandInConfig, write_cobot_magic_hdf5, write_mcap

SMALL = StandInConfig(duration_s=2.0, camera_size=(96, 128))


def test_one_bad_entry_of_a_folder_does_not_hide_the_others(tmp_path, capsys):
    write_mcap(tmp_path / "good.mcap", SMALL)
    (tmp_path / "v21/meta").mkdir(parents=True)
    (tmp_path / "v21/meta/info.json").write_text('{"codebase_version": "v2.1"}')
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "zero.mcap").touch()
    assert main(["ingest", "inspect", str(tmp_path / "missing.mcap"), str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert "missing.mcap: no such file" in printed
    assert "piper_flexitac_mcap" in printed
    assert f"{tmp_path}: not read: notes.txt (no recording)" in printed
    assert f"{tmp_path}: not read: v21 (is a LeRobot v2.1 dataset" in printed
    assert f"{tmp_path / 'zero.mcap'}: is empty (0 bytes)" in printed
    assert printed.count("zero.mcap: ") == 1


def test_times_that_the_reader_made_up_are_not_shown_as_measured(tmp_path, capsys):
    write_cobot_magic_hdf5(tmp_path / "a.hdf5", SMALL)
    assert main(["ingest", "inspect", str(tmp_path / "a.hdf5")]) == 0
    printed = capsys.readouterr().out
    assert "hdf5, – s" in printed
    [row] = [line for line in printed.splitlines() if line.startswith("/observations/qpos")]
    assert row.split() == ["/observations/qpos", "float32", "60", "–", "–", "–", "–"]


def test_what_is_wrong_comes_instead_of_a_spec_that_fits(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    write_mcap(path, StandInConfig(duration_s=2.0, camera_size=(96, 128), sim_time_stamps=True))
    main(["ingest", "inspect", str(path)])
    printed = capsys.readouterr().out
    assert "fits the shipped spec" not in printed
    assert "has the topics of the shipped spec piper_flexitac_mcap, but" in printed
    assert "stamped in simulation time" in printed


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_drafts_are_printed_of_a_whole_recording_and_a_cut_one_is_named(share, tmp_path, capsys):
    path = tmp_path / "a.mcap"
    write_mcap(tmp_path / "known.mcap", SMALL)
    types = {CAMERA_TOPICS["front"]: "foxglove_msgs/msg/CompressedImage"}
    rewrite(tmp_path / "known.mcap", path, list, types=types)
    (tmp_path / "known.mcap").unlink()
    path.write_bytes(path.read_bytes()[: round(share * path.stat().st_size)])
    code, printed = main(["ingest", "inspect", str(path)]), capsys.readouterr().out
    assert "no shipped spec fits" in printed and list(tmp_path.iterdir()) == [path]
    drafts = "dataset: draft_dataset.yaml" in printed and "draft_dataset.yaml: what its dataset holds" in printed
    is_named = f"to {path.stat().st_size:,}: the file ends without a footer" in printed
    assert (code, drafts, is_named) == ((0, True, False) if share == 1 else (1, False, True))
