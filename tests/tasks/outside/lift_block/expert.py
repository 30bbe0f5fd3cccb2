"""The right hand grips the block from above and lifts it; the left hand stays where it is."""

from lift_block.scene import LiftBlock
from taccorl.tasks.experts.scripted import Script, ScriptedExpert
from taccorl.tasks.experts.se3 import transform


class LiftBlockExpert(ScriptedExpert):
    """Expert of lift_block."""

    def script(self, arm: str) -> Script:
        return self._lift() if arm == "right" else iter(())

    def _lift(self) -> Script:
        assert isinstance(self.sim.task, LiftBlock)
        block = self.sim.task.block
        meant = self.grasp(block, "top", lift_m=0.004)
        yield from self.reach("right", meant, lambda pose: pose @ transform((0, 0, -0.06)), speed_mps=0.1)
        yield from self.close("right", block.grasps["top"].width_m)
        yield from self.rise("right", 0.06)
