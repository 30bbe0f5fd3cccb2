"""Read the columns of CSV, parquet and MATLAB files as numbers, and what comment lines before a CSV header say made the file."""

import codecs
import csv
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.io

from taccorl.alignment.measurements.even_rows import LONGEST_GAP_S
from taccorl.data.origin import Domain, Origin, labelled
from taccorl.data.strict_yaml import Document
from taccorl.errors import RecordingError, TaccorlError, nearest

SUFFIXES = (".csv", ".parquet", ".mat")  # Suffixes of the files that are read as tables
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
"""Name of a separator in a columns file → the character in CSV files."""
MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
"""First bytes of a CSV file that state its encoding (byte order marks) → that encoding, for Python's codecs."""
_ORIGIN_LINE = re.compile(r"#\s*(domain|origin):\s*(.*?)\s*$")
_CUT_OFF = "cut off while it was written? Remove the row, or copy the file again"
_CUT = f"remove such rows, or cut the file in two where more than {LONGEST_GAP_S:g} s of them follow each other"


class EmptyColumns(RecordingError):
    """Columns of a file in which no row holds a number."""

    def __init__(
        self, files: Mapping[tuple[str, ...], Sequence[object]], folder: str = ""
    ) -> None:
        """``files``: empty columns → files that have them."""
        self.columns = next(iter(files))
        every = "; ".join(
            f"{', '.join(map(str, of))}: column {', '.join(map(repr, own))}"
            for own, of in files.items()
        )
        way_out = "leave the column out of the file, and its line out of a columns file"
        super().__init__(f"{folder}{every}: no row holds a number: {way_out}")


@dataclass(frozen=True, kw_only=True)
class FileForm:
    """Keys of a columns file: how the table files are written (separator, decimal sign, encoding), and what made them."""

    separator: str = "comma"  # Separator of CSV files: comma, semicolon, tab or space; several spaces count as one
    decimal: Literal["point", "comma"] = (
        "point"  # Decimal sign of the numbers in CSV files
    )
    encoding: str = "utf-8"
    """Encoding of CSV files without a byte order mark, such as ``latin-1`` or ``utf-16-le``; a mark states its own."""
    domain: Domain | None = None
    """``real``: a robot or device made the file. ``surrogate``: a simulation in its place. None: not stated."""
    origin: str = ""  # Description of what made the file

    def check(self, document: Document[Any]) -> None:
        """Raises SpecError: the separator or the encoding is unknown. ``document``: the columns file, which messages name."""
        if self.separator not in SEPARATORS:
            raise document.error(
                "separator",
                f"{self.separator!r}; {nearest(self.separator, SEPARATORS)}",
            )
        try:
            "".encode(self.encoding)
        except LookupError as error:
            known = ("utf-8", "latin-1", "cp1252", "utf-16-le", "utf-16-be")
            text = (
                f"{self.encoding!r} is not an encoding; {nearest(self.encoding, known)}"
            )
            raise document.error("encoding", text) from error


def read_columns(
    path: Path,
    choose: Callable[[list[str]], list[str]],
    spec: FileForm | None = None,
    *,
    exact: bool = False,
) -> tuple[list[str], dict[str, np.ndarray]]:
    """Read columns of a CSV, parquet or MATLAB file as numbers: the header, and name of each chosen column → its numbers (T,).
    ``choose``: function that selects the columns to read from the header; it may raise. ``spec``: columns file, which states
    separator, decimal sign and encoding of CSV files; the defaults if not given. Raises RecordingError: a column is missing or
    occurs twice, or a cell is empty or not a number; the message names file, line and column.
    ``exact``: columns of whole numbers beyond 2⁵³, which no float64 holds, come as
    Python's integers (dtype object)."""
    if path.suffix == ".mat":
        header, columns = _read_mat(path, choose)
    elif path.suffix == ".parquet":
        header, columns = _read_parquet(path, choose)
    else:
        header, columns = _read_csv(path, choose, spec)
    if not exact:
        columns = {name: own.astype(float) for name, own in columns.items()}
    return header, columns


def _numbers(values: Sequence[float | int] | np.ndarray) -> np.ndarray:
    """(T,) ``values`` (T,) as float64; as Python's integers (dtype object) where all are
    whole and one is beyond 2⁵³."""
    as_float = np.asarray(values, dtype=float)
    if not len(as_float) or np.abs(as_float).max() < 2.0**53:
        return as_float
    if isinstance(values, np.ndarray) and values.dtype.kind not in "iu":
        return as_float
    if not (np.isfinite(as_float).all() and (as_float == np.round(as_float)).all()):
        return as_float
    return np.array([int(value) for value in values], dtype=object)


def _chosen(
    path: Path, header: list[str], choose: Callable[[list[str]], list[str]]
) -> list[str]:
    """Columns to read, each of which must be there once."""
    twice = sorted({h for h in header if header.count(h) > 1})
    wanted = choose(header)
    for name in wanted:
        if name not in header:
            raise RecordingError(f"{path}: no column {name!r}; {nearest(name, header)}")
        if name in twice:
            raise RecordingError(f"{path}: column {name!r} occurs twice")
    return wanted


