"""Whole batches from cached frames are those of the plain reader; what does not fit or is damaged is said."""

import logging
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
from lerobot.datasets import lerobot_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.common.vla_utils import resize_with_pad_torch
from tiny_dataset import WINDOWS, assert_same, put_frames, tiny_spec, write_tiny
from torch.utils.data import DataLoader, default_collate

import taccorl.lerobot_plugin  # noqa: F401
from taccorl.data.dataset import Dataset
from taccorl.data.lerobot_format import declare_pictures
from taccorl.errors import DatasetError, TaccorlError
from taccorl.lineage.store import Store
from taccorl.training import frame_cache, reading
from taccorl.training.frame_cache import (
    CacheRequest,
    FrameIndex,
    Frames,
    require_joinable,
    resized,
)
from taccorl.training.reading import FastReader, WholeBatch, cache_request

FRONT = "observation.images.front"
ROWS = [0, 13, 14, 20, 36, 36, 3, 25]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(
        tmp_path_factory.mktemp("tiny") / "dataset",
        rows=(14, 11, 12),
        sim_episodes=1,
        cameras=2,
    )


def load(
    root: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: CacheRequest | None,
    **settings,
) -> LeRobotDataset:
    monkeypatch.setattr(reading, "_requested", request)
    monkeypatch.setattr(lerobot_dataset, "DatasetReader", FastReader)
    return LeRobotDataset(
        "local/tiny", root=root, video_backend="pyav", return_uint8=True, **settings
    )


def request(tmp_path: Path, place="host", resolution=None) -> CacheRequest:
    return CacheRequest(
        place=place, resolution=resolution, store=tmp_path / "store", device="cpu"
    )


# Of the eight cases those that have every pair of choices; the others are slow.
PAIRS = [
    ("host", WINDOWS, None),
    ("disk", None, None),
    ("host", None, [0, 2]),
    ("disk", WINDOWS, [0, 2]),
]
OTHERS = [
    ("disk", WINDOWS, None),
    ("host", None, None),
    ("disk", None, [0, 2]),
    ("host", WINDOWS, [0, 2]),
]


@pytest.mark.parametrize(
    ("place", "windows", "episodes"),
    [*PAIRS, *(pytest.param(*case, marks=pytest.mark.slow) for case in OTHERS)],
)
def test_a_batch_is_the_plain_reader_s_to_the_bit_and_the_type(
    root, tmp_path, monkeypatch, place, windows, episodes
):
    plain = load(root, monkeypatch, None, delta_timestamps=windows, episodes=episodes)
    cached = load(
        root,
        monkeypatch,
        request(tmp_path, place),
        delta_timestamps=windows,
        episodes=episodes,
    )
    rows = [row % len(plain) for row in ROWS]
    (batch,) = cached.__getitems__(rows)
    assert isinstance(batch, WholeBatch)
    assert_same(batch, default_collate([plain[row] for row in rows]))


def test_with_a_picture_for_every_third_row_batches_hold_the_rows_that_have_one(
    root, tmp_path, monkeypatch
):
    numbers = write_tiny(
        tmp_path / "numbers", rows=(14, 11, 12), sim_episodes=1, cameras=0
    )
    declare_pictures(numbers, tiny_spec(cameras=1), rows_per_picture=3)
    assert Dataset(numbers).rows_per_picture == 3
    index = FrameIndex.of_dataset(Dataset(numbers))
    # 14 rows: 0 3 6 9 12; 11 rows: 0 3 6 9; 12 rows: 0 3 6 9
    assert index.frames_E.tolist() == [5, 4, 4] and index.num_frames == 13
    assert index.of_rows()[[0, 2, 3, 13, 14, 24, 25, 36]].tolist() == [
        0,
        0,
        1,
        4,
        5,
        8,
        9,
        12,
    ]
    frames = np.random.default_rng(0).integers(0, 256, (13, 3, 20, 28), dtype=np.uint8)
    put_frames(Store(tmp_path / "store"), numbers, FRONT, frames)
    cached = load(
        numbers,
        monkeypatch,
        request(tmp_path, resolution=(20, 28)),
        delta_timestamps=WINDOWS,
    )
    (batch,) = cached.__getitems__([0, 2, 4, 13, 24, 36])
    assert batch["index"].tolist() == [0, 0, 3, 12, 23, 34]
    assert torch.equal(batch[FRONT], torch.from_numpy(frames[[0, 0, 1, 4, 8, 12]]))
    (same,) = cached.__getitems__([0, 0, 3, 12, 23, 34])
    assert_same(batch, same)
    assert (
        batch["action_is_pad"][3].tolist() == [False] * 2 + [True] * 8
    )  # rows 12 and 13 of 14
    (of_one,) = load(
        numbers, monkeypatch, request(tmp_path, resolution=(20, 28)), episodes=[2]
    ).__getitems__([4])
    assert of_one["index"].tolist() == [28] and torch.equal(
        of_one[FRONT][0], torch.from_numpy(frames[10])
    )


