"""The cobot_magic file: layout of collect_data.py, commands one frame ahead, pictures that say which they are."""

import hashlib

import cv2
import h5py
import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.surrogate.drivers import PIPER_RAD_PER_DEG
from tests.recordings.pictures import read_frame_id
from tests.recordings.stand_in import StandInConfig, write_cobot_magic_hdf5

SMALL = {"duration_s": 2.0, "camera_size": (96, 128)}
FACTOR = PIPER_RAD_PER_DEG / np.radians(1)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("hdf5") / "episode_0.hdf5"
    return path, write_cobot_magic_hdf5(path, StandInConfig(**SMALL))


def test_layout_is_that_of_collect_data(written):
    with h5py.File(written[0]) as file:
        for name in ("observations/qpos", "observations/qvel", "observations/effort", "action"):
            assert (file[name].shape, file[name].dtype) == ((60, 14), np.float32)
        assert file["base_action"].shape == (60, 2)
        assert sorted(file["observations/images"]) == ["cam_high", "cam_left_wrist", "cam_right_wrist"]
        assert (bool(file.attrs["sim"]), bool(file.attrs["compress"])) == (False, True)
        assert file.attrs["origin"] == "stand-in recording, not a robot"


def test_action_is_the_command_of_the_next_frame(written):
    path, truth = written
    time_s = np.arange(60) / 30
    with h5py.File(path) as file:
        joints = [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12]
        qpos, action = file["observations/qpos"][:], file["action"][:]
    assert qpos[:, joints] == pytest.approx(truth.story.state(time_s)[:, joints] * FACTOR, abs=2e-5)
    assert action[:, joints] == pytest.approx(truth.story.command(time_s + 1 / 30)[:, joints] * FACTOR, abs=2e-5)
    assert qpos[:, [6, 13]] == pytest.approx(truth.story.state(time_s)[:, [6, 13]], abs=1e-6)


def test_jpeg_and_raw_pictures_show_the_same(written, tmp_path):
    raw_path = tmp_path / "episode_1.hdf5"
    write_cobot_magic_hdf5(raw_path, StandInConfig(**SMALL, hdf5_jpeg=False))
    with h5py.File(written[0]) as packed, h5py.File(raw_path) as raw:
        assert not raw.attrs["compress"]
        for c, camera in enumerate(("cam_high", "cam_left_wrist", "cam_right_wrist")):
            rows, pictures = packed[f"observations/images/{camera}"], raw[f"observations/images/{camera}"]
            assert pictures.shape == (60, 96, 128, 3)
            for n in (0, 17, 59):
                length = int(packed["compress_len"][c, n])
                assert not rows[n, length:].any()
                decoded = cv2.cvtColor(cv2.imdecode(rows[n, :length], cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
                assert read_frame_id(decoded) == read_frame_id(pictures[n]) == n
                assert np.abs(decoded.astype(int) - pictures[n]).mean() < 6


def test_same_configuration_gives_the_same_bytes(written, tmp_path):
    again = tmp_path / "episode_0.hdf5"
    write_cobot_magic_hdf5(again, StandInConfig(**SMALL))
    assert hashlib.sha256(again.read_bytes()).digest() == hashlib.sha256(written[0].read_bytes()).digest()


def test_faults_reach_the_hdf5_file_too(written, tmp_path):
    path = tmp_path / "episode_2.hdf5"
    write_cobot_magic_hdf5(path, StandInConfig(**SMALL, swap_arms=True, frozen_camera="left_wrist", hdf5_jpeg=False))
    with h5py.File(path) as faulty, h5py.File(written[0]) as usual:
        assert np.array_equal(faulty["observations/qpos"][:, :7], usual["observations/qpos"][:, 7:])
        ids = [read_frame_id(picture) for picture in faulty["observations/images/cam_left_wrist"]]
    assert ids == [*range(20), *[20] * 40]


def test_more_than_one_episode_is_refused(tmp_path):
    with pytest.raises(TaccorlError, match="holds one episode, not 2"):
        write_cobot_magic_hdf5(tmp_path / "episode_0.hdf5", StandInConfig(duration_s=4.0, episodes=2))
