"""Choose PyAV as the decoder of LeRobot's videos if torchcodec cannot be loaded. LeRobot 0.6.1 makes the same choice
(import_utils.py, ``get_safe_default_video_backend``), but prints about 180 lines each time: two tracebacks for each version of
FFmpeg that torchcodec did not find.
"""

import functools
import importlib
import importlib.util


@functools.cache
def default_video_backend() -> str:
    """Name of the video decoder: ``torchcodec``, or ``pyav`` if torchcodec is not installed or finds no FFmpeg."""
    if importlib.util.find_spec("torchcodec") is None:
        return "pyav"
    try:
        importlib.import_module("torchcodec")
    except (ImportError, OSError, RuntimeError):
        return "pyav"
    return "torchcodec"
