"""PNG: shades of grey and the two codes of colours in; 16-bit shades out, with what undoes them."""

from __future__ import annotations

import json
import struct
import sys
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import formats
from lodestream.errors import FormatError, FormatWarning, OptionError, UnavailableError
from lodestream.surface import Surface

pytest.importorskip("PIL")
from PIL import Image

from .test_hostile_grids import chunk

Array = NDArray[Any]


def save(path: Path, pixels: Array, **options: Any) -> Path:
    Image.fromarray(pixels).save(path, **options)
    return path


def shades(dtype: Any, shape: tuple[int, int] = (7, 11)) -> Array:
    limit = np.iinfo(dtype).max
    return (np.arange(shape[0] * shape[1]).reshape(shape) * 8191 % (limit + 1)).astype(dtype)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_shades_are_heights(tmp_path: Path, dtype: str) -> None:
    surface = formats.read(save(tmp_path / "a.png", shades(dtype)))
    np.testing.assert_array_equal(surface.points, shades(dtype))
    assert (surface.dtype.name, surface.metadata) == (dtype, {"name": "a", "format": "png"})
    assert formats.read(tmp_path / "a.png", encoding="grey").metadata == surface.metadata


def test_transparent_shades_are_holes(tmp_path: Path) -> None:
    grey = shades(np.uint8)
    alpha = np.where(grey % 5 > 0, 255, 0).astype(np.uint8)
    surface = formats.read(save(tmp_path / "a.png", np.dstack((grey, alpha))))
    np.testing.assert_array_equal(surface.points, grey)
    np.testing.assert_array_equal(surface.mask, alpha > 0)
    wide = shades(np.uint16)
    surface = formats.read(save(tmp_path / "b.png", wide, transparency=int(wide[3, 3])))
    np.testing.assert_array_equal(surface.mask, wide != wide[3, 3])


@pytest.mark.parametrize("shape", [(7, 11), (2, 3), (1, 2), (16, 16)])
def test_interlaced_pixels_are_counted_pass_by_pass(tmp_path: Path, shape: tuple[int, int]) -> None:
    grey = shades(np.uint8, shape)
    passes = [(0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1)]
    parts = [grey[top::down, left::right] for top, left, down, right in passes]
    data = b"".join(b"\0" + row.tobytes() for part in parts if part.size for row in part)
    header = struct.pack(">IIBBBBB", shape[1], shape[0], 8, 0, 0, 0, 1)
    ends = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header), chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(ends[0] + chunk(b"IDAT", zlib.compress(data)) + ends[1])
    np.testing.assert_array_equal(formats.read(tmp_path / "a.png").points, grey)
    (tmp_path / "a.png").write_bytes(ends[0] + chunk(b"IDAT", zlib.compress(data[:-1])) + ends[1])
    with pytest.raises(FormatError, match=f"whole PNG of {len(data)} bytes of pixels, got {len(data) - 1}"):
        formats.read(tmp_path / "a.png")


@pytest.mark.parametrize("alpha", [False, True])
def test_colours_are_what_the_option_says(tmp_path: Path, alpha: bool) -> None:
    rng = np.random.default_rng(3)
    colours = rng.integers(0, 256, (6, 8, 4 if alpha else 3)).astype(np.uint8)
    if alpha:
        colours[..., 3] = np.where(colours[..., 0] > 99, 255, 0)
    path = save(tmp_path / "a.png", colours)
    red, green, blue = (colours[..., channel].astype(np.float64) for channel in range(3))
    terrain = formats.read(path, encoding="terrain-rgb")
    assert terrain.points.tobytes() == (-10000 + 0.1 * (65536 * red + 256 * green + blue)).tobytes()
    terrarium = formats.read(path, encoding="terrarium")
    assert terrarium.dtype == np.float32
    np.testing.assert_array_equal(terrarium.points.astype(np.float64), 256 * red + green + blue / 256 - 32768)
    for surface in (terrain, terrarium):
        if alpha:
            np.testing.assert_array_equal(surface.mask, colours[..., 3] > 0)
        else:
            assert surface.mask is None
    np.testing.assert_array_equal(formats.read(path, filename="tile_terrarium.png").points, terrarium.points)
    with pytest.raises(FormatError, match="got colours: give their meaning with encoding=terrain-rgb or encoding=ter"):
        formats.read(path)
    for wrong in ("grey", "mars"):
        with pytest.raises(OptionError, match=f"encoding=.*got '{wrong}'"):
            formats.read(path, encoding=wrong)
    with pytest.raises(OptionError, match="expected encoding=grey for grey levels, got 'terrarium'"):
        formats.read(save(tmp_path / "b.png", shades(np.uint8)), encoding="terrarium")


