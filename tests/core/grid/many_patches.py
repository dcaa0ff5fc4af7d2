"""Files of very many small patches, one maker for each kind of patch: ``maker(folder, count)`` gives the file."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

__all__ = [
    "MORE",
    "READ",
    "cgns_nodes",
    "esri_rows",
    "geotiff_bands",
    "geotiff_images",
    "geotiff_items",
    "geotiff_overviews",
    "geotiff_strips",
    "hdf5_attributes",
    "hdf5_chunks",
    "loose_quads",
    "netcdf_attributes",
    "netcdf_variables",
    "npz_members",
    "obj_groups",
    "obj_polygon",
    "off_comments",
    "pcd_fields",
    "plot3d_blocks",
    "ply_elements",
    "ply_properties",
    "png_chunks",
    "png_pixels",
    "square_patches",
    "text_lines",
    "usgs_profiles",
    "vtk_arrays",
    "vtk_fields",
    "vts_arrays",
    "vts_attribute",
    "vts_attributes",
    "vts_pieces",
]

_GRID_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"


def _written(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def hdf5_chunks(folder: Path, count: int) -> Path:
    """One deflated variable in so many chunks."""
    import h5py

    path = folder / "chunks.nc"
    with h5py.File(path, "w") as file:
        heights = file.create_dataset("z", (count, 2), "u1", chunks=(1, 2), compression="gzip")
        chunk = zlib.compress(b"\1\2")
        for place in range(count):
            heights.id.write_direct_chunk((place, 0), chunk)
    return path


def hdf5_attributes(folder: Path, count: int) -> Path:
    """One variable of so many attributes."""
    import h5py

    path = folder / "attributes.nc"
    with h5py.File(path, "w", libver="latest") as file:
        heights = file.create_dataset("z", data=np.arange(4.0).reshape(2, 2))
        space, kind = h5py.h5s.create(h5py.h5s.SCALAR), h5py.h5t.STD_I8LE
        for place in range(count):
            h5py.h5a.create(heights.id, b"a%d" % place, kind, space).write(np.array(1, "i1"))
    return path


def _classic(names: list[bytes], attributes: list[bytes]) -> bytes:
    """A classic NetCDF of 2 x 2 bytes for each variable, as the NetCDF User's Guide specifies the format."""

    def text(words: bytes) -> bytes:
        return struct.pack(">I", len(words)) + words + b"\0" * (-len(words) % 4)

    dims = struct.pack(">II", 10, 2) + b"".join(text(name) + struct.pack(">I", 2) for name in (b"row", b"column"))
    said = b"".join(text(name) + struct.pack(">II", 1, 1) + b"\1\0\0\0" for name in attributes)
    said = struct.pack(">II", 12, len(attributes)) + said if attributes else bytes(8)
    head = b"CDF\1" + bytes(4) + dims + said + struct.pack(">II", 11, len(names))
    each = [text(name) + struct.pack(">3I", 2, 0, 1) + bytes(8) for name in names]
    begin = len(head) + sum(map(len, each)) + 12 * len(each)
    variables = [it + struct.pack(">3I", 1, 4, begin + 4 * place) for place, it in enumerate(each)]
    return head + b"".join(variables) + b"\1\2\3\4" * len(names)


def netcdf_variables(folder: Path, count: int) -> Path:
    """A classic NetCDF of so many variables."""
    return _written(folder, "variables.nc", _classic([b"v%d" % place for place in range(count)], []))


def netcdf_attributes(folder: Path, count: int) -> Path:
    """A classic NetCDF of so many global attributes."""
    return _written(folder, "attributes.nc", _classic([b"z"], [b"a%d" % place for place in range(count)]))


def npz_members(folder: Path, count: int) -> Path:
    """An archive of so many arrays."""
    path = folder / "members.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for place in range(count):
            archive.writestr(zipfile.ZipInfo(f"a{place}.npy"), b"")
    return path


def plot3d_blocks(folder: Path, count: int) -> Path:
    """Text of so many blocks of 2 x 2 x 1 points."""
    header = f"{count}\n" + "2 2 1\n" * count
    return _written(folder, "blocks.p3d", header + "0. 1. 0. 1.\n0. 0. 1. 1.\n0. 0. 0. 1.\n" * count)


