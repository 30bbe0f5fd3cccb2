"""PyAV as the decoder of LeRobot's videos where torchcodec cannot be loaded.

LeRobot 0.6.1 chooses so, too (import_utils.py, ``get_safe_default_video_backend``), but prints about 180 lines each time that it
asks: two tracebacks for each version of FFmpeg that torchcodec did not find.
"""

import functools
import importlib
import importlib.util


@functools.cache
def default_video_backend() -> str:
    """``torchcodec``, or ``pyav`` where that is not installed or finds no FFmpeg."""
    if importlib.util.find_spec("torchcodec") is None:
        return "pyav"
    try:
        importlib.import_module("torchcodec")
    except (ImportError, OSError, RuntimeError):
        return "pyav"
    return "torchcodec"
