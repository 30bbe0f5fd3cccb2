"""``make freeze`` writes digests of what the commands compute; ``make freeze CHECK=1`` names what no longer equals them.

Digests depend on the machine: they are in outputs/freeze/golden.json, which git ignores, beside the recordings that are ingested.
``ONLY=touch,ingest`` takes these parts only. About ten minutes of one core.
"""

import contextlib
import functools
import hashlib
import io
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ |= {
    f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")
}
os.environ |= {"HF_HUB_OFFLINE": "1", "SVT_LOG": "1"}
TESTS = Path(__file__).parent.resolve()
sys.path[:0] = [
    str(TESTS.parent),
    *(str(TESTS / folder) for folder in ("policies", "evaluation")),
]

import numpy as np  # noqa: E402
import pyarrow.parquet  # noqa: E402
from mcap.reader import make_reader  # noqa: E402

PLACE = Path("outputs/freeze")
TASKS = ("assembly_1", "assembly_2", "test_tube", "puzzle")
JOINT_EFFECTS = ("coulomb_friction", "backlash", "")
CELL_EFFECTS = ("taxel_hysteresis", "taxel_creep", "taxel_play", "")
TWIN_RECORDING = ("--task=test_tube", "--episodes=1", "--as_recording=true", "--seed=4")
# Parts of the names of keys whose values differ from run to run.
VOLATILE = (
    "took",
    "seconds",
    "wall",
    "cpu",
    "date",
    "created",
    "written",
    "command",
    "time_stamp",
)
Values = Iterator[
    tuple[str, Any]
]  # names and values: arrays, bytes, or anything that JSON holds


def digest(value: Any) -> str:
    """SHA-256 of an array with dtype and shape, of bytes, or of a JSON value; the clone's own place does not count."""
    if isinstance(value, np.ndarray):
        value = (
            f"{value.dtype} {value.shape} ".encode()
            + np.ascontiguousarray(value).tobytes()
        )
    if not isinstance(value, bytes):
        value = json.dumps(value, sort_keys=True, default=str).encode()
    return hashlib.sha256(value.replace(str(TESTS.parent).encode(), b"")).hexdigest()[
        :16
    ]


def taccorl(*words: str) -> None:
    """Run a verb in this process, without its output. 1 is the status of a diagnosis that stays above the noise floor."""
    from taccorl.cli.main import main

    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main(list(words))
    if code not in (0, 1 if words[0] == "diagnose" else 0):
        raise SystemExit(
            f"taccorl {' '.join(words)} ended with {code}:\n{said.getvalue()[-2000:]}"
        )


def leaves(value: Any, depth: int = 3, name: str = "") -> Values:
    """Values of a JSON file by the path of their keys, without volatile ones, to a depth."""
    if depth and (
        isinstance(value, dict)
        or (isinstance(value, list) and value and isinstance(value[0], dict))
    ):
        for key, below in (
            value.items() if isinstance(value, dict) else enumerate(value)
        ):
            if not any(word in str(key) for word in VOLATILE):
                yield from leaves(below, depth - 1, f"{name}.{key}")
    else:
        yield name, value


def files(folder: Path) -> Values:
    """What is in the files of a folder: columns of tables, values of JSON, bytes of all else but pages and manifests."""
    for path in sorted(
        path
        for path in folder.rglob("*")
        if path.is_file() and path.name != "manifest.json"
    ):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".parquet":
            table = pyarrow.parquet.read_table(path)
            for column in (
                c for c in table.column_names if not any(word in c for word in VOLATILE)
            ):
                yield (
                    f"{name} {column}",
                    table.column(column).combine_chunks().to_pylist(),
                )
        elif (
            path.suffix == ".mcap"
        ):  # times and bytes of the messages of each topic, not metadata
            topics: dict[str, list[bytes]] = {}
            with path.open("rb") as file:
                for _, channel, message in make_reader(file).iter_messages():
                    topics.setdefault(channel.topic, []).append(
                        b"%d " % message.log_time + message.data
                    )
            yield from (
                (f"{name} {topic}", b"".join(sent)) for topic, sent in topics.items()
            )
        elif path.suffix == ".json":
            yield from (
                (f"{name} {key}", value)
                for key, value in leaves(json.loads(path.read_text()))
            )
        elif path.suffix not in (".html", ".md", ".rrd", ".lock"):
            yield name, path.read_bytes()


def of(name: str, values: Values) -> Values:
    """The same values with a name in front."""
    return ((f"{name}/{key}", value) for key, value in values)


