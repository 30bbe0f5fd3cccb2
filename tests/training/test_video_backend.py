"""Which decoder LeRobot takes for videos, and what it prints about that."""

from pathlib import Path

import pytest

from tests.fresh_python import fresh_python

CODE = """
import logging
logging.basicConfig(level=logging.INFO)
import taccorl.lerobot_plugin
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import lerobot_dataset
print(DatasetConfig("local/x").video_backend, lerobot_dataset.get_safe_default_video_backend())
"""


@pytest.mark.parametrize(
    ("torchcodec", "expected"),
    [
        ("raise RuntimeError('Could not load libtorchcodec. Likely causes: …')", "pyav"),
        pytest.param("", "torchcodec", marks=pytest.mark.slow),
    ],
)
def test_a_torchcodec_that_cannot_be_loaded_is_left_out_in_silence(
    torchcodec: str, expected: str, tmp_path: Path
) -> None:
    (tmp_path / "torchcodec").mkdir()
    (tmp_path / "torchcodec" / "__init__.py").write_text(torchcodec)
    done = fresh_python("-c", CODE, path=tmp_path)
    assert done.stdout.split() == [expected, expected]
    assert "torchcodec" not in done.stderr and "Traceback" not in done.stderr
