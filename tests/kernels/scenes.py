"""Small uses of Lodestream that together call every kernel: what is recorded, replayed and fuzzed begins with them."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import lodestream as ls
from lodestream.errors import FormatError
from lodestream.formats.pcd.lzf import decompress
from lodestream.mesh.recognise import recognise
from tests.core.mesh.meshes import FaceList, collapse, cut_in_two, grid_faces, mesh_of, scrambled, star
from tests.core.mesh.test_mesh_attributes import sphere, with_texture
from tests.core.surfaces import all_large
from tests.golden.generate import FOLDER, expectations, originals

from .declared import declarations
from .recording import recorded

__all__ = ["SCENES", "check", "seeds"]


def _decode(name: str) -> None:
    """A golden file at every layer and level."""
    expected = _expected()[name]
    if expectations((FOLDER / f"{name}.lode").read_bytes(), "partial" in expected) != expected:
        raise AssertionError(f"expected {name}.lode to decode to what expected.json says")


@cache
def _expected() -> dict[str, Any]:
    found: dict[str, Any] = json.loads((FOLDER / "expected.json").read_text())
    return found


def _encode(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ls.FormatWarning)  # values at holes are left out
        originals()[name].encode()


def _small_surfaces() -> None:
    """What is quickly coded can be changed often: points few, of every kind."""
    rng = np.random.default_rng(1)
    for shape in ((1, 3), (2, 2), (5, 4), (9, 12)):
        steps, offset = rng.integers(-9, 9, shape).cumsum(1), rng.random((shape[0], 1))
        holes = np.where(rng.random(shape) < 0.2, np.nan, steps + offset)
        holes.flat[0] = 1.0
        for values in (
            steps.astype(np.int16),
            (0.3 * (steps + offset)).astype(np.float32),
            rng.normal(size=shape),
            holes,
        ):
            for rms in (None, "5%"):
                ls.decode(ls.encode(ls.Surface(values), rms=rms))


def _large_units() -> None:
    """Units that are large, of few coefficients, cut short and read on: attributes, and levels closed and open."""
    rng = np.random.default_rng(3)
    with all_large():
        for shape, closed in (((9, 12), (False, False)), ((24, 150), (False, True)), ((70, 5), (True, False))):
            rough, few = rng.integers(-900, 900, shape).cumsum(1), np.where(rng.random(shape) < 0.02, 9, 0)
            for values in (rough.astype(np.int32), few.astype(np.int16)):
                container = ls.encode(ls.Surface(values, closed, attributes={"few": few.astype(np.int8)}))
                decoder, chunk = ls.Decoder(), 40 + len(container) // 20
                for start in range(0, len(container), chunk):
                    decoder.feed(container[start : start + chunk])
                    if decoder.layers:
                        decoder.surface()


def _windows() -> None:
    for name in ("heights-int16", "holes-int16", "torus-odd", "attributes-types"):
        decoder = ls.Decoder()
        decoder.feed((FOLDER / f"{name}.lode").read_bytes())
        for view in decoder.layers:
            view.surface()
        rows, columns = decoder.surface().blocks[0].shape
        decoder.layers[-1].window(((rows // 3, rows // 2), (1, columns // 2)))


def _meshes() -> None:
    rng = np.random.default_rng(2)
    open_, ring = grid_faces(5, 7), grid_faces(6, 8, (False, True))
    poles = collapse(collapse(ring, range(8), 0), range(40, 48), 47)
    torn = [face for number, face in enumerate(grid_faces(9, 9)) if number % 17 != 8]
    cases: list[tuple[int, FaceList]] = [
        (35, open_),
        (35, cut_in_two(open_, "main")),
        (48, ring),
        (48, grid_faces(6, 8, (True, True), 3)),
        (48, poles),
        (48, cut_in_two(poles, "anti")),
        star(3, 4),
        star(5, 3),
        (81, torn),
    ]
    for vertices, faces in cases:
        for _ in range(3):
            mesh = mesh_of(scrambled(faces, vertices, rng), vertices, rng)
            with contextlib.suppress(FormatError):  # what is no surface is refused only after its walks
                recognise(mesh).surface()
    for cut in ("", "main"):
        recognise(with_texture(*sphere(5, 7, cut))).surface()


def _compressed_scans() -> None:
    raw = bytes(range(40)) * 3
    packed = b"\x1f" + raw[:32] + b"\x07" + raw[32:40] + bytes([0xE0, 80 - 9, 39])
    assert bytes(decompress(packed, len(raw))) == raw


#: By name. A golden file that comes out otherwise than is written down is an error.
SCENES: dict[str, Callable[[], None]] = {
    **{f"decode {name}": partial(_decode, name) for name in sorted(originals())},
    **{f"encode {name}": partial(_encode, name) for name in sorted(originals())},
    "small surfaces": _small_surfaces,
    "large units": _large_units,
    "windows": _windows,
    "meshes": _meshes,
    "compressed scans": _compressed_scans,
}


def seeds(path: Path, most_bytes: int, most_calls: int) -> None:
    """Record calls of all scenes: so many of each kernel, of no more memory each."""
    with recorded(path, most_bytes, most_calls) as recorder:
        for scene in SCENES.values():
            scene()
    check(recorder.calls)


def check(calls: Mapping[str, int]) -> None:
    """See that every kernel was called.

    Raises
    ------
    AssertionError
        Where one was not: a scene is missing then.
    """
    never = sorted(name for name in declarations() if not calls.get(name))
    if never:
        raise AssertionError(f"expected a scene for every kernel, found none that calls {', '.join(never)}")
