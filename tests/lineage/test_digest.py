"""Digests: known values, what counts and what does not, and a cache that never hides a change."""

import hashlib
import os
from pathlib import Path

import pytest

from taccorl.lineage import digest, manifest
from taccorl.lineage.digest import DigestCache, digest_bytes, digest_file, digest_files
from taccorl.lineage.errors import LineageError

SHA256_ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2, appendix B.1


def write(path: Path, content: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return path


def test_digest_of_a_file_is_its_sha256(tmp_path):
    assert digest_file(write(tmp_path / "a", "abc")) == SHA256_ABC


def test_parts_are_told_apart_by_their_lengths():
    by_hand = hashlib.sha256(b"\2\0\0\0\0\0\0\0ab" + b"\1\0\0\0\0\0\0\0c").hexdigest()
    assert digest_bytes(b"ab", b"c") == by_hand
    assert digest_bytes(b"a", b"bc") != by_hand


def test_folder_digest_sees_names_and_contents_but_neither_times_nor_hidden_files(tmp_path):
    write(tmp_path / "x" / "b" / "two", "2")
    write(tmp_path / "x" / "one", "abc")
    write(tmp_path / "y" / "one", "abc")
    write(tmp_path / "y" / "b" / "two", "2")
    os.utime(tmp_path / "y" / "one", (1, 1))
    write(tmp_path / "y" / ".DS_Store", "junk")
    write(tmp_path / "y" / ".cache" / "junk", "junk")
    (tmp_path / "y" / "empty").mkdir()
    expected = digest_files({"one": SHA256_ABC, "b/two": hashlib.sha256(b"2").hexdigest()})
    assert manifest.content_digest(tmp_path / "x") == manifest.content_digest(tmp_path / "y") == expected
    (tmp_path / "y" / "one").rename(tmp_path / "y" / "uno")
    assert manifest.content_digest(tmp_path / "y") != expected


def test_link_to_a_file_counts_as_the_file_and_link_to_a_folder_is_refused(tmp_path):
    write(tmp_path / "x" / "one", "abc")
    (tmp_path / "y").mkdir()
    (tmp_path / "y" / "one").symlink_to(tmp_path / "x" / "one")
    assert manifest.content_digest(tmp_path / "y") == manifest.content_digest(tmp_path / "x")
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


def test_file_touched_just_now_is_not_cached_and_a_torn_entry_is_ignored(tmp_path, monkeypatch):
    cache, path = DigestCache(tmp_path / "cache"), write(tmp_path / "a", "abc")
    digest_file(path, cache)
    assert not list(tmp_path.rglob("*.json"))
    monkeypatch.setattr(digest, "FRESH_S", -1.0)
    digest_file(path, cache)
    [entry] = cache.folder.rglob("*.json")
    entry.write_text(entry.read_text()[:20])
    assert digest_file(path, cache) == SHA256_ABC
