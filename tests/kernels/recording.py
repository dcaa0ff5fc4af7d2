"""Records the calls of kernels: what each was called with, what it returned, and what it left in memory.

A file of calls is described in ``calls.h``. Memory is kept once however often it is the same, so that what is handed
on from call to call takes no more room than once.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import struct
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from lodestream.kernels import INTEGER, VALUE_TYPES, Array, Kernel, Plane, Values
from lodestream.parallel import VARIABLE

from .declared import declarations, digest

__all__ = ["Recorder", "recorded"]

_ALIGNED = 64
_BLOB, _CALL = 1, 2
_REFUSED = -(2**63)


class _Region:
    """Memory in one piece that arguments hold."""

    def __init__(self, first: int, end: int, size: int) -> None:
        self.first, self.end, self.size, self.written = first, end, size, False

    def bytes(self) -> bytes:
        raw = ctypes.string_at(self.first, self.end - self.first)
        if sys.byteorder == "big":
            raw = np.frombuffer(raw, f">u{self.size}").astype(f"<u{self.size}").tobytes()
        return raw


def _extent(argument: Array | Plane | Values, value: NDArray[Any]) -> int:
    """Bytes from the first element to the last, gaps between rows included."""
    if not isinstance(argument, Plane) or not value.size:
        return value.nbytes
    rows, columns = value.shape
    return int((rows - 1) * value.strides[0] + columns * value.itemsize)


def _regions(arguments: tuple[Any, ...], values: tuple[Any, ...]) -> tuple[list[_Region], dict[int, int]]:
    """The memory of a call, and in which of it each argument that is an array begins."""
    spans = []
    for place, (argument, value) in enumerate(zip(arguments, values, strict=True)):
        if isinstance(argument, Array | Plane | Values):
            first = value.ctypes.data
            spans.append((first, first + _extent(argument, value), place))
    regions: list[_Region] = []
    found: dict[int, int] = {}
    for first, end, place in sorted(spans):
        argument = arguments[place]
        size = values[place].itemsize
        if not regions or first >= regions[-1].end or first == end:
            regions.append(_Region(first, end, size))
        region = regions[-1]
        if region.size != size:
            raise ValueError(f"expected arguments that overlap of one size, got {region.size} and {size} bytes")
        region.end = max(region.end, end)
        region.written |= argument.written
        found[place] = len(regions) - 1
    return regions, found


class Recorder:
    """Writes a file of calls.

    Parameters
    ----------
    file : binary file
    most_bytes : int or None
        Calls that hold more memory are left out.
    most_calls : int or None
        Of each kernel.
    names : collection of str or None
        The kernels; None: all.

    Attributes
    ----------
    calls : dict of str to int
        How many there were, by kernels.
    """

    def __init__(
        self,
        file: BinaryIO,
        most_bytes: int | None = None,
        most_calls: int | None = None,
        names: Collection[str] | None = None,
    ) -> None:
        self.calls = {name: 0 for name in declarations() if names is None or name in names}
        self._file = file
        self._most_bytes, self._most_calls = most_bytes, most_calls
        self._numbers = {name: number for number, name in enumerate(self.calls)}
        self._blobs: dict[bytes, int] = {}
        file.write(b"LODECALL" + struct.pack("<Q", digest(names)))

    def call(self, kernel: Kernel, call: Callable[..., int], values: tuple[Any, ...]) -> int:
        """Make a call, and record it.

        Raises
        ------
        ValueError
            When the kernel refused it, which is recorded too.
        """
        arguments = kernel.arguments
        if kernel.name not in self.calls or self.calls[kernel.name] == self._most_calls:
            return call(kernel, *values)
        regions, found = _regions(arguments, values)
        if self._most_bytes is not None and sum(r.end - r.first for r in regions) > self._most_bytes:
            return call(kernel, *values)
        before = [self._blob(region) for region in regions]
        result, refusal = _REFUSED, None
        try:
            result = call(kernel, *values)
        except ValueError as error:
            refusal = error
        words = [_CALL, self._numbers[kernel.name], result, len(regions)]
        for region, number in zip(regions, before, strict=True):
            after = self._blob(region) if region.written and refusal is None else -1
            words += (region.size, region.first % _ALIGNED, number, after)
        for place, (argument, value) in enumerate(zip(arguments, values, strict=True)):
            if isinstance(argument, Array | Plane | Values):
                words += (found[place], value.ctypes.data - regions[found[place]].first)
                if isinstance(argument, Array):
                    words.append(value.size)
                elif isinstance(argument, Values):
                    words += (value.size, VALUE_TYPES.index(value.dtype))
                else:
                    words += (*value.shape, value.strides[0] // value.itemsize)
            elif argument is INTEGER:
                words.append(int(value))
            else:
                words.append(struct.unpack("<q", struct.pack("<d", value))[0])
        self._file.write(struct.pack(f"<{len(words)}q", *words))
        self.calls[kernel.name] += 1
        if refusal is not None:
            raise refusal
        return result

    def _blob(self, region: _Region) -> int:
        raw = region.bytes()
        key = hashlib.blake2b(raw, digest_size=16).digest() + bytes([region.size])
        if key not in self._blobs:
            self._blobs[key] = len(self._blobs)
            self._file.write(struct.pack("<3q", _BLOB, region.size, len(raw)) + raw + bytes(-len(raw) % 8))
        return self._blobs[key]


@contextmanager
def recorded(
    path: Path,
    most_bytes: int | None = None,
    most_calls: int | None = None,
    names: Collection[str] | None = None,
) -> Iterator[Recorder]:
    """Record the calls of kernels in this process meanwhile, as a `Recorder` does.

    One thread works meanwhile: a second one would change memory of a call that is being written down.
    """
    call = Kernel.__call__
    with path.open("wb") as file, mock.patch.dict(os.environ, {VARIABLE: "1"}):
        recorder = Recorder(file, most_bytes, most_calls, names)

        def record(self: Kernel, *values: Any) -> int:
            return recorder.call(self, call, values)

        Kernel.__call__ = record  # type: ignore[method-assign]
        try:
            yield recorder
        finally:
            Kernel.__call__ = call  # type: ignore[method-assign]
