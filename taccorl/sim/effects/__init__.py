"""Physical effects that a twin may have or lack, one file each; each states the values at which it is absent.

One registry serves calibration, diagnosis, randomisation and the surrogate. To add an effect: one file here, or one module of
an outside package, with a class under ``@effects.register("name")``; ``effect.py`` says what the class may do.
"""

from taccorl.errors import TaccorlError, nearest
from taccorl.plugins import Registry
from taccorl.sim.effects.effect import Effect

effects: Registry[type[Effect]] = Registry("effect", "taccorl.sim.effects")


def make_effect(name: str, **values) -> Effect:
    """The effect of that name with ``values`` for its parameters and selectors; all others have the class's defaults.

    Raises:
        TaccorlError: an effect or parameter is unknown (the message names the nearest), or a value is out of bounds.
    """
    cls = effects.get(name)
    for key in values:
        if key not in (known := cls.settings()):
            raise TaccorlError(f"effect {name}: no parameter {key!r}; {nearest(key, known)}")
    return cls(**values)
