"""Datasets whose pictures are frames in the cache alone: the numbers of the video form, frames as rendered, refused elsewhere."""

import dataclasses
import shutil
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from lerobot.datasets import lerobot_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tiny_dataset import put_frames, tiny_episode, tiny_spec, write_spec, write_tiny

import taccorl.lerobot_plugin  # noqa: F401
from taccorl.cli.main import main as cli
from taccorl.cli.parse import cached_resolution
from taccorl.data.dataset import Dataset
from taccorl.data.lerobot_format import declare_pictures, merge, write_episodes
from taccorl.data.origin import Origin
from taccorl.data.spec import FeatureSpec
from taccorl.episodes.produce import produce
from taccorl.episodes.sources.mimicgen.augment import AugmentPlan
from taccorl.episodes.sources.mimicgen.from_dataset import make_simulation
from taccorl.episodes.sources.mimicgen.spec import load_mimic_spec
from taccorl.errors import DatasetError, TaccorlError
from taccorl.lineage.engines import LocalEngine
from taccorl.lineage.store import Store
from taccorl.policies.tactile_pi05.configuration_tactile_pi05 import TactilePI05Config
from taccorl.sim.part_poses import PARTS_KEY, POSE_NAMES, POSE_UNITS
from taccorl.training import reading, rendered_frames
from taccorl.training.cotrain import publish
from taccorl.training.frame_cache import CacheRequest, FramesConfig, resized
from taccorl.training.reading import FastReader
from taccorl.training.rendered_frames import render_frames

FRONT = "observation.images.front"


@pytest.fixture
def declared(tmp_path: Path) -> Path:
    """Numbers of two episodes, 14 and 11 rows, with a camera in info.json and no video."""
    root = write_tiny(tmp_path / "declared", rows=(14, 11), cameras=0)
    declare_pictures(root, tiny_spec(cameras=1))
    return root


def load(
    root: Path, monkeypatch: pytest.MonkeyPatch, request: CacheRequest | None
) -> LeRobotDataset:
    monkeypatch.setattr(reading, "_requested", request)
    monkeypatch.setattr(lerobot_dataset, "DatasetReader", FastReader)
    return LeRobotDataset(
        "local/tiny", root=root, video_backend="pyav", return_uint8=True
    )


def test_the_plain_reader_refuses_it_with_the_way_out_and_check_does_not_crash(
    declared, tmp_path, monkeypatch, capsys
):
    with pytest.raises(
        DatasetError,
        match=r"declared: has no videos of observation\.images\.front.*--dataset\.cache=",
    ):
        load(declared, monkeypatch, None)
    dataset = Dataset(declared)
    assert dataset.unstored == (FRONT,) and dataset.episode(0).picture_keys == ()
    assert dataset.video_problems() == []
    with pytest.raises(
        DatasetError, match=r"observation\.images\.front: not stored as video"
    ):
        dataset.video(0, FRONT)
    with pytest.raises(
        DatasetError,
        match=r"declared: has no videos of .* only frames in the cache.*--pictures=cache",
    ):
        merge([declared, declared], tmp_path / "both")
    cli(["check", str(declared)])
    assert "not stored as video" in " ".join(capsys.readouterr().out.split())


def test_frames_that_the_cache_lacks_are_named_with_the_command(
    declared, tmp_path, monkeypatch
):
    request = CacheRequest(
        place="host", resolution=(20, 28), store=tmp_path / "store", device="cpu"
    )
    said = r"declared: has no videos of .*no frames of it at 20×28 pixels: taccorl collect .*--resolution=20x28"
    with pytest.raises(DatasetError, match=said):
        load(declared, monkeypatch, request).__getitems__([0])