def inputs() -> Path:
    """Recordings (two episodes, a gap, of the twin, cobot_magic's) and a tiny policy, made once."""
    folder = TESTS.parent / PLACE / "inputs"
    if not folder.exists():
        from tiny_checkpoint import write_checkpoint

        from tests.recordings.stand_in import (
            StandInConfig,
            write_cobot_magic_hdf5,
            write_mcap,
        )

        made, small = (
            folder.with_suffix(".part"),
            functools.partial(StandInConfig, camera_size=(120, 160)),
        )
        shutil.rmtree(made, ignore_errors=True)
        gap = ("/camera_l/color/image_raw/compressed", 1.0, 2.0)
        write_mcap(made / "drafts/ros2.mcap", small(duration_s=3.0, seed=0))
        write_mcap(
            made / "mcap/two.mcap",
            small(episodes=2, outcomes=("success", "failure"), seed=3),
        )
        write_mcap(made / "mcap/gap.mcap", small(gap=gap, seed=4))
        write_cobot_magic_hdf5(
            made / "hdf5/episode_0.hdf5", small(duration_s=3.0, seed=5)
        )
        taccorl("collect", *TWIN_RECORDING, f"--out={made / 'twin'}")
        write_checkpoint(made)
        made.rename(folder)
    return folder


def ingest() -> Values:
    """Sample recordings as datasets, and drafts of specs."""
    for kind, spec in (
        ("mcap", "piper_flexitac_mcap"),
        ("twin", "piper_flexitac_mcap"),
        ("hdf5", "cobot_magic_hdf5"),
    ):
        taccorl(
            "ingest",
            str(inputs() / kind),
            f"--spec={spec}",
            f"--out={kind}",
            "--store=store",
        )
        yield from of(kind, files(Path(kind)))
    for path in sorted((inputs() / "drafts").iterdir()):
        taccorl("ingest", "inspect", str(path), f"--draft={path.stem}.yaml")
    yield from (
        (path.name, path.read_bytes()) for path in sorted(Path().glob("*.yaml"))
    )


def collected(task: str) -> Path:
    """Three demonstrations of a task, made once a run."""
    out = Path("..") / "collected" / task
    if not out.exists():
        words = (
            f"--task={task}",
            "--episodes=3",
            "--images=false",
            "--part_poses=true",
            "--seed=3",
        )
        taccorl(
            "collect", *words, f"--out={out}", "--store=store", "--engine.workers=1"
        )
    return out


def collect() -> Values:
    """Scripted demonstrations: actions, states, counts of touch, part poses; and a recording, message by message."""
    for task in TASKS:
        yield from of(task, files(collected(task)))
    taccorl("collect", *TWIN_RECORDING, "--out=recording")
    yield from of("recording", files(Path("recording")))


def augment() -> Values:
    """Generated demonstrations."""
    for task in TASKS:
        words = (
            f"--source={collected(task)}",
            f"--task={task}",
            "--episodes=2",
            "--images=false",
            "--seed=5",
        )
        taccorl(
            "augment", *words, f"--out={task}", "--store=store", "--engine.workers=1"
        )
        yield from of(task, files(Path(task)))


def correct() -> Values:
    """The expert takes over from a policy that knows nothing."""
    words = (
        "--policy.device=cpu",
        "--task=assembly_2",
        "--episodes=2",
        "--num_envs=2",
        "--episode_length=24",
    )
    words += (
        f"--policy.path={inputs() / 'pretrained_model'}",
        "--before_grasp=true",
        "--images=false",
    )
    taccorl(
        "correct", *words, "--out=assembly_2", "--store=store", "--engine.workers=1"
    )
    yield from of("assembly_2", files(Path("assembly_2")))


def rollouts() -> Values:
    """20 rollouts with actions that wander and their first pictures, in each task 5; 8 scored ones, of expert and tiny policy."""
    from taccorl.robots import ROBOT
    from taccorl.sim.vector_env import TaccorlVectorEnv

    for task in TASKS:
        env, rng = (
            TaccorlVectorEnv(task, num_envs=5, num_threads=1, images="on_request"),
            np.random.default_rng(1),
        )
        action, steps = np.array(env.reset(seed=7)[0]["observation.state"]), {}
        yield from (
            (f"{task} first {name}", np.array(value))
            for name, value in env.observe(images=True).items()
        )
        for _ in range(60):
            action = (action + rng.normal(0, 0.01, action.shape)).astype(np.float32)
            seen, *results, _ = env.step(
                np.clip(action, ROBOT.action_low, ROBOT.action_high).astype(np.float32)
            )
            results = zip(("reward", "terminated", "truncated"), results, strict=True)
            for name, value in (*results, *seen.items()):
                steps.setdefault(name, []).append(np.array(value))
        yield from (
            (f"{task} {name}", np.array(values)) for name, values in steps.items()
        )
        env.close()
    scored = (
        "--task=assembly_2",
        "--episodes=4",
        "--episode_length=120",
        "--failures=0",
        "--images=false",
    )
    for name, actor in (
        ("expert", "--policy.type=expert"),
        ("tiny", f"--policy.path={inputs() / 'pretrained_model'}"),
    ):
        taccorl("evaluate", actor, *scored, f"--out={name}")
        yield from of(name, files(Path(name)))


