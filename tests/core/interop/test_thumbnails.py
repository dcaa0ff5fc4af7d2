"""Thumbnails: less than 4 kB whatever is drawn, what is seen from where, and nothing where there is nothing."""

from __future__ import annotations

import io
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import InputError
from lodestream.interop.thumbnails import (
    HEIGHT,
    MOST_BLOCKS,
    PIXEL_BYTES,
    WIDTH,
    thumbnail_pixels,
    thumbnail_png,
)
from tests.core.surfaces import terrain, torus


def shades(points: Any, **more: Any) -> NDArray[np.uint8]:
    """The pixels of a thumbnail, (row, column): 0 where nothing is drawn, else 1 to 15."""
    pixels = thumbnail_pixels(points if isinstance(points, ls.Surface) else ls.Surface(points, **more))
    assert pixels is not None
    halves = np.frombuffer(pixels, np.uint8).reshape(HEIGHT, WIDTH // 2)
    return np.stack([halves >> 4, halves & 15], axis=2).reshape(HEIGHT, WIDTH)


@given(st.binary(min_size=PIXEL_BYTES, max_size=PIXEL_BYTES))
def test_any_pixels_are_a_png_of_less_than_4_kb(pixels: bytes) -> None:
    png = thumbnail_png(pixels)
    assert len(png) < 4096
    start = png.index(b"IDAT")
    rows = zlib.decompress(png[start + 4 : png.index(b"IEND") - 8])
    assert b"".join(rows[k + 1 : k + 1 + WIDTH // 2] for k in range(0, len(rows), 1 + WIDTH // 2)) == pixels


def test_noise_takes_less_than_4_kb() -> None:
    assert len(thumbnail_png(np.random.default_rng(1).integers(0, 256, PIXEL_BYTES, np.uint8).tobytes())) < 4096


def test_other_programs_read_it() -> None:
    image = pytest.importorskip("PIL.Image")
    drawn = shades(terrain((60, 80)))
    pixels = thumbnail_pixels(ls.Surface(terrain((60, 80))))
    assert pixels is not None
    with image.open(io.BytesIO(thumbnail_png(pixels))) as read:
        assert read.size == (WIDTH, HEIGHT)
        colours = np.asarray(read.convert("RGBA"))
    assert np.array_equal(colours[..., 3] > 0, drawn > 0)
    # Each shade is lighter than the one before.
    light = [int(colours[drawn == shade].sum(axis=1)[0]) for shade in np.unique(drawn[drawn > 0])]
    assert light == sorted(light)


@pytest.mark.parametrize("size", [0, PIXEL_BYTES - 1, PIXEL_BYTES + 1])
def test_other_bytes_are_no_pixels(size: int) -> None:
    with pytest.raises(InputError, match=f"expected {PIXEL_BYTES} bytes of pixels, got {size}"):
        thumbnail_png(bytes(size))


def test_heights_are_a_map_lit_from_the_north_west() -> None:
    rows, columns = np.mgrid[-30:31, -30:31]
    drawn = shades(np.maximum(20.0 - np.hypot(rows, columns), 0))
    row, column = HEIGHT // 2, WIDTH // 2
    assert drawn[row - 8, column - 8] > drawn[4, column] > drawn[row + 8, column + 8]
    assert drawn[:, : (WIDTH - HEIGHT) // 2].max() == 0, "it keeps its shape, and nothing is beside it"


def test_a_map_has_north_at_the_top() -> None:
    heights = np.zeros((61, 61))
    heights[:20] = np.nan
    up, down = (shades(heights, metadata={"geotransform": [0.0, 1.0, 0.0, 0.0, 0.0, step]}) for step in (1.0, -1.0))
    assert not down[: HEIGHT // 4].any()
    assert not up[-HEIGHT // 4 :].any()


def test_holes_are_transparent() -> None:
    heights = terrain((72, 96))
    heights[30:42, 40:56] = np.nan
    drawn = shades(heights)
    assert drawn[HEIGHT // 2, WIDTH // 2] == 0
    assert drawn[HEIGHT // 4, WIDTH // 4] > 0


def test_points_in_space_are_seen_from_above_and_beside() -> None:
    drawn = shades(torus(48, 32), closed=(True, True))
    assert drawn[HEIGHT // 2, WIDTH // 2] == 0 or drawn[HEIGHT // 2 - 6, WIDTH // 2] == 0, "its hole is seen"
    assert drawn[0].max() == drawn[-1].max() == 0
    assert len(np.unique(drawn)) > 8


def test_of_what_hides_something_the_near_part_is_drawn() -> None:
    flat = np.zeros((2, 2, 3))
    flat[..., :2] = np.stack(np.meshgrid([0, 1], [0, 1]), axis=2)
    steep = flat.copy()
    steep[..., 2] = 1e-3 + steep[..., 0]
    near = ls.Surface(blocks=[ls.Block(steep), ls.Block(flat)])
    far = ls.Surface(blocks=[ls.Block(flat), ls.Block(steep)])
    assert np.array_equal(shades(near), shades(far))


def test_points_in_a_plane_have_the_shades_of_an_attribute() -> None:
    points = np.stack(np.meshgrid(np.arange(20.0), np.arange(15.0)), axis=2)
    block = ls.Block(points, attributes={"name": np.full((15, 20, 3), 5.0), "heat": points[..., 0]})
    drawn = shades(ls.Surface(blocks=[block]))
    middle = drawn[HEIGHT // 2]
    assert (np.diff(middle[middle > 0].astype(int)) >= 0).all()
    assert (middle.max(), middle[middle > 0].min()) == (15, 1)
    assert len(np.unique(shades(points))) == 2, "without one it is flat"


def test_where_no_point_has_a_neighbour_there_is_none() -> None:
    assert thumbnail_pixels(ls.Surface(np.where(np.indices((9, 9)).sum(axis=0) % 2, np.nan, 1.0))) is None


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (2, 2), (2, 5000)])
@pytest.mark.parametrize("channels", [None, 2, 3, 5])
def test_surfaces_of_every_shape_are_drawn(shape: tuple[int, int], channels: int | None) -> None:
    points = np.random.default_rng(3).normal(size=shape if channels is None else (*shape, channels))
    assert shades(points).any()


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30, 1e300])
@pytest.mark.parametrize("channels", [None, 3])
def test_numbers_of_any_size_are_drawn_or_not_but_raise_nothing(scale: float, channels: int | None) -> None:
    points = np.random.default_rng(4).normal(size=(12, 9) if channels is None else (12, 9, channels)) * scale
    pixels = thumbnail_pixels(ls.Surface(points))
    assert pixels is None or len(pixels) == PIXEL_BYTES


def test_of_very_many_blocks_there_is_none() -> None:
    block = ls.Block(np.zeros((2, 2, 3)))
    assert thumbnail_pixels(ls.Surface(blocks=[block] * (MOST_BLOCKS + 1))) is None
