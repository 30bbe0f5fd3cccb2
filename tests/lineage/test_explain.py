"""Explain: the tree down to the raw files, and every kind of change since is reported."""

import shutil
from pathlib import Path

import pytest

from taccorl.lineage.errors import LineageError
from taccorl.lineage.explain import render, trace
from taccorl.lineage.stage import Artefact, Stage
from taccorl.lineage.store import Store

from .toys import INGEST, MERGE_DATASET, IngestConfig, make_raw

GOOD = "✓ everything is as it was recorded"


class World:
    """Two raw files, an episode of each in the store, and a dataset merged from both."""

    def __init__(self, folder: Path) -> None:
        self.raw, self.store, self.dataset = (
            make_raw(folder / "raw"),
            Store(folder / "store"),
            folder / "dataset",
        )
        config = IngestConfig(rate_hz=20.0)
        self.sources = [self.store.source(path) for path in sorted(self.raw.iterdir())]
        self.episodes: list[Artefact] = [
            self.store.run(INGEST, config, [source]) for source in self.sources
        ]
        self.made = self.store.run(
            MERGE_DATASET, IngestConfig(), self.episodes, destination=self.dataset
        )


@pytest.fixture
def world(tmp_path):
    return World(tmp_path)


def problems(path: Path, store: Store | None = None) -> list[str]:
    def all_of(origin):
        return origin.problems + [p for child in origin.inputs for p in all_of(child)]

    return all_of(trace(path, store))


def test_tree_names_stage_version_key_digest_config_date_and_raw_sources(world):
    text = render(trace(world.dataset, world.store))
    lines = text.splitlines()
    made, episode = world.made.manifest, world.episodes[0].manifest
    assert lines[0] == f"merge v1  key {made['key']}  digest {made['digest'][:12]}"
    assert lines[1] == f"│  at {world.dataset}: 5 files"
    assert lines[2].startswith(
        f"│  made {made['created']} in {made['seconds']} s by python 3.12"
    )
    assert (
        text.count("by python") == 1
    )  # said once, as it is the same for the whole tree
    assert lines[3] == "│  config: all at its default"
    assert (
        lines[4]
        == f"├─ ingest v1  key {episode['key']}  digest {episode['digest'][:12]}"
    )
    assert "config: rate_hz=20.0 (all else at its default)" in lines[7]
    assert (
        lines[8]
        == f"│  └─ source  {world.raw}/demo_0.raw  digest {world.sources[0].digest[:12]}"
    )
    assert lines[9].startswith("└─ ingest v1") and lines[-1] == GOOD


def test_any_file_of_a_dataset_explains_the_dataset_and_a_raw_file_is_its_own_source(
    world,
):
    whole = render(trace(world.dataset, None))
    assert render(trace(world.dataset / "0.bin", None)) == whole
    assert render(trace(world.dataset / "meta" / "taccorl", None)) == whole
    raw = render(trace(world.raw / "demo_0.raw", None))
    assert raw.splitlines() == [
        f"source  {world.raw}/demo_0.raw  digest {world.sources[0].digest[:12]}",
        GOOD,
    ]
    with pytest.raises(LineageError, match="does not exist"):
        render(trace(world.raw / "demo_9.raw", None))


def test_changed_missing_and_added_files_are_reported_by_name(world):
    (world.dataset / "0.bin").write_text("edited")
    (world.dataset / "1.bin").unlink()
    (world.dataset / "extra.txt").write_text("new")
    (world.dataset / ".DS_Store").write_text("no data")
    changed, missing, added = problems(world.dataset)
    assert changed.startswith("changed since: 0.bin, digest ")
    assert missing.startswith("missing: 1.bin, digest ")
    assert added == "added since: extra.txt"
    assert render(trace(world.dataset, None)).endswith(
        "✗ differs from the record in 3 places"
    )


def test_input_replaced_by_another_artefact_is_reported(world, tmp_path):
    made = world.store.run(
        INGEST,
        IngestConfig(rate_hz=1.0),
        [world.store.source(world.raw / "demo_0.raw")],
    )
    later = world.store.run(
        MERGE_DATASET, IngestConfig(), [made], destination=tmp_path / "later"
    )
    shutil.rmtree(made.path)
    shutil.copytree(world.episodes[0].path, made.path)
    [problem] = problems(later.path)
    assert (
        problem
        == f"holds something else now: digest {made.digest[:12]} went into the step above"
    )


def test_store_that_was_moved_is_found_by_key(world, tmp_path):
    (tmp_path / "store").rename(tmp_path / "elsewhere")
    moved = Store(tmp_path / "elsewhere")
    assert "not in the store any more" in render(trace(world.dataset, None))
    assert "not in the store any more" not in render(trace(world.dataset, moved))
    (moved.root / "ingest" / world.episodes[1].path.name / "data" / "3.bin").write_text(
        "edited"
    )  # found, so judged
    assert [
        problem.partition(",")[0] for problem in problems(world.dataset, moved)
    ] == ["changed since: data/3.bin"]


