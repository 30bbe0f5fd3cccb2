"""``python -m pipelines.paper_tables --only=[transfer]``, or ``--page=true``: what the paper's tables ask, simulated.

Each part is words for ``pipelines.learn``, which does nothing twice. Its scores become rows of docs/results.jsonl, one for each
policy and set of scenes; of the rows follow docs/results.md and docs/transfer.png. ``--page=true`` only writes these;
``--take=FOLDER`` takes scores that were made elsewhere. Hours on a GPU.
"""

import itertools
import json
import math
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Set
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import fisher_exact, ttest_ind

from pipelines import learn
from pipelines.steps import parsed
from taccorl.errors import nearest
from taccorl.evaluation.statistics import wilson_interval
from taccorl.sim.task import CLEARANCES_M

ROWS, PAGE, PICTURE, GRIPS, CURVES = (
    Path("docs") / name
    for name in (
        "results.jsonl",
        "results.md",
        "transfer.png",
        "grips.png",
        "curves.png",
    )
)
TWINS = ("nominal", "randomised", "mended", "surrogate")
ROBOTS = {
    "late": "commands 30 ms late",
    "sticky": "friction, 60 % of weight held",
    "heavy": "no weight held",
}
SENSORS = {"touch": "cameras and touch", "cameras": "cameras alone"}
TASKS = ("test_tube", "puzzle", "assembly_1", "assembly_2")
_SEEDS = "--seeds=[1000,2000,3000]"
_FOUR = "[nominal,configs/randomised,mended,surrogate]"
_EACH = f"--sensors=[touch,cameras] {_SEEDS}"
PLAIN = {
    "pictures": "clear",
    "difficulty": "train",
    "executed": 8,
    "twin": "",
    "scored_in": "",
}
DEMONSTRATIONS = (100, 300, 1000, 3500)
STAGES = {
    "start": "before",
    "ppo": "after",
    "ppo_anchored": "after, with an anchor",
}  # PPO: field of a row → text
_LONG, _SHORT, _BRIEF = (
    f"--train_options=[--steps={n},--save_freq={n}]" for n in (5400, 2500, 1500)
)
_PPO = (
    "--post_train=[configs/post_train/gpu.yaml] --scored=512"
    " --post_train_options=[--iterations=70,--rerun=false]"
)
PARTS = {
    "imitation": [
        f"--task=[assembly_1,assembly_2,test_tube] {_EACH}",
        f"--task=puzzle --episodes=2800 --rows_per_picture=4 {_LONG} {_EACH}",
    ],
    "randomised": [
        f"--task={t} --pictures=randomised --difficulty=[train,hard] --executed=[8,16] --episodes=2000 {_SHORT} {_EACH}"
        for t in ("assembly_1", "test_tube")
    ],
    "grips": [
        f"--sensors=[touch,cameras] --sources=[10,20,0] --episodes=[100,300,1000] {_SHORT} {_SEEDS}"
    ],
    "transfer": [
        f"--scored_in=[configs/surrogates/{r}.yaml] --twins={_FOUR} --episodes=1200 {_SHORT} {_SEEDS}"
        for r in ROBOTS
    ],
    "cotrained": [
        f"--scored_in=[configs/surrogates/{r}.yaml] --real=50 --sim_weight=[0,0.5,0.95] --episodes=1200 {_SHORT} {_SEEDS}"
        for r in ROBOTS
    ],
    "effects": [
        f"--scored_in=[configs/surrogates/{r}.yaml] --singly=true --episodes=1000 {_SHORT} {_SEEDS}"
        for r in ROBOTS
    ],
    "ppo": [
        f"--task=assembly_1 --episodes=300 {_BRIEF} {_PPO} {_EACH}",
        f"--task=puzzle --episodes=1000 --rows_per_picture=4 {_SHORT} {_PPO} {_EACH}",
    ],
}
"""Part of the tables → command-line arguments of each call of ``pipelines.learn`` that measures it."""
PAPER_STAGES = ("co-trained", "with noise", "RL, untrained", "RL")
PAPER = {
    "touch": dict(
        zip(
            PAPER_STAGES,
            ((41, 16, 47, 58), (36, 4, 35, 42), (0,) * 4, (72, 71, 92, 79)),
            strict=True,
        )
    ),
    "cameras": dict(
        zip(
            PAPER_STAGES,
            ((42, 12, 39, 39), (35, 5, 25, 25), (0,) * 4, (50, 54, 77, 61)),
            strict=True,
        )
    ),
}
"""Sensors → stage → completed [%] in simulation, of ``TASKS``: the paper's Table 1, π0.5 and 128 environments."""
HEADS_1 = f"task | policy | paper: {'; '.join(PAPER_STAGES)} | here: by imitation | with PPO's noise"
PAPER_BETA = "The paper, of a robot and α = 0.5: 45 % with β = 0, 80 % with 0.1 and with 1, less with 5"
PAPER_ALPHA = "The paper, assembly_2 of a robot after PPO without an anchor: 25 % with α = 0, 45 % with 0.5, 40 % with 0.95"
PAPER_REAL = "real-only 35 %, co-trained (α = 0.5) 45 %, after RL 95 %"
"""The paper's Table 2, assembly_1 with touch: of a robot."""
Rows = list[dict[str, Any]]


