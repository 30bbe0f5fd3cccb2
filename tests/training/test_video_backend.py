"""Which decoder LeRobot takes for videos, and what it prints about that."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from taccorl.training.reading import install
from taccorl.training.video_backend import default_video_backend

BROKEN = "raise RuntimeError('Could not load libtorchcodec. Likely causes: …')"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder in which this process looks for torchcodec first, and none that was imported."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchcodec"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(str(tmp_path))
    default_video_backend.cache_clear()
    yield tmp_path
    default_video_backend.cache_clear()
    sys.modules.pop("torchcodec", None)


@pytest.mark.parametrize(("torchcodec", "expected"), [(BROKEN, "pyav"), ("", "torchcodec")])
def test_a_torchcodec_that_cannot_be_loaded_is_left_out_in_silence(torchcodec, expected, site, capfd, caplog):
    from lerobot.configs.default import DatasetConfig
    from lerobot.datasets import lerobot_dataset

    (site / "torchcodec.py").write_text(torchcodec)
    install()
    assert DatasetConfig("local/x").video_backend == lerobot_dataset.get_safe_default_video_backend() == expected
    assert "".join(capfd.readouterr()) + caplog.text == ""
