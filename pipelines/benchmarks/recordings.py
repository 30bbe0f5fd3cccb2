"""Figures of reading and writing recordings: ``make bench ONLY=ingest``, ``check``, ``memory``, ``corruption``, ``start_up``."""

import itertools
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from statistics import mean, median
from typing import Any, NamedTuple

import numpy as np

from pipelines.benchmarks.rows import Row, benchmark
from pipelines.benchmarks.run import ROOT
from taccorl.data.lerobot_format import merge, quiet_lerobot
from taccorl.data.spec import data_specs_folder, load_recording_spec
from taccorl.lineage.processes import cpu_s

RECORDING_S = 24.0
LONG_RECORDING_S = 240.0
RIVAL_ROWS = 150
"""Number of rows for the reference writer. LeRobot's default writer takes 0.17 CPU-s per row, so that a part of the recording is
measured."""
REPEATS = 3
EPISODE_ROWS, FEW_EPISODES, MANY_EPISODES = 20, 5, 2000
"""Rows of an episode and numbers of episodes of the datasets that the benchmark ``check`` reads."""
NATIVE = [480, 640, 3]
CORRUPTION, DAMAGE = (
    ("tests/end_to_end/test_corruption.py",),
    ("tests/end_to_end/test_random_damage.py",),
)
"""Arguments of pytest: the tests of damaged recordings that the benchmark ``corruption`` runs and counts."""


class Cost(NamedTuple):
    """Measured cost of one piece of work: CPU time and wall time."""

    cpu_s: float
    wall_s: float


def _timed(work: Callable[[], Any]) -> Cost:
    cpu, wall = cpu_s(children=True), time.perf_counter()
    work()
    return Cost(cpu_s(children=True) - cpu, time.perf_counter() - wall)


def _native_spec(folder: Path) -> Path:
    """The shipped spec with pictures kept at 480 × 640, nothing is scaled, so encoding costs most."""
    specs = data_specs_folder()
    for part in ("sensors", "recordings"):
        (folder / part).mkdir(parents=True)
    dataset = (
        (specs / "taccorl_bimanual.yaml")
        .read_text()
        .replace("[224, 224, 3]", str(NATIVE))
    )
    (folder / "taccorl_bimanual.yaml").write_text(dataset)
    (folder / "sensors/flexitac_v2.yaml").write_text(
        (specs / "sensors/flexitac_v2.yaml").read_text()
    )
    recording = folder / "recordings/piper_flexitac_mcap.yaml"
    recording.write_text((specs / "recordings/piper_flexitac_mcap.yaml").read_text())
    return recording


def _stand_in(path: Path, duration_s: float) -> Path:
    from tests.recordings.stand_in import StandInConfig, write_mcap

    write_mcap(path, StandInConfig(duration_s=duration_s, seed=0))
    return path


@benchmark("ingest")
def ingest_speed() -> Iterator[Row]:
    """Benchmark of ingest: rows per second relative to LeRobot's own default writer and to real time, and the share of
    parsing."""
    with quiet_lerobot():
        import lerobot.datasets.lerobot_dataset  # noqa: F401  (its import, 11 CPU-s, is not what is measured)
    with tempfile.TemporaryDirectory(prefix="taccorl_bench_") as name:
        folder = Path(name)
        recording = _stand_in(folder / "recording.mcap", RECORDING_S)
        native = _native_spec(folder / "data_specs")
        yield from _ingest_rows(
            "480×640 kept", recording, load_recording_spec(native), folder, goal="≥ 4"
        )
        # No goal against the rival here: it is handed pictures already scaled down, and we decode them at 480 × 640.
        shipped = load_recording_spec("piper_flexitac_mcap")
        yield from _ingest_rows(
            "224×224, as shipped", recording, shipped, folder, goal=""
        )