def surfaces() -> dict[str, Array]:
    rng = np.random.default_rng(5)
    return {
        "shades": shades(np.uint16),
        "bytes": shades(np.uint8),
        "below zero": shades(np.int16) - np.int16(9026),
        "steps": (shades(np.int32) * 20 - 10**6).astype(np.int32),
        "decimals": np.round(rng.random((7, 11)) * 300 - 10, 2),
        "decimals float32": np.round(rng.random((7, 11)) * 300 - 10, 1).astype(np.float32),
        "terrain-rgb": -10000 + 0.1 * (100000 + rng.integers(0, 40000, (7, 11))),
        "halves": rng.integers(-4000, 4000, (7, 11)) / 32,
        "constant": np.full((7, 11), 7.25),
    }


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("name", list(surfaces()))
def test_heights_of_few_steps_come_back_bit_for_bit(tmp_path: Path, name: str, holes: bool) -> None:
    heights = surfaces()[name]
    mask = np.ones(heights.shape, np.bool_)
    mask[2:4, 5:] = not holes
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)
        formats.write(Surface(heights, mask=mask, metadata={"nodata": 3}), tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        assert image.mode == "I;16"
        if name in ("shades", "bytes"):
            np.testing.assert_array_equal(np.asarray(image)[mask], heights[mask])
    surface = formats.read(tmp_path / "a.png")
    assert surface.dtype == heights.dtype
    assert surface.points[mask].tobytes() == heights[mask].tobytes()
    assert (surface.mask is None) == (not holes)
    if surface.mask is not None:
        np.testing.assert_array_equal(surface.mask, mask)


def test_heights_of_many_steps_are_rounded_and_that_is_said(tmp_path: Path) -> None:
    heights = np.random.default_rng(7).normal(size=(400, 300)) * 1000
    mask = heights < 2000
    with pytest.warns(FormatWarning, match="heights are rounded to steps of"):
        formats.write(Surface(heights, mask=mask), tmp_path / "a.png")
    surface = formats.read(tmp_path / "a.png")
    np.testing.assert_array_equal(surface.mask, mask)
    step = np.ptp(heights[mask]) / 65534
    assert np.abs(surface.points - heights)[mask].max() <= step * 0.51
    full = Surface(
        np.arange(65536 + 4, dtype=np.uint32).reshape(-1, 4) % 65536, mask=np.arange(65540).reshape(-1, 4) > 3
    )
    with pytest.warns(FormatWarning, match="rounded to steps of 1.00002"):
        formats.write(full, tmp_path / "a.png")


def test_shifted_heights_are_announced_and_their_rule_is_a_text(tmp_path: Path) -> None:
    with pytest.warns(FormatWarning, match="shifted and scaled to them; a text chunk has the rule"):
        formats.write(Surface(np.array([[-3, 5], [7, 9]], np.int16)), tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        rule = json.loads(image.text["lodestream"])  # type: ignore[attr-defined]
        made = ((np.asarray(image, np.float64) + rule["first"]) * rule["step"] + rule["origin"]) / rule["scale"]
    assert made.tolist() == [[-3, 5], [7, 9]]
    assert rule["dtype"] == "int16"


def test_what_a_png_cannot_hold_is_said(tmp_path: Path) -> None:
    metadata = {"crs": "here", "geotransform": [0, 1, 0, 0, 0, 1], "unit": "m"}
    surface = Surface(shades(np.uint16), (True, False), attributes={"n": shades(np.uint8)}, metadata=metadata)
    with pytest.warns(FormatWarning, match="PNG holds heights only: crs, geotransform, unit, closure, n left out"):
        formats.write(surface, tmp_path / "a.png")


def test_other_pngs_are_refused(tmp_path: Path) -> None:
    palette = Image.fromarray(shades(np.uint8)).convert("P")
    palette.save(tmp_path / "a.png")
    with pytest.raises(FormatError, match="got a palette of 8 bits"):
        formats.read(tmp_path / "a.png")
    Image.fromarray(shades(np.uint8) > 99).save(tmp_path / "b.png")
    with pytest.raises(FormatError, match=r"expected grey of 8 or 16 bits, .* got grey of 1 bits"):
        formats.read(tmp_path / "b.png")
    whole = save(tmp_path / "c.png", shades(np.uint16)).read_bytes()
    for length in (0, 8, 20, 40, len(whole) // 2, len(whole) - 30):
        (tmp_path / "d.png").write_bytes(whole[:length])
        with pytest.raises(FormatError, match="expected" if length else "this is an empty file"):
            formats.read(tmp_path / "d.png")


def test_a_png_without_its_library_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save(tmp_path / "a.png", shades(np.uint8))
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(UnavailableError, match=r"pip install 'lodestream\[formats\]'"):
        formats.read(path)
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(UnavailableError, match=r"expected Pillow for PNG, .*pip install 'lodestream\[formats\]'"):
        formats.write(Surface(shades(np.uint8)), path)
