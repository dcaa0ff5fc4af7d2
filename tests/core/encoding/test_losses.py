"""What a format cannot hold comes back by our own reader or is named by a note; without a loss there is none."""

from __future__ import annotations

import json
import struct
import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream import formats
from lodestream.coordinates.height_fields import coordinates, to_xyz
from lodestream.encoding import losses
from lodestream.errors import FormatWarning
from lodestream.surface import Block, Surface
from tests.examples import examples

Array = NDArray[Any]

ROWS, COLUMNS = 7, 9
WKT = 'LOCAL_CS["a grid of our own",UNIT["metre",1]]'
PLACE = [500000.0, 30.0, 0.0, 4100000.0, 0.0, -30.0]

#: Metadata that a surface may have, and the word that a note has for each.
METADATA: dict[str, Any] = {
    "unit": "ft",
    "crs": WKT,
    "scale": 0.5,
    "scalars": {"mach": 0.8},
    "tags": {"": {"SURVEY": "1999"}},
    "description": "bare earth",
    "survey": "north",
}


def attributes() -> dict[str, Array]:
    shape = (ROWS, COLUMNS)
    index = np.arange(ROWS * COLUMNS).reshape(shape)
    normal = np.zeros((*shape, 3), np.float32)
    normal[..., 2] = 1
    return {
        "color": np.stack([index, index * 2 % 256, index * 3 % 256], axis=-1).astype(np.uint8),
        "uv": np.stack([index / 64, 1 - index / 128], axis=-1).astype(np.float32),
        "normal": normal,
        "heat": index / 7,
        "id": 2**60 + index,
        "flow": np.stack([index, -index], axis=-1).astype(np.int16),
        "größe a": index.astype(np.uint16),
        "x": index.astype(np.float32),
        "vtkGhostType": index.astype(np.uint8) % 2,
    }


@st.composite
def surfaces(draw: st.DrawFn) -> Surface:
    dtype = draw(st.sampled_from(["f4", "f8", "i2"]))
    heights = (np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS) * 7 % 31).astype(dtype)
    mask = np.ones(heights.shape, np.bool_)
    if draw(st.booleans()):
        mask[2, 3] = False
    known = attributes()
    chosen = draw(st.lists(st.sampled_from(list(known)), unique=True, max_size=3))
    words = draw(st.lists(st.sampled_from(list(METADATA)), unique=True, max_size=3))
    metadata = {key: METADATA[key] for key in words}
    closed = draw(st.sampled_from([(False, False), (False, False), (True, False), (False, True)]))
    kind = draw(st.sampled_from(["bare", "placed", "uneven", "bent"]))
    if kind in ("placed", "uneven"):
        metadata["geotransform"] = PLACE
    if kind == "uneven":
        x = [500015.0 + 30 * k + (k % 3) * 0.1 for k in range(COLUMNS)]
        metadata["axes"] = {"x": [*x, "values"], "y": [4099985.0, -30.0]}
    if kind == "bent":
        y, x = np.mgrid[:ROWS, :COLUMNS].astype(np.float32)
        points = np.stack([x + y * y / 16, y + x * x / 32, heights.astype(np.float32)], axis=-1)
        return Surface(points, closed, mask=mask, attributes={name: known[name] for name in chosen}, metadata=metadata)
    return Surface(heights, closed, mask=mask, attributes={name: known[name] for name in chosen}, metadata=metadata)


