"""``make demo``: simulated demonstrations → recordings as the robot's drivers would write them → dataset → checks → Rerun; then a
surrogate robot with a hidden effect → compare → diagnose → add it → the error has fallen.

There is no robot here: simulations stand in for it, and everything made from them says so.
"""

import shutil
from pathlib import Path

from taccorl.cli import main as cli

OUT = Path("outputs/demo")
SPEC = "piper_flexitac_mcap"
TASK = "test_tube"


def taccorl(*words: str) -> None:
    """One command, shown as a user would type it."""
    print(f"\n$ taccorl {' '.join(words)}", flush=True)
    code = cli.main(list(words))
    if code != 0:
        raise SystemExit(f"taccorl {words[0]} ended with {code}")


def main() -> None:
    """Everything lands in outputs/demo, which is made anew."""
    shutil.rmtree(OUT, ignore_errors=True)
    recordings, dataset = OUT / "recordings", OUT / "dataset"
    taccorl("collect", f"--task={TASK}", "--episodes=2", "--as_recording=true", f"--out={recordings}")
    taccorl("ingest", "inspect", str(recordings / f"{TASK}_000.mcap"))
    taccorl("ingest", str(recordings), f"--spec={SPEC}", f"--out={dataset}", f"--store={OUT / 'store'}")
    taccorl("check", str(dataset))
    taccorl(
        "view", str(dataset), "--episode=0", f"--save={OUT / 'episode.rrd'}", f"--sheet={OUT / 'contact_sheet.png'}"
    )
    taccorl("lineage", "explain", str(dataset), f"--store={OUT / 'store'}")
    _find_the_missing_effect(OUT / "robot", OUT / "diagnosis")
    print(f"\nrecordings     {recordings}")
    print(f"dataset        {dataset}   (LeRobotDataset('local/demo', root={str(dataset)!r}))")
    print(f"report         {OUT / 'dataset.ingest_report.json'}")
    print(f"Rerun          {OUT / 'episode.rrd'}   (.venv/bin/rerun {OUT / 'episode.rrd'})")
    print(f"contact sheet  {OUT / 'contact_sheet.png'}")
    print(f"diagnosis      {OUT / 'diagnosis' / 'report.html'}")
    print("\ntry next (after `source .venv/bin/activate`):")
    print(f"  taccorl view {dataset} --serve=true")
    print(f"  taccorl ingest YOUR_RECORDINGS/ --spec={SPEC} --out=outputs/mine --dry_run=true")


def _find_the_missing_effect(robot: Path, diagnosis: Path) -> None:
    """Dry friction is hidden in one joint of a surrogate robot."""
    twin, sweeps, mended = robot / "twin.yaml", robot / "sweeps", robot / "twin+coulomb_friction.yaml"
    hidden = ("--secret=3", "--effects=[coulomb_friction]", "--signal=left_joint4", "--strength=12")
    taccorl("surrogate", *hidden, "--design=chirp", "--gains_known=true", f"--out={robot}")
    taccorl("compare", str(sweeps), f"--twin={twin}")
    taccorl("diagnose", str(sweeps), f"--twin={twin}", f"--out={diagnosis}")
    taccorl("add-effect", "coulomb_friction", f"--twin={twin}", f"--diagnosis={diagnosis}")
    taccorl("compare", str(sweeps), f"--twin={twin}", f"--against={mended}")
    taccorl("surrogate", f"--reveal={robot}")


if __name__ == "__main__":
    main()
