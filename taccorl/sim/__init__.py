"""The MuJoCo twin of the bench: robot, touch, tasks, effects, environments."""

import os

from taccorl.errors import TaccorlError

_DEBIAN = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
_wanted = os.environ.get("MUJOCO_GL", "").lower()
if _wanted:
    # With the variable set, MuJoCo loads that library as soon as it is imported, and what it says then helps nobody.
    try:
        import mujoco as _mujoco  # noqa: F401
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        _install = (
            f" On Debian: apt-get install {_DEBIAN[_wanted]};"
            if _wanted in _DEBIAN
            else ""
        )
        raise TaccorlError(
            f"MUJOCO_GL={_wanted} does not load ({error}).{_install} Set egl, or unset it"
        ) from error