def test_frames_of_datasets_with_pictures_of_other_shares_of_rows_are_not_joined(
    tmp_path,
):
    parts = [write_tiny(tmp_path / f"part_{k}", rows=(14,), cameras=0) for k in (1, 3)]
    for k, part in zip((1, 3), parts, strict=True):
        declare_pictures(part, tiny_spec(cameras=1), rows_per_picture=k)
    with pytest.raises(DatasetError, match=r"part_1: 1, .*part_3: 3.*rows_per_picture"):
        require_joinable(parts, None, Store(tmp_path / "store"))


def test_smaller_pictures_are_those_that_the_policy_would_make_rounded(
    root, tmp_path, monkeypatch
):
    plain = load(root, monkeypatch, None)
    cached = load(root, monkeypatch, request(tmp_path, resolution=(20, 20)))
    (batch,) = cached.__getitems__(ROWS)
    expected = default_collate([plain[row] for row in ROWS])
    cameras = tuple(plain.meta.video_keys)
    assert_same(batch, expected, but=cameras)
    for key in cameras:
        full = expected[key].permute(0, 2, 3, 1).to(torch.float32) / 255
        small = resize_with_pad_torch(full, 20, 20).permute(0, 3, 1, 2)
        assert batch[key].shape == (len(ROWS), 3, 20, 20)
        assert (batch[key] / 255 - small).abs().max() <= 0.5 / 255 + 1e-6


def test_pictures_of_half_the_side_are_means_of_four_values_as_the_policy_makes_them():
    """(1 + 2 + 3 + 4) / 4 = 2.5: halves are rounded up, which is as near as down."""
    tiny = np.zeros((1, 2, 4, 3), np.uint8)
    tiny[0, :, :2, 0] = [[1, 2], [3, 4]]
    tiny[0, :, 2:, 1] = 200
    assert resized(tiny, (1, 2))[0, :, 0].tolist() == [[3, 0], [0, 200], [0, 0]]
    pictures = np.random.default_rng(0).integers(
        0, 256, (3, 224, 224, 3), dtype=np.uint8
    )
    wanted = resize_with_pad_torch(
        torch.from_numpy(pictures).to(torch.float32) / 255, 112, 112
    ).permute(0, 3, 1, 2)
    assert (
        torch.from_numpy(resized(pictures, (112, 112))) / 255 - wanted
    ).abs().max() <= 0.5 / 255 + 1e-6


def test_pictures_of_the_cameras_aspect_are_cut_at_the_black_bars():
    inside = np.random.default_rng(0).integers(0, 256, (3, 168, 224, 3), dtype=np.uint8)
    frames = np.zeros((3, 224, 224, 3), np.uint8)
    frames[:, 28:196] = inside  # 480 × 640 in a frame of 224 × 224
    assert np.array_equal(resized(frames, (84, 112)), resized(inside, (84, 112)))
    assert np.array_equal(
        resized(frames, (84, 112)), resized(frames, (112, 112))[:, :, 14:98]
    )
    with pytest.raises(
        TaccorlError, match=r"middle 126×224, but outside of it they are not black"
    ):
        resized(frames, (63, 112))


