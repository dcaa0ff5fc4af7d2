"""VMEC: the boundary of a stellarator's plasma, a torus given by Fourier series.

R = sum rmnc cos(m u - n v) + rmns sin(m u - n v), Z likewise of zmns and zmnc, where u goes around the short way and v
the long way; the last surface is the boundary.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError, OptionError
from ...surface import Surface
from ..source import Source

__all__ = ["is_vmec", "read"]

_NEEDED = ("rmnc", "zmns", "xm", "xn")
_DEFAULT = (64, 256)
_MOST_MODES = 4096


def is_vmec(dataset: Any) -> bool:
    """Return whether a NetCDF has what VMEC writes."""
    return all(name in dataset.variables for name in _NEEDED)


def read(source: Source, dataset: Any) -> Surface:
    """Evaluate the boundary at the points of the option ``resolution``, as x, y, z closed in both directions.

    Raises
    ------
    FormatError
        If it has more modes than a boundary of a stellarator has.
    """
    rows, columns = _resolution(source)
    source.check_vertices(rows * columns, f"{rows} x {columns} points")
    xm, xn = (_row(dataset, name) for name in ("xm", "xn"))
    if not len(xm) == len(xn) <= _MOST_MODES:
        raise FormatError(f"expected at most {_MOST_MODES} modes in xm and xn, got {len(xm)} and {len(xn)}")
    u = np.arange(rows) * (2 * np.pi / rows)
    v = np.arange(columns) * (2 * np.pi / columns)
    radius, height = np.zeros((rows, columns)), np.zeros((rows, columns))
    for total, terms in (
        (radius, (("rmnc", np.cos), ("rmns", np.sin))),
        (height, (("zmns", np.sin), ("zmnc", np.cos))),
    ):
        for name, wave in terms:
            if name in dataset.variables:
                for amplitude, m, n in zip(_row(dataset, name, len(xm)), xm, xn, strict=True):
                    total += amplitude * wave(m * u[:, None] - n * v[None, :])
    points = np.stack((radius * np.cos(v), radius * np.sin(v), height), axis=-1)
    metadata = source.metadata("netcdf") | {"recognised": "boundary of a VMEC equilibrium"}
    return Surface(points, source.closed or (True, True), metadata=metadata)


def _resolution(source: Source) -> tuple[int, int]:
    text = str(source.options.get("resolution", f"{_DEFAULT[0]}x{_DEFAULT[1]}"))
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if match is None or min(int(match[1]), int(match[2])) < 3:
        raise OptionError(f"expected resolution= as two numbers from 3 such as 64x256, got {text!r}")
    return int(match[1]), int(match[2])


def _row(dataset: Any, name: str, length: int | None = None) -> NDArray[np.float64]:
    """Return a vector, or the last row of an array."""
    variable = dataset.variables[name]
    if variable.dtype.kind not in "iuf" or variable.ndim not in (1, 2) or variable.size > _MOST_MODES**2:
        raise FormatError(f"expected a table of numbers in {name}, got {variable.dtype} of shape {variable.shape}")
    values = np.asarray(variable.values, np.float64)
    row = values if values.ndim == 1 else values[-1]
    if length is not None and len(row) != length:
        raise FormatError(f"expected {length} modes in {name}, got {len(row)}")
    return row
