"""Origin of data: made by a robot, by a surrogate in its place, or by the twin. Producers state it, consumers read it.

A recording states it in its metadata (MCAP record, HDF5 attributes) by the keys ``domain`` and ``origin``, an episode of a
dataset in its record of ``meta/taccorl/episodes.json``, a table in its columns file. Only the user knows that a robot made a
recording: ``taccorl ingest --domain=real``, or ``domain: real`` in a columns file or in measurements.yaml. A statement never
replaces another one, so that what a simulation made stays simulated.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

from taccorl.errors import TaccorlError, nearest

Domain = Literal["real", "surrogate", "twin"]
"""``real``: a robot. ``surrogate``: a simulated robot in place of a real one. ``twin``: the twin, or another simulation."""
DOMAINS: tuple[Domain, ...] = get_args(Domain)
NOT_STATED = "origin not stated"  # Label of data that do not state their origin
NO_ROBOT = (
    "not a robot"  # Words of every text that this project writes about simulated data
)
RATE_OF = "rate_hz "  # Key of the rate of a topic [Hz] in a recording's metadata, followed by the topic


@dataclass(frozen=True)
class Origin:
    """Where data come from. Raises TaccorlError: an unknown domain, or a real one with a text that says otherwise."""

    domain: Domain | None = None
    """``real`` (a robot), ``surrogate`` (a simulation in its place) or ``twin``; None: not stated."""
    text: str = ""
    """Description for people, such as "stand-in recording, not a robot"."""

    def __post_init__(self) -> None:
        if self.domain is not None and self.domain not in DOMAINS:
            described = f" of data described as {self.text!r}" if self.text else ""
            raise TaccorlError(
                f"unknown domain {self.domain!r}{described}: {nearest(self.domain, DOMAINS)}"
            )
        if self.domain == "real" and NO_ROBOT in self.text:
            raise TaccorlError(
                f"domain 'real' of {self.text!r} contradicts the data: they come from a simulation"
            )

    def __bool__(self) -> bool:
        return self.domain is not None or bool(self.text)

    def __str__(self) -> str:
        """Label in reports and figures: ``surrogate: stand-in recording, not a robot``."""
        if self.domain is None:
            return f"domain not stated: {self.text}" if self.text else NOT_STATED
        return f"{self.domain}: {self.text}" if self.text else self.domain

    def record(self) -> dict[str, Any]:
        """The origin as JSON values (``domain``, ``origin``); ``read`` is the inverse."""
        return {"domain": self.domain, "origin": self.text}

    @classmethod
    def read(cls, record: Mapping[str, Any], features: Iterable[str] = ()) -> "Origin":
        """Origin stated by a record with the keys ``domain`` and ``origin``. ``features`` of the dataset: ``sim.*`` are a
        simulator's state, which is of the twin if there is no ``domain``. Raises TaccorlError: as the class; or a real one with
        such features."""
        text = str(record.get("origin") or "")
        simulated = any(key.startswith("sim.") for key in features)
        if simulated and record.get("domain") == "real":
            raise TaccorlError(
                f"domain 'real' of {text!r} contradicts the data: they hold a simulator's state (sim.*)"
            )
        return cls(
            cast("Domain | None", record.get("domain", "twin" if simulated else None)),
            text,
        )

    def agreed(self, domain: Domain | None, who: str) -> "Origin":
        """With the ``domain`` that a user states, if the data state none. ``who``: where the user states it. Raises
        TaccorlError: the data state another domain."""
        if domain is None or domain == self.domain:
            return self
        if self.domain is not None:
            raise TaccorlError(
                f"{who} states domain {domain!r}, but the data state {self}: remove the statement"
            )
        return Origin(domain, self.text)


def labelled(origin: Origin) -> dict[str, str]:
    """The keys of ``Origin.record`` with their values as texts, for a recording's metadata; without those that are None."""
    return {
        key: str(value) for key, value in origin.record().items() if value is not None
    }


UNSTATED = Origin()
TWIN_ORIGIN = Origin("twin", "MuJoCo twin, not a robot")
"""Origin of episodes that are simulated in the twin, unless the caller states another one."""
