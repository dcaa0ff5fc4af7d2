"""STL, binary and text: a grid stays one, any other mesh is resampled if that is asked for."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream import formats
from tests.core.remesh import scenes

pytest.importorskip("trimesh")


def binary(triangles: NDArray[np.float64], colour: int = 0, head: bytes = b"") -> bytes:
    """A file of triangles, (T, 3, 3)."""
    rows = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("colour", "<u2")])
    rows["corners"], rows["colour"] = triangles, colour
    return head.ljust(80, b"\0") + struct.pack("<I", len(triangles)) + rows.tobytes()


def text(triangles: NDArray[np.float64]) -> bytes:
    facets = [
        "facet normal 0 0 0\n outer loop\n"
        + "".join(f"  vertex {x!r} {y!r} {z!r}\n" for x, y, z in corners)
        + " endloop\nendfacet\n"
        for corners in triangles.tolist()
    ]
    return ("solid thing\n" + "".join(facets) + "endsolid thing\n").encode()


def grid(rows: int = 5, columns: int = 7) -> NDArray[np.float64]:
    """The triangles of a bent grid."""
    r, c = np.indices((rows, columns))
    points = np.stack([r, c, r * c / 8], axis=-1)
    a, b, d, e = points[:-1, :-1], points[:-1, 1:], points[1:, :-1], points[1:, 1:]
    return np.stack([np.stack([a, b, e], axis=2), np.stack([a, e, d], axis=2)], axis=2).reshape(-1, 3, 3).astype(float)


@pytest.mark.parametrize("content", [binary(grid()), text(grid()), binary(grid(), head=b"solid, but binary")])
@pytest.mark.parametrize("name", ["a.stl", "A.STL"])
def test_a_grid_stays_one(content: bytes, name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    for surface in (ls.read(path), ls.read(path, remesh="yes")):
        assert (surface.shape, surface.points.dtype.name, surface.metadata["format"]) == ((5, 7), "float32", "stl")
        assert len(np.unique(surface.points.reshape(-1, 3), axis=0)) == 35


@pytest.mark.parametrize("kind", [binary, text])
def test_any_other_mesh_is_refused_with_the_option_and_resampled_with_it(kind: object, tmp_path: Path) -> None:
    points, faces = scenes.sphere()
    path = tmp_path / "ball.stl"
    path.write_bytes(kind(points[faces]))  # type: ignore[operator]
    with pytest.raises(ls.FormatError, match=r"ball\.stl: .*; remesh=yes resamples"):
        ls.read(path)
    pytest.importorskip("igl")
    surface = ls.read(path, remesh="yes", blocks="12", remesh_error="1e-2")
    assert 8 <= len(surface.blocks) <= 20
    assert surface.metadata["remesh"]["rms_from_input"] < 1e-2 * surface.metadata["remesh"]["diagonal"]


def test_text_is_known_without_a_name() -> None:
    assert formats.formats()[0].name == "npy"
    stl = next(row for row in formats.formats() if row.name == "stl")
    assert stl.sniff(text(grid())[:4096], "")
    assert not stl.sniff(b"solid ground\nand more of a text", "")


def test_colours_are_left_out_with_a_note(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(binary(grid(), 0x8421))
    with pytest.warns(ls.FormatWarning, match="colours of faces left out"):
        ls.read(tmp_path / "a.stl")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            binary(grid())[:-1],
            "cut short or damaged: .* 2,483 bytes are not the 2,484 of the 48 triangles",
        ),
        (b"\0" * 80 + b"\xff" * 4, "84 bytes are not the 214,748,364,834 of the 4,294,967,295 triangles"),
        (b"\0" * 84, "this STL has no triangles"),
        (b"solid a\nendsolid a\n", "this STL has no triangles"),
        (
            text(grid()).replace(b"vertex 1.0", b"vertex one"),
            "trimesh cannot read this STL, which may be damaged or cut",
        ),
        (text(grid())[:300], "this STL has no triangles"),
        (b"solid", "is no text that begins with a solid"),
    ],
)
def test_what_is_no_stl_is_refused(content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(content)
    with pytest.raises(ls.FormatError, match=words) as caught:
        ls.read(tmp_path / "a.stl")
    assert "\n" not in str(caught.value)


def test_more_triangles_than_allowed_are_refused_before_they_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(binary(grid(40, 40)))
    with pytest.raises(ls.TooLargeError):
        ls.read(tmp_path / "a.stl", max_vertices=1000)
