"""Prune: keeps what kept datasets were made from, frees the rest and the leftovers, and touches nothing else."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from taccorl.cli.lineage import main
from taccorl.errors import DatasetError, TaccorlError
from taccorl.lineage.explain import render, trace
from taccorl.lineage.prune import delete, unneeded
from taccorl.lineage.stage import Stage
from taccorl.lineage.store import Store

from .toys import INGEST, MERGE, IngestConfig, make_raw, run_and_die


@pytest.fixture
def world(tmp_path):
    """A dataset of two merged episodes, and two artefacts that it does not need."""
    store, raw = Store(tmp_path / "store"), make_raw(tmp_path / "raw", num=3)
    sources = [store.source(path) for path in sorted(raw.iterdir())]
    episodes = [store.run(INGEST, IngestConfig(), [source]) for source in sources[:2]]
    merged = store.run(MERGE, IngestConfig(), episodes)
    store.run(
        Stage("finish", _finish), None, [merged], destination=tmp_path / "dataset"
    )
    store.run(INGEST, IngestConfig(rate_hz=20.0), [sources[0]])
    store.run(INGEST, IngestConfig(), [sources[2]])
    return tmp_path


def _finish(config, inputs, out_dir):
    (out_dir / "all.bin").write_bytes((inputs[0] / "0.bin").read_bytes())


def test_keeps_what_the_dataset_was_made_from_however_deep_and_frees_the_rest(world):
    store = Store(world / "store")
    run_and_die(store.root)
    folders = unneeded(store, [world / "dataset"])
    assert [(folder.path.parent.name, folder.is_leftover) for folder in folders] == [
        ("ingest", False),
        ("ingest", False),
        ("one", True),
    ]
    # Five files each: 200 bytes less 0…4, and the text "20.0" or "30.0" at the end of each; and the manifest.
    manifest_bytes = (folders[0].path / "manifest.json").stat().st_size
    assert (
        folders[0].size_bytes == 5 * 200 - 10 + 5 * 4 + manifest_bytes
        and folders[2].size_bytes == 1000
    )
    assert delete(store, folders) == []
    assert len(store.folders()) == 3  # two episodes and what they were merged into
    assert (
        trace(world / "dataset", store).num_problems() == 0
        and unneeded(store, [world / "dataset"]) == []
    )


def test_what_a_published_dataset_was_made_from_stays_without_being_named(world):
    store = Store(world / "store")
    assert [folder.path.parent.name for folder in unneeded(store)] == [
        "ingest",
        "ingest",
    ]
    assert unneeded(store) == unneeded(store, [world / "dataset"])
    delete(store, unneeded(store))
    assert trace(world / "dataset", store).num_problems() == 0
    assert "any more" not in render(trace(world / "dataset", store))


@pytest.mark.parametrize("fate", ["removed", "moved", "replaced"])
def test_dataset_that_is_no_longer_there_keeps_nothing_unless_its_new_place_is_named(
    world, fate
):
    store, dataset, moved = Store(world / "store"), world / "dataset", world / "moved"
    dataset.rename(moved)
    if fate == "removed":
        shutil.rmtree(moved)
    elif fate == "replaced":
        other = store.run(
            INGEST,
            IngestConfig(rate_hz=20.0),
            [store.source(world / "raw" / "demo_0.raw")],
        )
        shutil.copytree(other.path, dataset)
    assert store.destinations.gone() == [dataset]
    assert len(unneeded(store)) == 5
    if fate != "removed":
        assert len(unneeded(store, [moved])) == 2
        delete(
            store, unneeded(store)
        )  # and even if it is not named, its lineage reaches the raw files
        text = render(trace(moved, store))
        assert text.count("not in the store any more") == 3
        assert all(f"{world}/raw/demo_{i}.raw" in text for i in range(2))
        assert trace(moved, store).num_problems() == 0


def test_store_that_was_made_anew_learns_of_a_dataset_when_its_run_is_repeated(world):
    store, raw = Store(world / "other"), world / "raw"
    episodes = [
        store.run(INGEST, IngestConfig(), [store.source(raw / f"demo_{i}.raw")])
        for i in range(2)
    ]
    merged = store.run(MERGE, IngestConfig(), episodes)
    assert len(unneeded(store)) == 3
    store.run(Stage("finish", _finish), None, [merged], destination=world / "dataset")
    assert unneeded(store) == []


def test_what_lies_behind_an_artefact_that_is_gone_is_kept_all_the_same(world):
    store = Store(world / "store")
    [merged] = (store.root / "merge").iterdir()
    shutil.rmtree(merged)
    assert len(store.artefacts()) == 4
    assert (
        len(unneeded(store)) == 2
    )  # the two episodes stay: the dataset's own manifest tells of them


def test_lineage_through_another_dataset_outside_the_store_is_followed(world):
    store = Store(world / "store")
    derived = store.run(
        Stage("copy", _copy),
        None,
        [store.source(world / "dataset")],
        destination=world / "derived",
    )
    assert len(unneeded(store, [derived.path])) == 2


def _copy(config, inputs, out_dir):
    (out_dir / "all.bin").write_bytes((inputs[0] / "all.bin").read_bytes())


def test_folders_that_the_store_did_not_make_are_left_alone(world):
    store = Store(world / "store")
    mine, outside = store.root / "ingest" / "my_notes", world / "outside"
    for folder in (mine, outside):
        folder.mkdir()
        (folder / "thesis.txt").write_text("mine")
    (store.root / "ingest" / "0123456789abcdef").symlink_to(outside)
    shutil.copytree(world / "dataset", world / "copy")
    shutil.rmtree(world / "dataset")  # so that every artefact may go
    delete(store, unneeded(store))
    assert (mine / "thesis.txt").exists()
    assert (outside / "thesis.txt").exists()
    assert store.artefacts() == []
    assert (world / "copy" / "all.bin").exists()
    assert len(list((world / "raw").iterdir())) == 3


def test_dataset_of_unknown_origin_cannot_be_kept(world):
    with pytest.raises(DatasetError, match="no taccorl manifest"):
        unneeded(Store(world / "store"), [world / "raw"])
    with pytest.raises(DatasetError, match="does not exist"):
        unneeded(Store(world / "store"), [world / "datset"])


def test_what_a_run_is_building_now_is_neither_listed_nor_deleted(world):
    store = Store(world / "store")
    script = (
        "import sys; from pathlib import Path; from taccorl.lineage.stage import Stage; from taccorl.lineage.store import Store\n"
        "def wait(config, inputs, out_dir):\n"
        "    (out_dir / 'half').write_text('x'); print('building', flush=True); sys.stdin.readline()\n"
        "print(Store(Path(sys.argv[1])).run(Stage('wait', wait), None, []).path)"
    )
    words = [sys.executable, "-c", script, str(store.root)]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "building\n"
        listed = unneeded(store)
        assert len(listed) == 2
        assert not any("wait" in str(folder.path) for folder in listed)
        assert delete(store, listed) == []
        made, _ = process.communicate("\n", timeout=20)
    assert (Path(made.strip()) / "half").exists()


# The command.


def test_command_lists_first_and_deletes_only_with_yes(world, capsys):
    words = ["prune", f"--store={world / 'store'}"]
    assert main([*words, f"--keep={world / 'dataset'}"]) == 0
    out = capsys.readouterr().out
    assert (
        f"not needed for 1 dataset: 2 of 5 folders in {world / 'store'}, 0.0 MB" in out
    )
    assert "Nothing was deleted" in out
    assert len(Store(world / "store").artefacts()) == 5
    assert main([*words, "--yes=true"]) == 0
    assert "Deleted 2 folders." in capsys.readouterr().out
    assert len(Store(world / "store").artefacts()) == 3
    run_and_die(world / "store")
    assert main([*words, "--yes=true"]) == 0
    assert "Deleted 1 folder." in capsys.readouterr().out
    (world / "dataset").rename(world / "moved")
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "3 of 3 folders" in out
    assert (
        f"1 dataset gone or moved; name moved ones with --keep=DATASET:\n  {world / 'dataset'}\n"
        in out
    )


def test_command_explains_and_its_status_tells_if_anything_changed(world, capsys):
    words = ["explain", str(world / "dataset"), f"--store={world / 'store'}"]
    assert main(words) == 0
    assert "demo_1.raw" in capsys.readouterr().out
    (world / "raw" / "demo_1.raw").write_text("edited")
    assert main(words) == 1
    assert "✗ changed since" in capsys.readouterr().out


def test_explain_needs_no_store(world, capsys, monkeypatch):
    monkeypatch.chdir(world)
    assert main(["explain", "dataset"]) == 0
    assert not (world / "outputs").exists()
    with pytest.raises(TaccorlError, match="not a taccorl store"):
        main(["explain", "dataset", "--store=raw"])


def test_unknown_verb_names_the_nearest(capsys):
    with pytest.raises(TaccorlError, match="did you mean 'explain'"):
        main(["explian"])
    assert main([]) == 0
    assert capsys.readouterr().out.startswith("taccorl lineage explain PATH")
