"""Strict YAML: every way to write a wrong spec gives one line that names file, line, key, value and the way out."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from taccorl.data.strict_yaml import Document, load_yaml
from taccorl.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class Inner:
    count: int
    kind: Literal["header", "log"] = "log"
    flag: bool = False


@dataclass(frozen=True, kw_only=True)
class Outer:
    name: str
    rate_hz: float
    from_: Literal["spec", "topic"] = "spec"
    inner: Inner | None = None
    many: dict[str, Inner] = field(default_factory=dict)
    shape: tuple[int, ...] = ()
    span: tuple[float, float] | dict[str, tuple[float, float]] = (0.0, 1.0)
    unit: str | tuple[str, ...] = ""
    note: str | None = None


def read(tmp_path: Path, text: str | bytes) -> Outer:
    path = tmp_path / "a.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return Document(Outer, path).value


def refusal(tmp_path: Path, text: str | bytes) -> str:
    """The message without the folder; it must be one line, and come from no other exception's hands."""
    with pytest.raises(SpecError) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert "\n" not in message
    return message.replace(f"{tmp_path}/", "")


GOOD = "name: pad\nrate_hz: 100\n"


def test_a_complete_file_becomes_the_dataclass(tmp_path):
    value = read(
        tmp_path,
        "# pads\nname: pad\nrate_hz: 100\nfrom: topic\ninner: {count: 3, kind: header, flag: true}\n"
        "many:\n  a: {count: 1}\n  b: {count: 2}\nshape: [32, 12]\nspan: {x: [0, 1], y: [-1.5, 2e-3]}\nunit: [rad, m]\nnote: ~\n",
    )
    assert value == Outer(
        name="pad",
        rate_hz=100.0,
        from_="topic",
        inner=Inner(count=3, kind="header", flag=True),
        many={"a": Inner(count=1), "b": Inner(count=2)},
        shape=(32, 12),
        span={"x": (0.0, 1.0), "y": (-1.5, 0.002)},
        unit=("rad", "m"),
        note=None,
    )
    assert isinstance(value.rate_hz, float)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (GOOD + "count: 3\n", "a.yaml:3: count: unknown key 'count'; write `many: {NAME: {count: …}}`, in each entry"),
        ("name: pad\nrate: 100\n", "a.yaml:2: rate: unknown key 'rate'; did you mean 'rate_hz'?"),
        ("name: pad\n", "a.yaml:1: key 'rate_hz' is missing"),
        (GOOD + "inner: {kind: log}\n", "a.yaml:3: inner: key 'count' is missing"),
        (GOOD + "name: pod\n", "a.yaml:3: name: stands here twice; keep one"),
        (GOOD + "inner:\n  count: 1\n  count: 2\n", "a.yaml:5: inner → count: stands here twice; keep one"),
        (GOOD + "many:\n  a: {count: 1}\n  a: {count: 2}\n", "a.yaml:5: many → a: stands here twice; keep one"),
        (GOOD + "inner: {count: many}\n", "a.yaml:3: inner → count: expected int, found 'many'; plain digits only"),
        (GOOD + "inner: {count: 1.5}\n", "a.yaml:3: inner → count: expected int, found '1.5'; plain digits only"),
        (GOOD + "inner: {count: 1, flag: 1}\n", "a.yaml:3: inner → flag: expected bool, found '1'"),
        (
            GOOD + "inner: {count: 1, kind: headr}\n",
            "a.yaml:3: inner → kind: 'headr' is not one of 'header', 'log'; did you mean 'header'?",
        ),
        ("x-inner: &i {count: x}\n" + GOOD + "inner: *i\n", "a.yaml:1: inner → count: expected int, found 'x'"),
        (GOOD + "inner: [1]\n", "a.yaml:3: inner: does not fit: found a list"),
        (GOOD + "shape: 32\n", "a.yaml:3: shape: expected a list, found '32'"),
        (GOOD + "shape: [32, [12]]\n", "a.yaml:3: shape → 1: expected one int, found a list"),
        (GOOD + "span: [1]\n", "a.yaml:3: span: expected 2 values, found 1"),
        (GOOD + "span: {x: [0, one]}\n", "a.yaml:3: span → x → 1: expected float, found 'one'; plain decimal digits only"),
        (GOOD + "name2: {}\n", "a.yaml:3: name2: unknown key 'name2'; did you mean 'name'?"),
        ("name: [pad]\nrate_hz: 1\n", "a.yaml:1: name: expected one str, found a list"),
        (GOOD + "many: {[1, 2]: {count: 1}}\n", "a.yaml:3: many: a key must be a word, found a list"),
        (GOOD + "<<: {note: x}\n", "a.yaml:3: <<: merge keys are not read"),
        (GOOD + "many: {<<: {a: {count: 1}}}\n", "a.yaml:3: many → <<: merge keys are not read"),
    ],
)  # fmt: skip
def test_a_wrong_file_names_file_line_key_and_value(tmp_path, text, expected):
    assert refusal(tmp_path, text).startswith(expected)