def noted(action: Callable[[], Any]) -> tuple[Any, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = action()
    assert all(warning.category is FormatWarning for warning in caught), [str(warning.message) for warning in caught]
    notes = [str(warning.message) for warning in caught]
    assert all(note.isprintable() and len(note) < 1000 for note in notes)
    return result, notes


def valid(surface: Surface) -> Array:
    return np.ones(surface.shape, np.bool_) if surface.mask is None else surface.mask


def equal(one: Array, other: Array, where: Array) -> bool:
    if one.size != other.size or one.shape[:2] != where.shape:
        return False
    one, other = (array.reshape(*where.shape, -1)[where] for array in (one, other))
    return np.array_equal(one, other.astype(one.dtype), equal_nan=one.dtype.kind == "f")


def same_attribute(back: Mapping[str, Array], name: str, values: Array, where: Array) -> bool:
    parts = [back.get(f"{name}_{part}") for part in range(values.shape[-1])] if values.ndim == 3 else []
    if name not in back and parts and all(part is not None for part in parts):
        return equal(values, np.stack([part for part in parts if part is not None], axis=-1), where)  # bands
    if name not in back:
        return False
    if name == "color" and back[name].dtype.kind == "f":
        return equal((values / 255).astype(np.float32), back[name], where)
    return equal(values, back[name], where)


def lost(surface: Surface, back: Surface) -> list[str]:
    """The words of all that did not come back."""
    if surface.shape != back.shape:
        return ["closure"]
    where = valid(surface)
    words = [] if np.array_equal(where, valid(back)) else ["holes"]
    if surface.points.ndim == back.points.ndim:
        assert equal(surface.points, back.points, where)
    else:
        assert equal(to_xyz(surface).points.astype(np.float64), to_xyz(back).points.astype(np.float64), where)
    if surface.points.ndim == back.points.ndim == 2:
        steps = [
            np.abs(one - other).max() / 30 for one, other in zip(coordinates(surface), coordinates(back), strict=True)
        ]
        words += ["geotransform"] * bool(max(steps) > 1e-6)
    words += ["clos"] * (surface.closed != back.closed)
    kept = {name: same_attribute(back.attributes, name, it, where) for name, it in surface.attributes.items()}
    kept |= {key: surface.metadata[key] == back.metadata.get(key) for key in METADATA if key in surface.metadata}
    if "crs" in back.metadata and not kept.get("crs", True):
        kept["crs"] = same_crs(surface.metadata["crs"], back.metadata["crs"])
    return words + [name for name, came_back in kept.items() if not came_back]


def same_crs(one: str, other: str) -> bool:
    from rasterio.crs import CRS

    return bool(CRS.from_wkt(one) == CRS.from_wkt(other))


@pytest.mark.parametrize("suffix", ["npy", "tif", "png", "obj", "ply"])
@given(surface=surfaces())
@examples(30)
def test_what_does_not_come_back_is_named_and_nothing_else_is(suffix: str, surface: Surface) -> None:
    pytest.importorskip({"tif": "rasterio", "png": "PIL"}.get(suffix, "numpy"))
    check_losses(suffix, surface)


@given(surface=surfaces())
@examples(5)  # each of which is read in a process of its own
def test_what_does_not_come_back_from_a_vts_is_named_and_nothing_else_is(surface: Surface) -> None:
    pytest.importorskip("vtkmodules")
    check_losses("vts", surface)


def check_losses(suffix: str, surface: Surface) -> None:
    if suffix in ("tif", "png") and surface.points.ndim == 3:
        return  # refused, see the tests of each
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{suffix}"
        _, notes = noted(lambda: formats.write(surface, path))
        back, _ = noted(lambda: formats.read(path, closed="none" if suffix in ("tif", "png", "npy") else "auto"))
    words = lost(surface, back)
    for word in words:
        shown = {"geotransform": ("geotransform", "evenly spaced"), "holes": ("hole",)}.get(word, (word,))
        assert any(it in note for note in notes for it in shown), (word, notes)
    allowed = ["PNG has grey levels from", "VTS is written with the attribute vtkGhostType as vtkGhostType_"]
    if not words:
        assert [note for note in notes if not any(note.startswith(it) for it in allowed)] == []


@given(surface=surfaces())
def test_a_glb_names_what_it_has_not(surface: Surface) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.glb"
        _, notes = noted(lambda: formats.write(surface, path))
        content = path.read_bytes()
    length = struct.unpack_from("<I", content, 12)[0]
    extras = json.loads(content[20 : 20 + length])["asset"].get("extras", {})
    for key in METADATA.keys() & surface.metadata.keys():
        assert extras.get(key) == METADATA[key] or any(key in note for note in notes)
    for name, values in surface.attributes.items():
        exact = np.array_equal(values.astype(np.float32).astype(np.float64), values.astype(np.float64))
        assert (exact and abs(int(values.max())) < 2**53) != any(name in note for note in notes), (name, notes)


QUAD = "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 0 1 0\nv 1 1 0\nv 2 1 0\n"
PLY = """ply
format ascii 1.0
comment unit m
comment crs LOCAL_CS["x"]
comment made by hand
element vertex {vertices}
property float x
property float y
property float z
{more}{elements}end_header
"""
PCD = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 2\nVIEWPOINT {}\nPOINTS 4\nDATA ascii\n{}"
CORNERS = "0 0 0\n1 0 0\n0 1 0\n1 1 0\n"
LEGACY = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_GRID\n{}DIMENSIONS 2 2 1\nPOINTS 4 float\n" + CORNERS
FACE = "element face 1\nproperty list uchar int vertex_indices\n"
GRID = "obj_info num_rows 2\nobj_info num_cols 2\nelement range_grid 4\nproperty list uchar int vertex_indices\n"

READ: dict[str, tuple[str, str, list[str]]] = {
    "OBJ, nothing": ("a.obj", QUAD + "o one\ns off\nf 1 2 5 4\nf 2 3 6 5\n", []),
    "OBJ, groups": ("a.obj", QUAD + "g one\nf 1 2 5 4\ng two\nf 2 3 6 5\n", ["groups and objects (g) left out"]),
    "OBJ, materials": ("a.obj", QUAD + "usemtl red\nf 1 2 5 4\nf 2 3 6 5\n", ["materials (usemtl) left out"]),
    "OBJ, smoothing": ("a.obj", QUAD + "s 1\nf 1 2 5 4\ns 2\nf 2 3 6 5\n", ["smoothing groups (s) left out"]),
    "OBJ, lines": ("a.obj", QUAD + "f 1 2 5 4\nf 2 3 6 5\nl 1 2\n", ["lines (l) beside faces left out"]),
    "OBJ, vt": (
        "a.obj",
        QUAD + "vt 0 0\nf 1 2 5 4\nf 2 3 6 5\n",
        ["places in a texture (vt) that no face names left out"],
    ),
    "OBJ, vt of some": (
        "a.obj",
        QUAD + "vt 0 0\nf 1/1 2/1 5/1 4/1\nf 2 3 6 5\n",
        ["uv left out: not on all faces"],
    ),
    "OBJ, vn of a curve": (
        "a.obj",
        QUAD + "vn 0 0 1\nl 1 2 3 4 5 6\n",
        ["normals (vn) that no face names left out"],
    ),
    "OBJ, alone": ("a.obj", QUAD + "v 9 9 9\nf 1 2 5 4\nf 2 3 6 5\n", ["1 vertex without a face left out"]),
    "OFF": ("a.off", "OFF\n4 1 0\n" + CORNERS + "4 0 1 3 2 255 0 0\n", ["colours of faces left out"]),
    "PLY": (
        "a.ply",
        PLY.format(vertices=4, more="", elements=FACE + "property uchar red\nelement camera 1\nproperty int n\n")
        + CORNERS
        + "4 0 1 3 2 7\n5\n",
        ["red of faces left out", "element camera left out"],
    ),
    "PLY, lists": (
        "a.ply",
        PLY.format(vertices=4, more="property list uchar int near\n", elements=FACE)
        + CORNERS.replace("\n", " 1 7\n")
        + "4 0 1 3 2\n",
        ["list near of vertices left out"],
    ),
    "PLY, curve": (
        "a.ply",
        PLY.format(
            vertices=4, more="", elements="element edge 3\nproperty int vertex1\nproperty int vertex2\nproperty int w\n"
        )
        + CORNERS
        + "0 1 5\n1 2 5\n2 3 5\n",
        ["w of edges left out"],
    ),
    "PLY, range grid": (
        "a.ply",
        PLY.format(vertices=5, more="", elements=GRID) + CORNERS + "9 9 9\n1 0\n1 1\n0\n1 3\n",
        ["2 vertices without a place left out"],
    ),
    "PCD": ("a.pcd", PCD.format("1 2 3 1 0 0 0", CORNERS), ["VIEWPOINT 1 2 3 1 0 0 0 left out"]),
    "PCD, nothing": ("a.pcd", PCD.format("0 0 0 1 0 0 0", CORNERS), []),
    "VTK": (
        "a.vtk",
        LEGACY.format("FIELD f 1\nTIME 1 1 double\n3.5\n")
        + "CELL_DATA 1\nSCALARS area float\nLOOKUP_TABLE default\n1\n",
        ["left out data that do not belong to points: TIME, area"],
    ),
    "VTK, nothing": ("a.vtk", LEGACY.format(""), []),
}


@pytest.mark.parametrize("case", READ)
def test_what_a_reader_does_not_keep_is_named(tmp_path: Path, case: str) -> None:
    name, content, expected = READ[case]
    if name.endswith("vtk"):
        pytest.importorskip("vtkmodules")
    (tmp_path / name).write_text(content)
    surface, notes = noted(lambda: formats.read(tmp_path / name))
    assert notes == expected
    if name.endswith("ply"):
        assert (surface.metadata["unit"], surface.metadata["crs"]) == ("m", 'LOCAL_CS["x"]')


def test_arrays_of_an_archive_that_are_not_taken_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", z=np.ones((3, 4)), x=np.arange(4.0) ** 2, y=np.arange(3.0), age=7, other=np.ones(5))
    surface, notes = noted(lambda: formats.read(tmp_path / "a.npz", array="z"))
    assert notes == ["left out arrays of the archive: other"]
    assert surface.metadata["scalars"] == {"age": 7}


def test_a_png_s_words_and_degrees_of_transparency_are_named(tmp_path: Path) -> None:
    pytest.importorskip("PIL")
    from PIL import Image, PngImagePlugin

    info = PngImagePlugin.PngInfo()
    for key in ("Software", "Copyright"):
        info.add_text(key, "somebody")
    pixels = np.dstack([np.arange(12).reshape(3, 4), np.arange(12).reshape(3, 4)]).astype(np.uint8)
    Image.fromarray(pixels, "LA").save(tmp_path / "a.png", pnginfo=info)
    surface, notes = noted(lambda: formats.read(tmp_path / "a.png"))
    assert notes == ["left out partial transparency in band 2", "left out texts of the PNG: Copyright"]
    assert surface.mask is not None
    assert int((~surface.mask).sum()) == 1


def test_variables_of_a_netcdf_that_are_not_taken_are_named_and_its_attributes_kept(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("scipy")
    data = {
        "depth": (("y", "x"), np.ones((3, 4)), {"long_name": "depth of water", "units": "m", "levels": [1, 2]}),
        "heat": (("t", "y", "x"), np.ones((2, 3, 4))),
        "wind": (("y", "x", "t"), np.ones((3, 4, 2))),
        "count": (("t",), np.ones(2)),
    }
    dataset = xarray.Dataset(data, {"x": np.arange(4.0), "y": np.arange(3.0)}, {"history": "made\nby hand"})
    dataset.to_netcdf(tmp_path / "a.nc", engine="scipy")
    surface, notes = noted(lambda: formats.read(tmp_path / "a.nc", variable="depth"))
    assert notes == [
        "left out variables of the same grid: wind; take them with attributes=",
        "left out variables of the same grid over further dimensions: heat",
    ]
    taken, _ = noted(lambda: formats.read(tmp_path / "a.nc", variable="depth", attributes="wind"))
    assert taken.attributes["wind"].shape == (3, 4, 2)
    with pytest.raises(ls.OptionError, match="expected attributes= of numbers over y and x, got 'heat'"):
        formats.read(tmp_path / "a.nc", variable="depth", attributes="heat")
    assert surface.metadata["tags"] == {
        "": {"NC_GLOBAL#history": "made\nby hand", "depth#long_name": "depth of water", "depth#levels": "{1,2}"}
    }


def test_names_from_a_file_make_no_long_notes(tmp_path: Path) -> None:
    arrays: dict[str, Any] = {f"{number:04}{'n' * 200}": np.ones(5) for number in range(300)}
    np.savez(tmp_path / "a.npz", z=np.ones((3, 4)), **({"a\n\x1b[31mred": np.ones(5)} | arrays))
    _, notes = noted(lambda: formats.read(tmp_path / "a.npz"))
    assert len(notes) == 1
    assert notes[0].endswith(" and 289 more")


LONG_NAME = f"a {'b' * 55}..."


def at_holes(kind: str) -> Surface:
    """A surface of which nothing is said at holes, but for what the kind names."""
    points = np.stack([*np.mgrid[:4, :5], np.zeros((4, 5))], axis=-1)
    mask = np.ones((4, 5), np.bool_)
    mask[1, 2:4] = mask[3, 0] = False
    heat = np.where(mask, 1.5, np.nan)
    flow = np.where(mask[..., np.newaxis], np.ones((4, 5, 3)), 0)
    count = np.where(mask, 7, -9).astype(np.int16)
    metadata = {"nodata": -9}
    if kind == "heat":
        heat[1, 2] = 2
    elif kind == "flow and heat":
        heat[1, 2], flow[1, 2:4, 1], flow[3, 0] = 2, 3, np.inf
    elif kind == "count":
        metadata = {}
    elif kind == "channels":
        points = np.concatenate([points, np.where(mask, 0, 4)[..., np.newaxis]], axis=-1)
    attributes: dict[str, Array] = {"heat": heat, "flow": flow, "count": count}
    if kind == "kept":
        points[1, 2, 0], heat[1, 2] = np.inf, 2
    elif kind == "names":
        attributes = {f"a\n{'b' * 80}{number}": np.ones((4, 5)) for number in range(14)}
    one = Block(points, mask=mask, attributes=attributes)
    return Surface(blocks=[one, Block(points[:, ::-1], attributes=attributes)], metadata=metadata)


@pytest.mark.parametrize(
    ("kind", "note"),
    [
        ("nothing", None),
        ("kept", None),
        ("heat", "values of attributes at 1 hole of the points left out: heat"),
        ("flow and heat", "values of attributes at 3 holes of the points left out: heat, flow"),
        ("count", "values of attributes at 3 holes of the points left out: count"),
        ("channels", "values of attributes at 3 holes of the points left out: channels beyond the third"),
        ("names", f"values of attributes at 3 holes of the points left out: {', '.join(12 * [LONG_NAME])} and 2 more"),
    ],
)
def test_values_at_holes_are_told_by_whoever_encodes(kind: str, note: str | None) -> None:
    surface = at_holes(kind)
    container, notes = noted(lambda: ls.encode(surface))
    assert notes == ([] if note is None else [note])
    assert losses.at_holes(surface) == note
    # What is told is what is lost, and nothing is lost of what comes back.
    back, notes = noted(lambda: ls.decode(container))
    assert notes == []
    assert noted(lambda: ls.encode(back))[1] == []
