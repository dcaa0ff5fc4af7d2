"""PNG: heights as shades of grey, or as colours in one of the two codes that map tiles use.

GDAL reads the pixels (`drivers`), Pillow writes them. The header is read before, so that a size is refused before
anything is expanded.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from io import BytesIO
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError, OptionError, UnavailableError
from ...quantization.lattice import Lattice, find_lattice, to_dtype
from ...surface import Surface
from ..notes import listing, metadata_left_out, warn
from ..source import Source, number
from .writing_heights import even_heights

__all__ = ["READ_OPTIONS", "check", "heights", "named", "sniff", "write"]

READ_OPTIONS = {
    "encoding": "meaning of the pixels: grey, terrain-rgb or terrarium (default: grey for grey levels; for colours "
    "as the file's name says)"
}

_MAGIC = b"\x89PNG\r\n\x1a\n"
_GREY, _RGB, _PALETTE, _GREY_ALPHA, _RGBA = 0, 2, 3, 4, 6
_CHANNELS = {_GREY: 1, _RGB: 3, _GREY_ALPHA: 2, _RGBA: 4}
_KINDS = {
    _GREY: "grey",
    _RGB: "colours",
    _PALETTE: "a palette",
    _GREY_ALPHA: "grey with alpha",
    _RGBA: "colours with alpha",
}
_ENCODINGS = ("grey", "terrain-rgb", "terrarium")
_WHITE = 65535

#: Left, top, and steps to the right and down of the passes of an interlaced image.
_INTERLACED = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
_PIECE = 1 << 20

#: Key of a text in the file: JSON with first, origin, step and scale, where heights are
#: (origin + step (first + shade)) / scale, in dtype; or with encoding, what its colours stand for.
_TEXT = "lodestream"

#: Texts that are read, or say nothing but by what the file was written.
_KNOWN_TEXTS = (_TEXT, "Software")


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins like PNG."""
    return head.startswith(_MAGIC)


def named(name: str) -> Mapping[str, str]:
    """Return the code of colours that a file's name suggests."""
    words = name.lower().replace("_", "-")
    for encoding, clues in (("terrarium", ("terrarium",)), ("terrain-rgb", ("terrain-rgb", "terrainrgb"))):
        if any(clue in words for clue in clues):
            return {"encoding": encoding}
    return {}


def require_pillow() -> Any:
    """Import and return Pillow's module for PNG."""
    try:
        from PIL import PngImagePlugin
    except ImportError:
        raise UnavailableError(
            "expected Pillow for PNG, which is not installed: pip install 'lodestream[formats]'"
        ) from None
    return PngImagePlugin


def heights(surface: Surface, source: Source) -> Surface:
    """Convert the bands of a PNG to heights: the shades themselves, or the values that the colours encode.

    Parameters
    ----------
    surface : Surface
        As GDAL reads it: a band as points, shape (row, column), the others as attributes; transparent pixels are holes.
    source : Source

    Raises
    ------
    FormatError
        If it is not said what the colours stand for, or the rule in the file's text is none.
    OptionError
        If the option ``encoding`` does not fit the file.
    """
    texts = dict(surface.metadata.get("tags", {}).get("", {}))
    rule = _rule(texts.pop(_TEXT, None))
    words = [key for key in texts if key not in _KNOWN_TEXTS]
    if words:
        warn(f"left out texts of the PNG: {listing(words)}")
    metadata = source.metadata("png")
    if not surface.attributes:
        if _encoding(source, colours=False, text=rule) == "grey" and "dtype" in rule:
            return Surface(_shaded(surface.points, rule), mask=surface.mask, metadata=metadata)
        return Surface(surface.points, mask=surface.mask, metadata=metadata)
    encoding = _encoding(source, colours=True, text=rule)
    code = np.zeros(surface.shape, np.float64)
    for band in (surface.points, *surface.attributes.values()):
        code = code * 256 + band
    values = (code / 256 - 32768).astype(np.float32) if encoding == "terrarium" else -10000 + 0.1 * code
    return Surface(values, mask=surface.mask, metadata=metadata | {"encoding": encoding})


