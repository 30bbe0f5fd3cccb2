"""Range checks for numbers in a configuration: finite, non-negative or positive."""

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

from taccorl.errors import TaccorlError


def check_numbers(
    section: str,
    config: Any,
    *,
    finite: Sequence[str] = (),
    not_negative: Sequence[str] = (),
    positive: Sequence[str] = (),
) -> None:
    """Check that the named fields of ``config`` (numbers or lists of them) are finite, that those in ``not_negative`` are ≥ 0,
    and those in ``positive`` > 0. Raises TaccorlError: one is not; the message names the field, its ``section`` and the
    value."""
    for names, above, wanted in (
        (finite, -math.inf, ""),
        (not_negative, 0.0, " ≥ 0"),
        (positive, 0.0, " > 0"),
    ):
        for name in names:
            value = getattr(config, name)
            for number in value if isinstance(value, list | tuple) else (value,):
                if not (
                    _finite(number)
                    and (number > above or (number == above and names is not positive))
                ):
                    raise TaccorlError(
                        f"{section}.{name}: {value} is out of range; give a finite number{wanted}"
                    )


def _finite(value: Any) -> bool:
    return (
        isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    )
