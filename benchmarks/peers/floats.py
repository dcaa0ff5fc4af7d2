"""Coders of arrays of floating point, each asked for errors on both sides of the targets."""

from __future__ import annotations

import bz2
import math
from typing import Any

import imagecodecs
import numpy as np
import pywt
from numpy.typing import NDArray

from .trial import SIDE, THREADS, Trial, decades, stacked

#: SPERR's own header of a plane, which says shape and type.
_SPERR_HEADER = 10


def sz3(trial: Trial) -> None:
    """Bounds of the error; lossless at bound 0, or within half a step of the lattice."""
    _bounded(trial, _sz3_encode, lambda data, like: imagecodecs.sz3_decode(data, like.shape, like.dtype))


def _sz3_encode(plane: NDArray[Any], bound: float) -> bytes:
    return bytes(imagecodecs.sz3_encode(plane, mode="abs", abs=bound))


def lerc(trial: Trial) -> None:
    """Bounds of the error, with zstd on top, which is its best."""
    _bounded(trial, _lerc_encode, lambda data, like: np.asarray(imagecodecs.lerc_decode(data)))


def _lerc_encode(plane: NDArray[Any], bound: float) -> bytes:
    return bytes(imagecodecs.lerc_encode(plane, level=bound, compression="zstd"))


def zfp(trial: Trial) -> None:
    """Bounds of the error, and its reversible mode."""
    _bounded(trial, _zfp_encode, lambda data, like: np.asarray(imagecodecs.zfp_decode(data)))


def _zfp_encode(plane: NDArray[Any], bound: float) -> bytes:
    if not bound:
        return bytes(imagecodecs.zfp_encode(plane, mode="reversible", numthreads=THREADS))
    return bytes(imagecodecs.zfp_encode(plane, level=bound, mode="accuracy", numthreads=THREADS))


def _bounded(trial: Trial, encode: Any, decode: Any) -> None:
    surface = trial.surface
    for bound in decades(0.5, 6, 2 if surface.large else 4):
        trial.each_channel(
            f"error {bound:.1e}",
            lambda plane, _, bound=bound: encode(plane, bound * surface.extent),  # type: ignore[misc]
            lambda data, number: decode(data, surface.floats[number]),
        )
    planes = [plane if plane.dtype.kind == "f" else plane.astype(np.float32) for plane in surface.channels]
    trial.case(
        "lossless",
        lambda: [encode(plane, 0.0) for plane in planes],
        lambda streams: stacked([decode(data, like) for data, like in zip(streams, planes, strict=True)]),
    )
    if trial.lattice is not None and trial.lattice.longest < 1 << 22:
        lattice = trial.lattice
        whole = [np.ascontiguousarray(lattice.numbers[..., i].astype(np.float32)) for i in range(len(planes))]
        trial.case(
            "whole numbers, error 0.49",
            lambda: [encode(plane, 0.49) for plane in whole],
            lambda streams: stacked([decode(data, like) for data, like in zip(streams, whole, strict=True)]),
            SIDE,
            lambda numbers: lattice.points(np.rint(numbers)),
        )


def _sperr_encode(plane: NDArray[Any], level: float, mode: Any) -> bytes:
    return bytes(imagecodecs.sperr_encode(plane, level=level, mode=mode, header=False, numthreads=THREADS))


def _sperr_decode(trial: Trial, data: bytes) -> NDArray[Any]:
    return np.asarray(
        imagecodecs.sperr_decode(data, header=False, shape=trial.surface.shape, dtype=np.float32, numthreads=THREADS)
    )


def _psnr(trial: Trial, channel: int, rms: float) -> float:
    """What SPERR calls the quality of an RMS error over the extent, shared evenly by the channels."""
    surface = trial.surface
    each = rms * surface.extent / math.sqrt(len(surface.channels))
    return 20 * math.log10(max(float(surface.sides[channel]), 1e-30) / each)


def _sperr_errors(trial: Trial) -> list[float]:
    return decades(1, 5, 2) if trial.surface.large else decades(1, 5.25, 4)


def _sperr_header(trial: Trial) -> int:
    return _SPERR_HEADER * len(trial.surface.channels)