def test_lerobots_loader_gives_whole_batches_in_the_order_that_it_draws(
    root, tmp_path, monkeypatch
):
    settings = {
        "batch_size": 8,
        "sampler": ROWS * 2 + [7],
        "num_workers": 0,
        "pin_memory": False,
    }
    plain = load(root, monkeypatch, None, delta_timestamps=WINDOWS)
    cached = load(root, monkeypatch, request(tmp_path), delta_timestamps=WINDOWS)
    ours, theirs = (
        list(DataLoader(cached, **settings)),
        list(DataLoader(plain, **settings)),
    )
    assert [len(batch["index"]) for batch in ours] == [8, 8, 1]
    for a, b in zip(ours, theirs, strict=True):
        assert_same(a, b)


def test_another_run_decodes_nothing_and_another_dataset_or_resolution_decodes_its_own(
    root, tmp_path, monkeypatch, caplog
):
    def open_at(root: Path, resolution=None) -> str:
        caplog.clear()
        with caplog.at_level(logging.INFO):
            load(
                root, monkeypatch, request(tmp_path, resolution=resolution)
            ).__getitems__([0])
        return caplog.text

    assert "decoding 74 frames" in open_at(root) and "decoding" not in open_at(root)
    assert "decoding 74 frames" in open_at(root, (20, 20))
    other = write_tiny(tmp_path / "other", rows=(14, 11), cameras=2)
    assert "decoding 50 frames" in open_at(other)
    moved = shutil.copytree(root, tmp_path / "moved")
    assert "decoding" not in open_at(moved), "the content counts, not the place"


def test_a_full_disk_is_an_error_that_names_the_file_and_no_signal(tmp_path):
    free = os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize
    with pytest.raises(OSError, match=r"GB of frames") as raised:
        frame_cache.empty_frames(
            tmp_path, "front", 2 * free // (3 * 112 * 112), (112, 112)
        )
    assert raised.value.filename == str(tmp_path / "front.npy") and not list(
        tmp_path.iterdir()
    )


@pytest.mark.parametrize("damage", ["flipped", "truncated", "shorter"])
def test_damaged_frames_are_decoded_again_and_never_trained_on(
    root, tmp_path, monkeypatch, damage, caplog
):
    (before,) = load(root, monkeypatch, request(tmp_path)).__getitems__(ROWS)
    (file,) = (tmp_path / "store" / "frames").glob("*/observation.images.front.npy")
    rng, whole = np.random.default_rng(0), file.read_bytes()
    if damage == "flipped":
        place = int(rng.integers(len(whole)))
        file.write_bytes(
            whole[:place]
            + bytes([whole[place] ^ 1 << int(rng.integers(8))])
            + whole[place + 1 :]
        )
    elif damage == "truncated":
        os.truncate(file, int(rng.integers(len(whole))))
    else:
        np.save(file, np.load(file)[:-1])
    caplog.clear()
    (after,) = load(root, monkeypatch, request(tmp_path)).__getitems__(ROWS)
    assert_same(after, before)
    assert file.name in caplog.text and file.read_bytes() == whole


def test_damaged_frames_of_a_dataset_without_videos_are_named_and_the_command_that_makes_them(
    tmp_path, monkeypatch
):
    numbers = write_tiny(tmp_path / "numbers", rows=(14,), sim_episodes=1, cameras=0)
    declare_pictures(numbers, tiny_spec(cameras=1), rows_per_picture=1)
    made = put_frames(
        Store(tmp_path / "store"), numbers, FRONT, np.full((14, 3, 20, 28), 3, np.uint8)
    )
    load(numbers, monkeypatch, request(tmp_path, resolution=(20, 28))).__getitems__([0])
    os.truncate(made / f"{FRONT}.npy", 1000)
    with pytest.raises(
        DatasetError,
        match=r"no frames of it at 20×28 pixels: taccorl .* --pictures=cache",
    ):
        load(numbers, monkeypatch, request(tmp_path, resolution=(20, 28))).__getitems__(
            [0]
        )
    assert made.is_dir(), "nothing was removed that this command cannot make"


