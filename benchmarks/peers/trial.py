"""One coder on one surface: every setting is a row."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .surfaces import Specimen

__all__ = ["SIDE", "TARGETS", "Peak", "Trial", "decades"]

TARGETS = (1e-2, 1e-3, 1e-4, 1e-5)

#: Bytes counted on top of a stream that does not itself say shape, type, and how its numbers become values.
SIDE = 32

Streams = Sequence[bytes]
_T = TypeVar("_T")
_STATUS = Path("/proc/self/status")


class Peak:
    """Peak memory of this process; None everywhere on a system that does not tell."""

    def __init__(self) -> None:
        self.base = self._read("VmRSS")

    def forget(self) -> None:
        """Start anew."""
        if self.base is not None:
            Path("/proc/self/clear_refs").write_text("5")

    def above(self) -> int | None:
        """Bytes above what the process held when this object was made."""
        peak = self._read("VmHWM")
        return None if peak is None or self.base is None else max(0, peak - self.base)

    @staticmethod
    def _read(field: str) -> int | None:
        try:
            line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(field))
        except (OSError, StopIteration):
            return None
        return 1024 * int(line.split()[1])


class Trial:
    """Collects the rows of a coder."""

    def __init__(self, surface: Specimen) -> None:
        self.surface = surface
        self.rows: list[dict[str, Any]] = []
        self.notes: list[str] = []
        self.lattice = surface.lattice
        _ = surface.floats, surface.reference, surface.low, surface.sides  # held before memory is counted
        self.peak = Peak()

    def case(
        self,
        setting: str,
        encode: Callable[[], Streams],
        decode: Callable[[Streams], NDArray[Any]],
        side: int = 0,
    ) -> None:
        """Measure a setting; one that fails is a note."""
        try:
            streams, encode_seconds, encode_peak = self.timed(encode)
            decoded, decode_seconds, decode_peak = self.timed(lambda: decode(streams))
        except Exception as error:  # whatever a peer raises, the others go on
            self.notes.append(f"{setting}: {type(error).__name__}: {error}"[:160])
            return
        size = sum(len(stream) for stream in streams) + side
        self.add(setting, size, decoded, (encode_seconds, decode_seconds), (encode_peak, decode_peak))

    def add(
        self,
        setting: str,
        size: int,
        decoded: NDArray[Any],
        seconds: tuple[float, float],
        peaks: tuple[int | None, int | None],
        stream: str = "",
        file: int | None = None,
    ) -> None:
        """Add the row of a decoded surface."""
        points = self.surface.points
        exact = np.array_equal(decoded.astype(points.dtype).reshape(points.shape), points)
        rms, largest = (0.0, 0.0) if exact else self.surface.errors(decoded)
        self.rows.append(
            {
                "setting": setting,
                "stream": stream,
                "bytes": int(size),
                "file": file,
                "rms": rms,
                "max": largest,
                "encode_s": seconds[0],
                "decode_s": seconds[1],
                "encode_peak": peaks[0],
                "decode_peak": peaks[1],
            }
        )

    def timed(self, work: Callable[[], _T]) -> tuple[_T, float, int | None]:
        """Result, seconds (the best of three where that takes no time), and peak memory."""
        self.peak.forget()
        best, spent = math.inf, 0.0
        for _ in range(3):
            start = time.perf_counter()
            result = work()
            best = min(best, time.perf_counter() - start)
            spent += best
            if spent > 0.1:
                break
        return result, best, self.peak.above()

    def each_channel(
        self,
        setting: str,
        encode: Callable[[NDArray[np.float32], int], bytes],
        decode: Callable[[bytes, int], NDArray[Any]],
        side: int = 0,
    ) -> None:
        """A coder of planes of float32, called for one channel after another."""
        self.case(
            setting,
            lambda: [bytes(encode(plane, number)) for number, plane in enumerate(self.surface.floats)],
            lambda streams: np.stack([decode(stream, number) for number, stream in enumerate(streams)], -1),
            side,
        )

    def steps(self) -> list[tuple[str, float]]:
        """Steps of quantisation that meet the targets, RMS and maximum, where the values are not coarser already."""
        xyz = len(self.surface.channels) > 1
        found = []
        for target in TARGETS:
            for kind, factor in (("RMS", 2.0 if xyz else math.sqrt(12)), ("max", 2 / math.sqrt(3) if xyz else 2.0)):
                step = factor * target * self.surface.extent
                if kind == "max" and self.surface.large:
                    continue
                if self.lattice is None or step > self.lattice.step:
                    found.append((f"quantised for {kind} {target:.0e}", step))
        return found

    def quantised(self, step: float) -> NDArray[np.int64]:
        """Rows, columns, channels of whole numbers from 0."""
        return np.rint((self.surface.reference - self.surface.low) / step).astype(np.int64)

    def restored(self, numbers: NDArray[Any], step: float) -> NDArray[np.float64]:
        """Values of such numbers."""
        return numbers.reshape(self.surface.reference.shape) * step + self.surface.low


def decades(first: float, last: float, each: int) -> list[float]:
    """Powers of ten from ``10**-first`` to ``10**-last``, so many in each decade."""
    count = round((last - first) * each) + 1
    return [10.0 ** -(first + number / each) for number in range(count)]