@dataclass(kw_only=True)
class PaperTablesConfig:
    """Parts to run, and scores to take."""

    only: list[str] = field(default_factory=list)
    """Parts to run: imitation, randomised, grips, transfer, cotrained, effects, ppo."""
    page: bool = False
    """Run nothing."""
    take: list[Path] = field(default_factory=list)
    """Folders with scores of pipelines.learn to take, at any depth; nothing is run."""
    out: Path = Path("outputs/learn")
    """Folder of pipelines.learn."""


def main(words: list[str]) -> None:
    config = parsed(PaperTablesConfig, words, "python -m pipelines.paper_tables")
    for name in config.only:
        if name not in PARTS:
            raise SystemExit(f"--only={name}: {nearest(name, PARTS)}")
    if not ROWS.exists():
        raise SystemExit(f"{ROWS}: not here; run it in the root of the clone")
    if not (config.only or config.take or config.page):
        raise SystemExit(
            f"give --only=[…] of {', '.join(PARTS)} (hours on a GPU each), --take=FOLDER or --page=true"
        )
    scores = [
        told.parent
        for folder in config.take
        for told in sorted(folder.rglob("settings.json"))
    ]
    if config.take and not scores:
        raise SystemExit(
            f"--take={', '.join(map(str, config.take))}: no score of pipelines.learn in there"
        )
    for call in (
        [call for name in config.only for call in PARTS[name]]
        if not (config.page or config.take)
        else []
    ):
        take(
            [
                score
                for one in learn.main([*call.split(), f"--out={config.out}"])
                for score in one.scores
            ]
        )
    take(scores)
    rows = read(ROWS)
    PAGE.write_text(page(rows), encoding="utf-8")
    draw(rows, PICTURE)
    draw_grips(rows, GRIPS)
    draw_curves(rows, CURVES)
    print(f"{ROWS}: {len(rows)} rows; {PAGE}, {PICTURE}, {GRIPS}, {CURVES}")


