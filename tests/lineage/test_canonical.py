"""Canonical configs: equal configs have one text; what has no one text is refused by name."""

import dataclasses
import enum
from pathlib import Path

import draccus
import numpy as np
import pytest

from taccorl.errors import TaccorlError
from taccorl.lineage.canonical import canonical, canonical_text, differences, not_default


class Colour(enum.Enum):
    RED = 1


@dataclasses.dataclass(frozen=True)
class Timing:
    rate_hz: float = 30.0
    clock: str = "log"


@dataclasses.dataclass(frozen=True)
class Ingest:
    source: Path
    timing: Timing = dataclasses.field(default_factory=Timing)
    workers: int = dataclasses.field(default=1, compare=False)


class Reader(draccus.ChoiceRegistry):
    pass


@Reader.register_subclass("mcap")
@dataclasses.dataclass
class McapReader(Reader):
    strict: bool = True


@Reader.register_subclass("hdf5")
@dataclasses.dataclass
class Hdf5Reader(Reader):
    strict: bool = True


def test_text_is_written_out():
    text = canonical_text({"b": (1, 2.5, None), "a": {"deep": True, "at": Path("x/y"), "colour": Colour.RED}})
    assert text == '{"a":{"at":"x/y","colour":"RED","deep":true},"b":[1,2.5,null]}'


def test_dataclass_is_its_type_and_fields_without_those_that_say_how():
    expected = {"source": "raw", "timing": {"clock": "log", "rate_hz": 30.0, "type": "Timing"}, "type": "Ingest"}
    assert canonical(Ingest(Path("raw"), workers=8)) == expected


def test_equal_configs_have_equal_text_and_others_do_not():
    assert canonical_text({"a": 1, "b": Path("x")}) == canonical_text({"b": "x", "a": 1})
    assert canonical_text([np.float64(0.1), np.int32(3), np.bool_(True), np.str_("s")]) == canonical_text(
        [0.1, 3, True, "s"]
    )
    assert canonical_text(True) != canonical_text(1) != canonical_text(1.0)


def test_two_plugins_with_the_same_fields_differ_by_their_choice_name():
    assert canonical(McapReader()) == {"strict": True, "type": "mcap"}
    assert canonical(Hdf5Reader()) == {"strict": True, "type": "hdf5"}


@pytest.mark.parametrize(
    ("config", "named"),
    [
        ({"a": [1.0, float("nan")]}, r"config\.a\[1\] is nan"),
        ({"a": float("inf")}, r"config\.a is inf"),
        ({"tags": {"x", "y"}}, r"config\.tags is a set"),
        (Ingest(Path("raw"), Timing(rate_hz=object())), r"config\.timing\.rate_hz is a object"),  # type: ignore[arg-type]
        ({"gains": np.zeros(3)}, r"config\.gains is a ndarray"),
        ({1: "x"}, "key 1 of type int"),
        ({"cls": Timing}, r"config\.cls is a type"),
    ],
)
def test_what_has_no_one_text_is_refused_by_name(config, named):
    with pytest.raises(TaccorlError, match=named) as caught:
        canonical(config)
    assert isinstance(caught.value, TypeError)


def test_only_settings_off_their_default_are_named():
    assert not_default(Timing()) == {}
    assert not_default(Ingest(Path("raw"), Timing(rate_hz=20.0), workers=3)) == {
        "source": "raw",
        "timing.rate_hz": 20.0,
    }
    assert not_default({"rate_hz": 20.0}) is None


def test_differences_between_two_configs_are_spelled_out():
    old, new = {"a": {"b": 30.0, "c": "x"}, "d": [1]}, {"a": {"b": 20.0, "c": "x"}, "e": None}
    assert differences(old, new) == ["a.b: 30.0 → 20.0", "d: [1] → absent", "e: absent → null"]
    assert differences(old, old) == []
