"""The store: keys, manifests, destinations, and stages that fail."""

import errno
import hashlib
import json
import os
import resource
import shutil
import signal
import socket
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taccorl.errors import DatasetError, TaccorlError
from taccorl.lineage import digest, files
from taccorl.lineage.canonical import canonical_text
from taccorl.lineage.destinations import check_writable, write_new
from taccorl.lineage.digest import stamp
from taccorl.lineage.errors import LineageError
from taccorl.lineage.manifest import verify
from taccorl.lineage.prune import delete, unneeded
from taccorl.lineage.stage import Stage
from taccorl.lineage.store import Store, is_store

from .kill_points import temporary
from .toys import (
    INGEST,
    MERGE_DATASET,
    IngestConfig,
    make_raw,
    run_and_die,
    run_pipeline,
)


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


@pytest.fixture
def raw(tmp_path):
    return make_raw(tmp_path / "raw")


def write_one(config, inputs, out_dir):
    (out_dir / "one").write_text(str(config))


ONE = Stage("one", write_one)


def test_of_a_new_file_that_cannot_be_written_nothing_remains(tmp_path):
    path = tmp_path / "robot.yaml"
    in_child = os.fork()
    if in_child == 0:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(
            resource.RLIMIT_FSIZE, (100, 100)
        )  # as a full disk would: the second part of the text fails
        try:
            write_new(path, "x" * 200)
        except OSError:
            os._exit(7)
        os._exit(0)
    assert (
        os.waitstatus_to_exitcode(os.waitpid(in_child, 0)[1]) == 7 and not path.exists()
    )
    write_new(path, "kept")
    with pytest.raises(FileExistsError):
        write_new(path, "other")
    assert path.read_text() == "kept"


def test_a_place_that_cannot_be_written_is_named_before_any_work(tmp_path):
    (tmp_path / "file").touch()
    check_writable(tmp_path / "new" / "below")
    assert not (tmp_path / "new").exists()
    with pytest.raises(
        TaccorlError, match=f"--out={tmp_path}/file/x: {tmp_path}/file is not a folder"
    ):
        check_writable(tmp_path / "file" / "x")
    with pytest.raises(
        TaccorlError, match="--out=/proc/x/y: /proc cannot be written to"
    ):
        check_writable(Path("/proc/x/y"))


def test_key_is_the_first_16_hex_of_the_sha256_of_stage_version_config_and_inputs(
    store, raw
):
    source = store.source(raw / "demo_0.raw")
    by_hand = hashlib.sha256()
    for part in [
        "ingest",
        "1",
        '{"rate_hz":30.0,"type":"IngestConfig"}',
        hashlib.sha256(bytes(200)).hexdigest(),
    ]:
        by_hand.update(len(part).to_bytes(8, "little") + part.encode())
    assert canonical_text(IngestConfig()) == '{"rate_hz":30.0,"type":"IngestConfig"}'
    assert store.key(INGEST, IngestConfig(), [source]) == by_hand.hexdigest()[:16]


def test_key_changes_with_stage_version_config_and_inputs_and_with_nothing_else(
    store, raw
):
    a, b = (store.source(path) for path in sorted(raw.iterdir()))
    key = store.key(INGEST, IngestConfig(), [a, b])
    others = [
        store.key(replace(INGEST, version=2), IngestConfig(), [a, b]),
        store.key(replace(INGEST, name="other"), IngestConfig(), [a, b]),
        store.key(INGEST, IngestConfig(rate_hz=20.0), [a, b]),
        store.key(INGEST, IngestConfig(), [b, a]),
        store.key(INGEST, IngestConfig(), [a]),
    ]
    assert len({key, *others}) == 6
    copy = shutil.copy(raw / "demo_0.raw", raw / "elsewhere")
    assert (
        store.key(INGEST, IngestConfig(log=Path("any")), [store.source(Path(copy)), b])
        == key
    )