def first_ns(path: Path, time_s: np.ndarray) -> int:
    """Time [ns] of the first of the rows at ``time_s`` (T,). Raises RecordingError: it is
    no time."""
    if not math.isfinite(time_s[0] * 1e9):
        raise RecordingError(
            f"{path}: the time of the first row is {time_s[0]:g} s: correct it, state the unit in the columns file, or remove "
            "the row"
        )
    return round(time_s[0] * 1e9)


def origin_lines(origin: Origin) -> str:
    """Lines ``# domain: …`` and ``# origin: …`` of a CSV file, each with its line break, to be written before the header."""
    return "".join(f"# {key}: {value}\n" for key, value in labelled(origin).items())


def table_origin(path: Path, spec: FileForm) -> Origin:
    """Origin of a table: as its own lines state it, else as its columns file does. Raises RecordingError: the two state different
    domains, or a line states an unknown one."""
    stated = Origin(spec.domain, spec.origin)
    if path.suffix != ".csv" or not (lines := _stated(path, _encoding(path, spec))):
        return stated
    try:
        return Origin.read(dict(lines)).agreed(stated.domain, "the columns file")
    except TaccorlError as error:
        raise RecordingError(f"{path}: {error}") from error


def _encoding(path: Path, spec: FileForm | None) -> str:
    """Return the text encoding of the CSV file at ``path``: the one that its byte order mark (first bytes) states; without such a
    mark the one under ``encoding:`` of the columns file; without both UTF-8."""
    with path.open("rb") as file:
        start = file.read(3)
    return next(
        (name for mark, name in MARKS.items() if start.startswith(mark)),
        spec.encoding if spec else "utf-8",
    )


def _stated(path: Path, encoding: str) -> list[tuple[str, str]]:
    """(key, value) of each line at the begin of a CSV file that states its origin."""
    found = []
    with path.open(encoding=encoding) as file:
        while match := _ORIGIN_LINE.match(file.readline(1000)):
            found.append((match[1], match[2]))
    return found


def _read_csv(
    path: Path, choose: Callable[[list[str]], list[str]], spec: FileForm | None
) -> tuple[list[str], dict[str, np.ndarray]]:
    separator, decimal = (spec.separator, spec.decimal) if spec else ("comma", "point")
    encoding = ""
    try:
        encoding = _encoding(path, spec)
        first = len(_stated(path, encoding))
        with path.open(newline="", encoding=encoding) as file:
            for _ in range(first):
                next(file)
            lines = (
                (" ".join(line.split()) for line in file)
                if separator == "space"
                else file
            )
            rows = csv.reader(lines, delimiter=SEPARATORS[separator], strict=True)
            header = [cell.strip() for cell in next(rows, [])]
            if not header:
                raise RecordingError(f"{path}: is empty; remove it, or copy it again")
            if any("\0" in cell for cell in header):
                raise RecordingError(
                    f"{path}:{first + 1}: has bytes of 0, as UTF-16 without a byte order mark; write `encoding: utf-16-le` (or "
                    "utf-16-be) in a columns file, or save it as UTF-8"
                )
            other = next(
                (
                    word
                    for word, sign in SEPARATORS.items()
                    if len(header) == 1 and sign in header[0]
                ),
                None,
            )
            if other:
                raise RecordingError(
                    f"{path}: its columns are separated by {other}; write `separator: {other}` in a columns file"
                )
            wanted = _chosen(path, header, choose)
            at = [header.index(name) for name in wanted]
            found: list[list[float | int]] = []
            for row in rows:
                if not row:
                    continue
                if len(row) != len(header):
                    hint = f"; {_CUT_OFF}"
                    if separator == "comma" and len(row) > len(header):
                        hint = (
                            "; decimal commas where commas part the columns? Save it with `;` between columns, with `separator: "
                            "semicolon` and `decimal: comma` in a columns file"
                        )
                    raise RecordingError(
                        f"{path}:{first + rows.line_num}: {len(row)} cells, but the header has {len(header)}{hint}"
                    )
                try:
                    found.append(
                        [
                            _number(
                                row[k], path, first + rows.line_num, header[k], decimal
                            )
                            for k in at
                        ]
                    )
                except RecordingError:
                    left = (
                        [] if found else [row, *rows]
                    )  # a column with a number in the first row is not empty
                    full = {
                        k
                        for r in left
                        for k in at
                        if k < len(r) and _is_number(r[k].replace(",", "."))
                    }
                    if left and len(full) < len(at):
                        raise EmptyColumns(
                            {tuple(header[k] for k in at if k not in full): [path]}
                        ) from None
                    bad = [k for k in at if not _is_number(row[k].replace(",", "."))]
                    if found and bad == [len(header) - 1] and next(rows, None) is None:
                        last = f"{path}:{first + rows.line_num}: the last row ends at column {header[-1]!r}"
                        raise RecordingError(f"{last}; {_CUT_OFF}") from None
                    raise
    except UnicodeError as error:
        raise _undecodable(path, encoding, str(error)) from error
    except (OSError, csv.Error) as error:
        raise RecordingError(f"{path}: cannot be read as CSV: {error}") from error
    columns = zip(*found, strict=True) if found else [()] * len(wanted)
    return header, {
        name: _numbers(own) for name, own in zip(wanted, columns, strict=True)
    }


