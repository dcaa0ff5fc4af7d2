"""Draco on x, y, z: vertices alone in the grid's order, and the mesh of the grid."""

from __future__ import annotations

from typing import Any

import DracoPy
import numpy as np
from numpy.typing import NDArray

from .trial import SIDE, Trial

_LEVEL = 10


def points(trial: Trial) -> None:
    """Vertices in the grid's order; the receiver is told the grid."""
    if len(trial.surface.channels) != 3:
        trial.notes.append("it takes x, y, z only")
        return
    vertices = np.stack(trial.surface.floats, -1).reshape(-1, 3)
    for bits in range(6, 21):
        trial.case(
            f"{bits} bits",
            lambda bits=bits: [  # type: ignore[misc]
                DracoPy.encode(vertices, preserve_order=True, quantization_bits=bits, compression_level=_LEVEL)
            ],
            lambda streams: np.asarray(DracoPy.decode(streams[0]).points),
            SIDE,
        )


def edgebreaker(trial: Trial) -> None:
    """The mesh: vertices come back in another order, and their way back into the grid is not counted."""
    if len(trial.surface.channels) != 3:
        trial.notes.append("it takes x, y, z only")
        return
    vertices = np.stack(trial.surface.floats, -1).reshape(-1, 3)
    faces = _triangles(*trial.surface.shape)
    numbers = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 1)
    for bits in (8, 11, 14, 17) if len(vertices) > 500_000 else range(6, 20):
        options: dict[str, Any] = {"quantization_bits": bits, "compression_level": _LEVEL}
        try:
            stream, encode_seconds, encode_peak = trial.timed(
                lambda options=options: DracoPy.encode(vertices, faces, **options)  # type: ignore[misc]
            )
            _, decode_seconds, decode_peak = trial.timed(lambda stream=stream: DracoPy.decode(stream))  # type: ignore[misc]
            marked = DracoPy.decode(DracoPy.encode(vertices, faces, generic_attributes={"id": numbers}, **options))
            order = np.asarray(marked.get_attribute_by_name("id")["data"]).ravel()
        except Exception as error:  # whatever a peer raises, the others go on
            trial.notes.append(f"{bits} bits: {type(error).__name__}: {error}"[:160])
            continue
        decoded = np.full(vertices.shape, np.nan)
        decoded[order] = marked.points
        seconds, peaks = (encode_seconds, decode_seconds), (encode_peak, decode_peak)
        trial.add(f"{bits} bits", len(stream), decoded, seconds, peaks)


def _triangles(rows: int, columns: int) -> NDArray[np.uint32]:
    at = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    return np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