def touch() -> Values:
    """Depth and rate of the taxels in 512 states, in which both hands shake a part. (Counts: ``collect``.)"""
    from pipelines.benchmarks.sim import holding

    (sim, goal), rng = holding(128), np.random.default_rng(2)
    for k in range(4):
        sim.step(goal + rng.normal(0, 0.01, goal.shape))
        for name in ("touch", "penetration", "compression"):
            depth, rate = getattr(sim.pads, name)(sim.batch)
            yield from ((f"{k} {name} depth", depth), (f"{k} {name} rate", rate))


def diagnoses() -> Values:
    """Reports of compare and diagnose: joints, cells, pads, other robots."""
    from pipelines.studies import robots

    for k, effect in enumerate(JOINT_EFFECTS):
        yield from surrogate(
            f"joint_{k}",
            f"--effects=[{effect}]",
            f"--secret={60 + k}",
            "--design=chirp",
        )
    for k, effect in enumerate(CELL_EFFECTS):
        yield from surrogate(
            f"cells_{k}", "--cells=true", f"--effects=[{effect}]", f"--secret={80 + k}"
        )
    yield from surrogate(
        "pads", "--pads=left", "--effects=[taxel_gain_spread]", "--secret=90"
    )
    for job in robots.jobs()[:3]:
        yield from (
            (f"robot {job[0]} {key}", value)
            for key, value in robots.run(job).items()
            if "cpu" not in key
        )


def surrogate(name: str, *words: str) -> Values:
    """Write the recordings, compare and diagnose them."""
    taccorl("surrogate", *words, f"--out={name}")
    (twin,), measured = (
        Path(name).glob("*.yaml"),
        next(p for p in Path(name).iterdir() if p.is_dir()),
    )
    taccorl("compare", str(measured), f"--twin={twin}", f"--out={name}_compared")
    taccorl(
        "diagnose",
        str(measured),
        f"--twin={twin}",
        f"--out={name}_found",
        "--workers=1",
    )
    for folder in (Path(name), Path(f"{name}_compared"), Path(f"{name}_found")):
        yield from of(folder.name, files(folder))


def policy() -> Values:
    """Loss and chunk of tiny policies."""
    from tiny_policies import batch_of, chunk, losses, sees_with, tiny_policy

    for vision in ("cameras", "patches"):
        with sees_with(vision):
            tiny, batch = tiny_policy(), batch_of(True, False, True)
        yield f"{vision} losses", losses(tiny, batch).numpy()
        yield f"{vision} chunk", chunk(tiny, batch).numpy()


PARTS = {
    one.__name__: one
    for one in (ingest, collect, augment, correct, rollouts, touch, diagnoses, policy)
}


def main(words: list[str]) -> int:
    """0: written, or all as before."""
    names = [
        name
        for word in words
        if word.startswith("--only=")
        for name in word[7:].split(",")
    ] or list(PARTS)
    root, check, differs = PLACE.resolve(), "--check" in words, []
    root.mkdir(parents=True, exist_ok=True)
    golden = root / "golden.json"
    if check and not golden.exists():
        raise SystemExit(
            f"{golden}: no digests; run `make freeze` on the commit to compare with"
        )
    known: dict[str, str] = json.loads(golden.read_text()) if golden.exists() else {}
    inputs()
    shutil.rmtree(root / "work", ignore_errors=True)
    for name in names:
        (root / "work" / name).mkdir(parents=True)
        os.chdir(root / "work" / name)
        began = time.process_time()
        now = {
            key.replace(str(TESTS.parent), ""): digest(value)
            for key, value in of(name, PARTS[name]())
        }
        before = {
            key: value for key, value in known.items() if key.startswith(f"{name}/")
        }
        differs += [
            key for key in sorted(before | now) if before.get(key) != now.get(key)
        ]
        known = {key: value for key, value in known.items() if key not in before} | now
        print(
            f"{name}: {len(now)} values, {time.process_time() - began:.0f} CPU-s",
            flush=True,
        )
        if not check:
            golden.write_text(json.dumps(known, indent=0, sort_keys=True))
    print(*(f"differs: {key}" for key in differs if check), sep="\n")
    return int(check and bool(differs))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
