"""Digests: known values, what counts and what does not; and whether an artefact's files are what its manifest says."""

import dataclasses
import enum
import errno
import hashlib
import json
import logging
import os
from pathlib import Path

import draccus
import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.lineage import digest, manifest
from taccorl.lineage.canonical import (
    canonical,
    canonical_text,
    differences,
    not_default,
)
from taccorl.lineage.digest import (
    DigestCache,
    digest_bytes,
    digest_each,
    digest_file,
    digest_files,
)
from taccorl.lineage.errors import LineageError
from taccorl.lineage.manifest import is_verified, verify, write_manifest
from taccorl.training.reading import _warn_unverified

PLACE = "meta/taccorl/manifest.json"


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    (tmp_path / "data").mkdir()
    for name in ("a", "b", "c"):
        (tmp_path / "data" / name).write_bytes(name.encode() * 1000)
    files = digest_each(tmp_path)
    write_manifest(tmp_path, PLACE, {"files": files, "digest": digest_files(files)})
    return tmp_path


def test_untouched_files_are_what_was_stored(stored):
    assert not is_verified(stored)
    found = verify(stored)
    assert found is not None and (found.num_files, found.changed, found.missing) == (
        3,
        (),
        (),
    )
    assert is_verified(stored)
    assert digest_each(stored).keys() == {"data/a", "data/b", "data/c", PLACE}, (
        "the mark is no part of the content"
    )


def test_changed_and_missing_files_are_named_also_with_their_old_times(stored):
    verify(stored)
    path = stored / "data" / "b"
    times = path.stat()
    path.write_bytes(b"b" * 999 + b"B")
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    (stored / "data" / "c").unlink()
    assert not is_verified(stored)
    found = verify(stored)
    assert found is not None and (found.changed, found.missing) == (
        ("data/b",),
        ("data/c",),
    )
    assert not is_verified(stored)


def test_another_manifest_is_not_verified(stored):
    verify(stored)
    (stored / "data" / "d").write_bytes(b"d")
    files = digest_each(stored / "data")
    (stored / PLACE).unlink()
    write_manifest(
        stored,
        PLACE,
        {"files": {f"data/{k}": v for k, v in files.items()}, "digest": "other"},
    )
    assert not is_verified(stored)


def test_a_file_that_changes_while_others_are_read_is_not_taken_as_verified(
    stored, monkeypatch
):
    def read(path: Path) -> str:
        digest = digest_file(path)
        if path.name == "b":
            path.write_bytes(b"changed after it was read")
        return digest

    monkeypatch.setattr(manifest, "digest_file", read)
    found = verify(stored)
    assert found is not None and not found.changed
    assert not is_verified(stored)


def test_a_file_that_cannot_be_read_does_not_hide_the_others(stored, monkeypatch):
    def read(
        path: Path,
    ) -> str:  # root may read everything, so that a mode of 000 would show nothing
        if path.name == "a":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return digest_file(path)

    monkeypatch.setattr(manifest, "digest_file", read)
    (stored / "data" / "b").write_bytes(b"x")
    found = verify(stored)
    assert found is not None and found.changed == ("data/b",)
    assert found.unreadable == ("data/a (Permission denied)",)


def test_a_name_that_no_file_can_have_is_missing_or_unreadable(stored):
    files = {"x" * 5000: "0" * 64}
    (stored / PLACE).unlink()
    write_manifest(stored, PLACE, {"files": files, "digest": digest_files(files)})
    found = verify(stored)
    assert found is not None and len(found.missing) + len(found.unreadable) == 1


@pytest.mark.parametrize(
    "content",
    [
        '{"files": 3}',
        '{"files": [1, 2]}',
        '{"files": {}}',
        "[" * 200_000,
        '{"files": null}',
    ],
)
def test_a_manifest_of_nonsense_is_damaged_and_does_not_stop_training(
    content, stored, caplog
):
    if content.startswith("{"):
        content = json.dumps(
            json.loads((stored / PLACE).read_text()) | json.loads(content)
        )
    (stored / PLACE).write_text(content)
    with pytest.raises(LineageError):
        verify(stored)
    _warn_unverified(stored)
    assert "have not been compared" in caplog.text