def _undecodable(path: Path, encoding: str, what: str) -> RecordingError:
    """The error for a file that is not in ``encoding``, with line and byte; ``what`` if no byte is at fault."""
    content, place = path.read_bytes(), str(path)
    try:
        content.decode(encoding)
    except UnicodeDecodeError as error:
        place = f"{path}:{content[: error.start].decode(encoding, 'replace').count(chr(10)) + 1}"
        what = f"it has the byte 0x{content[error.start]:02x} (a µ or ° of another encoding?)"
    return RecordingError(
        f"{place}: is not {encoding} text: {what}; state the file's own, such as `encoding: latin-1`, cp1252 or utf-16-le, in a "
        "columns file, or save it as UTF-8"
    )


def _number(
    cell: str, path: Path, line: int, column: str, decimal: str = "point"
) -> float | int:
    """The number in a cell; an integer where no float64 holds it. Raises RecordingError:
    it is none, is not finite, or has the other decimal sign."""
    own = cell.strip()
    if decimal == "comma" and "." in own:
        raise RecordingError(
            f"{path}:{line}: column {column!r}: {cell!r} has a point, but the columns file states `decimal: comma`; remove "
            "points between thousands, or that line"
        )
    try:
        value = float(own.replace(",", ".") if decimal == "comma" else own)
    except ValueError:
        comma = "," in own and _is_number(own.replace(",", "."))
        way = (
            "write `decimal: comma` in a columns file"
            if comma
            else "correct the cell, or leave the row out"
        )
        what = f"{cell!r} is no number; {way}" if own else "is empty; leave the row out"
        raise RecordingError(f"{path}:{line}: column {column!r}: {what}") from None
    if not math.isfinite(value):
        raise RecordingError(
            f"{path}:{line}: column {column!r}: {cell} is not finite; {_CUT}"
        )
    if abs(value) < 2.0**53:
        return value
    return int(own) if own.lstrip("+-").isdecimal() else value


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _read_parquet(
    path: Path, choose: Callable[[list[str]], list[str]]
) -> tuple[list[str], dict[str, np.ndarray]]:
    try:
        header = list(pq.read_schema(path).names)
        wanted = _chosen(path, header, choose)
        table = pq.read_table(path, columns=wanted)
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(
            f"{path}: cannot be read as parquet: {' '.join(str(error).split())}"
        ) from error
    columns = {}
    for name in wanted:
        column = table[name]
        if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
            hint = (
                "; of a LeRobot dataset give the folder"
                if pa.types.is_fixed_size_list(column.type)
                else ""
            )
            raise RecordingError(
                f"{path}: column {name!r} holds {column.type}, not numbers{hint}"
            )
        columns[name] = _numbers(np.asarray(column.to_numpy()))
    _check_numbers(path, columns)
    return header, columns


def _check_numbers(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Raise if a column has numbers that are not finite: RecordingError, of those without any EmptyColumns."""
    bad = {
        name: rows
        for name, values in columns.items()
        if len(rows := np.flatnonzero(~np.isfinite(values.astype(float))))
    }
    if empty := [name for name, rows in bad.items() if len(rows) == len(columns[name])]:
        raise EmptyColumns({tuple(empty): [path]})
    for name, rows in bad.items():
        what = f"row {rows[0]} is empty or not finite, and {len(rows) - 1} more are not"
        raise RecordingError(f"{path}: column {name!r}: {what}; {_CUT}")


def _read_mat(
    path: Path, choose: Callable[[list[str]], list[str]]
) -> tuple[list[str], dict[str, np.ndarray]]:
    """Variables of a MATLAB file up to version 7 that are vectors of numbers."""
    try:
        content = scipy.io.loadmat(path)
    except (
        OSError,
        ValueError,
        NotImplementedError,
        scipy.io.matlab.MatReadError,
    ) as error:
        raise RecordingError(
            f"{path}: cannot be read as a MATLAB file up to version 7: {' '.join(str(error).split())}"
        ) from error
    vectors = {
        name: _numbers(np.asarray(value).ravel())
        for name, value in content.items()
        if isinstance(value, np.ndarray)
        and value.dtype.kind in "fiu"
        and value.size == max(value.shape, default=0) > 1
    }
    wanted = _chosen(path, list(vectors), choose)
    lengths = {name: len(vectors[name]) for name in wanted}
    if len(set(lengths.values())) > 1:
        raise RecordingError(f"{path}: its variables differ in length: {lengths}")
    columns = {name: vectors[name] for name in wanted}
    _check_numbers(path, columns)
    return list(vectors), columns