def test_line_numbers_point_into_the_right_item_of_a_long_file(tmp_path):
    text = (
        "# a comment first\n\n"
        + GOOD
        + "many:\n"
        + "".join(f"  c{k}:\n    count: {k}\n" for k in range(50))
    )
    assert read(tmp_path, text).many["c49"].count == 49
    broken = text.replace("    count: 30\n", "    count: thirty\n")
    assert (
        broken.splitlines()[66] == "    count: thirty"
    )  # 5 lines before the first item, two an item
    assert refusal(tmp_path, broken).startswith(
        "a.yaml:67: many → c30 → count: expected int"
    )


def test_anchors_are_shared_and_keys_with_x_in_front_are_ignored(tmp_path):
    value = read(
        tmp_path,
        "x-unit: &unit [rad, m]\nx-inner: &inner {count: 7}\n"
        + GOOD
        + "unit: *unit\ninner: *inner\n",
    )
    assert value.unit == ("rad", "m")
    assert value.inner == Inner(count=7)
    nested = read(tmp_path, GOOD + "many: {x-default: &d {count: 5}, a: *d, b: *d}\n")
    assert nested.many == {"a": Inner(count=5), "b": Inner(count=5)}


def test_an_anchor_that_holds_itself_does_not_recurse_for_ever(tmp_path):
    assert "expected one str, found a list" in refusal(
        tmp_path, GOOD + "unit: &a [*a]\n"
    )


@pytest.mark.parametrize(
    "word",
    [
        "no",
        "on",
        "off",
        "Yes",
        "true",
        "null",
        "~",
        "3",
        "1.5",
        "1e5",
        "2024-01-01",
        "1:30",
        "012",
    ],
)
def test_what_yaml_1_1_reads_as_something_else_is_never_taken_for_a_text(
    tmp_path, word
):
    if (
        word == "1e5"
    ):  # YAML 1.1 reads this one as a text, and so do we where a text is wanted
        assert read(tmp_path, f"name: {word}\nrate_hz: 1\n").name == "1e5"
        return
    message = refusal(tmp_path, f"name: {word}\nrate_hz: 1\n")
    assert message == f"a.yaml:1: name: expected str, found '{word}'; put it in quotes"
    assert read(tmp_path, f"name: '{word}'\nrate_hz: 1\n").name == word


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("1e-3", 0.001),
        ("1E3", 1000.0),
        ("-2", -2.0),
        ("+.5", 0.5),
        ("5.", 5.0),
        ("0", 0.0),
        ("1.5e+2", 150.0),
    ],
)
def test_a_decimal_number_is_that_number(tmp_path, word, value):
    assert read(tmp_path, f"name: a\nrate_hz: {word}\n").rate_hz == value


@pytest.mark.parametrize(
    "word",
    ["010", "0x10", "0b11", "0o17", "1:30", "1:30.5", "1_000", ".inf", "-.inf", ".nan", "inf", "nan", "1e999", "'30'", '"30"',
     "yes", "2024-01-01", "٣", "1,5", "~", "''"],
)  # fmt: skip
def test_what_is_no_plain_decimal_number_is_refused_where_a_number_is_wanted(
    tmp_path, word
):
    message = refusal(tmp_path, f"name: a\nrate_hz: {word}\n")
    assert message.startswith("a.yaml:2: rate_hz: expected float, found ")
    assert "a.yaml:3: inner → count: expected int, found " in refusal(
        tmp_path, GOOD + f"inner: {{count: {word!s}}}\n"
    ) or (
        word == "1,5"  # a flow mapping ends at the comma
    )


@pytest.mark.parametrize(
    ("word", "value"), [("true", True), ("no", False), ("on", True), ("OFF", False)]
)
def test_a_switch_reads_every_yaml_word_for_on_and_off(tmp_path, word, value):
    assert read(tmp_path, GOOD + f"inner: {{count: 1, flag: {word}}}\n").inner == Inner(
        count=1, flag=value
    )


