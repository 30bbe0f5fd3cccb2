"""``make demo``: simulated demonstrations → recordings as the robot's drivers would write them → dataset → checks → Rerun; then a
surrogate robot with a hidden effect → compare → diagnose → add it → the error has fallen.

There is no robot here: simulations stand in for it, and everything made from them says so.
"""

import dataclasses
import shutil
from pathlib import Path

from pipelines.steps import step
from taccorl.cli import (
    add_effect,
    check,
    collect,
    compare,
    diagnose,
    ingest,
    lineage,
    surrogate,
    view,
)
from taccorl.cli.add_effect import AddEffectConfig
from taccorl.cli.check import CheckConfig
from taccorl.cli.collect import CollectConfig
from taccorl.cli.compare import CompareConfig
from taccorl.cli.diagnose import DiagnoseConfig
from taccorl.cli.ingest import IngestConfig, InspectConfig
from taccorl.cli.lineage import ExplainConfig
from taccorl.cli.surrogate import SurrogateConfig
from taccorl.cli.view import ViewConfig

OUT = Path("outputs/demo")
SPEC = "piper_flexitac_mcap"
TASK = "test_tube"


def main() -> None:
    """Everything lands in outputs/demo, which is made anew."""
    shutil.rmtree(OUT, ignore_errors=True)
    recordings, dataset = OUT / "recordings", OUT / "dataset"
    step(
        collect.run,
        CollectConfig(task=TASK, episodes=2, as_recording=True, out=recordings),
    )
    step(ingest.inspect, InspectConfig(paths=[recordings / f"{TASK}_000.mcap"]))
    step(
        ingest.run,
        IngestConfig(paths=[recordings], spec=SPEC, out=dataset, store=OUT / "store"),
    )
    step(check.run, CheckConfig(path=dataset))
    step(
        view.run,
        ViewConfig(
            path=dataset, save=OUT / "episode.rrd", sheet=OUT / "contact_sheet.png"
        ),
    )
    step(lineage.explain, ExplainConfig(path=dataset, store=OUT / "store"))
    _find_the_missing_effect(OUT / "robot", OUT / "diagnosis")
    print(f"\nrecordings     {recordings}")
    print(
        f"dataset        {dataset}   (LeRobotDataset('local/demo', root={str(dataset)!r}))"
    )
    print(f"report         {OUT / 'dataset.ingest_report.json'}")
    print(
        f"Rerun          {OUT / 'episode.rrd'}   (.venv/bin/rerun {OUT / 'episode.rrd'})"
    )
    print(f"contact sheet  {OUT / 'contact_sheet.png'}")
    print(f"diagnosis      {OUT / 'diagnosis' / 'report.html'}")
    print("\ntry next (after `source .venv/bin/activate`):")
    print(f"  taccorl view {dataset} --serve=true")
    print(
        f"  taccorl ingest YOUR_RECORDINGS/ --spec={SPEC} --out=outputs/mine --dry_run=true"
    )


def _find_the_missing_effect(robot: Path, diagnosis: Path) -> None:
    """Dry friction is hidden in one joint of a surrogate robot."""
    twin, sweeps, mended = (
        robot / "twin.yaml",
        robot / "sweeps",
        robot / "twin+coulomb_friction.yaml",
    )
    hidden = SurrogateConfig(
        secret=3,
        effects=["coulomb_friction"],
        signal="left_joint4",
        strength=12,
        design="chirp",
        out=robot,
    )
    step(surrogate.run, dataclasses.replace(hidden, gains_known=True))
    step(compare.run, CompareConfig(measurements=sweeps, twin=twin))
    step(diagnose.run, DiagnoseConfig(measurements=sweeps, twin=twin, out=diagnosis))
    step(
        add_effect.run,
        AddEffectConfig(effect="coulomb_friction", twin=twin, diagnosis=diagnosis),
    )
    step(compare.run, CompareConfig(measurements=sweeps, twin=twin, against=mended))
    step(surrogate.run, SurrogateConfig(reveal=robot))


if __name__ == "__main__":
    main()
