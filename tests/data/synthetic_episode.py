"""Episodes made by arithmetic for the checks: two arms reach, close on a part, lift it and let go. Not a robot.

command   minimum jerk between random poses within PiPER's limits, with a hand's tremor
state     follows it with a first-order lag of ``lead_s``; a gripper stops at its part's width
touch     a stripe, patch or point, grip^0.9 × force × gain, ``touch_delay_s`` after the stop, creep and residue of the
          film, white noise of 1 to 2 counts, rounded as the wire does
"""

import dataclasses
import functools
from collections.abc import Iterator

import numpy as np
from scipy.signal import lfilter

from taccorl.data.checks import check_episode
from taccorl.data.episode import ChannelTiming, Episode, Pictures
from taccorl.data.finding import Finding
from taccorl.data.origin import Origin
from tests.views.made_episode import bimanual_spec

STATE, ACTION, TOUCH = "observation.state", "action", "observation.tactile"
FRONT, LEFT_WRIST = "observation.images.front", "observation.images.left_wrist"
GRID_HZ = 600
PICTURE_PX = 56


SPEC = bimanual_spec(PICTURE_PX)
NAMES = SPEC.features[STATE].names
GRIPPER = {
    "left": NAMES.index("left_gripper.pos"),
    "right": NAMES.index("right_gripper.pos"),
}
PADS = SPEC.features[TOUCH].pads


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recipe:
    """What an episode shall be like. The defaults are a good one."""

    seed: int = 0
    duration_s: float = 12.0
    lead_s: float = 0.08
    touch_delay_s: float = 0.02
    touch_clock_s: dict[str, float] = dataclasses.field(default_factory=dict)
    """Pad → how much later it feels everything."""
    state_clock_s: float = 0.0  # States appear this much later than they were
    noise_count: float | None = (
        None  # Standard deviation of a taxel; None: drawn from 1 to 2
    )
    drift_count_per_s: float = 0.0
    part_m: dict[str, float] | None = (
        None  # Arm → width of its part; None: drawn. 0: it closes on nothing
    )
    rest_s: tuple[float, float] = (0.0, 0.0)  # Stillness added before and after


def _ramp(x: np.ndarray, start: float, end: float) -> np.ndarray:
    s = np.clip((x - start) / (end - start), 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s * s)


