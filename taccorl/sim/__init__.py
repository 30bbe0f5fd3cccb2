"""The MuJoCo twin of the bench: robot, touch, tasks, effects, environments."""

import os

from taccorl.errors import TaccorlError

_DEBIAN = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
_wanted = os.environ.get("MUJOCO_GL", "").lower()
if _wanted in _DEBIAN:
    # With the variable set, MuJoCo loads that library as soon as it is imported, and what it says then helps nobody.
    try:
        import mujoco as _mujoco  # noqa: F401
    except (AttributeError, ImportError, OSError) as error:
        raise TaccorlError(
            f"MUJOCO_GL={_wanted}, but its library does not load ({error}). On Debian: apt-get install {_DEBIAN[_wanted]}; "
            "or unset MUJOCO_GL: everything but images works without OpenGL"
        ) from error
