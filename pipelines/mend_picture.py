"""``make pictures`` draws docs/mended_twin.png, too: a surrogate robot with dry friction, the twin before and after."""

from pathlib import Path

from taccorl.diagnosis.comparison.compare import compare
from taccorl.diagnosis.machines.piper import PiperTwin
from taccorl.diagnosis.problems.joints import diagnose_joint
from taccorl.report.figures import joint_response
from taccorl.surrogate.cases import draw_case
from taccorl.surrogate.recordings import recordings

PICTURE = Path("docs/mended_twin.png")
SHOWN = "held_triangle"


def main() -> None:
    """The case of ``make demo`` and notebook 3."""
    case = draw_case(["coulomb_friction"], seed=3, signal="left_joint4", strength=12.0, gains_known=True)
    measurements = recordings(case, "chirp")
    finding = diagnose_joint(case.twin, case.signal, measurements)
    traces = []
    for twin in (case.twin, PiperTwin(case.twin).mended([finding])[0].config):
        compared = compare(twin, measurements, name="twin")
        traces.append(next(t for t in compared.traces if t.recording == SHOWN and t.kind == "position"))
    joint_response(*traces).savefig(PICTURE, dpi=80)
    print(PICTURE)


if __name__ == "__main__":
    main()
