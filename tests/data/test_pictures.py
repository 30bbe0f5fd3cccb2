"""Pictures of whole recordings: videos frame by frame, and the true reason where none is read, before any work is done."""

import cv2
import numpy as np
import pytest
from small_arm import (
    CAMERA,
    COLUMNS,
    ROWS,
    Sent,
    arrays,
    compressed,
    ingest,
    jpeg,
    messages,
    raw,
    scene,
    video,
    write_hdf5,
    write_mcap,
    write_spec,
)

from taccorl.cli.main import main
from taccorl.data.cutting import open_episodes
from taccorl.data.dataset import Dataset


@pytest.mark.parametrize(("codec", "form"), [("libx264", "h264"), ("libx265", "h265")])
def test_a_video_frame_by_frame_shows_the_picture_of_every_row(tmp_path, codec, form):
    path = write_mcap(
        tmp_path / "rec.mcap", messages(picture=video(codec=codec, form=form))
    )
    code, entry = ingest(path, write_spec(tmp_path))
    assert (code, entry["outcome"], entry["rows_lost"]) == (0, "written", 0)
    for k, shown in enumerate(
        Dataset(tmp_path / "out").frames(0, "observation.images.top")
    ):
        # row 0 is at the first picture, 3 ms after the first joint state
        assert (
            np.abs(shown.astype(int) - scene(k / 30)).mean() < 12
        )  # the bar moves by 1 pixel a row; H.264 twice


def test_an_episode_in_mid_video_is_decoded_from_the_frames_before_it(tmp_path):
    """State begins at 1.2 s, between two key frames (1.0 and 1.5 s): the rows' pictures need those before them."""
    sent = [
        m
        for m in messages(picture=video(every=60))
        if m.topic == CAMERA or m.time_s >= 1.2
    ]
    path = write_mcap(tmp_path / "rec.mcap", sent)
    with open_episodes(path, write_spec(tmp_path)) as [episode]:
        first = next(iter(episode.pictures()))["observation.images.top"]
        assert np.abs(first.astype(int) - scene(36 / 30)).mean() < 6


def test_a_video_that_begins_between_key_frames_loses_those_pictures_only(tmp_path):
    sent = messages(picture=video(every=60))
    path = write_mcap(
        tmp_path / "rec.mcap", [m for m in sent if m.topic != CAMERA or m.time_s > 1.0]
    )
    _, entry = ingest(path, write_spec(tmp_path))
    assert entry["outcome"] == "split"
    assert (
        entry["samples"]["top"]["broken picture"] == 30
    )  # 1.0 … 2.0 s, until the key frame


YUV = np.zeros((ROWS, COLUMNS, 2), np.uint8)


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (lambda t: compressed(t, cv2.imencode(".png", np.full((8, 8), 4700, np.uint16))[1].tobytes(), "16UC1; png"), "uint16"),
        (lambda t: compressed(t, bytes(40), "16UC1; compressedDepth png"), "compressedDepth"),
        (lambda t: raw(t, "16UC1", YUV), "16UC1"),
        (lambda t: raw(t, "yuv411", YUV), "yuv411"),
    ],
)  # fmt: skip
def test_pictures_that_are_not_read_are_refused_with_their_reason(
    tmp_path, picture, reason, capsys
):
    path = write_mcap(tmp_path / "rec.mcap", messages(picture=picture))
    spec = write_spec(tmp_path)
    code, entry = ingest(path, spec)
    assert (code, entry["outcome"]) == (1, "refused")
    capsys.readouterr()
    assert main(["check", str(path), f"--spec={spec}"]) == 1
    checked = capsys.readouterr().out
    main(["ingest", "inspect", str(path)])
    inspected = capsys.readouterr().out
    for text in (entry["reason"], checked, inspected):
        assert f"{CAMERA}: " in text and reason in text
    assert f"# not used: {CAMERA}" in inspected  # and the draft does not use them


def test_pictures_that_change_their_size_are_a_warning(tmp_path, capsys):
    sizes = [(ROWS, COLUMNS), (2 * ROWS, 2 * COLUMNS)]

    def picture(time_s: float) -> Sent:
        rows, columns = sizes[time_s > 2]
        return compressed(time_s, jpeg(cv2.resize(scene(time_s), (columns, rows))))

    path, spec = (
        write_mcap(tmp_path / "rec.mcap", messages(picture=picture)),
        write_spec(tmp_path),
    )
    _, entry = ingest(path, spec)
    (found,) = [
        f for f in entry["episodes"][0]["findings"] if f["check"] == "picture_size"
    ]
    assert (
        found["severity"] == "warning"
        and "32×48" in found["text"]
        and "64×96" in found["text"]
    )
    capsys.readouterr()
    assert main(["check", str(path), f"--spec={spec}"]) == 1
    assert "picture_size" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda rgb: rgb[..., 0], ""),
        (lambda rgb: rgb.transpose(0, 3, 1, 2), ""),
        (lambda rgb: rgb[..., :1], ""),
        (lambda rgb: rgb.astype(np.float32) / 255, "float32"),
        (lambda rgb: rgb.astype(np.uint16), "uint16"),
        (lambda rgb: rgb[..., 0].astype(np.uint16), "uint16"),
    ],
)
def test_stored_arrays_are_read_or_refused_with_their_reason(
    tmp_path, change, reason, capsys
):
    values = arrays(60)
    topic = "/observations/images/top"
    values[topic] = change(values[topic])
    path, spec = (
        write_hdf5(tmp_path / "rec.hdf5", values),
        write_spec(tmp_path, reader="hdf5"),
    )
    code, entry = ingest(path, spec)
    assert (code, entry["outcome"]) == ((1, "refused") if reason else (0, "written"))
    capsys.readouterr()
    main(["ingest", "inspect", str(path)])
    inspected = capsys.readouterr().out
    assert reason in entry["reason"]
    assert (f"not decodable {topic}: a picture of {reason}" in inspected) == bool(
        reason
    )
    assert ("observation.images.top:" in inspected) == (not reason)