def test_frames_in_the_cache_are_what_batches_and_rows_hold(
    declared, tmp_path, monkeypatch
):
    frames = np.random.default_rng(0).integers(0, 256, (25, 3, 20, 28), dtype=np.uint8)
    put_frames(Store(tmp_path / "store"), declared, FRONT, frames)
    monkeypatch.setattr(av, "open", lambda *_, **__: pytest.fail("PyAV is not needed"))
    request = CacheRequest(
        place="host", resolution=(20, 28), store=tmp_path / "store", device="cpu"
    )
    dataset = load(declared, monkeypatch, request)
    (batch,) = dataset.__getitems__([24, 3, 14])
    assert torch.equal(batch[FRONT], torch.from_numpy(frames[[24, 3, 14]]))
    assert torch.equal(dataset[14][FRONT], torch.from_numpy(frames[14]))
    assert batch["frame_index"].tolist() == [10, 3, 0]
    assert dataset.meta.stats[FRONT] == {}  # LeRobot puts ImageNet's there


def test_a_dataset_without_cameras_or_states_has_nothing_to_render(declared, tmp_path):
    with pytest.raises(DatasetError, match=r"has 1 cameras and no sim\.state"):
        render_frames(
            declared, None, Store(tmp_path / "store"), LocalEngine(), lambda _: None
        )


@pytest.mark.slow
def test_numbers_are_those_of_the_video_form_and_frames_those_rendered(
    collected, tmp_path, monkeypatch
):
    store, quiet = Store(tmp_path / "store"), lambda _: None
    robot = Origin("surrogate", "made up, not a robot")
    own = {
        "spec": load_mimic_spec("assembly_2"),
        "sources": store.dataset(collected),
        "origin": robot,
        "episodes": 1,
    }
    produce(AugmentPlan(**own), tmp_path / "video", store, quiet)
    with monkeypatch.context() as patch:
        patch.setattr(av, "open", lambda *_, **__: pytest.fail("PyAV is not needed"))
        produce(AugmentPlan(pictures="cache", **own), tmp_path / "cache", store, quiet)
        artefact, seconds = render_frames(
            tmp_path / "cache", (28, 28), store, LocalEngine(), quiet
        )
    assert set(seconds) == {"rendering", "resizing and writing"}
    video, numbers = Dataset(tmp_path / "video"), Dataset(tmp_path / "cache")
    assert set(video.info["features"]) == set(numbers.info["features"])
    keys = [key for key, f in numbers.info["features"].items() if f["dtype"] != "video"]
    theirs, ours = video.values(0, keys), numbers.values(0, keys)
    for key in keys:
        np.testing.assert_array_equal(ours[key], theirs[key])
    assert video.episode(0).origin == numbers.episode(0).origin == robot
    told = numbers.episode(0).provenance["simulation"]
    states = ours["sim.state"][[0, 100, -1]]
    shown = list(
        make_simulation(told).render_states(
            states, ["front", "left_wrist", "right_wrist"]
        )
    )
    for camera in ("front", "left_wrist", "right_wrist"):
        frames = np.load(artefact.path / f"observation.images.{camera}.npy")
        expected = resized(np.stack([images[camera] for images in shown]), (28, 28))
        np.testing.assert_array_equal(frames[[0, 100, -1]], expected)
    request = CacheRequest(
        place="host", resolution=(28, 28), store=tmp_path / "store", device="cpu"
    )
    (batch,) = load(tmp_path / "cache", monkeypatch, request).__getitems__([100])
    np.testing.assert_array_equal(
        batch[FRONT][0].numpy(), np.load(artefact.path / f"{FRONT}.npy")[100]
    )


