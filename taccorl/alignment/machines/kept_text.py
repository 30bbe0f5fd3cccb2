"""A user's YAML file with other numbers in it: comments, order, quotes and line ends of what does not change stay.

The file is not written anew. The difference between what was loaded and what is to be saved is applied to its text, by
ruamel.yaml, which keeps what YAML's data do not have.
"""

import io
from collections.abc import Mapping, MutableMapping
from typing import Any

import yaml
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import YAMLError
from ruamel.yaml.util import load_yaml_guess_indent

WIDE = 4096  # Columns of a line: none that the user wrote is folded


def with_changes(text: str, before: str, after: str) -> str | None:
    """The user's ``text`` with the changes from ``before`` to ``after``, two canonical texts of which the first says the
    same as ``text``. None: the three cannot be brought together, such as a file of an older form. Whether the result says
    what ``after`` says is for the caller to check."""
    line_end = "\r\n" if "\r\n" in text else "\n"
    round_trip = YAML(typ="rt")
    round_trip.preserve_quotes = True
    round_trip.width = WIDE
    try:
        _, mapping, sequence = load_yaml_guess_indent(text)
        if mapping and sequence is not None:
            round_trip.indent(mapping=mapping, sequence=sequence + 2, offset=sequence)
        own = round_trip.load(text.replace(line_end, "\n"))
        old, new = yaml.safe_load(before), yaml.safe_load(after)
        if not isinstance(own, MutableMapping):
            return None
        _change(own, old, new)
    except (YAMLError, yaml.YAMLError, KeyError, IndexError, TypeError):
        return None
    out = io.StringIO()
    round_trip.dump(own, out)
    return out.getvalue().replace("\n", line_end)


def _change(own: Any, old: Mapping[str, Any], new: Mapping[str, Any]) -> None:
    """Apply to the mapping ``own`` what differs between ``old`` and ``new``."""
    for key in [key for key in old if key not in new]:
        own.pop(key, None)
    for key, value in new.items():
        was = old.get(key)
        if key in old and value == was:
            continue
        inside = own.get(key)
        if isinstance(value, Mapping) and isinstance(was, Mapping) and inside:
            _change(inside, was, value)
        elif isinstance(value, list) and isinstance(was, list) and inside:
            _change_list(inside, was, value)
        else:
            own[key] = _in_line(value)


def _change_list(own: Any, old: list[Any], new: list[Any]) -> None:
    """Apply what differs to the sequence ``own``: entry by entry, then entries at its end."""
    for k, (was, value) in enumerate(zip(old, new, strict=False)):
        if value == was:
            continue
        if isinstance(value, Mapping) and isinstance(was, Mapping):
            _change(own[k], was, value)
        else:
            own[k] = _in_line(value)
    del own[len(new) :]
    for value in new[len(old) :]:
        own.append(_in_line(value))


def _in_line(value: Any) -> Any:
    """A new value, on one line."""
    if isinstance(value, Mapping):
        made = CommentedMap({k: _in_line(v) for k, v in value.items()})
        made.fa.set_flow_style()
        return made
    if isinstance(value, list):
        sequence = CommentedSeq([_in_line(v) for v in value])
        sequence.fa.set_flow_style()
        return sequence
    return value
