"""Faults planted in a LeRobot dataset's stamps, indices, statistics, totals, tasks, videos are named; good datasets are not."""

import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from by_lerobot import write_with_lerobot
from small_arm import messages, write_mcap, write_spec

from taccorl.cli.main import main
from taccorl.data.dataset import Dataset
from taccorl.data.dataset_checks import check_bookkeeping, check_statistics, repair
from taccorl.data.exact_statistics import QUANTILE_NAMES
from taccorl.data.finding import leave_out, recompute_statistics
from taccorl.data.lerobot_format import loading_problems, quiet_lerobot, read_as_lerobot
from taccorl.data.recording import Source, find_sources, readers
from taccorl.errors import DatasetError, RecordingError

ROWS, FPS, EPISODES = 12, 30, 3
SHAPE = (64, 96, 3)
JOINTS = ["pan.pos", "lift.pos"]
FEATURES = ("observation.state", "action", "count", "observation.images.top")


def row(features: tuple[str, ...], time_s: float, k: int) -> dict[str, Any]:
    values = {
        "observation.state": np.array([np.sin(time_s), np.cos(time_s)], np.float32),
        "action": np.array([np.sin(time_s + 0.1), np.cos(time_s + 0.1)], np.float32),
        "count": np.array([k]),
        "observation.images.top": np.full(SHAPE, 20 + 5 * k, np.uint8),
        "observation.images.still": np.full(SHAPE, 20 + 5 * k, np.uint8),
        "grid": np.full((2, 3), time_s, np.float32),
        "done": np.array([k == ROWS - 1]),
        "note": f"row {k}",
    }
    return {key: values[key] for key in features}


def build(
    root: Path,
    features: tuple[str, ...] = FEATURES,
    tasks: tuple[str, ...] = ("put", "open"),
    fps: int = FPS,
) -> Path:
    written = [
        [
            row(features, e + k / fps, k) | {"task": tasks[e % len(tasks)]}
            for k in range(ROWS + e)
        ]
        for e in range(EPISODES)
    ]
    return write_with_lerobot(
        root, written, fps=fps, robot_type="arm", names=dict.fromkeys(("observation.state", "action"), JOINTS),
        images=STILL, encoder={"vcodec": "h264", "g": 2, "crf": 30},
    )  # fmt: skip


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("good") / "good")


def findings(root: Path) -> dict[str, str]:
    """Check → text of all warnings and errors that need no LeRobot."""
    dataset = Dataset(root)
    found = [*check_bookkeeping(dataset), *check_statistics(dataset)]
    problems = dataset.video_problems()
    return ({"video_count": problems[0]} if problems else {}) | {
        f.check: f.text for f in found if f.severity != "note"
    }


def edit_dataset(command: str) -> None:
    with quiet_lerobot(), pytest.MonkeyPatch.context() as patched:
        from lerobot.scripts import lerobot_edit_dataset

        patched.setattr("sys.argv", shlex.split(command))
        lerobot_edit_dataset.main()


# ---- good datasets ----

MORE = ("grid", "done", "note")
MOTION = ("observation.state", "action")
STILL = ("observation.images.still",)


@pytest.mark.parametrize(
    ("features", "fps", "tasks"),
    [
        (FEATURES, 30, ("put", "open")),
        (FEATURES, 25, ("put",)),
        (FEATURES + STILL, 20, ("put", "open", "close")),
        (MOTION, 50, ("put", "open")),
        (MOTION + MORE, 15, ("put", "open")),
        (MOTION + STILL, 10, ("put", "open")),
    ],
)
def test_a_dataset_of_lerobot_is_good(tmp_path, features, fps, tasks):
    root = build(tmp_path / "d", features, tasks, fps)
    assert findings(root) == {} and read_as_lerobot(root, [0, ROWS, 3 * ROWS + 2]) == []