def read(path: Path) -> Rows:
    """Rows of a file; of those with one key the last."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return list({row["key"]: row for row in map(json.loads, lines)}.values())


def take(scores: list[Path], path: Path = ROWS) -> None:
    """Append the rows of ``scores`` that are not there yet. The file is replaced whole: a stop or a full disk costs no row."""
    there = {row["key"] for row in read(path)}
    if changed := _git(
        "status", "--porcelain", "--", "taccorl", "pipelines", "configs"
    ):
        raise SystemExit(
            f"rows state the commit that made them, but these files are not committed:\n{changed}\ncommit them first"
        )
    commit = _git("describe", "--always")
    made = {"commit": commit, "date": datetime.now(UTC).date().isoformat()}
    new = [
        json.dumps(row | made) + "\n"
        for row in map(row_of, scores)
        if row["key"] not in there
    ]
    draft = path.with_suffix(".unfinished")
    draft.write_text(
        "".join([path.read_text(encoding="utf-8") if path.exists() else "", *new]),
        encoding="utf-8",
    )
    draft.replace(path)


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], capture_output=True, text=True, check=False)
    return done.stdout.strip()


def row_of(score: Path) -> dict[str, Any]:
    """A score of ``pipelines.learn`` as a row; its key follows from the policy, the scenes and the result. After PPO, ``curve``:
    [episodes that ended, completed] of each iteration, of those that began at a reset, under noise; ``flow_loss``: on fixed rows
    of the anchor, after each."""
    about, told = (
        json.loads((score / f"{n}.json").read_text("utf-8"))
        for n in ("settings", "evaluation")
    )
    (one,), scenes = told["scores"], told["scenes"]
    row = about | {
        name: one[name] for name in ("task", "pictures", "hidden", "n", "successes")
    }
    row |= {
        "difficulty": scenes["difficulty"],
        "executed": int(score.name.split("_")[3]),
        "first_scene": scenes["seed"],
    }
    words = json.dumps(
        [row, [policy["digest"] for policy in told["policies"]]], sort_keys=True
    )
    key = {"key": sha256(words.encode()).hexdigest()[:12]}
    if (
        row.get("stage", "start") != "start"
        and (progress := score.parent / "progress.jsonl").exists()
    ):
        lines = [json.loads(line) for line in progress.read_text("utf-8").splitlines()]
        row["curve"] = [
            [line["episodes"], round(line["episodes"] * (line["success"] or 0))]
            for line in lines
        ]
        row |= (
            {"flow_loss": [round(line["drift"], 4) for line in lines]}
            if "drift" in lines[0]
            else {}
        )
    return key | row


def share(rows: Rows) -> str:
    """``95 % (93 … 97) of 256; 94.1, 96.1``: completed of all scenes with Wilson's 95 % interval, then by each training; then the
    number of iterations of PPO that changed the policy and the anchor's loss, if the rows state them."""
    if not rows:
        return "not run"
    (p,), (low,), (high,) = _shares([rows])
    each = (
        f"; {', '.join(f'{100 * row["successes"] / row["n"]:.1f}' for row in rows)}"
        if len(rows) > 1
        else "*"
    )
    updates = "".join(
        f", updates: {row['updates']}" for row in rows if "updates" in row
    )
    losses = (row["flow_loss"] for row in rows if "flow_loss" in row)
    updates += "".join(f", flow loss {of[0]:g} → {of[-1]:g}" for of in losses)
    return f"{p:.0f} % ({low:.0f} … {high:.0f}) of {_counts(rows)[1]}{each}{updates}"


