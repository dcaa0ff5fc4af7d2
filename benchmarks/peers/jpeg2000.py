"""JPEG 2000 in layers of quality: one stream, of which each row is a prefix."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import glymur
import imagecodecs
import numpy as np
from numpy.typing import NDArray

from .trial import SIDE, THREADS, Trial, stacked

_SOT, _SOD, _COD, _PLT, _EOC = b"\xff\x90", b"\xff\x93", b"\xff\x52", b"\xff\x58", b"\xff\xd9"


def irreversible(trial: Trial) -> None:
    """The 9/7 wavelet on 16 bits of the longest side."""
    _layers(trial, trial.quantised(_step(trial)), True)


def reversible(trial: Trial) -> None:
    """The 5/3 wavelet on the lattice, where it has 16 bits, to the last bit; else on 16 bits of the longest side."""
    lattice = trial.lattice
    if lattice is not None and lattice.longest <= 65535:
        _layers(trial, lattice.numbers, False)
        return
    _layers(trial, trial.quantised(_step(trial)), False)
    if lattice is not None:
        bits = lattice.longest.bit_length()
        trial.case(
            "lossless, one layer",
            lambda: [_lossless(lattice.numbers[..., i], bits) for i in range(lattice.numbers.shape[2])],
            lambda streams: stacked([_decode(data) for data in streams]),
            SIDE,
            lattice.points,
        )


def _lossless(numbers: NDArray[np.int64], bits: int) -> bytes:
    plane = np.ascontiguousarray(numbers.astype(np.uint32))
    return bytes(
        imagecodecs.jpeg2k_encode(plane, reversible=True, codecformat="j2k", bitspersample=bits, numthreads=THREADS)
    )


def _step(trial: Trial) -> float:
    return float(trial.surface.sides.max()) / 65535


def _layers(trial: Trial, numbers: NDArray[np.int64], wavelet97: bool) -> None:
    if glymur.version.openjpeg_version == "0.0.0":
        trial.notes.append("glymur found no OpenJPEG: apt-get install libopenjp2-7")
        return
    surface = trial.surface
    whole = numbers.astype(np.uint16)
    channels = whole.shape[2]
    count = 10 if surface.large else 28
    ratios = (*(16.0 * channels / bits for bits in np.geomspace(0.02, 14.0 * channels, count)), 1)
    resolutions = max(1, min(7, int(np.log2(min(surface.shape))) - 1))
    data = whole if channels > 1 else whole[..., 0]
    options: dict[str, Any] = {"mct": False} if channels == 3 else {}

    def encode() -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "surface.j2k")
            glymur.Jp2k(
                path,
                data=data,
                cratios=ratios,
                irreversible=wavelet97,
                prog="LRCP",
                numres=resolutions,
                plt=True,
                **options,
            )
            return path.read_bytes()

    stream, seconds, peak = trial.timed(encode)
    codestream = _Codestream.parse(stream, len(ratios))
    lattice = trial.lattice if not wavelet97 and trial.lattice and numbers is trial.lattice.numbers else None
    for layer in range(len(ratios)):
        trial.decoded(
            f"{layer + 1} of {len(ratios)} layers",
            [codestream.prefix(layer + 1)],
            lambda streams: _decode(streams[0]),
            (seconds, peak),
            SIDE,
            lattice.points if lattice else lambda decoded: trial.restored(decoded.astype(np.float64), _step(trial)),
        )


def _decode(data: bytes) -> NDArray[Any]:
    return np.asarray(imagecodecs.jpeg2k_decode(data, numthreads=THREADS))


@dataclass(frozen=True)
class _Codestream:
    """A stream of one tile whose outermost loop is over the layers, cut at its markers."""

    head: bytes
    count_at: int
    tile: bytes
    ends: tuple[int, ...]
    packets: bytes

    @classmethod
    def parse(cls, data: bytes, layers: int) -> _Codestream:
        """Find the ends of the layers by the lengths of packets that the encoder was asked to write."""
        at, count_at = 2, 0
        while data[at : at + 2] != _SOT:
            if data[at : at + 2] == _COD:
                count_at = at + 6
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        start = at
        end = start + int.from_bytes(data[at + 6 : at + 10], "big")
        at += 12
        lengths, value = [], 0
        while data[at : at + 2] != _SOD:
            size = int.from_bytes(data[at + 2 : at + 4], "big")
            if data[at : at + 2] == _PLT:
                for byte in data[at + 5 : at + 2 + size]:
                    value = value << 7 | byte & 127
                    if not byte & 128:
                        lengths.append(value)
                        value = 0
            at += 2 + size
        each = len(lengths) // layers
        if each * layers != len(lengths):
            raise ValueError(f"expected packets of {layers} layers, got {len(lengths)}")
        ends = tuple(int(end) for end in np.cumsum(lengths)[each - 1 :: each])
        return cls(data[:start], count_at, data[start : start + 12], ends, data[at + 2 : end])

    def prefix(self, layers: int) -> bytes:
        """The stream of the first layers."""
        head, tile, end = bytearray(self.head), bytearray(self.tile), self.ends[layers - 1]
        head[self.count_at : self.count_at + 2] = layers.to_bytes(2, "big")
        tile[6:10] = (14 + end).to_bytes(4, "big")
        return bytes(head) + bytes(tile) + _SOD + self.packets[:end] + _EOC