def test_manifest_says_what_was_made_from_what(store, raw):
    source = store.source(raw / "demo_1.raw")
    config = IngestConfig(rate_hz=20.0)
    artefact = store.run(INGEST, config, [source])
    manifest = json.loads((artefact.path / "manifest.json").read_text())
    assert (manifest["stage"], manifest["stage_version"]) == ("ingest", 1)
    assert manifest["config"] == {"rate_hz": 20.0, "type": "IngestConfig"}
    assert manifest["config_not_default"] == {"rate_hz": 20.0}
    assert manifest["inputs"] == [
        {"path": str(raw / "demo_1.raw"), "digest": source.digest, "key": None}
    ]
    assert (
        manifest["files"]["data/4.bin"]
        == hashlib.sha256(b"\1" * 196 + b"20.0").hexdigest()
    )
    assert set(manifest["files"]) == {f"data/{i}.bin" for i in range(5)}
    assert manifest["created"].endswith("+00:00") and 0.02 <= manifest["seconds"] < 10
    assert (
        manifest["software"]["python"].startswith("3.12")
        and "taccorl" in manifest["software"]
    )
    assert artefact.manifest == manifest
    assert source.manifest == {}


def test_equal_content_has_an_equal_digest_whatever_made_it_and_when(store):
    other = Stage("other", write_one, version=7)
    assert (
        store.run(ONE, "x", []).digest
        == store.run(other, "x", []).digest
        != store.run(ONE, "y", []).digest
    )


def test_dataset_used_as_a_source_is_the_artefact_it_is(store, raw, tmp_path):
    made = run_pipeline(store, raw, tmp_path / "dataset")
    (tmp_path / "dataset" / ".cache").mkdir()
    (tmp_path / "dataset" / ".cache" / "junk").write_text("dropped there by a tool")
    source = store.source(tmp_path / "dataset")
    assert source.digest == made.digest
    assert (
        store.run(ONE, "x", [source]).manifest["inputs"][0]["key"]
        == made.manifest["key"]
    )
    (tmp_path / "dataset" / "0.bin").write_text("edited")
    edited = store.source(tmp_path / "dataset")
    assert edited.digest != made.digest
    assert store.run(ONE, "x", [edited]).manifest["inputs"][0]["key"] is None


@pytest.mark.parametrize(
    "hurt",
    [lambda p: p.write_bytes(b"0123456x89"), lambda p: p.write_bytes(b""), Path.unlink],
)
def test_a_dataset_whose_numbers_are_not_as_written_is_refused_and_its_meta_may_change(
    store, tmp_path, hurt
):
    def write(config, inputs, out_dir):
        for name in ("data/file-000.parquet", "videos/front.mp4", "meta/stats.json"):
            (out_dir / name).parent.mkdir()
            (out_dir / name).write_bytes(b"0123456789")

    made = store.run(
        Stage("toy", write, manifest="meta/taccorl/manifest.json"),
        None,
        [],
        destination=tmp_path / "d",
    )
    assert store.dataset(tmp_path / "d") == store.source(tmp_path / "d")
    (tmp_path / "d/meta/stats.json").write_text("{}")  # as lerobot-edit-dataset does
    assert store.dataset(tmp_path / "d").digest != made.digest
    for name in ("data/file-000.parquet", "videos/front.mp4"):
        shutil.copytree(tmp_path / "d", tmp_path / "hurt")
        hurt(tmp_path / "hurt" / name)
        with pytest.raises(
            LineageError,
            match=rf"hurt: {name} is damaged or changed.*explain {tmp_path / 'hurt'}",
        ):
            store.dataset(tmp_path / "hurt")
        (
            tmp_path / "hurt/meta/taccorl/manifest.json"
        ).unlink()  # the way out that it names
        assert store.dataset(tmp_path / "hurt") == store.source(tmp_path / "hurt")
        shutil.rmtree(tmp_path / "hurt")
    with pytest.raises(LineageError):
        store.dataset(tmp_path / "nowhere")


def test_hidden_file_that_a_stage_wrote_is_part_of_the_artefact(store):
    def write_hidden(config, inputs, out_dir):
        (out_dir / ".info").mkdir()
        (out_dir / ".info" / "notes").write_text("x")

    artefact = store.run(Stage("hidden", write_hidden), None, [])
    assert list(artefact.manifest["files"]) == [".info/notes"]
    assert store.source(artefact.path).digest == artefact.digest


@pytest.mark.parametrize(
    "error", [ValueError("the gripper slipped"), OSError(errno.ENOSPC, "no space")]
)
def test_stage_that_raises_leaves_nothing_and_frees_its_lock(store, error):
    def fail(config, inputs, out_dir):
        (out_dir / "half").write_text("x")
        raise error

    for _ in range(2):
        with pytest.raises(
            type(error), match=r"slipped|/failing/"
        ):  # of a full disk also the place
            store.run(Stage("failing", fail), None, [])
    assert list((store.root / "failing").iterdir()) == []


