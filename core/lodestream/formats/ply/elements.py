"""Tables of a PLY file, text or binary: the rows of its elements, as the header announces them.

The reader is our own because one library keeps a list property as Python objects, each a hundred times its bytes, and
others know meshes only and drop what belongs to a grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError
from ..source import number
from .header import Element, PlyHeader, Property

__all__ = ["Lists", "Table", "read_elements"]

_CHUNK = 1 << 16


@dataclass(frozen=True, slots=True)
class Lists:
    """A column of lists.

    Attributes
    ----------
    counts : int64 array of shape (rows,)
    values : array of shape (sum of counts,)
        The lists one after another.
    """

    counts: NDArray[np.int64]
    values: NDArray[Any]


#: The columns of an element by name.
Table = Mapping[str, "NDArray[Any] | Lists"]


def read_elements(path: Path, header: PlyHeader) -> dict[str, Table]:
    """Read the tables of a PLY file, by the names of their elements.

    Raises
    ------
    FormatError
        When the file is cut short, something follows the tables, or text is no number.
    """
    return _read_text(path, header) if not header.order else _read_binary(path, header)


def _read_text(path: Path, header: PlyHeader) -> dict[str, Table]:
    with path.open("rb") as file:
        file.seek(header.end)
        body = file.read()
    if b"\r" in body:
        body = body.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    rows = body.split(b"\n")
    tables: dict[str, Table] = {}
    start, line = 0, header.lines + 1
    for element in header.elements:
        values = _Words(rows, start, element, line)
        tables[element.name] = values.table()
        start, line = start + element.rows, line + element.rows
    rest = next((row for row in rows[start:] if row.strip()), None)
    if rest is not None:
        raise FormatError(f"line {line}: expected the end of the file after its elements, got {_shown(rest)}")
    return tables


def _too_large(numbers: NDArray[np.float64], it: Property) -> NDArray[np.bool_]:
    """Return the mask of finite numbers that would be infinite in their floating type."""
    return np.isfinite(numbers) & (np.abs(numbers) > float(np.finfo(it.dtype).max))


class _Words:
    """The rows of one element in text, each on a line of its own."""

    def __init__(self, rows: list[bytes], start: int, element: Element, line: int) -> None:
        self._rows, self._start, self._element, self._line = rows, start, element, line

    def table(self) -> Table:
        element = self._element
        if self._start + element.rows > len(self._rows):
            got = len(self._rows) - self._start
            raise FormatError(
                f"this PLY is cut short: its header says {number(element.rows)} lines of {element.name}, and "
                f"{number(got)} follow"
            )
        if not any(it.count for it in element.properties):
            return self._plain()
        return self._lists()

    def _plain(self) -> Table:
        properties = self._element.properties
        columns = [np.empty(self._element.rows, it.dtype) for it in properties]
        for start, values in self._chunks(len(properties)):
            for column, numbers, it in zip(columns, values.T, properties, strict=True):
                column[start : start + len(numbers)] = self._fitting(numbers, it, start)
        return {it.name: column for it, column in zip(properties, columns, strict=True)}

    def _chunks(self, width: int) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Yield the numbers of some rows at a time, all of one length."""
        for start in range(0, self._element.rows, _CHUNK):
            stop = min(start + _CHUNK, self._element.rows)
            words = [row.split() for row in self._rows[self._start + start : self._start + stop]]
            for offset, row in enumerate(words):
                if len(row) != width:
                    raise self._refusal(start + offset, f"{width} numbers")
            # Not -1 rows: an element may have rows without any number.
            yield start, self._floats(words, start).reshape(len(words), width)

    def _floats(self, words: list[list[bytes]], start: int) -> NDArray[np.float64]:
        try:
            return np.array([float(word) for row in words for word in row], np.float64)
        except ValueError:
            for offset, row in enumerate(words):
                try:
                    list(map(float, row))
                except ValueError:
                    raise self._refusal(start + offset, "numbers") from None
            raise

    def _fitting(self, numbers: NDArray[np.float64], it: Property, start: int) -> NDArray[np.float64]:
        """Check that numbers fit into their type, and return them."""
        if np.dtype(it.dtype).kind == "f":
            large = _too_large(numbers, it)
            if large.any():
                raise self._refusal(
                    start + int(large.argmax()), f"a number that {np.dtype(it.dtype)} can hold ({it.name})"
                )
            return numbers
        limits = np.iinfo(it.dtype)
        wrong = ~((numbers >= limits.min) & (numbers <= limits.max) & (numbers == np.trunc(numbers)))
        if wrong.any():
            raise self._refusal(
                start + int(wrong.argmax()), f"an integer from {limits.min} to {limits.max} ({it.name})"
            )
        return numbers

    def _lists(self) -> Table:
        properties = self._element.properties
        rows = [row.split() for row in self._rows[self._start : self._start + self._element.rows]]
        scalars: dict[str, list[float]] = {it.name: [] for it in properties if not it.count}
        counts: dict[str, list[int]] = {it.name: [] for it in properties if it.count}
        lists: dict[str, list[float]] = {it.name: [] for it in properties if it.count}
        for index, row in enumerate(rows):
            place = 0
            try:
                for it in properties:
                    if not it.count:
                        scalars[it.name].append(float(row[place]))
                        place += 1
                        continue
                    count = int(row[place])
                    values = row[place + 1 : place + 1 + count]
                    if count < 0 or len(values) != count:
                        raise ValueError("a list of another length than it says")
                    counts[it.name].append(count)
                    lists[it.name].extend(map(float, values))
                    place += 1 + count
            except (ValueError, IndexError):
                raise self._refusal(index, "lists after their lengths") from None
            if place != len(row):
                raise self._refusal(index, f"{place} numbers")
        table: dict[str, NDArray[Any] | Lists] = {}
        for it in properties:
            if it.count:
                table[it.name] = Lists(np.array(counts[it.name], np.int64), self._typed(lists[it.name], it))
            else:
                table[it.name] = self._typed(scalars[it.name], it)
        return table

    def _typed(self, numbers: list[float], it: Property) -> NDArray[Any]:
        values = np.array(numbers, np.float64)
        dtype = np.dtype(it.dtype)
        if dtype.kind == "f" and _too_large(values, it).any():
            raise FormatError(
                f"expected {it.name} of {self._element.name} as numbers that {dtype} can hold, got larger ones"
            )
        if dtype.kind != "f" and values.size:
            limits = np.iinfo(dtype)
            if not (values.min() >= limits.min and values.max() <= limits.max and (values == np.trunc(values)).all()):
                raise FormatError(
                    f"expected {it.name} of {self._element.name} as integers from {limits.min} to {limits.max}, got "
                    "others"
                )
        return values.astype(dtype)

    def _refusal(self, row: int, expected: str) -> FormatError:
        shown = _shown(self._rows[self._start + row])
        return FormatError(f"line {self._line + row}: expected {expected} of {self._element.name}, got {shown}")