@pytest.mark.slow
def test_frames_of_an_episode_are_rendered_once_and_copied_into_the_next_dataset(
    collected, tmp_path, monkeypatch
):
    store, said = Store(tmp_path / "store"), []
    own = {
        "spec": load_mimic_spec("assembly_2"),
        "sources": store.dataset(collected),
        "pictures": "cache",
    }

    def made(
        name: str, episodes: int, size: tuple[int, int] = (28, 28)
    ) -> tuple[Dataset, np.ndarray]:
        produce(
            AugmentPlan(episodes=episodes, **own),
            tmp_path / name,
            store,
            lambda _: None,
        )
        said.clear()
        artefact, _ = render_frames(
            tmp_path / name, size, store, LocalEngine(), said.append
        )
        return Dataset(tmp_path / name), np.load(artefact.path / f"{FRONT}.npy")

    _, frames_of_one = made("one", 1)
    assert said == ["episode 0 of 1: rendered"]
    assert len(rendered_frames._rendered_before(store, FramesConfig((28, 28)))) == 1
    with monkeypatch.context() as patch:  # another MuJoCo may draw other pictures
        patch.setattr(rendered_frames, "software", lambda: {"mujoco": "3.0.0"})
        assert rendered_frames._rendered_before(store, FramesConfig((28, 28))) == {}
    both, frames_of_both = made("both", 2)
    assert sorted(said) == ["episode 0 of 2: copied", "episode 1 of 2: rendered"]
    first = both.first_row(1)
    assert first == both.num_rows(0) > 0
    np.testing.assert_array_equal(frames_of_both[:first], frames_of_one)
    assert frames_of_both[first:].std() > 10  # the other was rendered, too

    made("one again", 1, (14, 14))
    assert said == ["episode 0 of 1: rendered"], "another resolution"
    with (tmp_path / "both" / "meta" / "info.json").open(
        "a"
    ) as file:  # no longer what its frames were made of
        file.write(" ")
    shutil.rmtree(tmp_path / "one")
    made("three", 3)
    assert said == [f"episode {k} of 3: rendered" for k in range(3)]


@pytest.fixture
def domains(tmp_path: Path) -> tuple[Path, Path, Store, np.ndarray]:
    """A surrogate's dataset with videos (14 and 11 rows); the twin's of 9 rows with stored frames and the parts' poses."""
    rng = np.random.default_rng(0)
    real = write_tiny(tmp_path / "real", rows=(14, 11))
    names = tuple(f"plug.{name}" for name in POSE_NAMES)
    poses = FeatureSpec(
        dtype="float32",
        shape=(9,),
        unit=POSE_UNITS,
        frame="world",
        rate_hz=30,
        range=(-9, 9),
        names=names,
        optional=True,
    )
    spec = tiny_spec(cameras=0)
    spec = dataclasses.replace(spec, features={**spec.features, PARTS_KEY: poses})
    episode = tiny_episode(spec, 9, seed=5)
    arrays = {
        **episode.arrays,
        PARTS_KEY: rng.uniform(-1, 1, (9, 9)).astype(np.float32),
    }
    write_episodes(
        [dataclasses.replace(episode, arrays=arrays, origin=Origin("twin", "made up"))],
        tmp_path / "twin",
    )
    spec = dataclasses.replace(
        spec, features={**tiny_spec(cameras=1).features, PARTS_KEY: poses}
    )
    write_spec(tmp_path / "twin", spec)
    declare_pictures(tmp_path / "twin", spec)
    frames = rng.integers(0, 256, (9, 3, 28, 28), dtype=np.uint8)
    store = Store(tmp_path / "store")
    put_frames(store, tmp_path / "twin", FRONT, frames)
    return real, tmp_path / "twin", store, frames