def test_a_video_that_ends_early_is_named_with_the_place(root, tmp_path, monkeypatch):
    cut = shutil.copytree(root, tmp_path / "cut")
    for manifest in cut.rglob("*manifest*"):
        manifest.unlink()
    front = sorted((cut / "videos" / "observation.images.front").rglob("*.mp4"))[0]
    other = write_tiny(tmp_path / "other", rows=(9,), cameras=2)
    shutil.copy(
        sorted((other / "videos" / "observation.images.front").rglob("*.mp4"))[0], front
    )
    with pytest.raises(
        DatasetError, match=r"mp4: 9 of its 37 frames exist, and none at 0\.3"
    ):
        load(cut, monkeypatch, request(tmp_path)).__getitems__([0])


def test_what_does_not_fit_goes_to_the_next_place_and_says_what_would(
    monkeypatch, caplog
):
    arrays = {"front": np.zeros((10, 3, 100, 100), np.uint8)}
    monkeypatch.setattr(frame_cache, "_free_memory_bytes", lambda: 200_000)
    with caplog.at_level(logging.WARNING):
        frames = Frames(arrays, "host", "cpu", numbers_bytes=100_000)
    assert frames.place == "disk"
    # 0.8 · 200 kB of 400 kB: √0.4 = 63 % of the side
    assert "63%" in caplog.text and "fewer episodes" in caplog.text
    caplog.clear()
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (300_000, 10**9))
    assert Frames(arrays, "gpu", "cuda:0").place == "disk"
    assert (
        "--dataset.cache=gpu" in caplog.text and "--dataset.cache=host" in caplog.text
    )
    assert Frames(arrays, "gpu", "cpu").place == "disk"


@pytest.mark.parametrize("cached", [True, False])
def test_a_policy_without_cameras_reads_no_frames(root, tmp_path, monkeypatch, cached):
    """Numbers are those of the plain reader; no video is opened, so they may be missing."""
    plain = load(root, monkeypatch, None, delta_timestamps=WINDOWS)
    numbers = {
        key: x
        for key, x in default_collate([plain[row] for row in ROWS]).items()
        if "images" not in key
    }
    monkeypatch.setattr(reading, "_reads_pictures", False)
    monkeypatch.setattr(av, "open", lambda *_, **__: pytest.fail("a video was opened"))
    ours = load(
        root,
        monkeypatch,
        request(tmp_path) if cached else None,
        delta_timestamps=WINDOWS,
    )
    found = (
        ours.__getitems__(ROWS)[0]
        if cached
        else default_collate([ours[row] for row in ROWS])
    )
    assert_same(found, numbers)
    assert not (tmp_path / "store").exists()


def test_options_that_go_with_no_cache_are_refused():
    def cfg(place="gpu", **changes):
        values = {
            "cache": place,
            "cache_store": "s",
            "streaming": False,
            "image_transforms": SimpleNamespace(enable=False),
        }
        policy = SimpleNamespace(image_resolution=(96, 96), device="cpu")
        return SimpleNamespace(
            dataset=SimpleNamespace(**values | changes),
            trainable_config=policy,
            num_workers=2,
        )

    assert cache_request(cfg("none")) is None
    found = cache_request(cfg())
    assert found == CacheRequest(
        place="gpu", resolution=(96, 96), store=Path("s"), device="cpu"
    )
    with pytest.raises(TaccorlError, match=r"--dataset\.cache=gpuu: .*gpu"):
        cache_request(cfg("gpuu"))
    with pytest.raises(TaccorlError, match=r"streaming"):
        cache_request(cfg(streaming=True))
    with pytest.raises(TaccorlError, match=r"image_transforms"):
        cache_request(cfg(image_transforms=SimpleNamespace(enable=True)))