def _ingest_rows(
    label: str, path: Path, spec: Any, folder: Path, goal: str
) -> Iterator[Row]:
    ours, theirs, parsing = [], [], []
    for k in range(REPEATS):
        rows, cost = _our_ingest(path, spec, folder / f"ours_{label[:3]}_{k}")
        ours.append((rows, cost))
        theirs.append(_default_writer(path, spec, folder / f"theirs_{label[:3]}_{k}"))
        parsing.append(_parse_only(path, spec).cpu_s / cost.cpu_s * 100)
    per_cpu = [rows / cost.cpu_s for rows, cost in ours]
    rival = [RIVAL_ROWS / cost.cpu_s for cost in theirs]
    ratios = [a / b for a, b in zip(per_cpu, rival, strict=True)]
    wall = [
        (r / c.wall_s) / (RIVAL_ROWS / t.wall_s)
        for (r, c), t in zip(ours, theirs, strict=True)
    ]
    default_rate = mean([RIVAL_ROWS / cost.wall_s for cost in theirs])
    stock = "LeRobot default, rows/CPU-s, same frames, without decoding"
    rows_of = partial(Row.of, by=mean)
    name = f"rows per CPU-second over LeRobot's default writer, {label}"
    yield rows_of(
        ratios, name=name, unit="×", goal=goal, rival=stock, rival_value=mean(rival)
    )
    name, stock = (
        f"rows per second (wall) over LeRobot's default writer, {label}",
        "LeRobot default, rows/s",
    )
    yield rows_of(
        wall, name=name, unit="×", goal=goal, rival=stock, rival_value=default_rate
    )
    speed = [rows / 30 / cost.wall_s for rows, cost in ours]
    yield rows_of(speed, name=f"speed, {label}", unit="× real time", goal="≥ 1.5")
    yield rows_of(per_cpu, name=f"rows per CPU-second, {label}", unit="rows/CPU-s")
    yield rows_of(parsing, name=f"parsing, {label}", unit="% of CPU time", goal="< 5")


def _our_ingest(path: Path, spec: Any, folder: Path) -> tuple[int, Cost]:
    from taccorl.data.ingest import find_jobs, ingest
    from taccorl.lineage.store import Store

    store = Store(folder / "store")
    jobs = find_jobs([path], spec, "bench", folder / "store", dry_run=False)
    report: dict[str, Any] = {}
    cost = _timed(lambda: report.update(ingest(jobs, folder / "dataset", store)))
    assert report["outcomes"]["written"] + report["outcomes"]["split"] == 1, report[
        "recordings"
    ][0]["reason"]
    return report["rows"], cost