def test_a_list_of_files_that_was_changed_is_a_damaged_manifest(stored):
    content = json.loads((stored / PLACE).read_text())
    del content["files"]["data/a"]
    (stored / PLACE).write_text(json.dumps(content))
    with pytest.raises(LineageError, match=r"manifest\.json: is damaged"):
        verify(stored)


@pytest.mark.parametrize("name", ["../other", "/etc/hostname", "data/../../other"])
def test_a_file_outside_of_the_folder_is_not_read(name, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "other").write_bytes(b"other")
    files = {name: "0" * 64}
    write_manifest(folder, PLACE, {"files": files, "digest": digest_files(files)})
    with pytest.raises(LineageError, match="outside"):
        verify(folder)


def test_a_folder_of_somebody_else_has_nothing_to_compare_with(tmp_path):
    (tmp_path / "manifest.json").write_text("{}")
    assert verify(tmp_path) is None and not is_verified(tmp_path)


def test_training_says_once_that_a_dataset_was_never_compared(stored, caplog):
    with caplog.at_level(logging.WARNING, "taccorl.training.reading"):
        for _ in range(2):
            _warn_unverified(stored)
        assert len(caplog.records) == 1 and f"taccorl check {stored}" in caplog.text
        caplog.clear()
        other = stored.with_name("other")
        stored.rename(other)
        verify(other)
        _warn_unverified(other)
        assert not caplog.records


# ---- digests ----

SHA256_ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2, appendix B.1