def _sperr_at(trial: Trial, plane: NDArray[Any], channel: int, rms: float) -> bytes:
    """A stream of this RMS error; hardly anything of a channel that is flatter than that."""
    quality = _psnr(trial, channel, rms)
    return _sperr_encode(plane, quality, "psnr") if quality > 1 else _sperr_encode(plane, 0.01, "bpp")


def sperr_psnr(trial: Trial) -> None:
    """A stream for each error."""
    for rms in _sperr_errors(trial):
        trial.each_channel(
            f"RMS {rms:.1e}",
            lambda plane, number, rms=rms: _sperr_at(trial, plane, number, rms),  # type: ignore[misc]
            lambda data, _: _sperr_decode(trial, data),
            _sperr_header(trial),
        )


def sperr_prefix(trial: Trial) -> None:
    """One stream of each channel, cut where a stream of the error asked for would end."""
    planes = trial.surface.floats
    whole, seconds, peak = trial.timed(
        lambda: [_sperr_at(trial, plane, number, 10**-6.5) for number, plane in enumerate(planes)]
    )
    encoding = (seconds, peak)
    for rms in _sperr_errors(trial):
        lengths = [len(_sperr_at(trial, plane, number, rms)) for number, plane in enumerate(planes)]
        cut = [stream[:length] for stream, length in zip(whole, lengths, strict=True)]
        trial.decoded(
            f"prefix for RMS {rms:.1e}",
            cut,
            lambda streams: stacked([_sperr_decode(trial, data) for data in streams]),
            encoding,
            _sperr_header(trial),
        )


def sperr_bound(trial: Trial) -> None:
    """Bounds of the error; lossless within half a step of the lattice."""
    surface = trial.surface
    for bound in decades(1, 5, 2) if surface.large else decades(1, 5.5, 4):
        trial.each_channel(
            f"error {bound:.1e}",
            lambda plane, _, bound=bound: _sperr_encode(plane, bound * surface.extent, "pwe"),  # type: ignore[misc]
            lambda data, _: _sperr_decode(trial, data),
            _sperr_header(trial),
        )
    if trial.lattice is not None and trial.lattice.longest < 1 << 22:
        lattice = trial.lattice
        whole = [np.ascontiguousarray(lattice.numbers[..., i].astype(np.float32)) for i in range(len(surface.channels))]
        trial.case(
            "whole numbers, error 0.49",
            lambda: [_sperr_encode(plane, 0.49, "pwe") for plane in whole],
            lambda streams: stacked([_sperr_decode(trial, data) for data in streams]),
            SIDE,
            lambda numbers: lattice.points(np.rint(numbers)),
        )


def wavelets(trial: Trial) -> None:
    """What one writes oneself: a wavelet transform, one step for all coefficients, and a general compressor."""
    surface = trial.surface
    levels = max(1, min(6, int(math.log2(min(surface.shape))) - 3))
    like = pywt.wavedec2(np.zeros(surface.shape, np.float32), "bior4.4", level=levels)
    shape, slices = (lambda pair: (pair[0].shape, pair[1]))(pywt.coeffs_to_array(like))

    def encode(plane: NDArray[np.float32], step: float) -> bytes:
        bands = pywt.coeffs_to_array(pywt.wavedec2(plane, "bior4.4", level=levels))[0]
        return bz2.compress(np.rint(bands / step).astype(np.int32).tobytes())

    def decode(data: bytes, step: float) -> NDArray[Any]:
        bands = np.frombuffer(bz2.decompress(data), np.int32).reshape(shape) * step
        coefficients = pywt.array_to_coeffs(bands, slices, output_format="wavedec2")
        rows, columns = surface.shape
        restored: NDArray[Any] = pywt.waverec2(coefficients, "bior4.4")[:rows, :columns]
        return restored

    for rms in decades(1, 5, 1 if surface.large else 2):
        step = 3 * rms * surface.extent
        trial.each_channel(
            f"step {step:.1e}",
            lambda plane, _, step=step: encode(plane, step),  # type: ignore[misc]
            lambda data, _, step=step: decode(data, step),  # type: ignore[misc]
            SIDE,
        )