def page(rows: Rows) -> str:
    """Text of docs/results.md."""
    seen = [row for row in rows if not row["hidden"]]
    real = [{"stage": "", "beta": 1} | row for row in rows if "real" in row]
    mixed = _grouped(real, "task", "scored_in", "real", "sim_weight", "stage", "beta")
    plain = [
        row
        for row in seen
        if PLAIN.items() <= row.items() and not {"sources", "corrected"} & row.keys()
    ]
    own = _grouped(plain, "task", "sensors")
    harder = [
        row
        for row in seen
        if not (PLAIN.items() <= row.items() or row["twin"] or row["scored_in"])
    ]
    cells = _grouped(
        harder,
        "task",
        "pictures",
        "demonstrations",
        "difficulty",
        "executed",
        "sensors",
    )
    table_1, table_2, table_3, table_4, table_5, table_6, table_7 = (
        [],
        [],
        [],
        [],
        [],
        [],
        [],
    )
    learnt_of = defaultdict(list)
    for k, task in enumerate(TASKS):
        for sensors, text in SENSORS.items():
            paper = "; ".join(f"{stage[k]} %" for stage in PAPER[sensors].values())
            mine = own[task, sensors]
            trained = [r for r in mine if r["demonstrations"]]
            learnt = _most([r for r in trained if "stage" not in r])
            old, new = (
                _grouped([r for r in trained if r.get("stage") == s], "demonstrations")
                for s in ("start", "ppo")
            )
            after = [
                f"{share(new[n])}; of {n[0]} demonstrations"
                + (f", before {share(old[n])}" if n in old else "")
                for n in sorted(new, reverse=True)
            ]
            loudest = _most([r for r in mine if "noise" in r])
            noise = next(
                (
                    row["noise"] | {"demonstrations": row["demonstrations"]}
                    for row in loudest
                ),
                None,
            )
            loud = (
                "{without:g} → {with:g} % of {n:g}; of {demonstrations}".format(**noise)
                if noise
                else "not run"
            )
            none = share(
                [
                    r
                    for r in mine
                    if r.get("stage") == "ppo"
                    and not r["demonstrations"]
                    and r.get("updates", 1)
                ]
            )
            first = share(learnt) + (
                f"; of {learnt[0]['demonstrations']} demonstrations" if learnt else ""
            )
            table_1.append(
                (task, text, paper, first, loud, none, "; ".join(after) or "not run")
            )
            learnt_of[sensors].append(learnt)
        few = {
            key: of
            for key, of in grips(seen, task).items()
            if {*DEMONSTRATIONS[:-1]} & {*of}
        }
        table_5 += [
            (task, *key, *(share(of.get(n, [])) for n in DEMONSTRATIONS))
            for key, of in few.items()
        ]
    for task, pictures, n, clear, executed in sorted({cell[:5] for cell in cells}):
        here = (
            share(cells[task, pictures, n, clear, executed, sensors])
            for sensors in SENSORS
        )
        table_2.append(
            (
                f"{task}, {n}",
                pictures,
                f"{1e3 * CLEARANCES_M[clear]:g} mm, {executed}",
                *here,
            )
        )
    for key, of in transfer(seen).items():
        table_3.append(
            (
                ", ".join(map(str, key)),
                *(share(of.get(t, [])) for t in TWINS),
                gain(of),
                gain(of, TWINS[1]),
            )
        )
    for stage, text in STAGES.items():
        for (robot, _), of in transfer(seen, stage).items():
            table_4.append(
                (robot, text, share(of["nominal"]), share(of["mended"]), gain(of))
            )
    for task, robot, few in sorted({key[:3] for key in mixed}):
        name, of = robot.rpartition("_")[0], (task, robot, few)
        weights = [
            mixed[*of, *cell, 1]
            for cell in ((0, ""), (0.5, ""), (0.95, ""), (0.95, [*STAGES][-1]))
        ]
        n = max(row["demonstrations"] for row in itertools.chain(*weights))
        alone = transfer(seen, task=task, needed=set()).get((name, n), {})
        shares = [*weights, alone.get("nominal", []), alone.get("mended", [])]
        table_6.append((f"{task}, {name}: {few}, {n}", *map(share, shares)))
        betas = (
            ("start", 1),
            ("ppo", 0),
            *(([*STAGES][-1], beta) for beta in (0.1, 1, 5)),
        )
        table_7.append(
            (f"{task}, {name}", *(share(mixed[*of, 0.95, *cell]) for cell in betas))
        )
    single = singly(seen)
    alone = [
        row for row in seen if any(row in nominal for nominal, _ in single.values())
    ]
    costs = sorted(single.items(), key=lambda item: np.divide(*_counts(item[1][1])))
    table_8 = [
        (*name, share(of), gain({"nominal": nominal, "mended": of}))
        for name, (nominal, of) in costs
    ]
    learnt_more = np.subtract(
        PAPER["touch"]["co-trained"], PAPER["cameras"]["co-trained"]
    )
    return f"""# The paper's tables, by simulation

Written by `python -m pipelines.paper_tables` of `docs/results.jsonl` (commit, seed, scenes). **Simulated**: a small π0.5 from
scratch and tasks of our own; robots are surrogates. Completed scenes of all trainings (95 %, of the scenes),
their number, each training (`*`: one). 0.5 mm of clearance, 8 actions executed unless stated.

## Table 1

{_table(f"{HEADS_1} | after PPO, untrained | after PPO", table_1)}

PPO's noise: completed without → with it, before any update; of so many demonstrations.
Updates: iterations of PPO that changed the policy, if they were counted. Of untrained policies at most three, of 32 environments
of 72 decisions: no episode succeeded, so that no reward says what to improve.

Completed with touch minus completed with cameras alone, in points, mean of the tasks (95 %, of the scenes), by imitation of equal
numbers of demonstrations: {touch_gain(*learnt_of.values())}; the paper: {learnt_more.mean():+.0f}. What PPO adds to it is not
known: one run each, of other demonstrations and scenes.

![completed in each iteration of PPO]({CURVES.name})

In the first iteration only episodes that ended early are counted.

## Tighter holes, randomised pictures, more actions between looks

{_table(f"task, demonstrations | pictures | clearance, executed | {' | '.join(SENSORS.values())}", table_2)}

## How many demonstrations, of how many grips

![completed by demonstrations]({GRIPS.name})

Clear pictures, 2500 steps (of 3500 demonstrations: assembly_1 3500, assembly_2 2500 and once 3500, test_tube
2300). Of 10 demonstrations MimicGen made the others, with pushes
and the expert in contact. Corrections: the expert takes over from a policy of the demonstrations.

{_table(f"task | policy | grips | {' | '.join(map(str, DEMONSTRATIONS))} demonstrations", table_5)}

## Does the mended twin make better policies?

![completed in each surrogate]({PICTURE.name})

assembly_1, cameras and touch, learnt in a twin, scored in the surrogate. Gains in points, 95 % of trainings:

{_table(f"surrogate, demonstrations | in: {' | in: '.join(TWINS)} | mended − nominal | mended − randomised", table_3)}

### After PPO in the twin of the demonstrations

A policy of each twin, post-trained there, without and with an anchor on 50 demonstrations of the surrogate, in which all are
scored ([settings](training.md#post-training-ppo-in-the-twin)).

{_table("surrogate | PPO | in: nominal | in: mended | mended − nominal", sorted(table_4, key=lambda row: row[0]))}

### What each effect costs

Policies of the nominal twin, of {", ".join(map(str, sorted({row["demonstrations"] for row in alone})))} demonstrations,
scored in it with one effect of a surrogate (configs/surrogates), in the same scenes; in the nominal twin itself {share(alone)}.
p: Fisher's exact test of all scenes; 95 % intervals, where given, of three trainings or more.

{_table("effect | as in | completed | gained, in points", table_8)}

## Table 2 and α: demonstrations of the surrogate beside those of the nominal twin

Cameras and touch, scored in the surrogate; the loss is α · the twin's + (1 − α) · the surrogate's.
The paper, of a robot and assembly_1: {PAPER_REAL}. {PAPER_ALPHA}.

{_table("task, surrogate: its, the twin's | α = 0 | 0.5 | 0.95 | … after PPO, anchored | 1: nominal twin | mended twin", table_6)}

### β: weight of the anchor on the surrogate's demonstrations

One of the co-trained policies (α = 0.95), post-trained in the nominal twin, all for the same time, scored in the surrogate.
{PAPER_BETA}.
Flow loss: on fixed rows of the surrogate's demonstrations, after the first and the last iteration.

{_table("task, surrogate | before PPO | β = 0 | 0.1 | 1 | 5", table_7)}

**Not run**: PPO after other policies; Table 2 in other surrogates; other cells that say so.
"""