def test_dataset_whose_store_is_gone_still_tells_its_lineage_down_to_the_raw_files(
    world, tmp_path
):
    again = Store(tmp_path / "other").run(
        Stage("copy", _write),
        None,
        [world.store.source(world.dataset)],
        destination=tmp_path / "derived",
    )
    merge_key = world.made.manifest["key"]
    for gone in (world.store.root, tmp_path / "other", world.dataset):
        shutil.rmtree(gone)
    lines = render(trace(again.path, None)).splitlines()
    assert lines[4] == f"└─ merge v1  key {merge_key}  digest {world.made.digest[:12]}"
    assert lines[5].endswith(f"not there any more: {world.dataset}")
    shown = "\n".join(lines)
    for episode, source in zip(world.episodes, world.sources, strict=True):
        assert (
            f"ingest v1  key {episode.path.name}  digest {episode.digest[:12]}" in shown
        )
        assert f"not in the store any more: {episode.path}" in shown
        assert f"source  {source.path}  digest {source.digest[:12]}" in shown
    assert (
        shown.count("config: rate_hz=20.0 (all else at its default)") == 2
        and lines[-1] == GOOD
    )
    (world.raw / "demo_0.raw").write_text(
        "edited"
    )  # the raw files are judged all the same
    (world.raw / "demo_1.raw").unlink()
    assert [problem.split(":")[0] for problem in problems(again.path)] == [
        "changed since",
        "missing",
    ]


def test_manifest_without_its_inputs_records_says_that_they_are_missing(world):
    """As written before manifests carried them, and as any artefact in a store is."""
    merged = world.store.run(MERGE_DATASET, IngestConfig(), world.episodes)
    shutil.rmtree(world.episodes[0].path)
    assert problems(merged.path) == ["missing: there is nothing at this path now"]


# The paths of this very run.


@pytest.fixture
def mine(world, tmp_path):
    """A dataset of the user's copy of a file whose equal was read before, from another path."""
    copy = tmp_path / "my recording.raw"
    shutil.copy(world.raw / "demo_0.raw", copy)
    source = world.store.source(copy)
    episode = world.store.run(INGEST, IngestConfig(rate_hz=20.0), [source])
    assert episode == world.episodes[0]
    world.store.run(
        MERGE_DATASET,
        IngestConfig(),
        [episode],
        destination=tmp_path / "mine",
        sources=[source],
    )
    return tmp_path / "mine"


def test_the_users_own_file_is_named_and_the_path_of_its_equal_is_only_mentioned(
    mine, world, tmp_path
):
    lines = render(trace(mine, world.store)).splitlines()
    digest = world.sources[0].digest[:12]
    assert lines[4] == f"├─ source  {tmp_path}/my recording.raw  digest {digest}"
    assert lines[5].startswith("└─ ingest v1")
    assert (
        lines[9]
        == f"   └─ source  digest {digest}  first read from {world.raw}/demo_0.raw"
    )
    assert lines[10:] == [GOOD]


@pytest.mark.parametrize("store_is_there", [True, False])
def test_change_of_the_users_own_file_is_reported_and_that_of_its_equal_is_not(
    mine, world, tmp_path, store_is_there
):
    store = world.store if store_is_there else None
    if not store_is_there:
        shutil.rmtree(world.store.root)
    (world.raw / "demo_0.raw").unlink()
    assert problems(mine, store) == []
    (tmp_path / "my recording.raw").write_text("edited")
    assert [problem.split(":")[0] for problem in problems(mine, store)] == [
        "changed since"
    ]
    (tmp_path / "my recording.raw").unlink()
    assert [problem.split(":")[0] for problem in problems(mine, store)] == ["missing"]


def test_input_used_twice_is_explained_once(world, tmp_path):
    twice = world.store.run(
        MERGE_DATASET,
        IngestConfig(),
        [world.episodes[0]] * 2,
        destination=tmp_path / "twice",
    )
    text = render(trace(twice.path, world.store))
    assert text.count("demo_0.raw") == 1
    assert text.count("(see above)") == 1


RECORDINGS = [[f"réc {i}.mcap", None, "written"] for i in range(100)]
SHOWN = ", ".join(f"[réc {i}.mcap, written]" for i in range(4))


@pytest.mark.parametrize(
    ("config", "shown"),
    [
        (
            {"noise": {"std_m": 0.01}, "name": "cup"},
            "name=cup, noise.std_m=0.01",
        ),  # plain data declare no defaults
        (None, "none"),
        (
            {"recordings": RECORDINGS, "part": None, "fit": True, "pads": []},
            f"fit=true, pads=[], recordings=[{SHOWN}, … 96 more]",
        ),
        (
            {"twin": "arms:\n  left: 1\n\n" + "x" * 5000, "seed": 3},
            "seed=3, twin=arms: left: 1 xxx",
        ),
    ],
)
def test_config_is_shown_in_one_line_to_be_read_not_parsed(tmp_path, config, shown):
    store = Store(tmp_path / "store")
    text = render(trace(store.run(Stage("one", _write), config, []).path, store))
    (line,) = [line for line in text.splitlines() if "config:" in line]
    assert f"config: {shown}" in line and len(line) < 500
    assert line.endswith((shown, "characters, all in its manifest.json)"))


def _write(config, inputs, out_dir):
    (out_dir / "one").write_text("x")