def test_stage_may_run_other_stages_but_not_wait_for_itself(store):
    def outer(config, inputs, out_dir):
        (out_dir / "one").write_text(store.run(ONE, "x", []).digest)

    def itself(config, inputs, out_dir):
        store.run(Stage("itself", itself), None, [])

    made = store.run(Stage("outer", outer), None, [])
    assert (made.path / "one").read_text() == store.run(ONE, "x", []).digest
    with pytest.raises(RuntimeError, match="Deadlock"):
        store.run(Stage("itself", itself), None, [])


@pytest.mark.parametrize(
    "what", ["nothing", "the manifest", "a copied manifest", "no folder"]
)
def test_stage_that_wrote_no_artefact_is_named(store, what):
    inner = store.run(ONE, "x", [])

    def bad(config, inputs, out_dir):
        if what == "the manifest":
            (out_dir / "manifest.json").write_text("{}")
        elif what == "a copied manifest":
            shutil.copy(inner.path / "manifest.json", out_dir / "manifest.json")
        elif what == "no folder":
            out_dir.rmdir()

    place = (
        "meta/taccorl/manifest.json" if what == "a copied manifest" else "manifest.json"
    )
    with pytest.raises(LineageError, match="stage bad wrote"):
        store.run(Stage("bad", bad, manifest=place), None, [])
    assert list((store.root / "bad").iterdir()) == []


@pytest.mark.parametrize("name", ["", ".hidden", "a/b", "a b", "../up"])
def test_stage_name_that_is_no_folder_name_is_refused(name):
    with pytest.raises(LineageError, match="stage name"):
        Stage(name, write_one)
    with pytest.raises(LineageError, match="meta/taccorl"):
        Stage("one", write_one, manifest=name)  # where it would not be found


def test_input_that_is_gone_is_named(store, raw):
    source = store.source(raw / "demo_0.raw")
    (raw / "demo_0.raw").unlink()
    with pytest.raises(LineageError, match=r"demo_0\.raw no longer exists"):
        store.run(INGEST, IngestConfig(), [source])
    with pytest.raises(LineageError, match="does not exist"):
        store.source(raw / "demo_0.raw")


# Destination: the user's own folder.


def test_destination_holds_the_dataset_and_a_second_run_leaves_it_untouched(
    store, raw, tmp_path
):
    destination, log = tmp_path / "datasets" / "insert", tmp_path / "log"
    made = run_pipeline(store, raw, destination, log=log)
    assert made.path == destination
    assert (
        made.manifest["key"]
        == json.loads((destination / "meta" / "taccorl" / "manifest.json").read_text())[
            "key"
        ]
    )
    assert not (store.root / "merge").exists()
    (destination / "my_notes.txt").write_text("mine")
    assert run_pipeline(store, raw, destination, log=log) == made
    assert (destination / "my_notes.txt").read_text() == "mine"
    assert log.read_text().count("merge") == 1
    assert temporary(tmp_path / "datasets") == []


def test_manifest_of_a_destination_names_its_sources_and_carries_the_records_of_its_inputs(
    store, raw, tmp_path
):
    sources = [store.source(path) for path in sorted(raw.iterdir())]
    episodes = [store.run(INGEST, IngestConfig(), [source]) for source in sources]
    merged = store.run(MERGE_DATASET, IngestConfig(), episodes)
    made = store.run(
        ONE,
        "x",
        [merged, merged],
        destination=tmp_path / "d",
        sources=[*sources, *sources],
    )
    assert made.manifest["sources"] == [
        {"path": str(source.path), "digest": source.digest} for source in sources
    ]
    carried = made.manifest["ancestors"]
    assert set(carried) == {artefact.path.name for artefact in (*episodes, merged)}
    for artefact in (*episodes, merged):
        record = carried[artefact.path.name]
        assert record == {name: artefact.manifest[name] for name in record}
        assert set(artefact.manifest) - set(record) == {
            "taccorl_manifest",
            "place",
            "seconds",
            "software",
            "files",
        }
    with pytest.raises(LineageError, match="manifest, but there is no destination"):
        store.run(ONE, "x", [merged], sources=sources)