def _table(heads: str, rows: list[tuple]) -> str:
    lines = [
        f"| {heads} |",
        "|---" * (heads.count(" | ") + 1) + "|",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]
    return "\n".join(lines)


def _grouped(rows: Rows, *names: str) -> defaultdict[tuple, Rows]:
    groups = defaultdict(list)
    for row in rows:
        groups[tuple(row[name] for name in names)].append(row)
    return groups


def _most(rows: Rows) -> Rows:
    """Rows of the policies that learnt from the largest number of demonstrations, in the order of their seeds."""
    most = max((row["demonstrations"] for row in rows), default=0)
    return sorted(
        (row for row in rows if row["demonstrations"] == most),
        key=lambda row: row["seed"],
    )


def transfer(
    rows: Rows,
    stage: str = "",
    task: str = "assembly_1",
    needed: Set[str] = frozenset(("nominal", "mended")),
) -> dict[tuple[str, int], dict[str, Rows]]:
    """(surrogate, demonstrations) → twin of the demonstrations → rows; where all of ``needed`` were tried.
    ``stage``: of ``STAGES``, for rows of post-training."""
    found: dict[tuple[str, int], dict[str, Rows]] = defaultdict(
        lambda: defaultdict(list)
    )
    own = (
        row
        for row in rows
        if row["scored_in"] and row["task"] == task and "real" not in row
    )
    scored = (row for row in own if row.get("stage", "") == stage)
    for row in sorted(
        scored, key=lambda row: (row["scored_in"], -row["demonstrations"], row["seed"])
    ):
        kind = (row["twin"] or "nominal").partition("_")[0]
        key = row["scored_in"].rpartition("_")[0], row["demonstrations"]
        found[key][kind if kind in TWINS else "surrogate"].append(row)
    return {
        key: of for key, of in found.items() if key[0] in ROBOTS and needed <= of.keys()
    }