@pytest.mark.parametrize("edit", ["delete", "merge", "split", "remove_feature"])
def test_what_lerobots_own_tools_write_is_good(good, tmp_path, edit):
    with quiet_lerobot():
        from lerobot.datasets import dataset_tools as tools
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        source = LeRobotDataset("local/good", root=good)
        place = {"output_dir": tmp_path / "d", "repo_id": "local/d"}
        if edit == "delete":
            tools.delete_episodes(source, [1], **place)
        elif edit == "remove_feature":
            tools.remove_feature(source, "count", **place)
        elif edit == "split":
            tools.split_dataset(source, {"d": [0, 2]}, output_dir=tmp_path)
        else:
            other = LeRobotDataset(
                "local/other", root=build(tmp_path / "other", tasks=("close",))
            )
            tools.merge_datasets(
                [source, other], output_repo_id="local/d", output_dir=tmp_path / "d"
            )
    assert findings(tmp_path / "d") == {}


# ---- planted faults ----


def set_column(
    root: Path, kind: str, key: str, change: Callable[[np.ndarray], np.ndarray]
) -> None:
    path = next((root / kind).rglob("*.parquet"))
    table = pq.read_table(path)
    field = table.schema.field(key)
    column = pa.array(change(table[key].to_numpy().copy())).cast(field.type)
    pq.write_table(table.set_column(table.column_names.index(key), field, column), path)


def set_json(root: Path, name: str, change: Callable[[dict[str, Any]], Any]) -> None:
    path = root / "meta" / name
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def at(index: Any, value: Any) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values[index] = value(values[index]) if callable(value) else value
        return values

    return change


def data(
    key: str, change: Callable[[np.ndarray], np.ndarray]
) -> Callable[[Path], None]:
    return lambda root: set_column(root, "data", key, change)


def episodes(
    key: str, change: Callable[[np.ndarray], np.ndarray]
) -> Callable[[Path], None]:
    return lambda root: set_column(root, "meta/episodes", key, change)


