"""Whether an artefact's files are what its manifest says."""

import errno
import json
import logging
import os
from pathlib import Path

import pytest

from taccorl.lineage import manifest
from taccorl.lineage.digest import digest_each, digest_file, digest_files
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
    assert found is not None and (found.num_files, found.changed, found.missing) == (3, (), ())
    assert is_verified(stored)
    assert digest_each(stored).keys() == {"data/a", "data/b", "data/c", PLACE}, "the mark is no part of the content"


def test_changed_and_missing_files_are_named_also_with_their_old_times(stored):
    verify(stored)
    path = stored / "data" / "b"
    times = path.stat()
    path.write_bytes(b"b" * 999 + b"B")
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    (stored / "data" / "c").unlink()
    assert not is_verified(stored)
    found = verify(stored)
    assert found is not None and (found.changed, found.missing) == (("data/b",), ("data/c",))
    assert not is_verified(stored)


def test_another_manifest_is_not_verified(stored):
    verify(stored)
    (stored / "data" / "d").write_bytes(b"d")
    files = digest_each(stored / "data")
    (stored / PLACE).unlink()
    write_manifest(stored, PLACE, {"files": {f"data/{k}": v for k, v in files.items()}, "digest": "other"})
    assert not is_verified(stored)


def test_a_file_that_changes_while_others_are_read_is_not_taken_as_verified(stored, monkeypatch):
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
    def read(path: Path) -> str:  # root may read everything, so that a mode of 000 would show nothing
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
    "content", ['{"files": 3}', '{"files": [1, 2]}', '{"files": {}}', "[" * 200_000, '{"files": null}']
)
def test_a_manifest_of_nonsense_is_damaged_and_does_not_stop_training(content, stored, caplog):
    if content.startswith("{"):
        content = json.dumps(json.loads((stored / PLACE).read_text()) | json.loads(content))
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
