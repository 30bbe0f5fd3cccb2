"""``python -m pipelines.learn --task=assembly_1 [--small]``: policies from scratch, from nothing to their scores::

    collect --pictures=cache ── lerobot-train --dataset.cache=gpu ── evaluate

``--task=[assembly_1,test_tube] --sensors=[touch,cameras] --seeds=[1000,2000] --executed=[8,16] --difficulty=[train,hard]`` does
so for every combination, with a training on each GPU. All of it is simulated: no robot is near. Everything lands in
outputs/learn; a stopped run goes on where it was. It wants a GPU and 16 cores for half an hour (docs/learning.md). ``--small``
shows the chain on a CPU in minutes and learns nothing.

``--sources=[10,0]``: demonstrations that MimicGen makes of ten, and the expert's own: how many different grips a policy needs.
``--scored_in=[sticky.yaml] --twins=[nominal,mended,surrogate]``: learnt in the nominal twin, in the one that commands mend
(surrogate ── diagnose --until=noise_floor), and in the surrogate, scored in it; ``--singly=true``: also in each effect alone.
``--scored_in=[late.yaml] --real=50 --sim_weight=[0,0.5,0.95]``: co-trained with 50 demonstrations of the surrogate.
``--episodes=300 --corrections=700``: a second policy learns from 300 demonstrations and 700 corrections of the first.
"""

import dataclasses
import itertools
import json
import math
import os
import queue
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import yaml

from pipelines.lerobot_commands import Training
from pipelines.post_training import PostTraining
from pipelines.steps import chosen, parsed, step
from pipelines.surrogate_twin import is_folder, mended, named
from taccorl.cli import augment, collect, merge
from taccorl.cli.augment import AugmentConfig
from taccorl.cli.collect import CollectConfig
from taccorl.cli.correct import CorrectConfig
from taccorl.cli.evaluate import EvaluateConfig, PolicyChoice
from taccorl.cli.merge import MergeConfig
from taccorl.cli.parse import command, shared_fields
from taccorl.data.dataset import Dataset
from taccorl.data.origin import TWIN_ORIGIN
from taccorl.episodes.sources.expert import ExpertSource
from taccorl.episodes.sources.mimicgen.spec import mimic_spec_path
from taccorl.errors import TaccorlError, nearest
from taccorl.evaluation.rollouts import HIDDEN, PICTURES
from taccorl.lineage.engines import LocalEngine
from taccorl.sim.effects.added import present
from taccorl.sim.part_poses import PARTS_KEY
from taccorl.sim.task import CLEARANCES_M, tasks
from taccorl.sim.twin import TwinConfig
from taccorl.sim.twin_file import load_twin, save_twin
from taccorl.tasks.experts.hands import ScriptedExpertConfig

SMALL = (
    "--episodes=2",
    "--scored=2",
    "--executed=8",
    "--episode_length=12",
    "--workers=1",
    "--cache=host",
)
SMALL += (
    "--train=configs/learn/tiny.yaml",
    "--train_options=[--steps=2,--batch_size=2,--save_freq=2]",
)
RESOLUTION = "84x112"
SCORE_SEED = 70000
SENSORS = {"touch": [], "cameras": ["--policy.tactile=false"]}
RANDOMISED = [
    "--policy.image_crop=0.95",
    "--policy.image_rotation_deg=5",
    "--policy.image_noise_std=0.03",
]


