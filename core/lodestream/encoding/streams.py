"""Encode a surface as several streams, and keep the shortest one as its container."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from ..quality import Quality
from ..scratch import MemoryScratch
from ..surface import Surface
from .build import Build
from .executing import Execution
from .lattice_coordinates import Lattices, exact_lattices, fine_lattices, lies_on_coarse_lattice
from .one_error import NoQuantiserError
from .phases import Phases
from .prepared import Prepared, prepare
from .request import rising

__all__ = ["encoded", "shortest"]

#: Bits of a channel's range that the lattice keeps where coding does not pay, in the order in which they are tried.
_COARSER = (8, 4, 0)
#: More points than a surface has.
_ONE_PIECE = 1 << 62

_Progress = Callable[[float], None]
_Stream = TypeVar("_Stream")


def encoded(surface: Surface, quality: Quality, progress: _Progress) -> bytes:
    """Encode a surface, which has been checked, in memory.

    Parameters
    ----------
    surface : Surface
    quality : Quality
    progress : callable
        Is told the fraction done, 0 to 1.
    """
    report = rising(progress)
    container = None if quality.rms is None else _for_one_error(surface, quality, report)
    if container is None:
        prepared = prepare(surface, replace(quality, rms=None))
        container = shortest(
            surface, prepared, lambda bits: _stream(prepared, exact_lattices(prepared, bits), report), len
        )
    report(1.0)
    return container


def shortest(
    surface: Surface, prepared: Prepared, stream: Callable[[int | None], _Stream], size: Callable[[_Stream], int]
) -> _Stream:
    """Return the shortest of the streams of many layers, up to a precision or bit for bit.

    Parameters
    ----------
    surface : Surface
    prepared : Prepared
        Of the surface.
    stream : callable
        Makes the stream whose lattices have so many bits of a channel's range; None: all that there are.
    size : callable
        Of a stream in bytes.
    """
    best = stream(None)
    raw = sum(array.nbytes for block in surface.blocks for array in (block.points, *block.attributes.values()))
    for bits in _COARSER:
        if prepared.precision is not None or size(best) <= _longest(raw):
            break
        # What looks like noise is not worth coding: the lattice keeps the highest bits, the residual stores the rest.
        best = min(best, stream(bits), key=size)
    return best


def _for_one_error(surface: Surface, quality: Quality, progress: _Progress) -> bytes | None:
    """Return the stream for one root mean square error; None if it takes exact values to meet it."""
    prepared = prepare(surface, quality)
    lattices = fine_lattices(prepared)
    if lattices is None:
        return None
    try:
        container = _stream(prepared, lattices, progress)
    except NoQuantiserError:
        return None
    if lies_on_coarse_lattice(prepared):
        exact = prepare(surface, replace(quality, rms=None))
        container = min(container, _stream(exact, exact_lattices(exact), progress), key=len)
    return container


def _stream(prepared: Prepared, lattices: Lattices, progress: _Progress) -> bytes:
    """Return one stream, in one piece: its tasks run one after another, each on all threads."""
    build = Build(MemoryScratch(), prepared, lattices, _ONE_PIECE, _ONE_PIECE)
    out = io.BytesIO()
    Phases(build, Execution(build), progress).write(out)
    return out.getvalue()


def _longest(raw: int) -> int:
    """Return the most bytes that a container of ``raw`` bytes of values takes, unless no other stream is shorter.

    >>> _longest(100_000)
    102024
    """
    return raw + raw // 100 + 1024