def stats(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    return lambda root: set_json(root, "stats.json", change)


def info(**changes: Any) -> Callable[[Path], None]:
    return lambda root: set_json(root, "info.json", lambda d: d.update(changes))


def swap_rows(root: Path) -> None:
    path = next((root / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    order = np.arange(len(table))
    order[[3, 4]] = order[[4, 3]]
    pq.write_table(table.take(order), path)


def narrow_quantiles(told: dict[str, Any]) -> None:
    action = told["action"]
    for name in QUANTILE_NAMES:
        action[name] = np.mean([action[name], action["mean"]], axis=0).tolist()


TOTAL = 3 * ROWS + 3
FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "stamps run on over the episodes": (
        data("timestamp", lambda t: np.arange(len(t)) / FPS),
        "row_time",
    ),
    "stamps of half the rate": (data("timestamp", lambda t: t * 2), "row_time"),
    "jitter of 1 ms": (
        data("timestamp", lambda t: t + np.linspace(0, 1e-3, len(t))),
        "row_time",
    ),
    "one stamp is NaN": (data("timestamp", at(7, np.nan)), "row_time"),
    "stamps of 1970": (data("timestamp", lambda t: t + 1.76e9), "row_time"),
    "index restarts": (
        data(
            "index",
            lambda i: np.concatenate([np.arange(ROWS), np.arange(len(i) - ROWS)]),
        ),
        "row_index",
    ),
    "one index twice": (data("index", at(5, 4)), "row_index"),
    "frames exchanged": (swap_rows, "episode_rows"),
    "frames of another episode": (
        data("episode_index", at(slice(10, 12), 1)),
        "episode_rows",
    ),
    "first rows shifted": (
        episodes("dataset_from_index", at(slice(1, None), lambda v: v + 1)),
        "dataset_index",
    ),
    "last rows shifted": (
        episodes("dataset_to_index", at(0, lambda v: v - 1)),
        "dataset_index",
    ),
    "wrong number of rows": (info(total_frames=TOTAL + 1), "totals"),
    "wrong number of tasks": (info(total_tasks=7), "totals"),
    "unknown task": (data("task_index", at(2, 9)), "tasks"),
    "task of another episode": (data("task_index", at(slice(0, ROWS), 1)), "tasks"),
    "statistics absent": (
        lambda root: (root / "meta" / "stats.json").unlink(),
        "statistics",
    ),
    "statistics of a feature absent": (stats(lambda s: s.pop("action")), "statistics"),
    "standard deviation NaN": (
        stats(lambda s: s["action"].update(std=[float("nan")] * 2)),
        "statistics",
    ),
    "standard deviation negative": (
        stats(lambda s: s["action"].update(std=[0.5, -0.1])),
        "statistics",
    ),
    "mean of older data": (
        stats(lambda s: s["observation.state"].update(mean=[0.3, 0.2])),
        "statistics",
    ),
    "maximum in degrees": (
        stats(lambda s: s["action"].update(max=[57.0, 57.0])),
        "statistics",
    ),
    "quantiles absent": (
        stats(lambda s: [s["action"].pop(q) for q in ("q01", "q99")]),
        "statistics",
    ),
    "quantiles halfway to the mean": (stats(narrow_quantiles), "statistics"),
    "all quantiles are the mean": (
        stats(
            lambda s: s["action"].update(
                dict.fromkeys(QUANTILE_NAMES, s["action"]["mean"])
            )
        ),
        "statistics",
    ),
    "one quantile of other rows": (
        stats(
            lambda s: s["observation.state"].update(q99=s["observation.state"]["q50"])
        ),
        "statistics",
    ),
    "statistics of too few elements": (
        stats(lambda s: s["action"].update(mean=[0.1])),
        "statistics",
    ),
    "pictures' statistics infinite": (
        stats(
            lambda s: s["observation.images.top"].update(
                max=[[[1.0]], [[float("inf")]], [[1.0]]]
            )
        ),
        "statistics",
    ),
    "video of another episode": (
        episodes("videos/observation.images.top/from_timestamp", at(1, 0.0)),
        "video_count",
    ),
    "video begins between frames": (
        episodes(
            "videos/observation.images.top/from_timestamp",
            at(1, lambda v: v + 0.4 / FPS),
        ),
        "video_count",
    ),
}


@pytest.fixture
def faulty(good: Path, tmp_path: Path) -> Path:
    return shutil.copytree(good, tmp_path / "faulty")


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_named(faulty, name):
    plant, check = FAULTS[name]
    plant(faulty)
    found = findings(faulty)
    assert check in found, f"found {sorted(found)}"
    assert set(found) <= {check, "statistics", "row_time", "row_index"}, (
        "nothing that is right is accused"
    )


# By LeRobot's own writer; its deviation of 0.02 is about 2e-5, of counts near 30000 several of them, and of rows not 0 or 1.5.
@pytest.mark.parametrize(
    ("third", "expected"),
    [
        (lambda k, rng: 0.02, {"constant_element": "note"}),
        (lambda k, rng: 1000.3, {"constant_element": "note"}),
        (lambda k, rng: float(k == 7) / 50, {"rare_motion": "warning"}),
        (lambda k, rng: 30000 + 1.5 * rng.normal(), {"statistics": "error"}),
    ],
)
def test_what_hardly_moves_is_no_fault_but_for_lerobots_deviation(
    tmp_path, third, expected
):
    rng = np.random.default_rng(3)

    def state(k: int) -> np.ndarray:
        return np.array([np.sin(k / 20), np.cos(k / 20), third(k, rng)], np.float32)

    rows = [{"observation.state": state(k), "task": "put"} for k in range(200)]
    names = {"observation.state": [*JOINTS, "third.pos"]}
    root = write_with_lerobot(tmp_path / "d", [rows], names=names)
    found = {f.check: f for f in check_statistics(Dataset(root))}
    assert {f.check: f.severity for f in found.values()} == expected
    if "statistics" in expected:  # a copy is the only way: LeRobot would write the same
        commands = re.findall("`(.*?)`", found["statistics"].text)
        assert [command.split()[0] for command in commands] == ["taccorl"]
        repair(Dataset(root), tmp_path / "copy")
        assert check_statistics(Dataset(tmp_path / "copy")) == []


def test_lerobots_averages_of_quantiles_are_a_note(good):
    found = [(f.check, f.severity) for f in check_statistics(Dataset(good))]
    assert found == [("averaged_quantiles", "note")]


def more_rows(root: Path) -> None:
    path = next((root / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    pq.write_table(pa.concat_tables([table] * 2), path)


@pytest.mark.parametrize(
    ("plant", "said"),
    [
        (more_rows, f"{2 * (TOTAL)} rows in data/, but the episodes have {TOTAL}"),
        (
            lambda root: pd.DataFrame(
                {"task_index": [0, 1]}, pd.Index(["put " * 500_000, "x"], name="task")
            ).to_parquet(root / "meta/tasks.parquet"),
            "a task of 2,000,000 characters",
        ),
    ],
)
def test_what_is_too_much_is_said_in_a_line_before_it_is_read(
    faulty, plant, said, capsys
):
    plant(faulty)
    assert main(["check", str(faulty), "--pictures=false"]) == 1
    out = capsys.readouterr().out
    assert said in " ".join(out.split()) and len(out) < 3000


@pytest.mark.parametrize("from_s", [np.nan, 1e30, -1.0])
def test_a_video_that_begins_at_no_time_is_named(faulty, from_s, capsys):
    episodes("videos/observation.images.top/from_timestamp", at(1, from_s))(faulty)
    assert main(["check", str(faulty)]) == 2
    assert f"from_timestamp of episode 1 is {from_s:g} s" in capsys.readouterr().err


@pytest.mark.parametrize("value", [np.nan, 1e30])
def test_a_stamp_that_is_no_time_refuses_the_episode_that_has_it(faulty, value):
    data("timestamp", at(7, value))(faulty)
    with pytest.raises(
        RecordingError, match=re.escape(f"`timestamp` of row 7 is {value:g}")
    ):
        list(
            readers.get("lerobot")(Source(faulty, (), "episode_000000"), None).messages(
                None
            )
        )


@pytest.mark.parametrize(
    "name", ["stamps run on over the episodes", "wrong number of tasks"]
)
def test_lerobots_own_reading_is_part_of_the_check_where_asked_for(
    faulty, name, capsys
):
    FAULTS[name][0](faulty)
    assert main(["check", str(faulty), "--pictures=false", "--lerobot=true"]) == 1
    out = capsys.readouterr().out
    assert ("lerobot: LeRobot cannot read row" in out) == (
        name == "stamps run on over the episodes"
    )
    assert FAULTS[name][1] in out


def test_what_lerobot_requires_is_checked_without_it(faulty):
    dataset = Dataset(faulty)
    assert loading_problems(dataset, [0, 2]) == []
    path = next((faulty / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.append_column("extra", table["index"]), path)
    [said] = loading_problems(dataset, [])
    assert "the column extra" in said
    [by_lerobot] = read_as_lerobot(faulty, [])
    assert "LeRobot cannot load it" in by_lerobot


def test_a_picture_of_a_probed_row_that_does_not_decode_is_named(faulty):
    dataset = Dataset(faulty)
    video = dataset.video(1, dataset.cameras[0]).path
    video.write_bytes(video.read_bytes()[:400])
    problems = loading_problems(dataset, [1])
    rows = (dataset.first_row(1), dataset.first_row(2) - 1)
    assert {p.split(":")[0] for p in problems} == {
        f"LeRobot cannot read row {row}" for row in rows
    }


def test_an_episode_is_read_from_its_own_row_groups_and_after_a_change(faulty):
    path = next((faulty / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    for size in (1, ROWS + 1, len(table)):  # rows of two episodes in a group, too
        pq.write_table(table, path, row_group_size=size)
        number = Dataset(faulty).values(1, ["index"])["index"].ravel()
        assert number.tolist() == [*range(ROWS, 2 * ROWS + 1)]
    pq.write_table(table, path, write_statistics=False)
    assert Dataset(faulty).values(2, ["index"])["index"][0] == 2 * ROWS + 1
    pq.write_table(table.drop_columns(["action"]), path)
    with pytest.raises(DatasetError, match="lacks the column action"):
        Dataset(faulty).values(0, ["action"])


@pytest.mark.parametrize("from_within", [False, True])
def test_the_episode_to_leave_out_is_named_by_its_own_number_and_folder(
    faulty, from_within, monkeypatch, capsys
):
    swap_rows(faulty)  # episode 0 is not readable
    path = next((faulty / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    state = table["observation.state"].to_pylist()
    state[2 * ROWS + 5] = [np.nan, 0.0]  # row 4 of episode 2
    column = pa.array(state, table.schema.field("observation.state").type)
    pq.write_table(
        table.set_column(
            table.column_names.index("observation.state"), "observation.state", column
        ),
        path,
    )
    stats(lambda s: s["observation.state"].update(mean=[np.nan, 0.0]))(
        faulty
    )  # as LeRobot computes it of these rows
    monkeypatch.chdir(faulty if from_within else faulty.parent)
    assert main(["check", "." if from_within else faulty.name, "--quick=true"]) == 1
    out = capsys.readouterr().out
    assert (
        " statistics: " not in out and "install -D" not in out
    )  # no repair of statistics helps, and there is no spec
    assert (
        "episode 1: 13 rows" in out
        and "episode 2: 14 rows" in out
        and "episode 0: 12 rows" not in out
    )
    assert re.findall(r"episode_indices=\[(\d)\]", out) == ["2"]
    assert f"--root={faulty} " in out and f"--new_root={faulty}_without_2 " in out


REPAIRED = [
    name
    for name, (_, check) in FAULTS.items()
    if check not in ("episode_rows", "tasks", "video_count")
]


@pytest.mark.parametrize("name", REPAIRED)
def test_a_repaired_copy_is_the_good_dataset_again(good, faulty, name, tmp_path):
    FAULTS[name][0](faulty)
    before = {p: p.read_bytes() for p in faulty.rglob("*") if p.is_file()}
    assert (
        main(
            [
                "check",
                str(faulty),
                f"--repair={tmp_path / 'copy'}",
                "--pictures=false",
                "--quick=true",
            ]
        )
        == 0
    )
    assert {p: p.read_bytes() for p in faulty.rglob("*") if p.is_file()} == before, (
        "the dataset itself is untouched"
    )
    a, b = (
        pq.read_table(next((root / "data").rglob("*.parquet")))
        for root in (good, tmp_path / "copy")
    )
    assert a.equals(b)
    of = [
        {p.relative_to(d): p.read_bytes() for p in d.glob("videos/**/*.mp4")}
        for d in (good, tmp_path / "copy")
    ]
    assert of[0] == of[1]


# The check prints a copy's command first, and for rows' numbers LeRobot's command in place; each is run.
@pytest.mark.parametrize(
    ("name", "commands"),
    [
        ("statistics absent", ["taccorl"]),
        ("mean of older data", ["taccorl", "lerobot-edit-dataset"]),
        ("quantiles halfway to the mean", ["taccorl", "lerobot-edit-dataset"]),
        ("quantiles absent", ["taccorl"]),
        ("pictures' statistics infinite", ["taccorl"]),
    ],
)
def test_the_printed_commands_mend_wrong_statistics(
    good, name, commands, tmp_path, monkeypatch, capsys
):
    root = shutil.copytree(good, tmp_path / "it's a set")
    FAULTS[name][0](root)
    monkeypatch.chdir(root)
    assert main(["check", ".", "--pictures=false"]) == 1
    line = next(
        line for line in capsys.readouterr().out.splitlines() if " statistics: " in line
    )
    printed = re.findall("`([^`]*)`", line)
    assert [command.split()[0] for command in printed] == commands
    copy = tmp_path / "copy"
    assert main(shlex.split(printed[0].replace("COPY", str(copy)))[1:]) == 0
    for command in printed[1:]:
        edit_dataset(command)
        assert main(["check", str(root), "--pictures=false"]) == 0


def test_statistics_computed_anew_in_place_are_no_changed_file(
    dataset, tmp_path, capsys
):
    copy = Path(shutil.copytree(dataset, tmp_path / "copy"))
    edit_dataset(recompute_statistics(copy))
    assert (
        main(["check", str(copy), "--pictures=false"]) == 0
        and "changed_statistics" in capsys.readouterr().out
    )
    stats = json.loads((copy / "meta/stats.json").read_text())
    stats["observation.images.front"]["mean"][0][0][0] += (
        0.01  # which no number of a row gives
    )
    (copy / "meta/stats.json").write_text(json.dumps(stats))
    assert (
        main(["check", str(copy), "--pictures=false"]) == 1
        and "changed_file" in capsys.readouterr().out
    )


def shift_videos(root: Path, frames: float) -> None:
    """Episode k's ``from_timestamp`` and ``to_timestamp``, off by ``frames`` · k / 2."""
    (path,) = (root / "meta/episodes").rglob("*.parquet")
    table = pq.read_table(path)
    for end in ("from", "to"):
        name = f"videos/observation.images.top/{end}_timestamp"
        moved = table[name].to_numpy() + frames / FPS * np.arange(EPISODES) / 2
        at = table.column_names.index(name)
        table = table.set_column(at, table.schema.field(name), pa.array(moved))
    pq.write_table(table, path)


def starts_s(root: Path) -> list[float]:
    dataset = Dataset(root)
    return [dataset.video(k, "observation.images.top").from_s for k in range(EPISODES)]


@pytest.mark.parametrize("frames", [0.13, -0.3, 0.45])
def test_starts_of_videos_beside_their_frames_are_named_and_repaired(
    good, faulty, tmp_path, frames
):
    shift_videos(faulty, frames)
    of = [p for p in Dataset(faulty).video_problems() if "from_timestamp" in p]
    assert len(of) == EPISODES - 1
    assert f"{abs(frames) / FPS * 1000:.1f} ms" in of[1]
    words = ["check", str(faulty), f"--repair={tmp_path / 'copy'}"]
    assert main([*words, "--pictures=false", "--quick=true"]) == 0
    assert starts_s(tmp_path / "copy") == pytest.approx(starts_s(good), abs=1e-9)
    assert Dataset(tmp_path / "copy").video_problems() == []


def test_starts_that_are_off_by_more_than_half_a_frame_are_no_guess(faulty, tmp_path):
    """Which frame is meant is not known: nothing is moved."""
    shift_videos(faulty, 2.0)  # by 1 and 2 frames
    before = starts_s(faulty)
    repair(Dataset(faulty), tmp_path / "copy")
    assert starts_s(tmp_path / "copy") == before
    assert Dataset(tmp_path / "copy").video_problems() != []


def test_whole_episodes_of_a_writer_that_died_are_kept(good, faulty, tmp_path, capsys):
    path = faulty / "meta/info.json"
    info = json.loads(path.read_text(encoding="utf-8"))
    more = {"total_episodes": EPISODES + 2, "total_frames": info["total_frames"] + 70}
    path.write_text(json.dumps(info | more), encoding="utf-8")
    assert main(["check", str(faulty)]) == 2
    assert "--repair=" in capsys.readouterr().err
    words = ["check", str(faulty), f"--repair={tmp_path / 'copy'}"]
    assert main([*words, "--pictures=false", "--quick=true"]) == 0
    assert f"episodes {EPISODES}, {EPISODES + 1}" in capsys.readouterr().out
    copy = Dataset(tmp_path / "copy")
    assert copy.num_episodes == EPISODES
    assert copy.info["total_frames"] == info["total_frames"]
    assert [copy.num_rows(k) for k in range(EPISODES)] == [ROWS, ROWS + 1, ROWS + 2]


def test_an_episode_that_is_missing_in_the_middle_is_not_repaired(faulty, tmp_path):
    (path,) = (faulty / "meta/episodes").rglob("*.parquet")
    table = pq.read_table(path)
    pq.write_table(table.filter(pa.array([True, False, True])), path)
    with pytest.raises(DatasetError, match="episode 1 is missing"):
        Dataset(faulty, partial=True)


def test_exchanged_rows_are_not_repaired(faulty, tmp_path, capsys):
    swap_rows(faulty)
    assert main(["check", str(faulty), f"--repair={tmp_path / 'copy'}"]) != 0
    assert (
        "cannot be repaired" in capsys.readouterr().err
        and not (tmp_path / "copy").exists()
    )


def test_stamps_that_run_on_cost_no_row_in_ingest(faulty):
    FAULTS["stamps run on over the episodes"][0](faulty)
    for index, (_, source) in enumerate(find_sources(faulty)):
        times = [m.log_ns for m in readers.get("lerobot")(source).messages({"action"})]
        assert len(times) == ROWS + index
        assert times == [(k * 10**9 + FPS // 2) // FPS for k in range(ROWS + index)]


# ---- what taccorl writes ----


def test_statistics_of_all_columns_are_those_of_the_rows_after_ingest_and_merge(
    tmp_path, capsys
):
    for k, task in enumerate(("put the cup on the plate", "open the drawer")):
        folder = tmp_path / f"r{k}"
        for name in "ab":
            write_mcap(
                folder / "in" / f"{name}{k}.mcap",
                messages(seconds=1.5 + k + (name == "b")),
            )
        spec = write_spec(folder, ("put the cup on the plate", task))
        words = [
            f"--spec={spec}",
            f"--out={folder / 'out'}",
            f"--store={tmp_path / 'store'}",
            "--domain=real",
        ]
        assert main(["ingest", str(folder / "in"), *words]) == 0
    merged = tmp_path / "merged"
    parts = [f"--real={tmp_path / name / 'out'}" for name in ("r0", "r1")]
    assert (
        main(["merge", *parts, f"--out={merged}", f"--store={tmp_path / 'store'}"]) == 0
    )
    out = capsys.readouterr().out
    assert "--policy.type=act" in out, "the data has no touch"
    for root in (tmp_path / "r0" / "out", merged):
        table = pa.concat_tables(
            pq.read_table(p) for p in sorted((root / "data").rglob("*.parquet"))
        )
        stats = json.loads((root / "meta" / "stats.json").read_text())
        for key in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
            rows = table[key].to_numpy().astype(float)
            expected = {
                name: getattr(rows, name)() for name in ("min", "max", "mean", "std")
            }
            found = {name: stats[key][name][0] for name in expected}
            assert found == pytest.approx(expected), key
        assert [f.text for f in check_statistics(Dataset(root))] == []
    assert json.loads((merged / "meta/stats.json").read_text())["task_index"][
        "max"
    ] == [1]


def test_the_way_out_of_wrong_rows_is_a_command_of_lerobot(dataset, tmp_path, capsys):
    old = shutil.copytree(dataset, tmp_path / "a NEW set's NUMBER {0}")
    edit, keep = leave_out(old, 1).split("`")[1::2]
    edit_dataset(edit)
    subprocess.run(shlex.split(keep), check=True)
    before, after = Dataset(old), Dataset(old.with_name(f"{old.name}_without_1"))
    assert after.num_episodes == before.num_episodes - 1 and after.spec == before.spec
    for key, values in after.episode(0).arrays.items():
        np.testing.assert_array_equal(values, before.episode(0).arrays[key])
    assert findings(after.root) == {}
    capsys.readouterr()
    assert main(["check", str(after.root)]) == main(["check", str(old)]) == 0
    assert "no_manifest" not in capsys.readouterr().out