@dataclass(kw_only=True)
class LearnConfig:
    """Demonstrations of the twin → policies → scores. Where several values are given, every combination is done."""

    task: list[str] = field(default_factory=lambda: ["assembly_1"])
    """Task: {tasks}."""
    episodes: list[int] = field(default_factory=lambda: [3500])
    """Demonstrations of the scripted expert, each with a grip of its own. Of several numbers the largest is made, and policies of
    fewer learn from the first of them."""
    hands: ScriptedExpertConfig = field(
        default_factory=lambda: ScriptedExpertConfig(
            grasp_m=0.004, grasp_rad=0.06, pulse_rad=0.02
        )
    )
    """Spread of the grips, pulses, errors of the expert: --hands.grasp_m=0.004 …"""
    sources: list[int] = field(default_factory=lambda: [0])
    """Demonstrations of the expert of which MimicGen (taccorl augment), with pushes and the expert in contact, makes
    the others; 0: all are the expert's own."""
    twins: list[str] = field(default_factory=lambda: ["nominal"])
    """Twins of the demonstrations: nominal; mended, which taccorl diagnose makes of sweeps and presses of each twin of
    --scored_in; surrogate, those; a folder of twin files that share the demonstrations, such as configs/randomised."""
    scored_in: list[Path] = field(default_factory=list)
    """Twin files to score in: surrogates of a robot, with effects that the nominal twin lacks; the nominal twin if not given."""
    singly: bool = False
    """Also score what is learnt in the nominal twin there, and in twins that have one effect, or one other section, of each of
    --scored_in alone: which of them costs how many points."""
    real: int = 0
    """Demonstrations of each of --scored_in, which stands for the robot, that are merged with those of the twin; without poses of
    the parts, which only a simulator knows."""
    sim_weight: list[float] = field(default_factory=list)
    """α: weight of the twin's loss beside --real, 0.5 if not given. 0: those of --real alone are learnt from."""
    corrections: int = 0
    """Corrections of each policy (taccorl correct: the expert takes over at drawn times), from which, beside its demonstrations,
    another policy learns."""
    post_train: list[Path] = field(default_factory=list)
    """Settings of taccorl post-train: each policy is post-trained by each of these files, and scored again in the same scenes."""
    post_train_options: list[str] = field(default_factory=list)
    """Further words for taccorl post-train, among them the number of iterations, such as [--iterations=30,--anchor.weight=0]."""
    physics_steps: int = 20
    """Physics steps in a control step of the demonstrations; half of the twin's, for half of the time. Scores use the twin's."""
    difficulty: list[str] = field(default_factory=lambda: ["train"])
    """Clearances on each side of mating parts, of scores and (the first) of demonstrations: easy 1.0, train 0.5, hard 0.3 mm."""
    rows_per_picture: int = 3
    """Only every k-th row of the demonstrations has pictures, and training draws these rows: memory falls with it."""
    workers: int = 16
    """Processes that make demonstrations, and processes that score."""
    sensors: list[str] = field(default_factory=lambda: ["touch"])
    """What policies sense: touch (and cameras), cameras (alone)."""
    pictures: list[str] = field(default_factory=lambda: ["clear"])
    """Pictures of training and score: clear, randomised (see taccorl evaluate)."""
    seeds: list[int] = field(default_factory=lambda: [1000])
    """Seeds of trainings."""
    train: Path = Path("configs/learn/small.yaml")
    """Config of lerobot-train."""
    train_options: list[str] = field(default_factory=list)
    """Further words for lerobot-train, such as [--steps=2500,--save_freq=2500]."""
    cache: str = "gpu"
    """Where frames are held: gpu, host, disk."""
    executed: list[int] = field(default_factory=lambda: [8])
    """Numbers of actions of a chunk that are executed."""
    hide: list[str] = field(default_factory=lambda: ["nothing"])
    """Sensors that are hidden in a score, which shows what a policy uses when: nothing, touch, cameras, touch_at_mate, …"""
    scored: int = 512
    """Scenes of a score, seeds 70000 and on: nothing was chosen by them."""
    batch_size: int = 64
    """Scenes at the same time in a process that scores."""
    score_device: str = "cpu"
    """Device of the policies in a score, cpu or cuda. 32 processes that share a GPU with a training made 0.03 scenes a second
    each, and slowed it; on the CPU one makes 0.15 (configs/learn/small.yaml, pictures included)."""
    episode_length: int | None = None
    """Control steps after which a scored episode is cut off; the task's own limit if not given."""
    out: Path = Path("outputs/learn")
    """Folder of everything: the demonstrations are shared by all runs there, a policy's folder is named after its settings."""


class Made(NamedTuple):
    """Demonstrations to learn from."""

    task: str
    dataset: Path
    asked: CollectConfig
    """How the twin's demonstrations were made; its ``store`` has decoded frames among other intermediate results."""
    about: dict[str, Any]
    """Of what they are: twin, sources, real, sim_weight; corrected, the number of demonstrations before corrections."""
    robots: list[Path | None]
    """Twins to score in."""


class Learned(NamedTuple):
    """A policy that a run made."""

    policy: Path
    """Folder pretrained_model."""
    dataset: Path
    store: Path
    scores: list[Path]
    """Folders of the scores."""


