"""Physical effects that a twin may have or lack, a file for each family; each states the values at which it is absent.

One registry serves calibration, diagnosis, randomisation and the surrogate. To add an effect: a class under ``@effect("name",
slot=…)`` here, or in a module of an outside package; ``effect.py`` says what the class may do. Its texts stand in a section of
``effects.md`` here.
"""

from taccorl.errors import TaccorlError, nearest
from taccorl.sim.effects.effect import Effect, effects

__all__ = ["effects", "make_effect"]


def make_effect(name: str, **values) -> Effect:
    """The effect of that name with ``values`` for its parameters and selectors; all others have the class's defaults. Raises
    TaccorlError: an effect or parameter is unknown (the message names the nearest), or a value is out of bounds."""
    cls = effects.get(name)
    for key in values:
        if key not in (known := cls.settings()):
            raise TaccorlError(
                f"effect {name}: no parameter {key!r}; {nearest(key, known)}"
            )
    return cls(**values)
