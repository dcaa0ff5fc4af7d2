"""Lossless coders of whole numbers: on the surface's own lattice, and quantised to meet each target."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from .trial import SIDE, THREADS, Restore, Trial, stacked

_Encode = Callable[[NDArray[Any]], Any]
_Decode = Callable[[bytes], NDArray[Any]]
_Setting = tuple[str, Callable[[], NDArray[Any]], Restore]


def htj2k(trial: Trial) -> None:
    """Its lossless mode, and its 9/7 wavelet on 16 bits."""
    _planes(trial, lambda plane: imagecodecs.htj2k_encode(plane, reversible=True), _htj2k_decode)
    surface = trial.surface
    step = float(surface.sides.max()) / 65535
    for level in np.geomspace(0.3, 1e-5, 6 if surface.large else 40):

        def encode(level: float = float(level)) -> list[bytes]:
            numbers = trial.quantised(step).astype(np.uint16)
            planes = [_plane(numbers, i) for i in _all(numbers)]
            return [bytes(imagecodecs.htj2k_encode(plane, level=level, reversible=False)) for plane in planes]

        trial.case(
            f"9/7, level {level:.1e}",
            encode,
            lambda streams: stacked([_htj2k_decode(data) for data in streams]),
            SIDE,
            lambda numbers: trial.restored(numbers, step),
        )


def _htj2k_decode(data: bytes) -> NDArray[Any]:
    return np.asarray(imagecodecs.htj2k_decode(data))


#: Lossless at efforts 9 and 10. More samples than these are tried at 9 alone: 10 takes several times as long.
_FAST, _BEST = 9, 10
_BEST_SAMPLES = 1_000_000
#: Quantised values are tried at effort 10 too where there are at most so many samples.
_QUANTISED_SAMPLES = 200_000


def jpegxl(trial: Trial) -> None:
    """Lossless, efforts 9 and 10 (7 where a large one is quantised); float32 as such where 16 bits are not enough."""
    surface, lattice = trial.surface, trial.lattice
    samples = surface.points.size
    efforts = (_FAST, _BEST) if samples <= _BEST_SAMPLES else (_FAST,)
    whole = [setting for setting in _sixteen_bits(trial) if setting[0] == "lossless"]
    quantised = [setting for setting in _sixteen_bits(trial) if setting[0] != "lossless"]
    for effort in efforts:
        _planes_of(trial, whole, partial(_jpegxl_encode, effort=effort), _jpegxl_decode, f", effort {effort}")
    if (lattice is None or lattice.longest > 65535) and all(
        np.array_equal(plane, single) for plane, single in zip(surface.channels, surface.floats, strict=True)
    ):
        for effort in efforts:
            trial.each_channel(
                f"lossless float32, effort {effort}",
                lambda plane, _, effort=effort: _jpegxl_encode(plane, effort),  # type: ignore[misc]
                lambda data, _: _jpegxl_decode(data),
            )
    for effort in (7,) if surface.large else efforts if samples <= _QUANTISED_SAMPLES else (_FAST,):
        _planes_of(trial, quantised, partial(_jpegxl_encode, effort=effort), _jpegxl_decode, f", effort {effort}")


def _jpegxl_encode(plane: NDArray[Any], effort: int) -> bytes:
    return bytes(imagecodecs.jpegxl_encode(plane, lossless=True, effort=effort, numthreads=THREADS))


def _jpegxl_decode(data: bytes) -> NDArray[Any]:
    return np.asarray(imagecodecs.jpegxl_decode(data, numthreads=THREADS))


def jpegxl_lossy(trial: Trial) -> None:
    """Its lossy mode, which is made for the eye, on 16 bits."""
    surface = trial.surface
    step = float(surface.sides.max()) / 65535
    few, many = (0.01, 0.1, 1.0, 10.0), (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 3.0, 10.0, 25.0)
    for distance in few if surface.large else many:

        def encode(distance: float = distance) -> list[bytes]:
            numbers = trial.quantised(step).astype(np.uint16)
            return [
                bytes(
                    imagecodecs.jpegxl_encode(
                        _plane(numbers, i), lossless=False, distance=distance, effort=7, numthreads=THREADS
                    )
                )
                for i in _all(numbers)
            ]

        trial.case(
            f"distance {distance}",
            encode,
            lambda streams: stacked([_jpegxl_decode(data) for data in streams]),
            SIDE,
            lambda numbers: trial.restored(numbers, step),
        )


def jpegls(trial: Trial) -> None:
    """Lossless."""
    _planes(trial, imagecodecs.jpegls_encode, lambda data: np.asarray(imagecodecs.jpegls_decode(data)))


def pcodec(trial: Trial) -> None:
    """Level 12, its best; floating point as such, and whole numbers."""
    surface = trial.surface
    as_coded = _coded(surface.channels[0]).dtype
    trial.case(
        "lossless, as it is",
        lambda: [bytes(imagecodecs.pcodec_encode(_coded(plane), level=12)) for plane in surface.channels],
        lambda streams: stacked([_pcodec_decode(data, surface.shape, as_coded) for data in streams]),
        SIDE,
    )
    _planes(
        trial,
        lambda plane: imagecodecs.pcodec_encode(plane, level=12),
        lambda data: _pcodec_decode(data, surface.shape, np.dtype(np.uint16)),
    )
    lattice = trial.lattice
    if lattice is not None and lattice.longest > 65535:
        wide = np.dtype(np.uint32)
        trial.case(
            "lossless, 32 bits",
            lambda: [
                bytes(imagecodecs.pcodec_encode(_plane(lattice.numbers, i).astype(wide), level=12))
                for i in _all(lattice.numbers)
            ],
            lambda streams: stacked([_pcodec_decode(data, surface.shape, wide) for data in streams]),
            SIDE,
            lattice.points,
        )


def _coded(plane: NDArray[Any]) -> NDArray[Any]:
    return plane.astype(np.int32) if plane.dtype.itemsize == 1 else plane


def _pcodec_decode(data: bytes, shape: tuple[int, int], dtype: np.dtype[Any]) -> NDArray[Any]:
    return np.asarray(imagecodecs.pcodec_decode(data, shape, dtype))


def meshoptimizer(trial: Trial) -> None:
    """Vertices of 16 bits in the grid's order, padded to four bytes, with zstd on top, which is its best."""
    surface = trial.surface
    padded = len(surface.channels) + len(surface.channels) % 2
    vertices = surface.points.shape[0] * surface.points.shape[1]

    def encode(numbers: NDArray[Any]) -> bytes:
        rows = np.zeros((vertices, padded), np.uint16)
        rows[:, : numbers.shape[2]] = numbers.reshape(vertices, -1)
        return bytes(imagecodecs.zstd_encode(imagecodecs.meshopt_encode(rows), level=9))

    def decode(data: bytes) -> NDArray[Any]:
        rows = imagecodecs.meshopt_decode(imagecodecs.zstd_decode(data), shape=(vertices, padded), dtype=np.uint16)
        return np.asarray(rows)[:, : len(surface.channels)]

    for setting, numbers, back in _sixteen_bits(trial):
        trial.case(
            setting,
            lambda numbers=numbers: [encode(numbers())],  # type: ignore[misc]
            lambda streams: decode(streams[0]),
            SIDE,
            back,
        )


