"""Camera latency: pictures show what was, not what is."""

from dataclasses import dataclass
from typing import ClassVar

from taccorl.sim.effects import effects
from taccorl.sim.effects.camera_effect import CameraEffect
from taccorl.sim.effects.effect import parameter


@effects.register("camera_latency")
@dataclass(kw_only=True)
class CameraLatency(CameraEffect):
    """Latency of a camera: the picture at time t shows the scene at t − d. Before the reset the scene counts as at rest."""

    name: ClassVar = "camera_latency"
    equation: ClassVar = "I(t) = picture of the scene at t − d"
    in_words: ClassVar = (
        "Exposure, read-out, compression and the way to the computer take time, and the driver stamps a picture when it "
        "arrives: what it shows is already past."
    )
    at_a_policy: ClassVar = (
        "It sees its own hand where it was: it overshoots, and swings about the goal when it moves quickly."
    )
    to_record: ClassVar = "Arms that move to and fro in view, with pictures and joints on one clock."
    near_twins: ClassVar = {
        "camera_pose": (
            "Late pictures of a moving arm look shifted along its motion; one that goes to and fro is shifted both ways, "
            "and at rest not at all."
        ),
    }
    delay_s: float = parameter(
        unit="s",
        symbol="d",
        absent=0.0,
        low=0.0,
        high=0.3,
        typical=0.05,
        source="a choice: one to two frames at 30 Hz, as USB cameras have",
    )

    def picture_age_s(self) -> float:
        return self.delay_s