def check(source: Source) -> None:
    """Refuse a PNG that is too large, has pixels of a kind without heights, or fewer pixels than it announces.

    Raises
    ------
    FormatError, TooLargeError
    """
    with source.path.open("rb") as file:
        head = file.read(33)
    if len(head) < 33 or head[8:16] != b"\0\0\0\rIHDR":
        raise FormatError(f"expected a PNG that begins with its header of 33 bytes, got {len(head)} other bytes")
    width, height, depth, kind = struct.unpack(">IIBB", head[16:26])
    source.check_array((height, width), np.dtype(np.uint8))
    if kind not in _CHANNELS or (depth != 8 and (kind, depth) != (_GREY, 16)):
        got = f"{_KINDS.get(kind, f'kind {kind}')} of {depth} bits"
        raise FormatError(f"expected grey of 8 or 16 bits, or grey with alpha or colours of 8, got {got}")
    source.check_expansion(height * width * depth // 8 * _CHANNELS[kind])
    _check_pixels(source)


def _check_pixels(source: Source) -> None:
    """Count the decompressed pixels: GDAL would replace missing ones by black."""
    with source.path.open("rb") as file:
        file.seek(16)
        width, height, depth, kind, _, _, interlaced = struct.unpack(">IIBBBBB", file.read(13))
        bits = depth * _CHANNELS[kind]
        passes = _INTERLACED if interlaced else ((0, 0, 1, 1),)
        sizes = ((-(-(width - left) // right), -(-(height - top) // down)) for left, top, right, down in passes)
        wanted = sum(rows * (1 + (columns * bits + 7) // 8) for columns, rows in sizes if columns > 0 and rows > 0)
        file.seek(8)
        expanded, expander = 0, zlib.decompressobj()
        while expanded < wanted and len(head := file.read(8)) == 8:
            length, name = struct.unpack(">I4s", head)
            if name != b"IDAT":
                file.seek(length + 4, 1)
                continue
            while length > 0 and (data := file.read(min(length, _PIECE))):
                length -= len(data)
                try:
                    while data and expanded < wanted:
                        expanded += len(expander.decompress(data, _PIECE))
                        data = expander.unconsumed_tail
                except zlib.error as error:
                    raise FormatError(f"expected a whole PNG, got one with damaged pixels: {error}") from None
            file.seek(length + 4, 1)
    if expanded < wanted:
        raise FormatError(f"expected a whole PNG of {number(wanted)} bytes of pixels, got {number(expanded)}")


def _encoding(source: Source, colours: bool, text: Mapping[str, Any]) -> str:
    chosen = source.options.get("encoding", text.get("encoding"))
    if chosen is not None and chosen not in _ENCODINGS:
        raise OptionError(f"expected encoding= one of {', '.join(_ENCODINGS)}, got {str(chosen)!r}")
    if not colours:
        if chosen not in (None, "grey") and "encoding" in source.options:
            raise OptionError(f"expected encoding=grey for grey levels, got {chosen!r}")
        return "grey"
    if chosen is None:
        raise FormatError(
            "expected grey levels, got colours: give their meaning with encoding=terrain-rgb or encoding=terrarium"
        )
    if chosen == "grey":
        raise OptionError("expected encoding=terrain-rgb or encoding=terrarium for colours, got 'grey'")
    return str(chosen)


def _rule(content: Any) -> dict[str, Any]:
    try:
        rule = json.loads(str(content))
    except ValueError:
        return {}
    return rule if isinstance(rule, dict) else {}


def _shaded(shades: NDArray[Any], rule: Mapping[str, Any]) -> NDArray[Any]:
    """Return heights from shades by the rule in the file's text."""
    try:
        first, origin, step, scale = (float(rule[key]) for key in ("first", "origin", "step", "scale"))
        dtype = np.dtype(str(rule["dtype"]))
        values = ((shades + first) * step + origin) / scale
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise FormatError(f"expected a rule of heights in the text of the PNG, got another one: {error!r}") from None
    if (
        not np.isfinite([first, origin, step, scale]).all()
        or dtype.kind not in "iuf"
        or dtype.itemsize not in (1, 2, 4, 8)
    ):
        raise FormatError(f"expected a rule of heights in the text of the PNG, got {str(dict(rule))[:80]}")
    return to_dtype(values, dtype)


def write(surface: Surface, file: BinaryIO) -> None:
    """Write heights as shades of grey of 16 bits; a shade that no height has is transparent and stands for holes.

    Whole numbers from 0 to 65,535 are the shades. Others, of at most that many different steps, are shifted and scaled
    without loss, and rounded where there are more steps; the rule that undoes it is a text in the file.
    """
    pillow = require_pillow()
    surface = even_heights(surface, "PNG")
    left_out = [*metadata_left_out(surface, ()), *["closure"] * any(surface.closed), *surface.attributes]
    if left_out:
        warn(f"PNG holds heights only: {listing(left_out)} left out")
    shades, rule, clear = _shades(surface)
    info = pillow.PngInfo()
    if rule:
        info.add_text(_TEXT, json.dumps(rule))
    from PIL import Image

    whole = BytesIO()  # Pillow asks for the position, which a pipe has not
    Image.fromarray(shades).save(whole, "PNG", pnginfo=info, **({} if clear is None else {"transparency": clear}))
    file.write(whole.getbuffer())


def _shades(surface: Surface) -> tuple[NDArray[np.uint16], dict[str, Any], int | None]:
    """Return the shades, the rule that restores heights (empty for plain shades), and the shade of holes."""
    points, mask = surface.points, surface.mask
    valid = points if mask is None else points[mask]
    low, high = valid.min(), valid.max()
    rule: dict[str, Any] = {"first": 0, "origin": 0, "step": 1, "scale": 1, "dtype": points.dtype.name}
    holes = int(mask is not None)
    if points.dtype.kind in "iu" and low >= 0 and high <= _WHITE and not (holes and len(np.unique(valid)) > _WHITE):
        shades = points.astype(np.uint16)
        rule = {} if points.dtype == np.uint16 else rule
    else:
        lattice = find_lattice(valid)
        filled = points if mask is None else np.where(mask, points, low)
        if lattice is not None:
            rule |= {"origin": lattice.origin}
            rule |= {"scale": lattice.step} if lattice.rule == "decimal" else {"step": lattice.step}
            whole = lattice.coordinates(filled)
            rule["first"] = int(whole.min())
            steps = int(whole.max()) - rule["first"]
        if lattice is None or steps + holes > _WHITE:
            step = (float(high) - float(low)) / (_WHITE - holes)
            lattice = Lattice("affine", float(low), step)
            rule |= {"first": 0, "origin": float(low), "step": step, "scale": 1}
            whole = lattice.coordinates(filled)
            warn(f"PNG has 65,536 grey levels: heights are rounded to steps of {step:.6g}")
        else:
            warn(
                "PNG has grey levels from 0 to 65,535: heights are shifted and scaled to them; a text chunk has the "
                "rule"
            )
        shades = (whole - rule["first"]).astype(np.uint16)
    if mask is None:
        return shades, rule, None
    used = np.bincount(shades[mask], minlength=_WHITE + 1)
    nodata = surface.metadata.get("nodata")
    wanted = [int(nodata)] if isinstance(nodata, int) and 0 <= nodata <= _WHITE else []
    clear = next(shade for shade in (*wanted, *np.flatnonzero(used == 0).tolist()) if not used[shade])
    return np.where(mask, shades, np.uint16(clear)), rule, clear