@pytest.mark.parametrize("word", ["y", "n", "'true'", "1", "enabled"])
def test_anything_else_is_no_switch(tmp_path, word):
    assert "expected bool" in refusal(
        tmp_path, GOOD + f"inner: {{count: 1, flag: {word}}}\n"
    )


def test_an_empty_value_is_nothing_only_where_nothing_is_allowed(tmp_path):
    assert read(tmp_path, GOOD + "note:\n").note is None
    assert refusal(tmp_path, "name:\nrate_hz: 1\n").startswith(
        "a.yaml:1: name: expected str, found ''"
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"", "a.yaml: is empty; its keys are name, rate_hz, "),
        (b"# only a comment\n", "a.yaml: is empty"),
        (b"- name: pad\n- rate_hz: 1\n", "a.yaml:1: expected keys and values, found a list"),
        (b"just words\n", "a.yaml:1: expected keys and values, found 'just words'"),
        (b"\x89PNG\r\n\x1a\n\x00\x00\xff\xfe", "a.yaml: cannot be read as a spec: it is not a text file"),
        (b"name: a\x00b\n", "a.yaml: is not YAML: unacceptable character"),
        (b"inner:\n\tcount: 3\n", "a.yaml:2: is not YAML: found character '\\t' that cannot start any token; indent with spaces"),
        (b"name: [pad\nrate_hz: 1\n", "a.yaml:2: is not YAML: "),
        (b"name: pad\n---\nname: pod\n", "a.yaml:2: is not YAML: but found another document"),
        (b"name: *nowhere\n", "a.yaml:1: is not YAML: found undefined alias 'nowhere'"),
        (b"name: a: b\n", "a.yaml:1: is not YAML: mapping values are not allowed here"),
        (b"[" * 5000, "a.yaml: is nested too deeply for a spec"),
    ],
)  # fmt: skip
def test_what_is_no_spec_at_all_gets_a_plain_message(tmp_path, text, expected):
    assert refusal(tmp_path, text).startswith(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f"{GOOD}inner: {{count: {'1' * 5000}}}", ("a.yaml:3: inner → count", "(5,000 characters)", "at most 100 digits")),
        (f"name: pad\nrate_hz: {'1' * 5000}", ("a.yaml:2: rate_hz", "expected float", "(5,000 characters)")),
        (f"{GOOD}{'x' * 900}: 1", ("a.yaml:3: xxx", "unknown key", "(900 characters)")),
        ("name: " + "[" * 20_000, ("a.yaml: is nested too deeply",)),
        (f"name: {'x' * 20_000_000}", ("a.yaml: is larger than 262,144 bytes",)),
        ("name: [" + "1," * 5_000_000 + "]", ("a.yaml: is larger than 262,144 bytes",)),
    ],
)  # fmt: skip
def test_absurd_values_are_refused_soon_and_in_short(tmp_path, text, expected):
    begin_s = time.process_time()
    message = refusal(tmp_path, text)
    assert time.process_time() - begin_s < 10
    assert all(fact in message for fact in expected)
    assert len(message) < 700


@pytest.mark.parametrize(
    "text", ["a: " + "1" * 5000, "[" * 20_000, "x" * 300_000, "a: [", "\x1b: 1"]
)
def test_other_peoples_yaml_has_the_same_bounds(tmp_path, text):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(SpecError, match=r"a\.yaml: is"):
        load_yaml(tmp_path / "a.yaml")


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    (tmp_path / "nope.yaml").touch()
    with pytest.raises(
        SpecError, match=r"none\.yaml: no such file; did you mean 'nope\.yaml'"
    ):
        Document(Outer, tmp_path / "none.yaml")
    with pytest.raises(SpecError, match=r"is a folder; give a file"):
        Document(Outer, tmp_path)


def test_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path):
    assert read(tmp_path, b"\xef\xbb\xbfname: pad\r\nrate_hz: 3\r\n") == Outer(
        name="pad", rate_hz=3.0
    )


def test_error_points_at_the_closest_parent_that_stands_in_the_file(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(GOOD + "many:\n  a:\n    count: 1\n")
    document = Document(Outer, path)
    assert (
        str(document.error("many/a/count", "odd")) == f"{path}:5: many → a → count: odd"
    )
    assert (
        str(document.error("many/a/kind", "odd")) == f"{path}:4: many → a → kind: odd"
    )
    assert str(document.error("shape", "odd")) == f"{path}:1: shape: odd"
