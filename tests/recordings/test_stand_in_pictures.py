"""Pictures: every one says which it is, none repeats, and the robot in them moves with its joints."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.surrogate.drivers import CAMERA_TOPICS, CAMERAS
from tests.recordings.pictures import Scene, draw_frame_id, read_frame_id
from tests.recordings.story import Story, plan_episodes


@pytest.fixture(scope="module")
def scene() -> Scene:
    story = Story(plan_episodes(6.0, 1, ("success",), 0), 6.0, command_lead_s=0.08, contact_delay_s=0.03, seed=0)
    return Scene(story, (480, 640), seed=0)


def _decode(data: bytes) -> np.ndarray:
    return cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


@pytest.mark.parametrize("frame_id", [0, 1, 0b1010101010101010, 0b0101010101010101, 719, 65535])
def test_frame_id_is_read_back(frame_id):
    picture = np.full((48, 64, 3), 128, np.uint8)
    draw_frame_id(picture, frame_id)
    assert read_frame_id(picture) == frame_id


def test_frame_ids_survive_jpeg(record):
    recorded = record()
    for camera, topic in CAMERA_TOPICS.items():
        read = [read_frame_id(_decode(message.data)) for message in recorded.messages[topic]]
        assert read == recorded.truth.frame_ids[camera].tolist()


def test_frame_ids_survive_h264(scene, tmp_path):
    ids = np.arange(21, 41)
    with av.open(tmp_path / "video.mp4", "w") as container:
        stream = container.add_stream("h264", rate=Fraction(30), options={"crf": "30", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
        for picture in scene.pictures_bgr("front", ids / 30, ids):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())
    with av.open(tmp_path / "video.mp4") as container:
        read = [read_frame_id(frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    assert read == ids.tolist()


def test_a_picture_without_frame_id_is_refused(scene):
    picture = next(scene.pictures_bgr("front", np.array([1.0]), np.array([0b1010101010101010])))
    with pytest.raises(TaccorlError, match="no frame id in this 168 × 224 picture"):
        read_frame_id(cv2.resize(picture, (224, 168), interpolation=cv2.INTER_AREA))


@pytest.mark.parametrize("camera", CAMERAS)
def test_pictures_have_the_size_of_real_ones(scene, camera):
    """RealSense pictures of this size and quality are 60–100 kB; ours must load readers and encoders alike."""
    for picture in scene.pictures_bgr(camera, np.array([0.5, 2.6, 4.4]), np.arange(3)):
        assert picture.shape == (480, 640, 3)
        assert 45e3 < len(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]) < 110e3


def test_no_two_pictures_are_the_same(record):
    recorded = record()
    for topic in CAMERA_TOPICS.values():
        data = [bytes(message.data) for message in recorded.messages[topic]]
        assert len(set(data)) == len(data)


def test_what_a_camera_sees_changes_when_its_arm_moves(scene):
    """At 1.7 s both arms are on their way, at 0.05 s at rest: moving changes a wrist picture far more than noise does."""
    for camera in ("left_wrist", "right_wrist"):
        rest_a, rest_b, way_a, way_b = scene.pictures_bgr(camera, np.array([0.02, 0.05, 1.0, 1.1]), np.zeros(4, int))
        assert cv2.absdiff(way_a, way_b).mean() > 1.5 * cv2.absdiff(rest_a, rest_b).mean()