def _read_binary(path: Path, header: PlyHeader) -> dict[str, Table]:
    data = np.memmap(path, np.uint8, "r")
    tables: dict[str, Table] = {}
    place = header.end
    for element in header.elements:
        if not element.properties:
            tables[element.name] = {}
            continue
        if not any(it.count for it in element.properties):
            record = _record(element, header.order, {})
            stop = place + element.rows * record.itemsize
            if stop > len(data):
                raise _short(element, element.rows, stop - len(data))
            rows = data[place:stop].view(record)
            tables[element.name] = {it.name: rows[it.name].astype(np.dtype(it.dtype)) for it in element.properties}
        else:
            tables[element.name], stop = _binary_lists(data, place, element, header.order)
        place = stop
    if place != len(data):
        raise FormatError(
            f"expected the end of the file after its elements, got {number(len(data) - place)} bytes more"
        )
    return tables


def _record(element: Element, order: str, lengths: Mapping[str, int]) -> np.dtype[Any]:
    """Return the dtype of a row if all lists of a column have the same length."""
    fields: list[Any] = []
    for it in element.properties:
        if it.count:
            fields.append((f"count of {it.name}", order + it.count))
            fields.append((it.name, order + it.dtype, (lengths[it.name],)))
        else:
            fields.append((it.name, order + it.dtype))
    return np.dtype(fields)


