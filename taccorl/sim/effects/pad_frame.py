"""Base of effects that move the frame of a pad's taxels: a pad that is mounted elsewhere than in the model."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from taccorl.sim.effects.effect import TouchEffect

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


@dataclass(kw_only=True)
class PadFrameEffect(TouchEffect):
    """Base of effects that move the frame of a pad's taxels in the finger, and the pad's box with it if the effect says so.

    ``edit`` changes the twin's model. The calibration of touch (``taccorl.alignment.touch.model``) works without that model: it
    evaluates the depths at positions displaced by ``offset_pad_m``.
    """

    layer: ClassVar = "robot"
    needs: ClassVar = ("depth",)

    def offset_pad_m(self, pad: str) -> np.ndarray:
        """(3,) displacement of the taxels of ``pad`` [m] in the pad's frame: across, from palm to tip, out of the pad. The
        direction "across" is +x of the TCP for fingers a and −x for fingers b."""
        raise NotImplementedError

    def edit(self, spec: mujoco.MjSpec, config: "TwinConfig") -> None:
        for pad in self.pads:
            offset, site = self.offset_pad_m(pad), spec.site(pad)
            finger_from_pad = Rotation.from_quat(site.quat, scalar_first=True)
            site.pos += finger_from_pad.apply(offset)
            # The box's body has the finger's orientation. A film glued on askew does not take its backing along.
            spec.geom(pad).pos += finger_from_pad.apply([0.0, 0.0, offset[2]])
