"""Origin of data: made by a robot, by a surrogate in its place, or by the twin. Producers state it, consumers read it.

A recording states it in its metadata (MCAP record, HDF5 attributes) by the keys ``domain`` and ``origin``, an episode of a
dataset in its record of ``meta/taccorl/episodes.json``, a table in its columns file. Only the user knows that a robot made a
recording: ``taccorl ingest --domain=real``, or ``domain: real`` in a columns file or in measurements.yaml. A statement never
replaces another one, so that what a simulation made stays simulated.

Data written before there was the key ``domain`` only have a text. Their domain is derived from it in one place, ``_derived``,
and the label says so: ``surrogate (derived): …``.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

from taccorl.errors import TaccorlError, nearest

Domain = Literal["real", "surrogate", "twin"]
"""``real``: a robot. ``surrogate``: a simulated robot in place of a real one. ``twin``: the twin, or another simulation."""
DOMAINS: tuple[Domain, ...] = get_args(Domain)
NOT_STATED = "origin not stated"  # Label of data that do not state their origin
NO_ROBOT = "not a robot"  # Words of every text that this project writes about simulated data
_FIRST_WORDS: dict[str, Domain] = {
    **dict.fromkeys(("surrogate", "simulated robot (", "simulated servo ("), "surrogate"),
    **dict.fromkeys(("MuJoCo twin", "twin replay of", "imagined"), "twin"),
}
"""First words of the texts written before there was a ``domain``."""

RATE_OF = "rate_hz "  # Key of the rate of a topic [Hz] in a recording's metadata, followed by the topic


@dataclass(frozen=True)
class Origin:
    """Where data come from. Raises TaccorlError: an unknown domain, or a real one with a text that says otherwise."""

    domain: Domain | None = None
    """``real`` (a robot), ``surrogate`` (a simulation in its place) or ``twin``; None: not stated."""
    text: str = ""
    """Description for people, such as "stand-in recording, not a robot"."""
    derived: bool = False
    """True if the domain is not stated but derived from the text or the features."""

    def __post_init__(self) -> None:
        if self.domain is not None and self.domain not in DOMAINS:
            described = f" of data described as {self.text!r}" if self.text else ""
            raise TaccorlError(f"unknown domain {self.domain!r}{described}: {nearest(self.domain, DOMAINS)}")
        if self.domain == "real" and (NO_ROBOT in self.text or _derived(self.text)):
            raise TaccorlError(f"domain 'real' of {self.text!r} contradicts the data: they come from a simulation")

    def __bool__(self) -> bool:
        return self.domain is not None or bool(self.text)

    def __str__(self) -> str:
        """Label in reports and figures: ``surrogate: stand-in recording, not a robot``."""
        if self.domain is None:
            return f"domain not stated: {self.text}" if self.text else NOT_STATED
        words = f"{self.domain} (derived)" if self.derived else self.domain
        return f"{words}: {self.text}" if self.text else words

    def record(self) -> dict[str, Any]:
        """The origin as JSON values (``domain``, ``origin``; ``domain_derived`` only if true); ``read`` is the inverse."""
        return {"domain": self.domain, "origin": self.text} | ({"domain_derived": True} if self.derived else {})

    @classmethod
    def read(cls, record: Mapping[str, Any], features: Iterable[str] = ()) -> "Origin":
        """Origin stated by a record with the keys ``domain`` and ``origin``; derived if it has no ``domain``. ``features`` of
        the dataset; ``sim.*`` are a simulator's state. Raises TaccorlError: as the class; or a real one with such features."""
        text = str(record.get("origin") or "")
        simulated = any(key.startswith("sim.") for key in features)
        if simulated and record.get("domain") == "real":
            raise TaccorlError(f"domain 'real' of {text!r} contradicts the data: they hold a simulator's state (sim.*)")
        if "domain" in record:
            return cls(cast("Domain | None", record["domain"]), text, str(record.get("domain_derived")) == "True")
        domain = _derived(text) or ("twin" if simulated else None)
        return cls(domain, text, domain is not None)

    def agreed(self, domain: Domain | None, who: str) -> "Origin":
        """With the ``domain`` that a user states, if the data state none. ``who``: where the user states it. Raises
        TaccorlError: the data state another domain."""
        if domain is None or domain == self.domain:
            return self
        if self.domain is not None:
            raise TaccorlError(f"{who} states domain {domain!r}, but the data state {self}: remove the statement")
        return Origin(domain, self.text)


def labelled(origin: Origin) -> dict[str, str]:
    """The keys of ``Origin.record`` with their values as texts, for a recording's metadata; without those that are None."""
    return {key: str(value) for key, value in origin.record().items() if value is not None}


def stated_origin(domain: Domain | None, text: str) -> Origin:
    """Origin from a file in which a user may leave the domain out; derived then. Raises TaccorlError: as ``Origin``."""
    return Origin.read({"origin": text} | ({} if domain is None else {"domain": domain}))


def _derived(text: str) -> Domain | None:
    """Domain of data written before there was the key ``domain``, by the first words of their text; None if these say nothing."""
    return next((domain for words, domain in _FIRST_WORDS.items() if text.startswith(words)), None)


UNSTATED = Origin()
TWIN_ORIGIN = Origin("twin", "MuJoCo twin, not a robot")
"""Origin of episodes that are simulated in the twin, unless the caller states another one."""