def write(path: Path, content: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return path


def test_parts_are_told_apart_by_their_lengths():
    by_hand = hashlib.sha256(b"\2\0\0\0\0\0\0\0ab" + b"\1\0\0\0\0\0\0\0c").hexdigest()
    assert digest_bytes(b"ab", b"c") == by_hand
    assert digest_bytes(b"a", b"bc") != by_hand


def test_folder_digest_sees_names_and_contents_but_neither_times_nor_hidden_files(
    tmp_path,
):
    write(tmp_path / "x" / "b" / "two", "2")
    write(tmp_path / "x" / "one", "abc")
    write(tmp_path / "y" / "one", "abc")
    write(tmp_path / "y" / "b" / "two", "2")
    os.utime(tmp_path / "y" / "one", (1, 1))
    write(tmp_path / "y" / ".DS_Store", "junk")
    write(tmp_path / "y" / ".cache" / "junk", "junk")
    (tmp_path / "y" / "empty").mkdir()
    expected = digest_files(
        {"one": SHA256_ABC, "b/two": hashlib.sha256(b"2").hexdigest()}
    )
    assert (
        manifest.content_digest(tmp_path / "x")
        == manifest.content_digest(tmp_path / "y")
        == expected
    )
    (tmp_path / "y" / "one").rename(tmp_path / "y" / "uno")
    assert manifest.content_digest(tmp_path / "y") != expected


def test_link_to_a_file_counts_as_the_file_and_link_to_a_folder_is_refused(tmp_path):
    write(tmp_path / "x" / "one", "abc")
    (tmp_path / "y").mkdir()
    (tmp_path / "y" / "one").symlink_to(tmp_path / "x" / "one")
    assert manifest.content_digest(tmp_path / "y") == manifest.content_digest(
        tmp_path / "x"
    )
    (tmp_path / "y" / "linked").symlink_to(tmp_path / "x")
    with pytest.raises(LineageError, match=r"linked .*link to a folder"):
        manifest.content_digest(tmp_path / "y")


@pytest.mark.parametrize("kind", ["absent", "folder", "pipe", "broken link"])
def test_what_has_no_content_is_named(tmp_path, kind):
    path = tmp_path / "thing"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "broken link":
        path.symlink_to("nowhere")
    with pytest.raises(LineageError, match="thing"):
        digest_file(path)


def test_file_touched_just_now_is_not_cached_and_a_torn_entry_is_ignored(
    tmp_path, monkeypatch
):
    cache, path = DigestCache(tmp_path / "cache"), write(tmp_path / "a", "abc")
    digest_file(path, cache)
    assert not list(tmp_path.rglob("*.json"))
    monkeypatch.setattr(digest, "FRESH_S", -1.0)
    digest_file(path, cache)
    [entry] = cache.folder.rglob("*.json")
    entry.write_text(entry.read_text()[:20])
    assert digest_file(path, cache) == SHA256_ABC


# ---- canonical texts ----


class Colour(enum.Enum):
    RED = 1


@dataclasses.dataclass(frozen=True)
class Timing:
    rate_hz: float = 30.0
    clock: str = "log"


@dataclasses.dataclass(frozen=True)
class Ingest:
    source: Path
    timing: Timing = dataclasses.field(default_factory=Timing)
    workers: int = dataclasses.field(default=1, compare=False)


class Reader(draccus.ChoiceRegistry):
    pass


@Reader.register_subclass("mcap")
@dataclasses.dataclass
class McapReader(Reader):
    strict: bool = True


@Reader.register_subclass("hdf5")
@dataclasses.dataclass
class Hdf5Reader(Reader):
    strict: bool = True


def test_text_is_written_out():
    text = canonical_text(
        {
            "b": (1, 2.5, None),
            "a": {"deep": True, "at": Path("x/y"), "colour": Colour.RED},
        }
    )
    assert text == '{"a":{"at":"x/y","colour":"RED","deep":true},"b":[1,2.5,null]}'


def test_dataclass_is_its_type_and_fields_without_those_that_say_how():
    expected = {
        "source": "raw",
        "timing": {"clock": "log", "rate_hz": 30.0, "type": "Timing"},
        "type": "Ingest",
    }
    assert canonical(Ingest(Path("raw"), workers=8)) == expected


def test_equal_configs_have_equal_text_and_others_do_not():
    assert canonical_text({"a": 1, "b": Path("x")}) == canonical_text(
        {"b": "x", "a": 1}
    )
    assert canonical_text(
        [np.float64(0.1), np.int32(3), np.True_, np.str_("s")]
    ) == canonical_text([0.1, 3, True, "s"])
    assert canonical_text(True) != canonical_text(1) != canonical_text(1.0)


def test_two_plugins_with_the_same_fields_differ_by_their_choice_name():
    assert canonical(McapReader()) == {"strict": True, "type": "mcap"}
    assert canonical(Hdf5Reader()) == {"strict": True, "type": "hdf5"}


@pytest.mark.parametrize(
    ("config", "named"),
    [
        ({"a": [1.0, float("nan")]}, r"config\.a\[1\] is nan"),
        ({"a": float("inf")}, r"config\.a is inf"),
        ({"tags": {"x", "y"}}, r"config\.tags is a set"),
        (
            Ingest(Path("raw"), Timing(rate_hz=object())),
            r"config\.timing\.rate_hz is a object",
        ),  # type: ignore[arg-type]
        ({"gains": np.zeros(3)}, r"config\.gains is a ndarray"),
        ({1: "x"}, "key 1 of type int"),
        ({"cls": Timing}, r"config\.cls is a type"),
    ],
)
def test_what_has_no_one_text_is_refused_by_name(config, named):
    with pytest.raises(TaccorlError, match=named) as caught:
        canonical(config)
    assert isinstance(caught.value, TypeError)


def test_only_settings_off_their_default_are_named():
    assert not_default(Timing()) == {}
    assert not_default(Ingest(Path("raw"), Timing(rate_hz=20.0), workers=3)) == {
        "source": "raw",
        "timing.rate_hz": 20.0,
    }
    assert not_default({"rate_hz": 20.0}) is None


def test_differences_between_two_configs_are_spelled_out():
    old, new = (
        {"a": {"b": 30.0, "c": "x"}, "d": [1]},
        {"a": {"b": 20.0, "c": "x"}, "e": None},
    )
    assert differences(old, new) == [
        "a.b: 30.0 → 20.0",
        "d: [1] → absent",
        "e: absent → null",
    ]
    assert differences(old, old) == []