class _Truth:
    """Everything on a fine grid, to be sampled at any time."""

    def __init__(self, recipe: Recipe, rng: np.random.Generator) -> None:
        total_s = recipe.duration_s + sum(recipe.rest_s)
        self.time_s = np.arange(-2 * GRID_HZ, int((total_s + 2) * GRID_HZ)) / GRID_HZ
        self.duration_s, self.before_s = recipe.duration_s, recipe.rest_s[0]
        limits = SPEC.features[STATE].limits
        self.command = np.empty((len(self.time_s), 14))
        self.part_m = recipe.part_m or {
            a: float(rng.uniform(0.010, 0.045)) for a in GRIPPER
        }
        self.squeeze_m = {a: float(rng.uniform(0.006, 0.012)) for a in GRIPPER}
        close = {"left": rng.uniform(0.25, 0.30), "right": rng.uniform(0.38, 0.45)}
        release = {"left": rng.uniform(0.84, 0.88), "right": rng.uniform(0.70, 0.78)}
        for i in range(14):
            arm = "left" if i < 7 else "right"
            if i == GRIPPER[arm]:
                self.command[:, i] = self._gripper(arm, close[arm], release[arm], rng)
            else:
                self.command[:, i] = self._joint(limits[i], rng)
        keep = np.exp(-1 / (GRID_HZ * recipe.lead_s))
        first = self.command[0]
        self.state = first + lfilter(
            [1 - keep], [1, -keep], self.command - first, axis=0
        )
        self.felt = {}
        for arm, i in GRIPPER.items():
            self.felt[arm] = np.clip(
                (self.part_m[arm] - self.state[:, i]) / self.squeeze_m[arm], 0, None
            )
            self.state[:, i] = np.maximum(self.state[:, i], self.part_m[arm])

    def at(self, share: float) -> float:
        return self.before_s + share * self.duration_s

    def _joint(self, limit: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        middle, span = float(limit.mean()), float(limit[1] - limit[0])
        poses = middle + span * np.clip(rng.normal(0, 0.12, 5), -0.3, 0.3)
        x = np.full(len(self.time_s), poses[0])
        for k, (a, b) in enumerate(
            ((0.02, 0.22), (0.46, 0.56), (0.58, 0.68), (0.88, 0.98))
        ):
            fastest = 3.0 / 1.875 * (b - a) * self.duration_s  # minimum jerk at 3 rad/s
            poses[k + 1] = poses[k] + np.clip(
                poses[k + 1] - poses[k], -fastest, fastest
            )
            x += (poses[k + 1] - poses[k]) * _ramp(self.time_s, self.at(a), self.at(b))
        working = _ramp(self.time_s, self.at(0.0), self.at(0.01)) - _ramp(
            self.time_s, self.at(0.99), self.at(1.0)
        )
        for _ in range(3):
            x += (
                0.002
                * working
                * np.sin(
                    2 * np.pi * (rng.uniform(0.3, 2.2) * self.time_s + rng.random())
                )
            )
        return x

    def _gripper(
        self, arm: str, close: float, release: float, rng: np.random.Generator
    ) -> np.ndarray:
        opening, target = 0.065, max(self.part_m[arm] - self.squeeze_m[arm], 0.0)
        takes = rng.uniform(0.4, 0.8)
        down = _ramp(self.time_s, self.at(close), self.at(close) + takes)
        up = _ramp(self.time_s, self.at(release), self.at(release) + 0.5)
        return opening - (opening - target) * (down - up)

    def sample(self, grid: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return np.stack(
            [np.interp(time_s, self.time_s, c) for c in np.atleast_2d(grid.T)], axis=1
        )


def _footprint(rng: np.random.Generator) -> np.ndarray:
    """(32, 12) at most 1: a stripe along the finger, a patch at its tip, or the end of a pin."""
    row, column = np.mgrid[0:32, 0:12].astype(float)
    kind = rng.integers(3)
    if kind == 0:
        middle = rng.uniform(3, 8) + rng.uniform(-0.08, 0.08) * (row - 16)
        return np.exp(-0.5 * ((column - middle) / rng.uniform(1.0, 2.0)) ** 2) / (
            1 + np.exp(rng.uniform(4, 12) - row)
        )
    if kind == 1:
        top, half = rng.uniform(10, 22), rng.uniform(2.5, 5)
        return (
            1
            / (1 + np.exp((top - row) / 0.7))
            / (1 + np.exp((np.abs(column - 5.5) - half) / 0.6))
        )
    r, c = rng.uniform(6, 26), rng.uniform(3, 8)
    return np.exp(-0.5 * (((row - r) / 2.0) ** 2 + ((column - c) / 1.8) ** 2))


def _touch(
    recipe: Recipe, truth: _Truth, time_s: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(T, 1536) counts above baseline and (1536,) baseline."""
    pads, baselines = [], []
    noise = rng.uniform(1.0, 2.0) if recipe.noise_count is None else recipe.noise_count
    push = 1 + 0.3 * np.sin(
        2 * np.pi * rng.uniform(0.1, 0.4, 2)[:, None] * time_s + rng.random((2, 1))
    )
    shape = {arm: _footprint(rng) for arm in GRIPPER}
    force = {arm: rng.uniform(60, 110) for arm in GRIPPER}
    for pad in PADS:
        arm = pad.split("_")[0]
        felt_at = (
            time_s
            - recipe.touch_delay_s
            - recipe.touch_clock_s.get(pad, 0.0)
            - rng.uniform(0, 0.01, len(time_s))
        )
        grip = truth.sample(truth.felt[arm], felt_at)[:, 0]
        contact = grip**0.9 * push[list(GRIPPER).index(arm)]
        # the film gives back the rest within a second or two
        residue = 0.06 * np.asarray(lfilter([0.02], [1, -0.98], contact))
        image = shape[arm] if pad.endswith("a") else shape[arm][:, ::-1]
        gain = np.clip(rng.normal(1, 0.12, (32, 12)), 0.6, 1.4)
        baseline = np.round(rng.uniform(10, 40, (32, 12)))
        counts = force[arm] * (contact + residue)[:, None, None] * image * gain
        counts = (
            counts
            + recipe.drift_count_per_s * time_s[:, None, None]
            + rng.normal(0, noise, counts.shape)
        )
        pads.append(np.clip(np.round(counts + baseline), 0, 255) - baseline)
        baselines.append(baseline)
    return np.stack(pads, axis=1).reshape(len(time_s), -1), np.stack(baselines).reshape(
        -1
    )


def pictures_of(state: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Video key → (T, rows, columns, 3): a bright square that the joints move about, over a still background with noise."""
    rng = np.random.default_rng([seed, 9])
    out = {}
    for key, joints in (
        (FRONT, [0, 1, 7, 8]),
        (LEFT_WRIST, [0, 1, 2, 3]),
        (FRONT.replace("front", "right_wrist"), [7, 8]),
    ):
        background = rng.integers(40, 160, (PICTURE_PX, PICTURE_PX, 3))
        frames = np.repeat(background[None], len(state), axis=0) + rng.normal(
            0, 2, (len(state), *background.shape)
        )
        where = 20 + 12 * np.stack(
            [state[:, joints].sum(axis=1), state[:, joints[::2]].sum(axis=1)], axis=1
        )
        for t, (r, c) in enumerate(np.clip(where, 0, PICTURE_PX - 14).astype(int)):
            frames[t, r : r + 14, c : c + 14] = 230
        out[key] = np.clip(frames, 0, 255).astype(np.uint8)
    return out


def make(recipe: Recipe | None = None, **changes: object) -> Episode:
    """One episode; ``changes`` are fields of the recipe."""
    recipe = dataclasses.replace(recipe or Recipe(), **changes)  # type: ignore[arg-type]
    rng = np.random.default_rng(recipe.seed)
    truth = _Truth(recipe, rng)
    num_rows = int((recipe.duration_s + sum(recipe.rest_s)) * SPEC.fps)
    time_s = np.arange(num_rows) / SPEC.fps
    sampled = [
        time_s - rng.uniform(0, 0.005, num_rows) for _ in range(2)
    ]  # 200 Hz, the last sample before the row
    encoder_noise = np.where(
        np.isin(np.arange(14), list(GRIPPER.values())), 5e-5, 2e-4
    )  # m, rad
    state = truth.sample(truth.state, sampled[0] - recipe.state_clock_s)
    state += encoder_noise * rng.normal(size=(num_rows, 14))
    touch, baseline = _touch(recipe, truth, time_s, rng)
    arrays = {
        STATE: state.astype(np.float32),
        ACTION: truth.sample(truth.command, sampled[1]).astype(np.float32),
        TOUCH: touch.astype(np.int16),
    }
    frames: dict[str, np.ndarray] = {}

    def stream() -> Iterator[Pictures]:
        if not frames:
            frames.update(pictures_of(state, recipe.seed))
        for t in range(num_rows):
            yield {key: video[t] for key, video in frames.items()}

    keys = tuple(SPEC.keys("video"))
    return Episode(
        name=f"synthetic {recipe.seed}",
        spec=SPEC,
        start_ns=0,
        arrays=arrays,
        pictures=stream,
        picture_keys=keys,
        instruction="put the pin into the hole",
        origin=Origin("surrogate", "made by tests/data, not a robot"),
        timing=tuple(good_timing(key) for key in SPEC.features),
        picture_rows={key: np.arange(num_rows) for key in keys},
        baselines={TOUCH: baseline.astype(np.int64)},
    )


@functools.lru_cache(maxsize=64)
def base(seed: int) -> Episode:
    """A good episode of 8 s, made once: faults are planted in copies of its arrays."""
    return make(seed=seed, duration_s=8.0)


def good_timing(key: str, **changes: object) -> ChannelTiming:
    """A channel that came at its rate."""
    rate_hz = SPEC.features[key].rate_hz
    period_s = 1 / rate_hz
    timing = ChannelTiming(
        key.rsplit(".", 1)[-1],
        key,
        "asof",
        rate_hz,
        1,
        2 * period_s,
        period_s / 2,
        period_s,
    )
    return dataclasses.replace(timing, **changes)  # type: ignore[arg-type]


def with_arrays(episode: Episode, **arrays: np.ndarray) -> Episode:
    """The episode with other arrays: ``state``, ``action``, ``touch``."""
    keys = {"state": STATE, "action": ACTION, "touch": TOUCH}
    return dataclasses.replace(
        episode, arrays=episode.arrays | {keys[k]: v for k, v in arrays.items()}
    )


def copies(episode: Episode) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State, action and (T, 4, 32, 12) touch, to be changed."""
    a = episode.arrays
    return a[STATE].copy(), a[ACTION].copy(), a[TOUCH].copy().reshape(-1, 4, 32, 12)


def serious(findings: list[Finding]) -> list[Finding]:
    return [f for f in findings if f.severity != "note"]


def found(episode: Episode, check: str, *, pictures: bool = False) -> list[Finding]:
    return [f for f in check_episode(episode, pictures=pictures) if f.check == check]


def one(episode: Episode, check: str, *, pictures: bool = False) -> Finding:
    findings = found(episode, check, pictures=pictures)
    assert len(findings) == 1, findings
    return findings[0]