def main(words: list[str]) -> list[Learned]:
    config = parsed(LearnConfig, chosen(words, SMALL), "python -m pipelines.learn")
    _check(config)  # before hours of demonstrations
    gpus: queue.Queue[str] = queue.Queue()
    for gpu in (names := _gpus()):
        gpus.put(gpu)
    with ThreadPoolExecutor(
        2 * len(names)
    ) as pool:  # one policy learns on a GPU while another is scored
        runs = []
        for made in datasets(config):
            each = itertools.product(
                config.seeds, config.episodes, config.pictures, config.sensors
            )
            runs += [
                pool.submit(_learned, config, made, settings, gpus) for settings in each
            ]
        learned = [run.result() for run in runs]
    table = _table([score for one in learned for score in one.scores])
    (config.out / "scores.md").write_text(table, encoding="utf-8")
    print(
        f"\n{table}\n{config.out / 'scores.md'}; pages: {learned[0].scores[0] / 'report.html'} …"
    )
    return learned


def _gpus() -> list[str]:
    """Numbers of the GPUs to use, those that CUDA_VISIBLE_DEVICES allows; ``["0"]`` without one."""
    names = list(filter(None, os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")))
    if not names and shutil.which("nvidia-smi"):
        shown = subprocess.run(
            ["nvidia-smi", "-L"], capture_output=True, text=True, check=False
        ).stdout
        names = [str(number) for number, _ in enumerate(shown.splitlines())]
    return names or ["0"]


def _check(config: LearnConfig) -> None:
    """Check the options before hours of work begin. Raises SystemExit: a later step would refuse an option."""
    if not config.train.is_file():
        raise SystemExit(f"--train={config.train}: no such file")
    chunk = yaml.safe_load(config.train.read_text(encoding="utf-8"))["policy"].get(
        "chunk_size", math.inf
    )
    ones = ("executed", "episodes", "rows_per_picture", "workers", "scored")
    ones += ("batch_size", "physics_steps", "episode_length")
    for name, least in (
        dict.fromkeys(ones, 1)
        | dict.fromkeys(("seeds", "sources", "real", "corrections"), 0)
    ).items():
        most = chunk if name == "executed" else math.inf
        value = getattr(config, name)
        numbers = (
            value if isinstance(value, list) else [least if value is None else value]
        )
        if not numbers or min(numbers) < least or max(numbers) > most:
            ends = f"at least {least}" + (
                ""
                if most == math.inf
                else f", at most {most}, the chunk_size of {config.train}"
            )
            raise SystemExit(f"--{name}={value}: {ends}")
    if not config.scored_in and (
        {"mended", "surrogate"} & {*config.twins} or config.singly or config.real
    ):
        asked = (
            "--singly"
            if config.singly
            else f"--real={config.real}"
            if config.real
            else f"--twins={config.twins}"
        )
        raise SystemExit(
            f"{asked}: of which surrogate? Give its twin file as --scored_in="
        )
    if config.real and (
        config.singly or len(config.episodes) > 1 or any(map(is_folder, config.twins))
    ):
        raise SystemExit(
            f"--real={config.real}: takes one number of --episodes, no --singly, and no folder of --twins"
        )
    if config.corrections and (config.real or any(map(is_folder, config.twins))):
        raise SystemExit(
            f"--corrections={config.corrections}: takes no --real, and no folder of --twins"
        )
    for path in config.post_train:
        if not path.is_file():
            raise SystemExit(f"--post_train={path}: no such file")
        PostTraining.of(path, path.parent, path, config.post_train_options, 0)
    if not all(0 <= weight <= 1 for weight in config.sim_weight):
        raise SystemExit(f"--sim_weight={config.sim_weight}: shares of the loss, 0 … 1")
    if config.sim_weight and not config.real:
        raise SystemExit(
            f"--sim_weight={config.sim_weight}: weights the twin's loss beside that of --real=50, or so many"
        )
    try:
        for path in config.scored_in:
            load_twin(path)
    except TaccorlError as error:
        raise SystemExit(str(error)) from error
    for name, known in (
        ("task", tuple(tasks)),
        ("twins", ("nominal", "mended", "surrogate", *filter(is_folder, config.twins))),
        ("difficulty", tuple(CLEARANCES_M)),
        ("pictures", PICTURES),
        ("sensors", tuple(SENSORS)),
        ("hide", ("nothing", *HIDDEN)),
        ("cache", ("gpu", "host", "disk")),
        ("score_device", ("cpu", "cuda")),
    ):
        value = getattr(config, name)
        if not value:
            raise SystemExit(f"--{name}=[]: give one of {', '.join(known)}")
        for one in value if isinstance(value, list) else [value]:
            if one not in known:
                raise SystemExit(
                    f"--{name}={one}: {nearest(one, known)}{', or a folder of twins' * (name == 'twins')}"
                )


def _twins(config: LearnConfig) -> dict[Path | None, list[Path | None]]:
    """Twin of demonstrations → twins in which its policies are scored; None: the nominal one. Mended ones are made."""
    scored: dict[Path | None, list[Path | None]] = {}
    for word in config.twins:
        for robot in config.scored_in or [None]:
            made_in = (
                Path(word)
                if is_folder(word)
                else None
                if word == "nominal" or robot is None
                else robot
            )
            if word == "mended" and robot:
                made_in = mended(robot, config.out, config.workers)
            robots = scored.setdefault(made_in, [])
            robots += [
                robot,
                *(
                    _single(config, robot)
                    if config.singly and robot and word == "nominal"
                    else []
                ),
            ]
    return {made_in: list(dict.fromkeys(robots)) for made_in, robots in scored.items()}


def _single(config: LearnConfig, robot: Path) -> list[Path | None]:
    """The nominal twin, and twin files of one effect or one other section each in which ``robot`` differs from it."""
    whole, nominal = load_twin(robot), TwinConfig()
    sections = [
        section.name
        for section in dataclasses.fields(TwinConfig)
        if section.name != "effects"
    ]
    parts = {
        name: {name: getattr(whole, name)}
        for name in sections
        if getattr(whole, name) != getattr(nominal, name)
    }
    for effect in present(whole.effects):
        parts.setdefault(effect.name, {"effects": []})["effects"].append(effect)
    files = {
        config.out
        / "surrogates"
        / named(robot)
        / f"{name}_of_{robot.stem}.yaml": parts[name]
        for name in parts
    }
    for path, part in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        save_twin(dataclasses.replace(nominal, **part), path)
    return [None, *files]


def datasets(config: LearnConfig) -> Iterator[Made]:
    """Make the demonstrations of every combination, as far as they are not there."""
    few, there = (
        dataclasses.replace(config, episodes=[config.real]),
        set[tuple[Path, float]](),
    )
    weights = (config.sim_weight or [0.5]) if config.real else []
    for (twin, robots), task, sources in itertools.product(
        _twins(config).items(), config.task, config.sources
    ):
        about = {"twin": named(twin) if twin else ""} | (
            {"sources": sources} if sources else {}
        )
        many = None if weights == [0] else demonstrations(config, task, twin, sources)
        if many and not config.real:
            yield Made(task, *many, about, robots)
        for robot, weight in itertools.product(filter(None, robots), weights):
            real, asked = demonstrations(few, task, robot, domain="surrogate")
            sim = [many[0]] if many and weight else []
            both = real.with_name(
                f"{sim[0].name if sim else 'nothing'}_and_{real.name}"
            )
            if (both, weight) not in there:
                _merge(config, both, sim, [real])
                mixed = {"real": config.real, "sim_weight": weight} | (
                    {} if sim else {"twin": "", "demonstrations": 0}
                )
                yield Made(task, both, asked, about | mixed, [robot])
            there.add((both, weight))


def _merge(config: LearnConfig, out: Path, sim: list[Path], real: list[Path]) -> None:
    asked = MergeConfig(
        real=real,
        sim=sim,
        out=out,
        store=config.out / "store",
        pictures="cache",
        resolution=RESOLUTION,
    )
    step(merge.run, asked)


def demonstrations(
    config: LearnConfig,
    task: str,
    made_in: Path | None,
    sources: int = 0,
    domain: Literal["twin", "surrogate"] = "twin",
) -> tuple[Path, CollectConfig]:
    """Make the demonstrations of a task in a twin, if they are not there: the expert's own, or MimicGen's of ``sources`` of them.
    ``domain``: surrogate, if the twin stands for the robot: other scenes, no poses of the parts. Returns the dataset's folder,
    and how it was made."""
    folder, end = config.out / task, f"_mimicgen_{sources}" if sources else ""
    if made_in is not None and is_folder(made_in):
        files = sorted(made_in.glob("*.yaml"))
        each, workers = (
            math.ceil(whole / len(files))
            for whole in (max(config.episodes), config.workers)
        )
        some = dataclasses.replace(config, episodes=[each], workers=workers)
        with ThreadPoolExecutor(config.workers) as pool:
            parts, (asked, *_) = zip(
                *pool.map(
                    lambda file: demonstrations(some, task, file, sources), files
                ),
                strict=True,
            )
        both = f"{config.difficulty[0]}_{max(config.episodes)}_{config.physics_steps}_steps_{named(made_in)}{end}"
        _merge(config, folder / both, list(parts), [])
        return folder / both, asked
    name, whole = (
        ("", TwinConfig())
        if made_in is None
        else (f"_{named(made_in)}", load_twin(made_in))
    )
    is_robot = domain == "surrogate"
    end += "_as_robot" * is_robot
    twin = folder / f"twin_of_{config.physics_steps}_steps{name}.yaml"
    dataset = (
        folder
        / f"{config.difficulty[0]}_{max(config.episodes)}_{config.physics_steps}_steps{name}{end}"
    )
    folder.mkdir(parents=True, exist_ok=True)
    physics = dataclasses.replace(
        whole.physics, steps_per_control_step=config.physics_steps
    )
    save_twin(dataclasses.replace(whole, physics=physics), twin)
    own = CollectConfig(
        task=task,
        source=ExpertSource(hands=config.hands),
        episodes=max(config.episodes),
        out=dataset,
        store=config.out / "store",
        difficulty=config.difficulty[0],
        twin=twin,
        pictures="cache",
        resolution=RESOLUTION,
        rows_per_picture=config.rows_per_picture,
        part_poses=not is_robot,
        domain=domain,
        origin=f"twin {made_in}, not a robot" if is_robot else TWIN_ORIGIN.text,
        seed=int(is_robot),
        engine=LocalEngine(workers=config.workers),
    )
    if not sources:
        step(collect.run, own)
    else:  # of the expert without pulses, as MimicGen disturbs the arms itself
        few, spec = (
            dataset.with_name(f"{dataset.name}_{n}") for n in ("sources", "spec.yaml")
        )
        pushed = {
            "contact_mode": "closed_loop_expert",
            "disturbance": {"joint_rad": config.hands.pulse_rad},
        }
        cut = yaml.safe_load(mimic_spec_path(task).read_text(encoding="utf-8"))
        spec.write_text(
            yaml.safe_dump(cut | {"datagen_config": pushed}), encoding="utf-8"
        )
        plain = ExpertSource(hands=dataclasses.replace(config.hands, pulse_rad=0.0))
        bare = {
            "images": False,
            "pictures": "video",
            "resolution": None,
            "rows_per_picture": 1,
            "part_poses": False,
        }
        step(
            collect.run,
            dataclasses.replace(own, source=plain, episodes=sources, out=few, **bare),
        )
        moved: dict[str, Any] = {"source": few, "spec": str(spec)}
        step(augment.run, AugmentConfig(**shared_fields(own, AugmentConfig) | moved))
    return dataset, own


def _learned(
    config: LearnConfig,
    made: Made,
    settings: tuple[int, int, str, str],
    gpus: "queue.Queue[str]",
) -> Learned:
    """Train a policy on a GPU that is free, and score it in each of ``made.robots``."""
    seed, episodes, pictures, sensors = settings
    words = [
        f"--dataset.cache={config.cache}",
        f"--dataset.cache_store={made.asked.store}",
        f"--seed={seed}",
    ]
    changes = RANDOMISED if pictures == "randomised" else []
    words += [
        f"--policy.image_resolution=[{RESOLUTION.replace('x', ',')}]",
        *SENSORS[sensors],
        *changes,
    ]
    corrected, most = made.about.get("corrected", episodes), max(config.episodes)
    if (
        corrected < most or corrected < episodes
    ):  # corrections follow all demonstrations
        ids = [*range(corrected), *range(most, most + episodes - corrected)]
        words.append(f"--dataset.episodes={json.dumps(ids)}")
    features = (made.dataset / "meta" / "info.json").read_text(encoding="utf-8")
    if "observation.is_sim" in features:  # without real rows: merged of several twins
        words.append(f"--policy.sim_weight={made.about.get('sim_weight', 1):g}")
    words += [] if PARTS_KEY in features else ["--policy.pose_loss=0"]
    training = Training(
        config.train,
        made.dataset,
        [*words, *config.train_options],
        config.out / made.task,
    )
    about = {"sensors": sensors, "demonstrations": episodes, "seed": seed} | made.about
    gpu = gpus.get()
    try:
        if words := training.command():
            module = "lerobot.scripts.lerobot_train"
            _logged(
                [sys.executable, "-m", module, *words[1:]],
                training.folder.with_suffix(".log"),
                gpu,
                about,
            )
    finally:
        gpus.put(gpu)
    cells = list(
        itertools.product(config.difficulty, config.executed, config.hide, made.robots)
    )
    scores = [
        _scored(config, (made.task, pictures), training, about, cell, gpu)
        for cell in cells
    ]
    for path in config.post_train:
        gpu = gpus.get()  # for itself, as a training has it
        try:
            better = _post_trained(config, made, training, about | {"ppo": path}, gpu)
        finally:
            gpus.put(gpu)
        scores += [
            _scored(
                config, (made.task, pictures), better, about | better.about(), c, gpu
            )
            for c in cells
        ]
    if config.corrections and "corrected" not in made.about:
        better = _corrected(config, made, training, about, (pictures, gpu))
        settings = seed, episodes + config.corrections, pictures, sensors
        scores += _learned(config, better, settings, gpus).scores
    return Learned(training.policy, made.dataset, made.asked.store, scores)


def _post_trained(
    config: LearnConfig, made: Made, training: Training, about: dict, gpu: str
) -> PostTraining:
    """Post-train the policy of ``training`` in the twin of its demonstrations, by the settings ``about["ppo"]``."""
    better = PostTraining.of(
        training.policy,
        training.folder,
        about["ppo"],
        config.post_train_options,
        training.steps,
    )
    options = [
        f"--env.task={made.task}",
        f"--env.twin={made.asked.twin}",
        f"--env.difficulty={config.difficulty[0]}",
        f"--seed={about['seed']}",
    ]
    if words := better.command(options):
        words = [sys.executable, "-m", "taccorl.cli.main", *words]
        _logged(words, better.folder.with_suffix(".log"), gpu, about)
    return better


def _corrected(
    config: LearnConfig,
    made: Made,
    training: Training,
    about: dict,
    acts: tuple[str, str],
) -> Made:
    """The demonstrations ``made``, followed by corrections of the policy of ``training``. ``acts``: its pictures and its GPU.
    Raises SystemExit: there are fewer corrections than are wanted."""
    fixes = made.dataset.with_name(
        f"{made.dataset.name}_corrections_{config.corrections}_of_{training.folder.name}"
    )
    choice = PolicyChoice(
        path=training.policy,
        n_action_steps=config.executed[0],
        device=config.score_device,
    )
    own = {
        "policy": choice,
        "hands": config.hands,
        "takeover": "all",
        "before_grasp": True,
        "out": fixes,
    }
    scenes = math.ceil(
        config.corrections / 3
    )  # of four corrections each, more than one may fail
    own |= {
        "episodes": scenes,
        "per_episode": 4,
        "num_envs": math.ceil(scenes / config.workers),
    }
    own |= {
        "policy_workers": config.workers,
        "episode_length": config.episode_length,
        "policy_pictures": acts[0],
    }
    asked = CorrectConfig(**shared_fields(made.asked, CorrectConfig) | own)
    if not fixes.exists():
        words = [
            sys.executable,
            "-m",
            "taccorl.cli.main",
            *command("correct", asked)[1:],
        ]
        _logged(words, fixes.with_suffix(".log"), acts[1], about, one_thread=True)
    if (there := Dataset(fixes).num_episodes) < config.corrections:
        raise SystemExit(
            f"{fixes}: {there} corrections, too few; give --corrections={there} or less"
        )
    both = fixes.with_name(f"{fixes.name}_too")
    _merge(config, both, [made.dataset, fixes], [])
    return made._replace(
        dataset=both, about=made.about | {"corrected": about["demonstrations"]}
    )


def _scored(
    config: LearnConfig,
    scene: tuple[str, str],
    training: Training | PostTraining,
    about: dict,
    cell: tuple[str, int, str, Path | None],
    gpu: str,
) -> Path:
    """Score the trained policy, if that is not done yet, on ``gpu`` or the CPU. Returns the folder of the results."""
    (task, pictures), (difficulty, executed, hidden, robot) = scene, cell
    length = "" if config.episode_length is None else f"_{config.episode_length}_steps"
    about = about | {
        "scored_in": named(robot) if robot else "",
        "steps": training.steps,
    }
    length += f"_in_{named(robot)}" if robot else ""
    out = (
        training.folder
        / f"score_{config.scored}_{difficulty}_{executed}_{pictures}_{hidden}{length}"
    )
    if not out.exists():
        asked = EvaluateConfig(
            policy=PolicyChoice(
                path=training.policy,
                n_action_steps=executed,
                device=config.score_device,
            ),
            task=[task],
            episodes=config.scored,
            seed=SCORE_SEED,
            out=out.with_suffix(".unfinished"),
            difficulty=difficulty,
            twin=robot,
            pictures=pictures,
            hide=[] if hidden == "nothing" else [hidden],
            batch_size=min(config.batch_size, config.scored),
            workers=min(config.workers, config.scored),
            episode_length=config.episode_length,
        )
        shutil.rmtree(asked.out, ignore_errors=True)
        words = [
            sys.executable,
            "-m",
            "taccorl.cli.main",
            *command("evaluate", asked)[1:],
        ]
        _logged(
            words, out.with_suffix(".log"), gpu, about, one_thread=config.workers > 1
        )
        (asked.out / "settings.json").write_text(json.dumps(about), encoding="utf-8")
        asked.out.rename(out)
        print(_row(out), flush=True)
    return out


def _logged(
    words: list[str], log: Path, gpu: str, about: dict, *, one_thread: bool = False
) -> None:
    """Run a command, with its output in ``log``, on one GPU. ``one_thread``: its processes share the cores. Raises SystemExit: an
    exit status other than 0; the message has the end of the output."""
    begun = time.monotonic()
    print(f"\n$ {shlex.join(words)} > {log}  # {about}", flush=True)
    log.parent.mkdir(parents=True, exist_ok=True)
    env = {**os.environ, "CUDA_VISIBLE_DEVICES": gpu} | (
        {"OMP_NUM_THREADS": "1"} if one_thread else {}
    )
    with log.open("w") as file:
        code = subprocess.run(
            words, stdout=file, stderr=subprocess.STDOUT, env=env
        ).returncode
    if code:
        raise SystemExit(
            f"{words[2]} ended with {code} ({log}):\n{log.read_text(errors='replace')[-1000:]}"
        )
    print(f"{log}: {time.monotonic() - begun:.0f} s", flush=True)


def _row(score: Path) -> str:
    """``score`` as a row of the table."""
    about = json.loads((score / "settings.json").read_text(encoding="utf-8"))
    told = json.loads((score / "evaluation.json").read_text(encoding="utf-8"))
    (one,), scenes = told["scores"], told["scenes"]
    low, high = (100 * end for end in one["interval_95"])
    executed, hidden = score.name.split("_")[3], ", ".join(scenes["hidden"]) or "–"
    made = f"{about['demonstrations']}{' of {sources} sources'.format(**about) if 'sources' in about else ''}"
    made += (
        ", of the expert alone {corrected}".format(**about)
        if "corrected" in about
        else ""
    )
    made += (
        " + {real} of the surrogate, α = {sim_weight:g}".format(**about)
        if "real" in about
        else ""
    )
    made += ", then PPO by {settings}".format(**about) if "settings" in about else ""
    cells = [scenes["tasks"][0], about["sensors"], made, about["seed"]]
    cells += [
        scenes["pictures"],
        scenes["difficulty"],
        executed,
        hidden,
        f"{one['successes']} of {one['n']}",
    ]
    took = one["median_success_s"]
    cells += [
        f"{100 * one['rate']:.1f} % ({low:.1f} … {high:.1f})",
        "–" if took is None else f"{took:.1f} s",
    ]
    cells += [about.get(where) or "nominal" for where in ("twin", "scored_in")]
    return f"| {' | '.join(map(str, cells))} |"


def _table(scores: list[Path]) -> str:
    heads = "task, sensors, demos, seed, pictures, difficulty, executed, hidden, completed, 95 %, time, learnt in, scored in"
    lines = [
        f"| {heads.replace(', ', ' | ')} |",
        "|---" * (heads.count(", ") + 1) + "|",
        *map(_row, scores),
    ]
    told = f"Simulated; scenes from seed {SCORE_SEED}. What is scored in is a twin, a surrogate at best, never a robot."
    return told + "\n\n" + "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(sys.argv[1:])
