"""Acceptance criteria (gates) of generated successes: forces, penetration, joint limits and speeds, unintended contact."""

from dataclasses import asdict, dataclass, field

import numpy as np

from taccorl.episodes.sources.mimicgen.spec import GatesSpec
from taccorl.episodes.sources.mimicgen.touching import Touching
from taccorl.robots import ROBOT
from taccorl.sim.simulation import Simulation, Watch

_EVERY = 5  # physics steps between looks: peaks last some milliseconds
_JOINTS = np.array([not name.endswith("gripper") for name in ROBOT.action_names])


@dataclass
class Measured:
    """Largest values over an episode, for the acceptance criteria: force, penetration, joint speed, joint limit."""

    force_n: float = 0.0  # Net force between mating parts [N]
    penetration_m: float = 0.0  # Overlap of mating parts [m]
    joint_speed_radps: float = 0.0  # Measured speed of any joint [rad/s]
    at_limit: str = ""  # Name of a joint whose command was at its limit; empty: none

    def record(self) -> dict[str, object]:
        """The values as JSON values, name of the field → value, for the provenance."""
        return asdict(self)

    def refused(self, gates: GatesSpec) -> tuple[str, str] | None:
        """First acceptance criterion that is not met, as (name, reason); None if all are met."""
        checks = (
            ("force", self.force_n, gates.max_force_n, 1.0, "N between mating parts"),
            (
                "penetration",
                self.penetration_m,
                gates.max_penetration_m,
                1e3,
                "mm overlap of mating parts",
            ),
            (
                "speed",
                self.joint_speed_radps,
                gates.max_joint_speed_radps,
                1.0,
                "rad/s of a joint",
            ),
        )
        for gate, value, limit, scale, what in checks:
            if not value <= limit:
                return (
                    gate,
                    f"{value * scale:.3g} {what}, the gate is {limit * scale:.3g}",
                )
        return (
            ("joint limit", f"{self.at_limit} is commanded to its limit")
            if self.at_limit
            else None
        )


@dataclass
class GateKeeper:
    """Measures the values for the acceptance criteria while simulation 0 is stepped, without changing it."""

    sim: Simulation
    measured: Measured = field(default_factory=Measured)

    def __post_init__(self) -> None:
        names = [f"{arm}_{joint}" for arm in ROBOT.arms for joint in ROBOT.joints]
        self._joints = [self.sim.model.joint(name).dofadr[0] for name in names]

    def watch(self) -> Watch:
        """``Watch`` for the next control step."""
        return Watch(
            range(_EVERY, self.sim.config.physics.steps_per_control_step + 1, _EVERY),
            self._look,
        )

    def _look(self, _: int) -> None:
        for pair in self.sim.task.mating:
            contact = self.sim.contact(*pair)
            self.measured.force_n = max(
                self.measured.force_n, float(contact.force_n[0])
            )
            self.measured.penetration_m = max(
                self.measured.penetration_m, float(contact.penetration_m[0])
            )
        speed_radps = float(np.abs(self.sim.arrays["qvel"][0, self._joints]).max())
        self.measured.joint_speed_radps = max(
            self.measured.joint_speed_radps, speed_radps
        )

    def see_actions(self, actions: np.ndarray) -> None:
        """Set all actions (T, 14) of the episode, for the limit of joint speed."""
        at_limit = ((actions <= ROBOT.action_low) | (actions >= ROBOT.action_high)).any(
            0
        ) & _JOINTS
        self.measured.at_limit = ", ".join(
            np.array(ROBOT.action_names)[at_limit].tolist()
        )


def foreign_contact(sim: Simulation, states: np.ndarray) -> tuple[str, str] | None:
    """Return ("foreign contact", names of the bodies and the row) if in any of the stored rows ``states`` (T, row_size) an arm
    touches the other arm or the table, or a part with anything but its fingers; else None.
    """
    touching, owner = (
        Touching(sim),
        [_owner(sim, body) for body in sim.model.geom_bodyid],
    )
    for t, row in enumerate(states):
        touching.look(row)
        for contact in touching.data.contact:
            one, other = (owner[geom] for geom in contact.geom)
            if contact.dist < 0 and (foreign := _foreign(one, other)):
                return "foreign contact", f"{foreign} at row {t}"
    return None


def _owner(sim: Simulation, body: int) -> tuple[str, str]:
    """(kind, name) of a body: arm, finger, part or table."""
    name = sim.model.body(body).name
    arm = next((arm for arm in ROBOT.arms if name.startswith(f"{arm}_")), None)
    if arm:
        return (
            "finger"
            if "finger" in name or "pad" in name or name in ROBOT.pads
            else "arm"
        ), name
    return (
        ("part", name)
        if name in (*sim.task.parts, *sim.task.clamped)
        else ("table", "table")
    )


def _foreign(one: tuple[str, str], other: tuple[str, str]) -> str:
    kinds = {one[0], other[0]}
    hands = [o for o in (one, other) if o[0] in ("arm", "finger")]
    across = len(hands) == 2 and hands[0][1].split("_")[0] != hands[1][1].split("_")[0]
    if across or (hands and "table" in kinds) or kinds == {"arm", "part"}:
        return f"{one[1]} touches {other[1]}"
    return ""
