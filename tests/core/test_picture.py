from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream.lattice import Lattice
from lodestream.measure import distances
from lodestream.picture import Original, coordinate_distances, store_values
from lodestream.transform import PADDING

DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]
LATTICES = [
    Lattice("affine", 0.1, 0.3),
    Lattice("affine", -3.0, 1e-7),
    Lattice("decimal", 7.0, 100.0),
    Lattice("affine", 1e300, 1e290),
    Lattice("affine", 0.0, 1e-200),
]


def coordinates(shape: tuple[int, int, int]) -> NDArray[np.int32]:
    count, rows, columns = shape
    rng = np.random.default_rng(columns)
    values = rng.integers(-(2**26), 2**26, (count, rows, columns + PADDING)) >> rng.integers(0, 26, shape[1])[:, None]
    return values.astype(np.int32)


@pytest.mark.parametrize("dtype", DTYPES)
def test_values_are_those_of_the_lattice_bit_for_bit(dtype: str) -> None:
    numbers = coordinates((1, 40, 700))[0, :, :700]
    for lattice, fraction, channels in itertools.product(LATTICES, (0, 5), (1, 3)):
        points = np.zeros((40, 700, channels), dtype)
        store_values(lattice, (numbers, fraction), points, channels - 1)
        assert points[..., -1].tobytes() == lattice.values(numbers, points.dtype, fraction).tobytes()
        assert not points[..., :-1].any()


@pytest.mark.parametrize("dtype", DTYPES)
def test_distances_are_those_of_the_picture(dtype: str) -> None:
    for shape, geometric in itertools.product([(300, 520), (1, 3), (3, 1025)], (1, 2, 3)):
        numbers = coordinates((geometric, *shape))
        for number, fraction in itertools.product(range(len(LATTICES)), (0, 4)):
            lattices = (LATTICES[number:] + LATTICES[:number])[:geometric]
            picture = np.zeros((*shape, geometric), dtype)
            for channel, lattice in enumerate(lattices):
                store_values(lattice, (numbers[channel, :, : shape[1]], fraction), picture, channel)
            original = np.roll(picture, 1, axis=1)
            found = coordinate_distances([Original(original, None)], lattices, [numbers], [fraction] * geometric)
            assert found == pytest.approx(distances(original, picture, geometric), rel=1e-12, abs=0)
            assert coordinate_distances([Original(picture, None)], lattices, [numbers], [fraction] * geometric) == (
                0.0,
                0.0,
            )


def test_attributes_have_no_part_in_distances() -> None:
    numbers = coordinates((3, 20, 30))
    points = np.zeros((20, 30, 5), np.float32)
    for channel in range(3):
        store_values(LATTICES[0], (numbers[channel, :, :30], 0), points, channel)
    points[..., 3:] = 1e30
    points[4, 5, 2] += 1024.0
    rms, worst = coordinate_distances([Original(points, None)], LATTICES[:1] * 3, [numbers], [0, 0, 0])
    assert worst == pytest.approx(1024.0, rel=1e-3)
    assert rms == pytest.approx(worst / np.sqrt(600))