def test_destination_with_another_config_is_refused_with_both_named(
    store, raw, tmp_path
):
    source = store.source(raw / "demo_0.raw")
    made = store.run(
        MERGE_DATASET,
        IngestConfig(),
        [store.run(INGEST, IngestConfig(), [source])],
        destination=tmp_path / "d",
    )
    other = IngestConfig(rate_hz=20.0)
    with pytest.raises(DatasetError) as caught:
        store.run(
            MERGE_DATASET,
            other,
            [store.run(INGEST, other, [source])],
            destination=tmp_path / "d",
        )
    message = str(caught.value)
    for part in [
        str(tmp_path / "d"),
        made.manifest["key"],
        "rate_hz: 30.0 → 20.0",
        "inputs",
        "another destination",
    ]:
        assert part in message
    assert store.source(tmp_path / "d").digest == made.digest


@pytest.mark.parametrize("what", ["folder", "file", "broken link", "foreign manifest"])
def test_destination_that_is_the_users_is_never_touched(store, tmp_path, what):
    destination = tmp_path / "d"
    if what == "file":
        destination.write_text("mine")
    elif what == "broken link":
        destination.symlink_to("nowhere")
    else:
        destination.mkdir()
    if what == "folder":
        (destination / "thesis.txt").write_text("mine")
    elif what == "foreign manifest":
        (destination / "manifest.json").write_text('{"name": "a web app", "key": "x"}')
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DatasetError, match="is occupied"):
        store.run(ONE, "x", [], destination=destination)
    new = set(tmp_path.rglob("*")) - set(before)
    assert all(path.is_relative_to(store.root) for path in new)
    assert set(before) <= set(tmp_path.rglob("*"))


@pytest.mark.parametrize("linked", [False, True])
def test_empty_folder_is_a_free_destination(store, tmp_path, linked):
    (tmp_path / "d").mkdir()
    if linked:
        (tmp_path / "link").symlink_to("d")
    destination = tmp_path / ("link" if linked else "d")
    for _ in range(2):  # and found there by a second run
        store.run(ONE, "x", [], destination=destination)
        assert (tmp_path / "d" / "one").read_text() == "x"
        assert temporary(tmp_path) == []


def test_destination_in_the_store_is_refused(store):
    with pytest.raises(DatasetError, match="in one another"):
        store.run(ONE, "x", [], destination=store.root / "mine")


def test_scratch_of_a_dead_run_goes_with_the_next_one_or_with_prune_and_not_while_it_is_used(
    store,
):
    with store.scratch(ONE, {"of": "a"}) as folder:
        (folder / "x").write_text("x")
        assert (
            folder.is_relative_to(store.root)
            and unneeded(store) == []
            and store.artefacts() == []
        )
        dead = folder.with_name(f"{folder.name}-dead")
        shutil.copytree(folder, dead)
    assert not folder.exists()
    (found,) = unneeded(store)
    assert found.path == dead and found.is_leftover
    with store.scratch(ONE, {"of": "b"}):
        assert dead.exists()
    with store.scratch(ONE, {"of": "a"}) as folder:
        assert not dead.exists() and list(folder.iterdir()) == []


def test_leftovers_beside_a_destination_go_only_if_they_are_this_stores(
    store, tmp_path
):
    for root in (store.root, tmp_path / "other_store"):
        run_and_die(root, tmp_path / "d")
    assert len(temporary(tmp_path)) == 2
    store.run(ONE, "x", [], destination=tmp_path / "d")
    assert (
        len(temporary(tmp_path)) == 1
    )  # that one's maker may be alive: only the other store's lock can tell


# The store's own folder.


def test_store_marks_its_folder_and_refuses_a_folder_that_holds_other_things(tmp_path):
    Store(tmp_path / "new").run(ONE, "x", [])
    assert is_store(tmp_path / "new")
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("mine")
    with pytest.raises(LineageError, match="not a taccorl store"):
        Store(tmp_path / "home")
    assert [path.name for path in (tmp_path / "home").iterdir()] == ["thesis.txt"]


def test_store_is_made_by_the_first_stage_and_knows_digests_from_before(tmp_path, raw):
    old_s = time.time() - 60  # a file that was just written is not remembered
    os.utime(raw / "demo_0.raw", (old_s, old_s))
    store = Store(tmp_path / "store")
    store.digests.put(raw / "demo_0.raw", stamp(raw / "demo_0.raw"), "known")
    assert store.source(raw / "demo_0.raw").digest == "known"
    assert store.artefacts() == [] and store.find_key("0" * 16) is None
    assert not store.root.exists()
    store.run(ONE, "x", [])
    assert Store(store.root).source(raw / "demo_0.raw").digest == "known"