def _planes(trial: Trial, encode: _Encode, decode: _Decode) -> None:
    """A coder of planes of 16 bits."""
    _planes_of(trial, _sixteen_bits(trial), encode, decode)


def _planes_of(trial: Trial, settings: list[_Setting], encode: _Encode, decode: _Decode, suffix: str = "") -> None:
    for setting, numbers, back in settings:

        def encode_all(numbers: Callable[[], NDArray[Any]] = numbers) -> list[bytes]:
            whole = numbers()
            return [bytes(encode(_plane(whole, i))) for i in _all(whole)]

        trial.case(
            f"{setting}{suffix}",
            encode_all,
            lambda streams: stacked([decode(data) for data in streams]),
            SIDE,
            back,
        )


def _sixteen_bits(trial: Trial) -> list[_Setting]:
    """Whole numbers of at most 16 bits, and the way back: the lattice itself, then each target's quantisation."""
    found: list[_Setting] = []
    lattice = trial.lattice
    if lattice is None:
        trial.note("lossless in 16 bits: the values lie on no lattice")
    elif lattice.longest > 65535:
        trial.note(f"lossless in 16 bits: the lattice has {lattice.longest + 1} steps")
    else:
        found.append(("lossless", lambda: lattice.numbers.astype(np.uint16), lattice.points))
    for setting, step in trial.steps():
        if float(trial.surface.sides.max()) / step > 65535:
            trial.note(f"{setting}: needs more than 16 bits")
            continue
        found.append(
            (
                setting,
                lambda step=step: trial.quantised(step).astype(np.uint16),  # type: ignore[misc]
                lambda numbers, step=step: trial.restored(numbers.astype(np.float64), step),  # type: ignore[misc]
            )
        )
    return found


def _plane(numbers: NDArray[Any], channel: int) -> NDArray[Any]:
    return np.ascontiguousarray(numbers[..., channel])


def _all(numbers: NDArray[Any]) -> range:
    return range(numbers.shape[2])