def _png(chunks: list[tuple[bytes, bytes]]) -> bytes:
    patches = [
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(patches)


_PNG_HEAD = (b"IHDR", struct.pack(">IIBBBBB", 2, 2, 8, 0, 0, 0, 0))


def png_chunks(folder: Path, count: int) -> Path:
    """A PNG of so many texts."""
    texts = [(b"tEXt", b"key%d\0text" % place) for place in range(count)]
    pixels = (b"IDAT", zlib.compress(b"\0\1\2\0\3\4"))
    return _written(folder, "chunks.png", _png([_PNG_HEAD, *texts, pixels, (b"IEND", b"")]))


def png_pixels(folder: Path, count: int) -> Path:
    """A PNG whose pixels are in so many chunks, most of them empty."""
    content = zlib.compress(b"\0\1\2\0\3\4")
    pieces = [content[:4], *[b""] * (count - 2), content[4:]]
    return _written(folder, "pixels.png", _png([_PNG_HEAD, *((b"IDAT", it) for it in pieces), (b"IEND", b"")]))


def ply_properties(folder: Path, count: int) -> Path:
    """A range grid of vertices with so many properties."""
    lines = [
        *("ply", "format binary_little_endian 1.0", "element vertex 4"),
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property char {place}" for place in range(count)),
        *("element face 1", "property list uchar uchar vertex_indices", "end_header"),
    ]
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
    body = b"".join(point.tobytes() + bytes(count) for point in points) + b"\4\0\1\2\3"
    return _written(folder, "properties.ply", "\n".join([*lines, ""]).encode() + body)


def ply_elements(folder: Path, count: int) -> Path:
    """A mesh, and beside it so many elements of lists of different lengths."""
    lines = [
        *("ply", "format binary_little_endian 1.0", "element vertex 4"),
        *(f"property float {axis}" for axis in "xyz"),
        *("element face 1", "property list uchar uchar vertex_indices"),
        *(line for place in range(count) for line in (f"element {place} 2", "property list char char a")),
        *(f"element last {100 * count}", "property char a", "end_header"),
    ]
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4").tobytes()
    body = points + b"\4\0\1\2\3" + b"\1\5\2\6\7" * count + bytes(100 * count)
    return _written(folder, "elements.ply", "\n".join([*lines, ""]).encode() + body)


def obj_groups(folder: Path, count: int) -> Path:
    """A strip of faces, each in a group of its own, with a material and a comment."""
    points = "".join(f"v {place} 0 0\nv {place} 1 0\n" for place in range(count + 1))
    faces = "".join(
        f"g {place}\nusemtl {place}\n# {place}\nf {2 * place + 1} {2 * place + 3} {2 * place + 4} {2 * place + 2}\n"
        for place in range(count)
    )
    return _written(folder, "groups.obj", points + faces)


def obj_polygon(folder: Path, count: int) -> Path:
    """A single face of so many corners."""
    return _written(folder, "polygon.obj", _GRID_OBJ + "f" + " 1 2 3 4" * (count // 4) + "\n")


def off_comments(folder: Path, count: int) -> Path:
    """One face, and so many comments before and after each line."""
    between = "# nothing\n\n" * (count // 4)
    lines = ["4 1 0", "0 0 0", "1 0 0", "1 1 0\n0 1 0", "4 0 1 2 3"]
    return _written(folder, "comments.off", "OFF\n" + "".join(f"{between}{line}\n" for line in lines))


def pcd_fields(folder: Path, count: int) -> Path:
    """An organised cloud of so many fields, and as many points as fill the file."""
    names = ["x", "y", "z", *map(str, range(count))]
    lines = [
        *("VERSION 0.7", f"FIELDS {' '.join(names)}", f"SIZE 4 4 4{' 1' * count}", f"TYPE F F F{' I' * count}"),
        *("WIDTH 2", "HEIGHT 2", "DATA binary\n"),
    ]
    points = [np.array([x, y, 0], "<f4").tobytes() + bytes(count) for y in (0, 1) for x in (0, 1)]
    return _written(folder, "fields.pcd", "\n".join(lines).encode() + b"".join(points))


def vtk_fields(folder: Path, count: int) -> Path:
    """A legacy file of VTK with so many arrays of field data."""
    head = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_GRID\nDIMENSIONS 2 2 1\nPOINTS 4 float\n"
    points = "0 0 0 1 0 0 0 1 0 1 1 0\n"
    arrays = "".join(f"a{place} 1 1 char\n1\n" for place in range(count))
    return _written(folder, "fields.vtk", f"{head}{points}FIELD FieldData {count}\n{arrays}")


def vtk_arrays(folder: Path, count: int) -> Path:
    """A legacy file of VTK with so many arrays of the points."""
    head = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_GRID\nDIMENSIONS 2 2 1\nPOINTS 4 float\n"
    points = "0 0 0 1 0 0 0 1 0 1 1 0\nPOINT_DATA 4\n"
    arrays = "".join(f"SCALARS a{place} char 1\nLOOKUP_TABLE default\n1 2 3 4\n" for place in range(count))
    return _written(folder, "arrays.vtk", head + points + arrays)


def _vts(extent: str, pieces: str, attributes: str = "") -> str:
    return (
        f'<VTKFile type="StructuredGrid" version="0.1"{attributes}><StructuredGrid WholeExtent="{extent}">{pieces}'
        "</StructuredGrid></VTKFile>"
    )


def _array(name: str, values: str, components: int = 1) -> str:
    return f'<DataArray type="Float32" Name="{name}" NumberOfComponents="{components}">{values}</DataArray>'


def vts_arrays(folder: Path, count: int) -> Path:
    """A .vts of so many arrays of the points."""
    arrays = "".join(_array(f"a{place}", "1 2 3 4") for place in range(count))
    points = _array("p", "0 0 0 1 0 0 0 1 0 1 1 0", 3)
    piece = f'<Piece Extent="0 1 0 1 0 0"><PointData>{arrays}</PointData><Points>{points}</Points></Piece>'
    return _written(folder, "arrays.vts", _vts("0 1 0 1 0 0", piece))


def vts_pieces(folder: Path, count: int) -> Path:
    """A .vts of so many pieces."""
    pieces = "".join(
        f'<Piece Extent="{place} {place + 1} 0 1 0 0"><Points>'
        f"{_array('p', f'{place} 0 0 {place + 1} 0 0 {place} 1 0 {place + 1} 1 0', 3)}</Points></Piece>"
        for place in range(count)
    )
    return _written(folder, "pieces.vts", _vts(f"0 {count} 0 1 0 0", pieces))


def vts_attributes(folder: Path, count: int) -> Path:
    """A .vts whose first element has so many attributes."""
    return _written(folder, "attributes.vts", _vts("0 1 0 1 0 0", "", "".join(f' a{it}="1"' for it in range(count))))


def vts_attribute(folder: Path, count: int) -> Path:
    """A .vts of one very long attribute, of a kilobyte for each patch."""
    return _written(folder, "attribute.vts", _vts("0 1 0 1 0 0", "", f' a="{" " * 1024 * count}"'))


def cgns_nodes(folder: Path, count: int) -> Path:
    """An HDF5 file with so many zones, each but its label and its size."""
    import h5py

    path = folder / "zones.cgns"
    with h5py.File(path, "w", libver=("earliest", "v110")) as file:

        def node(parent: Any, name: str, label: str, kind: str, data: np.ndarray[Any, Any] | None = None) -> Any:
            group = parent if name == "HDF5 MotherNode" else parent.create_group(name)
            for key, text, length in (("label", label, 33), ("name", name, 33), ("type", kind, 3)):
                group.attrs.create(key, np.bytes_(text), dtype=f"S{length}")
            if data is not None:
                group.create_dataset(" data", data=data)
            return group

        node(file, "HDF5 MotherNode", "Root Node of HDF5 File", "MT")
        node(file, "CGNSLibraryVersion", "CGNSLibraryVersion_t", "R4", np.array([3.1], "f4"))
        base = node(file, "Base", "CGNSBase_t", "I4", np.array([2, 3], "i4"))
        for place in range(count):
            zone = node(base, f"Zone{place}", "Zone_t", "I4", np.array([[2, 2], [1, 1], [0, 0]], "i4"))
            node(zone, "ZoneType", "ZoneType_t", "C1", np.frombuffer(b"Structured", "i1"))
            grid = node(zone, "GridCoordinates", "GridCoordinates_t", "MT")
            for axis, values in (("X", [[0, 1], [0, 1]]), ("Y", [[0, 0], [1, 1]]), ("Z", [[0, 0], [0, 0]])):
                node(grid, f"Coordinate{axis}", "DataArray_t", "R4", np.array(values, "f4") + place)
    return path


def text_lines(folder: Path, count: int) -> Path:
    """Lines of two numbers, with a comment after each."""
    return _written(folder, "lines.txt", "".join(f"{place} 2\n# {place}\n\n" for place in range(count)))


def esri_rows(folder: Path, count: int) -> Path:
    """An ESRI ASCII grid of so many rows."""
    return _written(
        folder, "rows.asc", f"ncols 2\nnrows {count}\nxllcorner 0\nyllcorner 0\ncellsize 1\n" + "1 2\n" * count
    )


def usgs_profiles(folder: Path, count: int) -> Path:
    """A USGS DEM of so many profiles of two heights."""
    record = bytearray(b" " * 1024)

    def put(at: int, words: str) -> None:
        record[at : at + len(words)] = words.encode()

    put(0, "TEST")
    for at, value in ((144, 1), (150, 1), (156, 1), (162, 10), (528, 2), (534, 2), (540, 4), (852, 1)):
        put(at, f"{value:6d}")
    for place, value in enumerate([0, 0, 0, 2, count, 2, count, 0]):
        put(546 + 24 * place, f"{float(value):24.15E}")
    for place, number in enumerate([0.0, 10.0]):
        put(738 + 24 * place, f"{number:24.15E}")
    for place in range(3):
        put(816 + 12 * place, f"{1.0:12.6E}")
    put(852, f"{1:6d}")
    put(858, f"{count:6d}" if count < 10**6 else "")
    profiles = [
        f"{1:6d}{place + 1:6d}{2:6d}{1:6d}{float(place):24.15E}{0.0:24.15E}{0.0:24.15E}{0.0:24.15E}{10.0:24.15E}"
        f"{5:6d}{6:6d}".ljust(1024)
        for place in range(count)
    ]
    return _written(folder, "profiles.dem", bytes(record) + "".join(profiles).encode())


def _tiff(entries: list[tuple[int, int, bytes]], after: bytes = b"") -> bytes:
    """A little-endian TIFF of one directory; `after` follows it, and its place stands where an entry says ``here``."""
    sizes = {1: 1, 2: 1, 3: 2, 4: 4}
    length = 8 + 2 + 12 * len(entries) + 4
    directory, data = struct.pack("<H", len(entries)), b""
    for tag, kind, content in sorted(entries):
        count = len(content) // sizes[kind]
        field = content.ljust(4, b"\0") if len(content) <= 4 else struct.pack("<I", length + len(data))
        if len(content) > 4:
            data += content + b"\0" * (len(content) % 2)
        directory += struct.pack("<HHI", tag, kind, count) + field
    return b"II*\0" + struct.pack("<I", 8) + directory + bytes(4) + data + after


def _short(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}H", *values)


def _long(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def geotiff_strips(folder: Path, count: int) -> Path:
    """A TIFF of so many strips, all of which are the same two bytes of the file."""
    entries = [
        *((256, 4, _long(2)), (257, 4, _long(count)), (258, 3, _short(8)), (259, 3, _short(1)), (262, 3, _short(1))),
        *((273, 4, _long(*[2] * count)), (277, 3, _short(1)), (278, 4, _long(1)), (279, 4, _long(*[2] * count))),
    ]
    return _written(folder, "strips.tif", _tiff(entries))


def geotiff_bands(folder: Path, count: int) -> Path:
    """A TIFF of 2 x 2 pixels and so many bands."""
    size = 4 * count
    entries = [
        *((256, 4, _long(2)), (257, 4, _long(2)), (258, 3, _short(*[8] * count)), (259, 3, _short(1))),
        *((262, 3, _short(1)), (273, 4, _long(0)), (277, 3, _short(count)), (278, 4, _long(2)), (279, 4, _long(size))),
        *((284, 3, _short(1)), (338, 3, _short(*[0] * (count - 1)))),
    ]
    place = len(_tiff(entries))
    entries[5] = (273, 4, _long(place))
    return _written(folder, "bands.tif", _tiff(entries, bytes(size)))


def geotiff_items(folder: Path, count: int) -> Path:
    """A TIFF with so many tags of GDAL's."""
    items = "".join(f'<Item name="a{place}">1</Item>' for place in range(count))
    entries = [
        *((256, 4, _long(2)), (257, 4, _long(2)), (258, 3, _short(8)), (259, 3, _short(1)), (262, 3, _short(1))),
        *((273, 4, _long(4)), (277, 3, _short(1)), (278, 4, _long(2)), (279, 4, _long(4))),
        (42112, 2, f"<GDALMetadata>{items}</GDALMetadata>".encode() + b"\0"),
    ]
    return _written(folder, "items.tif", _tiff(entries))


def loose_quads(folder: Path, count: int) -> Path:
    """A mesh of so many quads that share no vertex."""
    points = "".join(f"v {place} 0 0\nv {place} 1 0\nv {place} 1 1\nv {place} 0 1\n" for place in range(count))
    faces = "".join(f"f {4 * it + 1} {4 * it + 2} {4 * it + 3} {4 * it + 4}\n" for it in range(count))
    return _written(folder, "quads.obj", points + faces)


def square_patches(folder: Path, count: int) -> Path:
    """A mesh of so many patches of 8 x 8 quads that lie side by side, at the same places but with own vertices."""
    row, column = np.indices((9, 9)).reshape(2, -1)
    corner = np.add.outer(np.add.outer(9 * np.arange(8), np.arange(8)).reshape(-1), np.array([0, 1, 10, 9]))
    places = np.arange(count)[:, None]
    x = (8 * places + column).reshape(-1)
    points = np.stack([x, np.broadcast_to(row, (count, 81)).reshape(-1)], axis=-1)
    faces = (81 * places[..., None] + corner + 1).reshape(-1, 4)
    text = "".join(f"v {x} {y} 0\n" for x, y in points.tolist())
    return _written(folder, "patches.obj", text + "".join(f"f {a} {b} {c} {d}\n" for a, b, c, d in faces.tolist()))


def _directories(folder: Path, count: int, kind: int) -> Path:
    """A TIFF of so many directories, of whose images all but the first are of a kind (tag 254)."""
    patches = []
    for place in range(count):
        entries = [
            *((254, 4, _long(kind if place else 0)), (256, 4, _long(2)), (257, 4, _long(2)), (258, 3, _short(8))),
            *((259, 3, _short(1)), (262, 3, _short(1)), (273, 4, _long(4)), (277, 3, _short(1))),
            *((278, 4, _long(2)), (279, 4, _long(4))),
        ]
        one = _tiff(entries)[8:-4]
        patches.append(one + _long(8 + (len(one) + 4) * (place + 1) if place + 1 < count else 0))
    return _written(folder, "directories.tif", b"II*\0" + _long(8) + b"".join(patches))


def geotiff_images(folder: Path, count: int) -> Path:
    """A TIFF of so many images."""
    return _directories(folder, count, 0)


def geotiff_overviews(folder: Path, count: int) -> Path:
    """A TIFF of one image and so many smaller ones."""
    return _directories(folder, count, 1)


#: So many times the patches are read as a kind is listed with.
MORE = 4

#: Each kind that is read, with a number of patches.
READ: list[tuple[Callable[[Path, int], Path], int]] = [
    (hdf5_chunks, 8_000),
    (hdf5_attributes, 1_000),
    (netcdf_attributes, 6_000),
    (plot3d_blocks, 1_000),
    (png_chunks, 12_000),
    (png_pixels, 25_000),
    (ply_properties, 4_000),
    (ply_elements, 2_500),
    (obj_groups, 8_000),
    (off_comments, 25_000),
    (pcd_fields, 1_500),
    (text_lines, 25_000),
    (esri_rows, 25_000),
    (usgs_profiles, 1_000),
    (geotiff_strips, 25_000),
    (geotiff_bands, 1_000),
    (geotiff_items, 2_000),  # beyond, GDAL's own reading of them takes longer than ours
    (geotiff_overviews, 1_000),
    (vtk_fields, 250),
    (vtk_arrays, 100),
    (vts_arrays, 249),
    (vts_pieces, 100),
    (cgns_nodes, 50),
    (square_patches, 250),
]