def singly(rows: Rows) -> dict[tuple[str, str], tuple[Rows, Rows]]:
    """(effect or section of a twin, surrogate) → rows of policies in the nominal twin, and in it with that of the surrogate
    alone, in the same scenes."""
    found: dict[tuple[str, str], tuple[Rows, Rows]] = defaultdict(lambda: ([], []))
    differ = {"key", "successes", "commit", "date", "scored_in", "stage"}
    scenes = [
        {name: value for name, value in row.items() if name not in differ}
        for row in rows
    ]
    for row, same in zip(rows, scenes, strict=True):
        effect, of, robot = row["scored_in"].rpartition("_")[0].partition("_of_")
        if of:
            nominal = [
                r
                for r, other in zip(rows, scenes, strict=True)
                if other == same and not r["scored_in"]
            ]
            for side, more in zip(found[effect, robot], (nominal, [row]), strict=True):
                side += more
    return found


def grips(
    rows: Rows, task: str = "assembly_1"
) -> dict[tuple[str, str], dict[int, Rows]]:
    """(sensors, grips), in words → demonstrations → rows; of a task, in the nominal twin."""
    found: dict[tuple[str, str], dict[int, Rows]] = defaultdict(
        lambda: defaultdict(list)
    )
    for row in sorted(
        rows,
        key=lambda row: (
            row["sensors"] != "touch",
            -row.get("sources", 3500),
            row["seed"],
        ),
    ):
        if (PLAIN | {"task": task}).items() <= row.items() and "stage" not in row:
            of = f"{row['sources']} grips" if "sources" in row else "each its own grip"
            of += (
                f" for {row['corrected']}, then corrections"
                if "corrected" in row
                else ""
            )
            found[SENSORS[row["sensors"]], of][row["demonstrations"]].append(row)
    return found


def gain(of: dict[str, Rows], over: str = "nominal") -> str:
    """Points of mended ``over`` another; Welch's 95 % interval of three or more trainings, or of fewer Fisher's p, as if scenes
    of one training were independent."""
    if not (sides := (of.get(over, []), of["mended"]))[0]:
        return "not run"
    (a, m), (b, n) = map(_counts, sides)
    _, p = fisher_exact([[a, m - a], [b, n - b]])
    text = f"{100 * (b / n - a / m):+.0f}; p = {p:.1g}"
    if min(map(len, sides)) < 3:
        return text
    nominal, mended = (
        [100 * row["successes"] / row["n"] for row in side] for side in sides
    )
    low, high = ttest_ind(mended, nominal, equal_var=False).confidence_interval()
    return f"{text.partition(';')[0]}; {low:+.0f} … {high:+.0f}"


def touch_gain(*of: list[Rows]) -> str:
    """``+13 (+12 … +14)``: completed with touch minus with cameras alone [points], mean of the tasks. ``of``: rows of each task
    with touch, then with cameras. The 95 % interval: Zou and Donner 2008, doi:10.1002/sim.3095, of independent cells."""
    if not all(itertools.chain(*of)):
        return "not run"
    (p, low, high), (q, floor, top) = map(_shares, of)
    mean, down, up = (
        (p - q).mean(),
        np.hypot(p - low, top - q),
        np.hypot(high - p, q - floor),
    )
    return f"{mean:+.0f} ({mean - math.hypot(*down) / len(p):+.0f} … {mean + math.hypot(*up) / len(p):+.0f})"


def _counts(rows: Rows) -> tuple[int, int]:
    """(completed, all) scenes of ``rows``."""
    return sum(row["successes"] for row in rows), sum(row["n"] for row in rows)