def test_who_waits_for_a_lock_says_for_what_and_who_holds_it(store, caplog):
    def wait():
        with store.lock("abc", what="recording, /data/out"):
            pass

    store.make()
    caplog.clear()
    waiting = threading.Thread(target=wait)
    with store.lock("abc"):
        waiting.start()
        begin_s = time.monotonic()
        while not caplog.records and time.monotonic() - begin_s < 30:
            time.sleep(0.01)
    waiting.join(30)
    (record,) = caplog.records
    assert record.levelname == "WARNING"  # is shown without any setting
    holder = f"process {os.getpid()} on {socket.gethostname()}"
    for part in (
        "recording, /data/out",
        str(store.root),
        holder,
        Path(sys.argv[0]).name,
    ):
        assert part in record.getMessage()


def flip(path, rng):
    """Flip one random bit."""
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    path.write_bytes(data)


def flip_and_set_the_times_back(path, rng):
    before = path.stat()
    flip(path, rng)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


DAMAGES = {
    "flipped": flip,
    "flipped, with its old times": flip_and_set_the_times_back,
    "truncated": lambda path, rng: os.truncate(path, rng.integers(path.stat().st_size)),
    "longer": lambda path, rng: path.write_bytes(path.read_bytes() + b"x"),
    "removed": lambda path, rng: path.unlink(),
}


