"""One coder on one surface: every setting is a row."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..measure import Peak
from .surfaces import Specimen

__all__ = ["SIDE", "TARGETS", "THREADS", "Restore", "Streams", "Trial", "decades", "stacked"]

TARGETS = (1e-2, 1e-3, 1e-4, 1e-5)

#: Bytes counted on top of a stream that does not itself say shape, type, and how its numbers become values.
SIDE = 32

#: Processor seconds after which no further setting of a coder is tried on a surface.
BUDGET = 30.0

#: Threads of the peers that have any: one for all figures but those that name another number.
THREADS = int(os.environ.get("LODESTREAM_THREADS") or os.cpu_count() or 1)

Streams = Sequence[bytes]
Restore = Callable[[NDArray[Any]], NDArray[Any]]
_T = TypeVar("_T")


class Trial:
    """Collects the rows of a coder, in a file too, so that they stay if the process ends."""

    def __init__(self, surface: Specimen, out: Path | None = None) -> None:
        self.surface = surface
        self.rows: list[dict[str, Any]] = []
        self.notes: list[str] = []
        self.moments: list[dict[str, Any]] = []
        self.lattice = surface.lattice
        _ = surface.floats, surface.reference, surface.low, surface.sides  # held before memory is counted
        self.peak = Peak()
        self._out, self._start = out, time.process_time()

    def case(
        self,
        setting: str,
        encode: Callable[[], Streams],
        decode: Callable[[Streams], NDArray[Any]],
        side: int = 0,
        restore: Restore | None = None,
    ) -> None:
        """Measure a setting; one that fails is a note.

        What ``decode`` gives becomes values by ``restore``, which is not timed: coders of whole numbers are not charged
        for it.
        """
        if time.process_time() - self._start > BUDGET:
            self.note(f"after {BUDGET:.0f} s no further setting was tried")
            return
        try:
            streams, seconds, peak = self.timed(encode)
            self.decoded(setting, streams, decode, (seconds, peak), side, restore)
        except Exception as error:  # whatever a peer raises, the others go on
            self.note(f"{setting}: {type(error).__name__}: {error}"[:160])

    def decoded(
        self,
        setting: str,
        streams: Streams,
        decode: Callable[[Streams], NDArray[Any]],
        encoding: tuple[float, int | None],
        side: int = 0,
        restore: Restore | None = None,
    ) -> None:
        """Decode streams that took so many seconds and so much memory, and add the row."""
        numbers, seconds, peak = self.timed(lambda: decode(streams))
        values = numbers if restore is None else restore(numbers)
        size = sum(len(stream) for stream in streams) + side
        self.add(setting, size, values, (encoding[0], seconds), (encoding[1], peak))

    def note(self, text: str) -> None:
        """Say something once."""
        if text not in self.notes:
            self.notes.append(text)

    def write(self) -> None:
        """Write the rows so far, if there is a file for them."""
        if self._out is not None:
            seconds = time.process_time() - self._start
            found = {"rows": self.rows, "notes": self.notes, "moments": self.moments, "seconds": seconds}
            self._out.write_text(json.dumps(found))

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
        self.write()

    def timed(self, work: Callable[[], _T]) -> tuple[_T, float, int | None]:
        """Result, seconds of the processor (the best of three where that takes no time), and peak memory."""
        self.peak.forget()
        best, spent = math.inf, 0.0
        for _ in range(3):
            start = time.process_time()
            result = work()
            best = min(best, time.process_time() - start)
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
            lambda streams: stacked([decode(stream, number) for number, stream in enumerate(streams)]),
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


def stacked(planes: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Rows, columns, channels of planes; nothing is copied of a single one."""
    return planes[0][..., None] if len(planes) == 1 else np.stack(planes, -1)


def decades(first: float, last: float, each: int) -> list[float]:
    """Powers of ten from ``10**-first`` to ``10**-last``, so many in each decade."""
    count = round((last - first) * each) + 1
    return [10.0 ** -(first + number / each) for number in range(count)]
