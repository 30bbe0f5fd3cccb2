"""All effects of one twin together: the order in which they act, their memory, and combinations that are refused."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from mujoco.batch import Batch

from taccorl.errors import TaccorlError
from taccorl.robots import ROBOT
from taccorl.sim.cameras import CameraConfig, letterbox_window
from taccorl.sim.effects.camera_past import PastScene
from taccorl.sim.effects.effect import CELLS, SLOTS, TOUCH_SLOTS, Effect, Memory
from taccorl.sim.effects.live_model import LiveModel

if TYPE_CHECKING:
    from taccorl.sim.twin import TwinConfig


PAST_POSITIONS, PAST_TIME_S = (
    "pictures/positions",
    "pictures/time_s",
)  # of ``PastScene``, in a snapshot


class AddedEffects:
    """Effects of N simulations. Absent effects are left out; the others act in the order of ``SLOTS``, then by name.

    A sensor takes it as one of its transforms. Reading the pads does not change the memory of touch effects: only ``scan``,
    which ``Simulation.advance`` calls at the boards' rate, advances it.

    Args:
        time_s: (N,) the simulations' clocks [s]; the array is read at each call.
        batch: the simulations' physics; without it the hooks ``feel`` and ``rewrite`` are not called.
        pad_shape: rows and columns of the sensor's pads.

    Letters in shapes: N simulations, A numbers of an action, P pads, R rows and C columns of a pad.
    """

    def __init__(
        self,
        effects: Sequence[Effect],
        time_s: np.ndarray,
        batch: Batch | None = None,
        pad_shape: tuple[int, int] = ROBOT.pad.shape,
    ) -> None:
        self.present = present(effects)
        rewritten = sorted(
            {name for effect in self.present for name in effect.rewrites}
        )
        self.rewrites = bool(rewritten)
        """True if an effect changes the model between physics steps."""
        self._live = LiveModel(batch, rewritten) if batch and self.present else None
        self._time_s = time_s
        self._scanned_s = np.array(time_s)
        self._start = [effect.memory(len(time_s), pad_shape) for effect in self.present]
        self._memory: list[Memory] = [
            {k: v.copy() for k, v in rows.items()} for rows in self._start
        ]
        touch = [
            k for k, effect in enumerate(self.present) if effect.slot in TOUCH_SLOTS
        ]
        self.remember_touch = any(self._start[k] for k in touch)
        """True if a reading depends on earlier ones: then every step must scan the pads, even if nobody reads them."""
        oldest_s = sum(effect.picture_age_s() for effect in self.present)
        self.past = PastScene(batch, oldest_s) if batch and oldest_s > 0 else None
        """Positions of all bodies in the recent past, if a camera has a latency, else None; ``Simulation.advance`` updates it."""

    def command(self, targets: np.ndarray, dt_s: np.ndarray) -> np.ndarray:
        """``Effect.command`` of all effects: targets (N, A) [rad, m] that arrive."""
        for effect, memory in zip(self.present, self._memory, strict=True):
            targets = effect.command(targets, memory, dt_s)
        return targets

    def feel(self, ids: np.ndarray, dt_s: float) -> None:
        """Call the hook ``feel`` of all effects for simulations ``ids`` (n,) after a physics step of ``dt_s`` [s] (0: after a
        reset), then ``rewrite`` for the next step."""
        if self._live:
            for effect, memory in zip(self.present, self._memory, strict=True):
                effect.feel(self._live, memory, ids, dt_s)
            self._rewrite()

    def _rewrite(self) -> None:
        if self._live and self.rewrites:
            self._live.make_nominal()
            for effect, memory in zip(self.present, self._memory, strict=True):
                effect.rewrite(self._live, memory)

    def friction(self, friction: float) -> float:
        """``Effect.friction`` of all effects."""
        for effect in self.present:
            friction = effect.friction(friction)
        return friction

    def encoder(self, values: np.ndarray) -> np.ndarray:
        """``Effect.encoder`` of all effects: reported values (N, A) [rad, m]."""
        for effect in self.present:
            values = effect.encoder(values)
        return values

    def __call__(
        self, reading: np.ndarray, ids: np.ndarray | None = None
    ) -> np.ndarray:
        """Reading of the pads (n, P, R, C) of the simulations ``ids`` (n,) (all by default) for their ideal ``reading``
        (n, P, R, C). Does not change the memory."""
        rows = np.arange(len(reading)) if ids is None else ids
        return self._read(reading, self._copied(rows), rows)

    def scan(self, reading: np.ndarray, ids: np.ndarray) -> None:
        """Advance the memory of touch effects. The reading counts as constant since the last scan.

        Args:
            reading: (N, P, R, C) readings of the pads without effects at this instant, as the policy's normalised readings.
            ids: (n,) simulations whose pads are scanned now; other rows are not used.
        """
        memories = self._copied(ids)
        self._read(reading[ids], memories, ids)
        for memory, rows in zip(self._memory, memories, strict=True):
            for name, values in rows.items():
                memory[name][ids] = values
        self._scanned_s[ids] = self._time_s[ids]

    def _copied(self, ids: np.ndarray) -> list[Memory]:
        return [
            {name: values[ids] for name, values in rows.items()}
            for rows in self._memory
        ]

    def _read(
        self, reading: np.ndarray, memories: list[Memory], ids: np.ndarray
    ) -> np.ndarray:
        now = self._time_s[ids]
        for effect, memory in zip(self.present, memories, strict=True):
            reading = effect.reading(reading, memory, now, now - self._scanned_s[ids])
        return reading

    def picture_age_s(self, camera: str) -> float:
        """Age [s] of the scene that the camera's pictures show."""
        return sum(
            effect.picture_age_s()
            for effect in self.present
            if camera in effect.acts_on()
        )

    def changes_pictures(self, camera: str) -> bool:
        """True if the camera's pictures are late, or changed after they are rendered."""
        return self.picture_age_s(camera) > 0 or bool(self._of_pictures(camera))

    def _of_pictures(self, camera: str) -> list[Effect]:
        return [
            e
            for e in self.present
            if camera in e.acts_on() and type(e).picture is not Effect.picture
        ]

    def picture(self, pictures: np.ndarray, camera: CameraConfig) -> np.ndarray:
        """Pictures of ``camera`` with effects, from rendered ``pictures`` (n, rows, columns, 3) uint8 RGB, letterboxed; same
        shape."""
        acting = self._of_pictures(camera.name)
        if not acting:
            return pictures
        window = letterbox_window(camera.recording_size, pictures.shape[1:3])
        inside = np.s_[
            window.top : window.top + window.rows,
            window.left : window.left + window.columns,
        ]
        pictures = pictures.copy()
        for picture in pictures:
            values = picture[inside].astype(np.float32)
            for effect in acting:
                values = effect.picture(
                    values, window.columns / camera.recording_size[1]
                )
            picture[inside] = np.clip(np.round(values), 0, 255)
        return pictures

    def reset(
        self, ids: np.ndarray, targets: np.ndarray, seeds: np.ndarray | None = None
    ) -> None:
        """Start new episodes: the memory of all effects returns to its initial state.

        Args:
            ids: (n,) simulations that start a new episode.
            targets: (N, A) targets, taken as constant before the episode; rows of ``ids`` are read.
            seeds: (n,) seeds of the episodes, for effects that draw random numbers; 0 by default.
        """
        seeds = np.zeros(len(ids), dtype=np.int64) if seeds is None else seeds
        for effect, memory, start in zip(
            self.present, self._memory, self._start, strict=True
        ):
            for name, values in memory.items():
                values[ids] = start[name][ids]
            effect.begin(memory, ids, seeds)
        self.command(targets, np.zeros(len(targets)))
        self._scanned_s[ids] = self._time_s[ids]
        if self.past:
            self.past.reset(ids)
        self._rewrite()

    def snapshot(self, ids: np.ndarray) -> Memory:
        """Memory of the simulations ``ids`` (n,): ``"0/taxel_creep/crept"`` and the like → rows (n, …), and the time of the last
        scan of the pads."""
        return {key: values[ids].copy() for key, values in self._named().items()}

    def restore(self, rows: Memory, ids: np.ndarray) -> None:
        """Set the memory of the simulations ``ids`` (n,) from ``snapshot``; entries for others are ignored. Raises
        TaccorlError: the snapshot is of a twin with other effects."""
        kept, named = {key for key in rows if "/" in key}, self._named()
        if kept != named.keys():
            raise TaccorlError(
                f"restore: the state contains the memory of {', '.join(sorted(kept)) or 'nothing'}, but this twin's effects "
                f"need that of {', '.join(sorted(named)) or 'nothing'}; the state is of another twin"
            )
        for key, values in named.items():
            values[ids] = rows[key]
        self._rewrite()

    def _named(self) -> Memory:
        # Rows of datasets hold them in the order of these keys: of the robot's effects, whatever their slot, by name.
        robot = SLOTS.index("robot")
        ordered = sorted(
            zip(self.present, self._memory, strict=True),
            key=lambda pair: (
                max(SLOTS.index(pair[0].slot), robot),
                pair[0].name,
                pair[0].acts_on(),
            ),
        )
        named = {
            f"{k}/{effect.name}/{name}": values
            for k, (effect, memory) in enumerate(ordered)
            for name, values in memory.items()
        }
        named |= {"pads/scanned_s": self._scanned_s}
        if self.past:
            named |= {
                PAST_POSITIONS: self.past.positions,
                PAST_TIME_S: self.past.time_s,
            }
        return named


def present(effects: Sequence[Effect]) -> list[Effect]:
    """Return the effects that are not absent, in the order in which they act. Raises TaccorlError: two entries of one effect
    act on the same joint, pad or camera."""
    taken: dict[tuple[str, str], int] = {}
    for k, effect in enumerate(effects):
        for thing in effect.acts_on():
            if (first := taken.setdefault((effect.name, thing), k)) != k:
                raise TaccorlError(
                    f"{effect.name} acts on {thing} twice, entries {first + 1} and {k + 1}: combine"
                )
    here = [effect for effect in effects if not effect.is_absent]
    return sorted(
        here,
        key=lambda effect: (SLOTS.index(effect.slot), effect.name, effect.acts_on()),
    )


def edit_model(spec: mujoco.MjSpec, config: "TwinConfig") -> None:
    """Edit a complete model specification so that it contains the effects of ``config``."""
    for effect in present(config.effects):
        if CELLS in effect.acts_on():
            raise TaccorlError(
                f"effects: {effect.name}: a twin has no cells; select pads: {', '.join(ROBOT.pads)}"
            )
        effect.edit(spec, config)