def _default_writer(path: Path, spec: Any, root: Path) -> Cost:
    """LeRobotDataset.create with its defaults (PNG files, then AV1), fed the same decoded rows."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from taccorl.data.cutting import open_episodes
    from taccorl.data.lerobot_format import _rows, lerobot_features

    with open_episodes(path, spec) as episodes, quiet_lerobot():
        episode = episodes[0]
        rows = [row for row, _ in zip(_rows(episode), range(RIVAL_ROWS), strict=False)]
        features = lerobot_features(
            episode.spec, [k for k in episode.spec.features if k in rows[0]]
        )

        def write() -> None:
            dataset = LeRobotDataset.create(
                "local/rival", episode.spec.fps, features, root=root
            )
            for row in rows:
                dataset.add_frame(dict(row))
            dataset.save_episode()
            dataset.finalize()

        return _timed(write)


def _parse_only(path: Path, spec: Any) -> Cost:
    """Both passes over the file, with messages decoded but no picture."""
    from taccorl.data.recording import find_sources, opened

    def parse() -> None:
        with opened(find_sources(path)[0][1], spec) as recording:
            cameras = [
                spec.features[key].channels[0] for key in spec.target.keys("video")
            ]
            ids = {}
            for name in cameras:
                channel = recording.channels[name]
                ids[name] = list(
                    zip(channel.log_ns.tolist(), channel.stamp_ns.tolist(), strict=True)  # pyright: ignore
                )
            for _ in recording.pictures(ids):
                pass

    return _timed(parse)


@benchmark("memory")
def ingest_memory() -> Iterator[Row]:
    """Benchmark of the peak resident memory of the whole command, for a short and a long recording."""
    peaks = {}
    with tempfile.TemporaryDirectory(prefix="taccorl_bench_") as name:
        folder = Path(name)
        native, imports = (
            _native_spec(folder / "data_specs"),
            "lerobot.datasets.lerobot_dataset, lerobot.datasets.aggregate",
        )
        importing = _peak_mb([sys.executable, "-c", f"import {imports}"])
        for duration_s in (RECORDING_S, LONG_RECORDING_S):
            recording = _stand_in(folder / f"recording_{duration_s:g}.mcap", duration_s)
            command = [
                sys.executable,
                "-m",
                "taccorl.cli.main",
                "ingest",
                str(recording),
                f"--spec={native}",
            ]
            command += [
                f"--out={folder / f'out_{duration_s:g}'}",
                f"--store={folder / 'store'}",
            ]
            peaks[duration_s] = _peak_mb(command)
            recording.unlink()
    for duration_s, peak in peaks.items():
        name, rival = (
            f"peak memory, {duration_s:g} s at 3 × 480×640",
            "import of LeRobot alone",
        )
        yield Row.of(
            [peak],
            name=name,
            unit="MB",
            goal="< 1000",
            rival=rival,
            rival_value=importing,
        )


@benchmark("check")
def check_dataset() -> Iterator[Row]:
    """Benchmark of ``taccorl check`` on a dataset of numbers with few and with many episodes of 20 rows: CPU time of the
    command, and its peak resident memory."""
    with tempfile.TemporaryDirectory(prefix="taccorl_bench_") as name:
        folder = Path(name)
        one, many = folder / "one", folder / "many"
        # By another process: a command's peak memory is at least that of the process which starts it.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            pool.submit(_numbers, one, FEW_EPISODES).result()
            copies = [one] * (MANY_EPISODES // FEW_EPISODES)
            pool.submit(merge, copies, many).result()
        for root, number in ((one, FEW_EPISODES), (many, MANY_EPISODES)):
            command = [sys.executable, "-m", "taccorl.cli.main", "check", str(root)]
            _used(command, subprocess.DEVNULL)  # compiles what is imported
            found = [_used(command, subprocess.DEVNULL)[1] for _ in range(REPEATS)]
            cpu = [usage.ru_utime + usage.ru_stime for usage in found]
            label = f"taccorl check, {number} episodes of {EPISODE_ROWS} rows"
            goal = f"≤ {1.5 if number == FEW_EPISODES else 0.02 * number:g}"
            yield Row.of(cpu, name=label, unit="CPU-s", goal=goal, by=mean)
            peak = [usage.ru_maxrss / 1000 for usage in found]
            yield Row.of(
                peak, name=f"{label}: peak memory", unit="MB", goal="≤ 300", by=mean
            )


def _numbers(root: Path, num_episodes: int) -> None:
    """A dataset of six joints that follow their commands, written by LeRobot."""
    with quiet_lerobot():
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        joints = {"dtype": "float32", "shape": (6,), "names": None}
        features = {"observation.state": joints, "action": joints}
        made = LeRobotDataset.create("local/numbers", 30, features, root=root)
        for phase, k in itertools.product(range(num_episodes), range(EPISODE_ROWS)):
            target = np.sin(phase + 0.1 * k + np.arange(6)).astype(np.float32)
            state = np.sin(phase + 0.1 * (k - 2) + np.arange(6)).astype(np.float32)
            row = {"observation.state": state, "action": target, "task": "wave"}
            made.add_frame(row)
            if k == EPISODE_ROWS - 1:
                made.save_episode()
        made.finalize()


def _used(
    command: list[str], stderr: int | None = None
) -> tuple[int, resource.struct_rusage]:
    """Exit status of a command, and what it used."""
    env = {**os.environ, "HF_HUB_OFFLINE": "1"}
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=stderr, env=env
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, usage


def _peak_mb(command: list[str]) -> float:
    code, usage = _used(command)
    assert code == 0, command
    return usage.ru_maxrss / 1000


@benchmark("corruption")
def corruption() -> Iterator[Row]:
    """Benchmark that runs the corruption suites: 31 planned cases (tests/end_to_end/test_corruption.py), and files with random
    damage in four formats (test_random_damage.py)."""
    suite = _pytest(*CORRUPTION)
    yield _share(
        "cases in their right outcome",
        sum(suite.cases.values()),
        len(suite.cases),
        "≥ 100",
    )
    found = _pytest(*DAMAGE).properties
    kinds = list(dict.fromkeys(name.partition(": ")[0] for name in found))
    files, wrong = (
        sum(found[f"{kind}: {name}"] for kind in kinds) for name in ("files", "wrong")
    )
    yield _share(
        "files with random damage in their right outcome", files - wrong, files, "≥ 100"
    )
    for kind in kinds:
        silent = found.get(f"{kind}: changed, and the format cannot show it", 0)
        text = f"{kind}: random damage that changes rows and that the format cannot show; the report states so"
        yield _share(text, silent, found[f"{kind}: files"])


def _share(name: str, part: int, of: int, goal: str = "") -> Row:
    return Row(name=name, value=100 * part / of, unit="%", goal=goal, n=of, spread=0.0)


class _Suite(NamedTuple):
    """Result of running tests."""

    properties: dict[str, int]
    """What the tests recorded."""
    cases: dict[str, bool]
    """Test that ran → whether it passed."""


def _pytest(*words: str) -> _Suite:
    with tempfile.TemporaryDirectory() as name:
        result = Path(name) / "result.xml"
        command = [sys.executable, "-m", "pytest", "-q", *words, f"--junitxml={result}"]
        subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL, check=False)
        suite = ElementTree.parse(result).getroot()[0]
    properties = {
        p.attrib["name"]: int(p.attrib["value"]) for p in suite.iter("property")
    }
    outcomes = {
        c.attrib["name"]: {part.tag for part in c} for c in suite.iter("testcase")
    }
    return _Suite(
        properties,
        {
            k: not tags & {"failure", "error"}
            for k, tags in outcomes.items()
            if "skipped" not in tags
        },
    )


@benchmark("start_up")
def start_up() -> Iterator[Row]:
    """Benchmark of CPU time until the verbs are listed, relative to an empty Python; and until ``taccorl check`` has read an
    (empty) recording, relative to Python with NumPy. Measured in turns."""
    with tempfile.TemporaryDirectory() as name:
        empty = Path(name) / "empty.mcap"
        empty.touch()
        program = str(Path(sys.executable).with_name("taccorl"))
        check = [program, "check", str(empty), "--spec=piper_flexitac_mcap"]
        for label, words, rival, code, goal in (
            ("list of verbs", [program], "an empty Python", "pass", "< 8"),
            (
                "taccorl check on a recording",
                check,
                "Python with NumPy",
                "import numpy",
                "< 9",
            ),
        ):
            bare = [sys.executable, "-c", code]
            pairs = [(_cpu_s(words), _cpu_s(bare)) for _ in range(7)][2:]
            ratios, bare_s = (
                [ours / theirs for ours, theirs in pairs],
                median([theirs for _, theirs in pairs]),
            )
            yield Row.of(
                ratios,
                name=label,
                unit=f"× {rival}",
                goal=goal,
                rival=f"{rival}, CPU-s",
                rival_value=bare_s,
            )


def _cpu_s(command: list[str]) -> float:
    usage = _used(command, subprocess.DEVNULL)[1]
    return usage.ru_utime + usage.ru_stime
