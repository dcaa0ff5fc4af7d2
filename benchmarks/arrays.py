"""The surfaces that are measured."""

from __future__ import annotations

import functools
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["ROOT", "Array", "fractal", "load"]

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT.parent / "shared" / "bench" / "surfaces.py"
CACHE = ROOT / "build" / "bench"
NAMES = ("bigtujunga", "fuji", "etopo20", "jacksboro", "smooth", "knot")


@dataclass(frozen=True)
class Array:
    """A surface with the precision that it is coded to: 16 bits of the range of heights, 18 of the longest side."""

    name: str
    points: NDArray[Any]

    @property
    def xyz(self) -> bool:
        return self.points.ndim == 3

    @property
    def extent(self) -> float:
        """Range of the heights, or diagonal of the box."""
        return float(np.linalg.norm(self._sides))

    @property
    def step(self) -> float:
        """Step of the lattice: longest side / 2^16 or, for xyz, / 2^18."""
        return float(self._sides.max()) / 2 ** (18 if self.xyz else 16)

    @property
    def samples(self) -> int:
        return self.points.size

    @property
    def _sides(self) -> NDArray[np.float64]:
        flat = self.points.reshape(-1, self.points.shape[2] if self.xyz else 1)
        sides: NDArray[np.float64] = np.ptp(flat.astype(np.float64), axis=0)
        return sides


@functools.cache
def load() -> tuple[Array, ...]:
    """Real and generated surfaces, made once by the script beside the project; none where it is absent."""
    if not SCRIPT.exists():
        print(f"\nskipped: the arrays of ../{SCRIPT.relative_to(ROOT.parent)} (there is no such file)")
        return ()
    if not all((CACHE / f"{name}.npy").exists() for name in NAMES):
        subprocess.run([sys.executable, str(SCRIPT), str(CACHE)], check=True, stdout=subprocess.DEVNULL)
    return tuple(Array(name, np.load(CACHE / f"{name}.npy")) for name in NAMES)


@functools.cache
def fractal(side: int = 4097, share: float = 0.5, rounded: bool = True) -> NDArray[np.float64]:
    """Terrain-like heights of any size, from 0 to 65535: octaves of noise, each of a share of the height.

    ``rounded``: to whole numbers.
    """
    rng = np.random.default_rng(2002)
    heights = np.zeros((2, 2))
    amplitude = 1.0
    while heights.shape[0] < side:
        finer = np.empty((2 * heights.shape[0] - 1, 2 * heights.shape[1] - 1))
        finer[::2, ::2] = heights
        finer[1::2, ::2] = (heights[:-1] + heights[1:]) / 2
        finer[:, 1::2] = (finer[:, :-1:2] + finer[:, 2::2]) / 2
        heights = finer + amplitude * rng.standard_normal(finer.shape)
        amplitude *= share
    heights = heights[:side, :side] - heights[:side, :side].min()
    scaled: NDArray[np.float64] = heights * (65535 / heights.max())
    return np.rint(scaled, out=scaled) if rounded else scaled
