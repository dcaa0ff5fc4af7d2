"""Text of any kind in metadata and names, handed to every other library: it arrives, or is refused with the reason."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.page import HOW_TO_BUILD, widget_modules

TEXTS = {
    "not ASCII": "Höhe Ωμ² 北 🗻",
    "NUL": "a\0b",
    "newlines": "a\nb\r\nc",
    "escape": "a\x1b[31mb",
    "markup": "<b>&\"']]>$^{",
    "empty": "",
    "4 KB": "x" * 4096,
    "4 KB, not ASCII": "é" * 2048,
}
WORDS = ("name", "unit", "crs")
PLACES = (*WORDS, "foreign", "tag", "attribute")
METADATA = PLACES[:-1]
HEIGHTS = np.arange(12, dtype=np.int32).reshape(3, 4)


def surface_with(text: str, *places: str) -> ls.Surface:
    """A surface that has a text in some places."""
    attributes = {text: HEIGHTS.astype(np.float32)} if "attribute" in places else {}
    metadata: dict[str, Any] = {word: text for word in WORDS if word in places}
    if "foreign" in places:
        metadata["foreign"] = {"org.example": {"key": text}}
    if "tag" in places:
        metadata["tags"] = {"": {"key": text}}
    return ls.Surface(HEIGHTS, attributes=attributes, metadata=metadata)


def by_pyvista(surface: ls.Surface, folder: Path) -> ls.Surface:
    pytest.importorskip("pyvista")
    return ls.Surface.from_pyvista(surface.to_pyvista())


def by_reader_of_pyvista(surface: ls.Surface, folder: Path) -> ls.Surface:
    pyvista = pytest.importorskip("pyvista")
    (folder / "a.lode").write_bytes(ls.encode(surface))
    return ls.Surface.from_pyvista(pyvista.read(folder / "a.lode"))


def by_trimesh(surface: ls.Surface, folder: Path) -> ls.Surface:
    pytest.importorskip("trimesh")
    return ls.Surface.from_trimesh(surface.to_trimesh())


def by_xarray(surface: ls.Surface, folder: Path) -> ls.Surface:
    pytest.importorskip("xarray")
    return ls.Surface.from_xarray(surface.to_xarray())


def by_engine_of_xarray(surface: ls.Surface, folder: Path) -> None:
    xarray = pytest.importorskip("xarray")
    (folder / "a.lode").write_bytes(ls.encode(surface))
    with xarray.open_dataset(folder / "a.lode", engine="lode") as dataset:
        assert dataset.load()


def by_html(surface: ls.Surface, folder: Path) -> None:
    shown = surface._repr_html_()
    assert not any(character in shown for character in "\0\x1b\r")
    assert "<b>" not in shown


def by_picture(surface: ls.Surface, folder: Path) -> None:
    pytest.importorskip("matplotlib")
    from lodestream_client.program import main

    (folder / "a.lode").write_bytes(ls.encode(surface))
    assert main(["view", str(folder / "a.lode"), "--png", str(folder / "a.png")]) == 0


def by_widget(surface: ls.Surface, folder: Path) -> None:
    pytest.importorskip("anywidget")
    if widget_modules() is None:
        pytest.skip(HOW_TO_BUILD)
    from lodestream_client import Widget

    Widget(surface).close()


LIBRARIES: dict[str, Callable[[ls.Surface, Path], ls.Surface | None]] = {
    "pyvista": by_pyvista,
    "pyvista.read": by_reader_of_pyvista,
    "trimesh": by_trimesh,
    "xarray": by_xarray,
    "engine of xarray": by_engine_of_xarray,
    "HTML": by_html,
    "picture": by_picture,
    "widget": by_widget,
}

#: Those that take long get a text in all places at once, others in one place after the other.
SLOW = ("engine of xarray", "picture", "widget")
HANDED = [
    *((library, place) for library in LIBRARIES if library not in SLOW for place in PLACES),
    *((library, "everywhere") for library in SLOW),
]

#: What xarray's conventions take for nothing.
LOST = {("xarray", "empty", "unit"), ("xarray", "empty", "crs")}


@pytest.mark.sweep(88)
@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize(("library", "place"), HANDED)
@pytest.mark.long
def test_any_text_reaches_every_library(library: str, text: str, place: str, tmp_path: Path) -> None:
    surface = surface_with(TEXTS[text], *(PLACES if place == "everywhere" else (place,)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ls.FormatWarning)
        back = LIBRARIES[library](surface, tmp_path)
    if back is not None and place in WORDS and (library, text, place) not in LOST:
        assert back.metadata[place] == TEXTS[text]


#: Readable again with what is written; of the others a reader needs more than one file, or there is none.
WRITTEN = (".nc", ".zarr", ".tif", ".cog.tif", ".vts", ".obj", ".ply", ".asc", ".png", ".npz", ".npy")
UNREAD = (".vtm", ".glb")
NEEDS = {".nc": "h5netcdf", ".zarr": "zarr", ".tif": "rasterio", ".cog.tif": "rasterio", ".asc": "rasterio"}
NEEDS |= {".vts": "vtkmodules", ".png": "PIL"}

#: What a format cannot hold, and says so.
REFUSED = {(".zarr", "4 KB"), (".zarr", "4 KB, not ASCII")}


@pytest.mark.sweep(52)
@pytest.mark.parametrize("places", [METADATA, ("attribute",)], ids=["metadata", "attribute"])
@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("suffix", [*WRITTEN, *UNREAD])
@pytest.mark.long
def test_any_text_is_written_and_what_is_written_is_read(
    suffix: str, text: str, places: tuple[str, ...], tmp_path: Path
) -> None:
    if suffix in NEEDS:
        pytest.importorskip(NEEDS[suffix])
    surface, path = surface_with(TEXTS[text], *places), tmp_path / f"a{suffix}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ls.FormatWarning)
        try:
            ls.write(surface, path)
        except ls.FormatError:
            assert (suffix, text) in REFUSED
            return
        if suffix in UNREAD:
            assert path.stat().st_size > 0
            return
        back = ls.read(path)
    heights = back.points if back.points.ndim == 2 else back.points[..., 2]
    assert np.array_equal(np.sort(heights, axis=None), np.arange(12))  # some formats begin with the last row


@pytest.mark.sweep(10)
@pytest.mark.parametrize("place", ["name", "unit", "crs", "tag", "attribute"])
@pytest.mark.parametrize("suffix", [".nc", ".tif", ".cog.tif", ".vts", ".obj"])
def test_nul_is_written_as_python_writes_it_with_a_note(suffix: str, place: str, tmp_path: Path) -> None:
    """Libraries in C end a text there, or refuse it: what comes behind is not lost, and nobody is refused for it."""
    if suffix in NEEDS:
        pytest.importorskip(NEEDS[suffix])
    path = tmp_path / f"a{suffix}"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ls.FormatWarning)
        ls.write(surface_with("a\0b", place), path)
        notes = [str(it.message) for it in caught]
        back = ls.read(path)
    assert any(
        words in note
        for note in notes
        for words in ("which are written as Python writes them", "without tags", "without a b", "as a\\x00b")
    )
    if place == "unit":
        assert back.metadata["unit"] == "a\\x00b"
    if place == "tag" and suffix in (".tif", ".cog.tif"):
        assert "a\\x00b" in [value for tags in back.metadata["tags"].values() for value in tags.values()]
    if place == "attribute" and suffix in (".tif", ".cog.tif"):
        assert list(back.attributes) == ["a\\x00b"]