def _binary_lists(data: NDArray[np.uint8], place: int, element: Element, order: str) -> tuple[Table, int]:
    uniform = _uniform_lists(data, place, element, order)
    if uniform is not None:
        return uniform
    # One loop over bytes finds where each list lies; the values are then gathered at once.
    content = data.data  # not a copy of the rest of the file, of which every element would take one
    starts: dict[str, list[int]] = {it.name: [] for it in element.properties}
    counts: dict[str, list[int]] = {it.name: [] for it in element.properties if it.count}
    steps = [
        (it, np.dtype(it.count).itemsize if it.count else 0, np.dtype(it.dtype).itemsize) for it in element.properties
    ]
    endian: Literal["little", "big"] = "little" if order == "<" else "big"
    at = place
    for row in range(element.rows):
        for it, head, item in steps:
            count = 1
            if head:
                signed = it.count[0] == "i"
                count = int.from_bytes(content[at : at + head], endian, signed=signed)
                at += head
                counts[it.name].append(count)
            starts[it.name].append(at)
            at += count * item
            if count < 0 or at > len(content):
                raise _short(element, row, max(at - len(content), 1))
    table: dict[str, NDArray[Any] | Lists] = {}
    for it, _, item in steps:
        lengths = np.array(counts.get(it.name, [1] * element.rows), np.int64)
        values = _gather(data, np.array(starts[it.name], np.int64), lengths, order + it.dtype, item)
        table[it.name] = Lists(lengths, values) if it.count else values
    return table, at


def _uniform_lists(data: NDArray[np.uint8], place: int, element: Element, order: str) -> tuple[Table, int] | None:
    """Read lists that are all as long as the first, as in a mesh of equal faces; None if they are not."""
    if not element.rows:
        return None
    lengths: dict[str, int] = {}
    at = place
    for it in element.properties:
        if it.count:
            head = np.dtype(order + it.count)
            if at + head.itemsize > len(data):
                return None
            lengths[it.name] = int(data[at : at + head.itemsize].view(head)[0])
            at += head.itemsize
        at += np.dtype(it.dtype).itemsize * lengths.get(it.name, 1)
        if min(lengths.values(), default=0) < 0 or at > len(data):
            return None
    record = _record(element, order, lengths)
    stop = place + element.rows * record.itemsize
    if stop > len(data):
        return None
    rows = data[place:stop].view(record)
    if any((rows[f"count of {name}"] != length).any() for name, length in lengths.items()):
        return None
    table: dict[str, NDArray[Any] | Lists] = {}
    for it in element.properties:
        values = rows[it.name].astype(np.dtype(it.dtype)).reshape(-1)
        table[it.name] = Lists(np.full(element.rows, lengths[it.name], np.int64), values) if it.count else values
    return table, stop


def _gather(
    raw: NDArray[np.uint8], starts: NDArray[np.int64], counts: NDArray[np.int64], dtype: str, item: int
) -> NDArray[Any]:
    total = int(counts.sum())
    before = np.cumsum(counts) - counts
    inside = np.arange(total, dtype=np.int64) - np.repeat(before, counts)
    places = np.repeat(starts, counts) + inside * item
    bytes_ = raw[places[:, None] + np.arange(item)] if total else np.empty((0, item), np.uint8)
    return np.ascontiguousarray(bytes_).reshape(-1).view(dtype).astype(np.dtype(dtype).newbyteorder("="))


def _short(element: Element, row: int, missing: int) -> FormatError:
    return FormatError(
        f"this PLY is cut short: its header says {number(element.rows)} rows of {element.name}, and at row "
        f"{number(row)} {number(missing)} bytes are missing"
    )


def _shown(row: bytes) -> str:
    return repr(row.strip()[:60].decode("ascii", "backslashreplace"))