def _shares(cells: Iterable[Rows]) -> np.ndarray:
    """(3, C) share of completed scenes in each of C cells [%], then the lower and upper ends of Wilson's 95 % interval."""
    return 100 * np.transpose(
        [(done / n, *wilson_interval(done, n)) for done, n in map(_counts, cells)]
    )


def draw(rows: Rows, path: Path) -> None:
    """A picture: completed in each surrogate, with the most demonstrations; intervals of the scenes; a dot for each training."""
    figure, axis = plt.subplots(figsize=(7, 3.4), layout="constrained")
    table = {
        f"{robot}:\n{ROBOTS[robot]}": of
        for (robot, _), of in reversed(transfer(rows).items())
    }
    table |= {
        f"{robot},\nafter PPO in the twin": of
        for (robot, _), of in transfer(rows, "ppo").items()
    }
    shown = [twin for twin in TWINS if any(twin in of for of in table.values())]
    for k, twin in enumerate(shown):
        off = 0.8 * ((k + 0.5) / len(shown) - 0.5)
        there = {x + off: of[twin] for x, of in enumerate(table.values()) if twin in of}
        height, *ends = _shares(there.values())
        label = "learnt in: " + (twin if twin == "surrogate" else f"{twin} twin")
        axis.bar(
            list(there),
            height,
            0.75 / len(shown),
            yerr=abs(ends - height),
            capsize=4,
            label=label,
        )
        for x, mine in there.items():
            axis.plot(
                [x] * len(mine),
                [100 * row["successes"] / row["n"] for row in mine],
                "k.",
                ms=4,
                clip_on=False,
            )
        for x in {x + off for x in range(len(table))} - {*there}:
            axis.text(
                x, 1, "not run", rotation=90, ha="center", color="gray", fontsize=7
            )
    axis.set_xticks(range(len(table)), [*table], fontsize=8)
    axis.set(ylabel="completed [%]", ylim=(0, 100), xlim=(-0.5, len(table) - 0.5))
    axis.set_title(
        "assembly_1, scored in surrogate robots (simulated); whiskers: 95 % of the scenes",
        fontsize=9,
    )
    figure.legend(loc="outside lower center", ncols=len(shown), fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_grips(rows: Rows, path: Path) -> None:
    """A picture: completed by number of demonstrations; intervals of the scenes."""
    figure, axis = plt.subplots(figsize=(9, 3.4), layout="constrained")
    for key, of in grips(rows).items():
        height, *ends = _shares(of[n] for n in sorted(of))
        axis.errorbar(
            sorted(of),
            height,
            abs(ends - height),
            marker="o",
            capsize=4,
            label=", ".join(key),
        )
    axis.set(
        xscale="log", ylim=(0, 100), xlabel="demonstrations", ylabel="completed [%]"
    )
    axis.set_xticks(DEMONSTRATIONS, map(str, DEMONSTRATIONS), minor=False)
    axis.set_title("assembly_1, simulated; whiskers: 95 % of the scenes", fontsize=9)
    figure.legend(loc="outside right center", fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_curves(rows: Rows, path: Path) -> None:
    """A picture: completed under noise in each iteration of PPO in the nominal twin, of Table 1; intervals of the episodes."""
    figure, axis = plt.subplots(figsize=(9, 3.4), layout="constrained")
    for row in (
        row
        for row in rows
        if row["demonstrations"] and not (row["twin"] or row["scored_in"])
    ):
        cells = {
            k: [{"n": n, "successes": done}]
            for k, (n, done) in enumerate(row.get("curve", []), start=1)
            if n
        }
        if cells:
            height, *ends = _shares(cells.values())
            label = f"{row['task']}, {SENSORS[row['sensors']]}, {row['demonstrations']}"
            axis.errorbar(
                list(cells),
                height,
                abs(ends - height),
                marker="o",
                ms=3,
                capsize=2,
                lw=1,
                label=label,
            )
    axis.set(
        ylim=(0, 100), xlabel="iteration of PPO", ylabel="completed, with noise [%]"
    )
    axis.set_title(
        "simulated; episodes that ended in the iteration; whiskers: 95 % of the episodes",
        fontsize=9,
    )
    figure.legend(loc="outside right center", fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main(sys.argv[1:])