def test_a_merge_with_cached_frames_holds_both_domains_rows_frames_and_poses(
    domains, tmp_path, monkeypatch, capsys
):
    real, twin, store, frames = domains
    words = [
        f"--real={real}",
        f"--sim={twin}",
        f"--out={tmp_path / 'both'}",
        f"--store={store.root}",
    ]
    assert cli(["merge", *words]) == 2
    assert "twin: has no videos of observation.images.front" in " ".join(
        capsys.readouterr().err.split()
    )
    assert cli(["merge", *words, "--pictures=cache", "--resolution=28x28"]) == 0
    both, one, other = Dataset(tmp_path / "both"), Dataset(real), Dataset(twin)
    assert (
        both.num_episodes == 3
        and both.unstored == (FRONT,)
        and not (tmp_path / "both/videos").exists()
    )
    keys = ["action", "observation.tactile", "observation.state"]
    for k, (source, index) in enumerate([(one, 0), (one, 1), (other, 0)]):
        found, wanted = (
            both.values(k, [*keys, PARTS_KEY, "observation.is_sim"]),
            source.values(index, keys),
        )
        assert all(np.array_equal(found[key], wanted[key]) for key in keys)
        assert (found["observation.is_sim"] == (source is other)).all()
        if source is one:
            assert np.isnan(found[PARTS_KEY]).all()
        else:
            np.testing.assert_array_equal(
                found[PARTS_KEY], other.values(0, [PARTS_KEY])[PARTS_KEY]
            )

    request = CacheRequest(
        place="host", resolution=(28, 28), store=store.root, device="cpu"
    )
    dataset = load(tmp_path / "both", monkeypatch, request)
    (batch,) = dataset.__getitems__(list(range(34)))
    np.testing.assert_array_equal(batch[FRONT][25:].numpy(), frames)
    videos = resized(np.stack([*one.frames(0, FRONT), *one.frames(1, FRONT)]), (28, 28))
    np.testing.assert_array_equal(batch[FRONT][:25].numpy(), videos)
    stats = dataset.meta.stats
    assert stats[PARTS_KEY]["count"] == [9] and stats["action"]["count"] == [34]
    np.testing.assert_allclose(
        stats[PARTS_KEY]["mean"],
        other.values(0, [PARTS_KEY])[PARTS_KEY].mean(axis=0),
        atol=1e-6,
    )
    assert stats["observation.is_sim"]["mean"] == [pytest.approx(9 / 34)]

    cli(["check", str(tmp_path / "both")])
    said = capsys.readouterr().out
    assert "not_finite" not in said and "NaN in every row" in " ".join(said.split())
    config = TactilePI05Config(device="cpu", backbone="tiny", part_poses=True)
    with pytest.raises(TaccorlError, match=r"part_poses=true: .* in 25 of 34 rows"):
        config.match_dataset(dataset.meta)


def test_a_camera_that_only_one_of_two_datasets_without_videos_has_is_named(
    domains, tmp_path
):
    _, twin, store, _ = domains
    two = write_tiny(tmp_path / "two", rows=(12,), cameras=0)
    declare_pictures(two, tiny_spec(cameras=2))
    write_spec(two, tiny_spec(cameras=2))
    with pytest.raises(
        DatasetError, match=r"two has observation\.images\.\w+, but twin does not"
    ):
        publish([two], [twin], tmp_path / "both", store, videos=False)


@pytest.mark.parametrize("damage", ["cut", "bytes", "absent"])
def test_a_damaged_video_is_named_and_its_frames_are_not_merged(
    domains, tmp_path, capsys, damage
):
    real, twin, store, _ = domains
    (video,) = real.rglob("*.mp4")
    content = video.read_bytes()
    if damage == "absent":
        video.unlink()
    else:
        half = len(content) // 2
        video.write_bytes(
            content[:half]
            if damage == "cut"
            else content[:half] + bytes(200) + content[half + 200 :]
        )
    words = [
        f"--real={real}",
        f"--sim={twin}",
        f"--out={tmp_path / 'both'}",
        f"--store={store.root}",
    ]
    assert cli(["merge", *words, "--pictures=cache", "--resolution=28x28"]) == 2
    assert video.name in capsys.readouterr().err


@pytest.mark.parametrize("text", ["112", "112x0", "-1x5", "112×112", "99999x99999"])
def test_a_wrong_resolution_is_refused_at_once(text):
    with pytest.raises(TaccorlError, match=f"--resolution={text}: rows x columns"):
        cached_resolution(text, "cache")


def test_pictures_of_another_size_are_not_merged(domains, tmp_path):
    _, twin, store, _ = domains
    small = write_tiny(tmp_path / "small", rows=(12,), picture_px=28)
    with pytest.raises(
        DatasetError, match=r"front is \[56, 56, 3\] in twin, \[28, 28, 3\] in small"
    ):
        publish([small], [twin], tmp_path / "both", store, videos=False)
    assert not (tmp_path / "both").exists()
