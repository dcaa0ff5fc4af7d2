"""Lossless coders of whole numbers: on the surface's own lattice, and quantised to meet each target."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from .trial import SIDE, Trial

_Encode = Callable[[NDArray[Any]], Any]
_Decode = Callable[[bytes], NDArray[Any]]


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
            lambda streams: trial.restored(np.stack([_htj2k_decode(data) for data in streams], -1), step),
            SIDE,
        )


def _htj2k_decode(data: bytes) -> NDArray[Any]:
    return np.asarray(imagecodecs.htj2k_decode(data))


def jpegxl(trial: Trial) -> None:
    """Lossless, effort 9 (7 where a large one is quantised); float32 as such where there are no 16 bits of numbers."""
    surface, lattice = trial.surface, trial.lattice
    first = 7 if surface.large else 9
    _planes(trial, lambda plane: _jpegxl_encode(plane, first), _jpegxl_decode)
    if lattice is not None and lattice.longest <= 65535:
        if surface.large:
            whole = lattice.numbers.astype(np.uint16)
            trial.case(
                "lossless, effort 9",
                lambda: [_jpegxl_encode(_plane(whole, i), 9) for i in _all(whole)],
                lambda streams: lattice.points(np.stack([_jpegxl_decode(data) for data in streams], -1)),
                SIDE,
            )
    elif all(np.array_equal(plane, single) for plane, single in zip(surface.channels, surface.floats, strict=True)):
        trial.each_channel(
            "lossless float32", lambda plane, _: _jpegxl_encode(plane, 9), lambda data, _: _jpegxl_decode(data)
        )


def _jpegxl_encode(plane: NDArray[Any], effort: int) -> bytes:
    return bytes(imagecodecs.jpegxl_encode(plane, lossless=True, effort=effort, numthreads=1))


def _jpegxl_decode(data: bytes) -> NDArray[Any]:
    return np.asarray(imagecodecs.jpegxl_decode(data, numthreads=1))


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
                        _plane(numbers, i), lossless=False, distance=distance, effort=7, numthreads=1
                    )
                )
                for i in _all(numbers)
            ]

        trial.case(
            f"distance {distance}",
            encode,
            lambda streams: trial.restored(np.stack([_jpegxl_decode(data) for data in streams], -1), step),
            SIDE,
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
        lambda streams: np.stack([_pcodec_decode(data, surface.shape, as_coded) for data in streams], -1),
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
            lambda streams: lattice.points(
                np.stack([_pcodec_decode(data, surface.shape, wide) for data in streams], -1)
            ),
            SIDE,
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
            lambda streams, back=back: back(decode(streams[0])),  # type: ignore[misc]
            SIDE,
        )


def _planes(trial: Trial, encode: _Encode, decode: _Decode) -> None:
    """A coder of planes of 16 bits."""
    for setting, numbers, back in _sixteen_bits(trial):

        def encode_all(numbers: Callable[[], NDArray[Any]] = numbers) -> list[bytes]:
            whole = numbers()
            return [bytes(encode(_plane(whole, i))) for i in _all(whole)]

        def decode_all(streams: Any, back: Callable[[NDArray[Any]], NDArray[Any]] = back) -> NDArray[Any]:
            return back(np.stack([decode(data) for data in streams], -1))

        trial.case(setting, encode_all, decode_all, SIDE)


_Setting = tuple[str, Callable[[], NDArray[Any]], Callable[[NDArray[Any]], NDArray[Any]]]


def _sixteen_bits(trial: Trial) -> list[_Setting]:
    """Whole numbers of at most 16 bits, and the way back: the lattice itself, then each target's quantisation."""
    found: list[_Setting] = []
    lattice = trial.lattice
    if lattice is None:
        trial.notes.append("lossless in 16 bits: the values lie on no lattice")
    elif lattice.longest > 65535:
        trial.notes.append(f"lossless in 16 bits: the lattice has {lattice.longest + 1} steps")
    else:
        found.append(("lossless", lambda: lattice.numbers.astype(np.uint16), lattice.points))
    for setting, step in trial.steps():
        if float(trial.surface.sides.max()) / step > 65535:
            trial.notes.append(f"{setting}: needs more than 16 bits")
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