@pytest.mark.parametrize("hurt", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("file", ["data/3.bin", "manifest.json"])
def test_a_damaged_artefact_of_the_store_is_made_anew_and_never_published(
    store, raw, tmp_path, hurt, file, caplog
):
    """The dataset is that of an undamaged store. A manifest's bits outside of its list of files may differ."""
    log, rng = tmp_path / "log", np.random.default_rng(0)
    expected = run_pipeline(store, raw, tmp_path / "before", log=log).digest
    for trial in range(3):
        (path,) = [
            p / file
            for p in store.artefacts()
            if (p / "data/3.bin").read_bytes().startswith(b"\1")
        ]
        hurt(path, rng)
        log.unlink()
        again = run_pipeline(
            Store(store.root), raw, tmp_path / f"again_{trial}", log=log
        )
        assert again.digest == expected and verify(again.path).changed == ()
        made = log.read_text().splitlines()
        if file == "data/3.bin" or hurt not in (flip, flip_and_set_the_times_back):
            assert (
                made == ["ingest demo_1.raw", "merge"]
                and f"{path.parents[file.count('/')]}: {file}" in caplog.text
            )
            assert (
                store.find(INGEST, IngestConfig(), [store.source(raw / "demo_1.raw")])
                is not None
            )


def test_an_artefact_is_read_again_only_if_its_size_or_times_changed(
    store, raw, monkeypatch
):
    monkeypatch.setattr(digest, "FRESH_S", -1.0)  # as if two seconds had passed
    made = store.run(INGEST, IngestConfig(), [store.source(raw / "demo_0.raw")])
    again = Store(store.root)
    source = again.source(raw / "demo_0.raw")
    with monkeypatch.context() as patched:
        patched.setattr(
            hashlib, "file_digest", lambda *_: pytest.fail("a file was read")
        )
        assert (
            again.run(INGEST, IngestConfig(), [source])
            == again.find(INGEST, IngestConfig(), [source])
            == made
        )
    flip(made.path / "data/0.bin", np.random.default_rng(0))
    assert again.damaged(made.path) == ["data/0.bin"]


@pytest.mark.parametrize("hurt", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_artefact_at_a_destination_is_refused_and_left_as_it_is(
    store, raw, tmp_path, hurt
):
    made = run_pipeline(store, raw, tmp_path / "dataset")
    hurt(made.path / "2.bin", np.random.default_rng(0))
    before = {p: p.read_bytes() for p in sorted(made.path.rglob("*")) if p.is_file()}
    with pytest.raises(
        DatasetError, match=r"dataset is what this run makes, but 2\.bin"
    ):
        run_pipeline(Store(store.root), raw, tmp_path / "dataset")
    assert {
        p: p.read_bytes() for p in sorted(made.path.rglob("*")) if p.is_file()
    } == before


# --- a published file is not stored twice


def write_rows(config, inputs, out_dir):
    (out_dir / "data").mkdir()
    (out_dir / "data/rows").write_bytes(np.random.default_rng(0).bytes(BIG))
    (out_dir / "data/few").write_bytes(b"few")


def publish_rows(config, inputs, out_dir):
    shutil.copytree(inputs[0] / "data", out_dir / "data")
    (out_dir / "meta").mkdir()
    shutil.copyfile(inputs[0] / "data/rows", out_dir / "meta/stats")


BIG = 1 << 20
ROWS, PUBLISHED = (
    Stage("rows", write_rows),
    Stage("published", publish_rows, manifest="meta/taccorl/manifest.json"),
)
ROWS_SHA = hashlib.sha256(np.random.default_rng(0).bytes(BIG)).hexdigest()


def publish(store, place):
    return store.run(
        PUBLISHED, None, [store.run(ROWS, None, [])], destination=place
    ).path


def sha(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def used_bytes(*places):
    """As du counts: a file with several names once."""
    files = [
        path.stat() for place in places for path in place.rglob("*") if path.is_file()
    ]
    return sum(
        {(file.st_dev, file.st_ino): file.st_blocks * 512 for file in files}.values()
    )


@pytest.fixture
def without_clones(monkeypatch):
    """As on ext4."""

    def refuse(*_):
        raise OSError(errno.EOPNOTSUPP, "no clones")

    monkeypatch.setattr(files.fcntl, "ioctl", refuse)


def test_a_published_file_is_a_link_to_the_stores_and_meta_is_its_own(
    store, tmp_path, without_clones
):
    made = publish(store, tmp_path / "a")
    (stored,) = store.root.glob("rows/*/data/rows")
    assert (made / "data/rows").samefile(stored) and not (made / "meta/stats").samefile(
        stored
    )
    assert not (made / "data/few").samefile(stored.with_name("few"))
    assert used_bytes(store.root, made) < 2.1 * BIG  # with meta/stats
    assert verify(made).changed == () and store.damaged(stored.parents[1]) == []
    assert not list(tmp_path.rglob("*.shared"))
    again = publish(
        store, tmp_path / "b"
    )  # the user's folders share nothing with each other
    assert (
        not (again / "data/rows").samefile(stored)
        and sha(again / "data/rows") == ROWS_SHA
    )


def test_what_prune_frees_is_what_no_published_dataset_holds(
    store, tmp_path, without_clones
):
    made = publish(store, tmp_path / "a").rename(tmp_path / "moved")
    (left,) = unneeded(store)
    assert left.size_bytes < BIG / 10
    delete(store, [left])
    assert sha(made / "data/rows") == ROWS_SHA and not left.path.exists()


@pytest.mark.parametrize("hurt", [flip, flip_and_set_the_times_back])
def test_what_is_edited_where_it_is_published_is_not_served(
    store, tmp_path, without_clones, hurt, caplog
):
    made = publish(store, tmp_path / "a")
    hurt(made / "data/rows", np.random.default_rng(1))
    edited = sha(made / "data/rows")
    with pytest.raises(
        DatasetError, match=r"data/rows is damaged or changed since written"
    ):
        publish(Store(store.root), tmp_path / "a")
    other = publish(Store(store.root), tmp_path / "b")
    assert (
        "data/rows damaged or changed since written, so that the artefact is not used"
        in caplog.text
    )
    assert sha(other / "data/rows") == ROWS_SHA and verify(other).changed == ()
    assert sha(made / "data/rows") == edited != ROWS_SHA  # the user's edit stays
    assert verify(made).changed == ("data/rows",)


def test_where_a_file_system_neither_clones_nor_links_are_two_copies(
    store, tmp_path, without_clones, monkeypatch
):
    def refuse(*_):
        raise OSError(errno.EXDEV, "another file system")

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    made = publish(store, tmp_path / "a")
    assert (
        sha(made / "data/rows") == ROWS_SHA
        and (made / "data/rows").stat().st_nlink == 1
    )
    assert verify(made).changed == () and not list(tmp_path.rglob("*.shared"))


def test_a_clone_is_taken_where_there_are_some(store, tmp_path, monkeypatch):
    def clone(to, request, source):
        assert request == 0x40049409
        to.write(os.pread(source, BIG, 0))

    monkeypatch.setattr(files.fcntl, "ioctl", clone)
    made = publish(store, tmp_path / "a")
    (stored,) = store.root.glob("rows/*/data/rows")
    assert not (made / "data/rows").samefile(stored) and verify(made).changed == ()
    assert (made / "data/rows").stat().st_mode == stored.stat().st_mode


def test_the_place_of_a_store_is_told_when_it_is_made(tmp_path, caplog):
    for _ in range(2):
        Store(tmp_path / "store").run(ONE, "x", [])
    assert [
        str(tmp_path / "store") in record.getMessage() for record in caplog.records
    ] == [True]
