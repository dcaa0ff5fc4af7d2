"""The sixth stage: the residual, which turns what the last layer leaves into the values as they were given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..container.model import Errors, Header
from .measured import Measured
from .residual_encoder import chunk_size, encode_chunks

__all__ = ["Corrected", "correct", "remaining_errors"]


@dataclass(frozen=True, eq=False)
class Corrected:
    """All that the container tells, but for the coded passes.

    Attributes
    ----------
    measured : Measured
    header : Header
        With the size of chunks.
    levels : tuple of Errors
        Of the states that hold all levels up to one; the last of them is the complete surface, residual included.
    chunks : tuple of bytes
        The residual, see `encode_chunks`.
    exact : tuple of bool, one for each channel
        Whether it comes back bit for bit.
    """

    measured: Measured
    header: Header
    levels: tuple[Errors, ...]
    chunks: tuple[bytes, ...]
    exact: tuple[bool, ...]


def correct(measured: Measured) -> Corrected:
    """Code what the last layer leaves.

    It is a stage of its own since the coefficients, which take as much as all values, are of no use to it.
    """
    prepared, header = measured.quantized.prepared, measured.header
    chunk = chunk_size(prepared, header, measured.last, measured.coefficient_bytes)
    header = replace(header, chunk=chunk)
    chunks, exact = encode_chunks(prepared, header, measured.last)
    last = remaining_errors(measured.layers[-1].errors, exact, prepared.geometric)
    kept = replace(measured, last=())
    return Corrected(kept, header, (*measured.levels, last), tuple(chunks), tuple(exact))


def remaining_errors(errors: Errors, exact: Sequence[bool], geometric: int) -> Errors:
    """The errors of the complete surface, of which some channels are exact."""
    channels = tuple((0.0, 0.0) if known else pair for known, pair in zip(exact, errors.channels, strict=False))
    return Errors(0.0, 0.0, channels) if all(exact[:geometric]) else errors._replace(channels=channels)
