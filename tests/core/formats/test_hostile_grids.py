"""Gridded files made to do harm: each refused with its reason, within five seconds of a processor and 512 MiB."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from .refusals import SECONDS, Refusal, refusals
from .test_bad_input import MIB, npy, npz, tiff

VRT = (
    '<VRTDataset rasterXSize="5" rasterYSize="4"><VRTRasterBand dataType="Int16" band="1"><SimpleSource>'
    "<SourceFilename>/etc/passwd</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, depth: int = 8, kind: int = 0, data: bytes = b"", extra: bytes = b"") -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + extra + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def deflated_zeros(size: int) -> bytes:
    """So many zeros, deflated, without ever having them all."""
    packer = zlib.compressobj(1)
    block = bytes(1 << 20)
    return b"".join([*(packer.compress(block) for _ in range(size >> 20)), packer.flush()])


def tiff_with(tags: dict[int, tuple[int, int, int]], following: int = 0) -> bytes:
    """A little-endian TIFF of one directory, whose tags are given as kind, count, value."""
    entries = b"".join(struct.pack("<HHII", tag, *value) for tag, value in sorted(tags.items()))
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + struct.pack("<I", following) + bytes(64)


def plain_tags(width: int, height: int) -> dict[int, tuple[int, int, int]]:
    return {
        256: (4, 1, width),
        257: (4, 1, height),
        258: (3, 1, 8),
        259: (3, 1, 1),
        262: (3, 1, 1),
        273: (4, 1, 8),
        277: (3, 1, 1),
        278: (4, 1, height),
        279: (4, 1, 64),
    }


def tiled_tags(width: int, height: int, tile: int) -> dict[int, tuple[int, int, int]]:
    tags = {tag: value for tag, value in plain_tags(width, height).items() if tag not in (273, 278, 279)}
    return tags | {322: (4, 1, tile), 323: (4, 1, tile), 324: (4, 1, 8), 325: (4, 1, 64), 259: (3, 1, 8)}


def dem(columns: int, extent: float) -> bytes:
    """The first record of a USGS DEM over a square, and profiles that are not there."""
    record = bytearray(b" " * 1024)
    record[:4] = b"Hill"
    for place, text in ((144, f"{1:6d}{4:6d}{0:6d}{0:6d}"), (528, f"{2:6d}{2:6d}{4:6d}"), (858, f"{1:6d}{columns:6d}")):
        record[place : place + len(text)] = text.encode()
    corners = (0.0, 0.0, 0.0, extent, extent, extent, extent, 0.0)
    numbers = "".join(f"{value:24.15E}".replace("E", "D") for value in (*corners, 0.0, 1000.0))
    record[546 : 546 + len(numbers)] = numbers.encode()
    record[816:852] = b"0.100000E+010.100000E+010.100000E+01"
    return bytes(record) + bytes(record)


def classic(
    dims: list[tuple[str, int]], shape: list[int], *, count: int = 1, records: int = 0, begin: int = 1 << 10
) -> bytes:
    """A NetCDF of 32 bits with one float variable, and 2 KiB."""

    def name(text: str) -> bytes:
        return struct.pack(">I", len(text)) + text.encode().ljust(-(-len(text) // 4) * 4, b"\0")

    head = b"CDF\x01" + struct.pack(">I", records)
    head += struct.pack(">II", 10, len(dims)) + b"".join(name(key) + struct.pack(">I", size) for key, size in dims)
    head += bytes(8) + struct.pack(">II", 11, count) + name("z")
    head += struct.pack(">I", len(shape)) + b"".join(struct.pack(">I", dim) for dim in shape) + bytes(8)
    head += struct.pack(">III", 5, 64, begin)
    return head.ljust(2048, b"\0")


def hdf5(fill: Callable[[Any], None], **options: Any) -> bytes:
    h5py = pytest.importorskip("h5py")
    memory = io.BytesIO()
    with h5py.File(memory, "w", **options) as file:
        fill(file)
    return memory.getvalue()


def external_link(file: Any) -> None:
    import h5py

    file["z"] = h5py.ExternalLink("/etc/passwd", "/z")


def soft_links(file: Any) -> None:
    import h5py

    file["a"] = h5py.SoftLink("/b")
    file["b"] = h5py.SoftLink("/a")


def circle_of_groups(file: Any) -> None:
    file["z"] = np.zeros((3, 4))
    inner = file.create_group("one/two/three")
    inner["back"] = file["one"]
    inner["home"] = file["/"]


def values_outside(file: Any) -> None:
    file.create_dataset("z", (3, 4), "f4", external=[("/etc/passwd", 0, 48)])


def virtual(file: Any) -> None:
    import h5py

    layout = h5py.VirtualLayout((3, 4), "f4")
    layout[:] = h5py.VirtualSource("/etc/passwd", "z", (3, 4))
    file.create_virtual_dataset("z", layout)


def never_written(file: Any) -> None:
    file.create_dataset("z", (15000, 15000), "f8", chunks=(1000, 1000), compression="gzip")


def vast_chunk(file: Any) -> None:
    file.create_dataset("z", (40, 50), "f8", chunks=(20000, 20000), maxshape=(None, None), compression="gzip")


def bursting_chunk(file: Any) -> None:
    data = file.create_dataset("z", (100, 100), "f8", chunks=(100, 100), compression="gzip")
    data.id.write_direct_chunk((0, 0), deflated_zeros(1 << 27))


def deflated_twice(file: Any) -> None:
    import h5py

    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((100, 100))
    properties.set_deflate(9)
    properties.set_filter(1, 0, (9,))
    space = h5py.h5s.create_simple((100, 100))
    data = h5py.h5d.create(file.id, b"z", h5py.h5t.NATIVE_DOUBLE, space, properties)
    data.write_direct_chunk((0, 0), zlib.compress(deflated_zeros(1 << 27)))


def dimension_of_itself(file: Any) -> None:
    import h5py

    x = file.create_dataset("x", data=np.arange(4.0))
    x.make_scale("x")
    z = file.create_dataset("z", data=np.zeros((4, 4)))
    z.attrs["coordinates"] = "z z z"
    for item, scale in ((x, x), (z, z)):
        references = np.empty(item.ndim, dtype=object)
        for axis in range(item.ndim):
            references[axis] = np.array([scale.ref], dtype=h5py.ref_dtype)
        item.attrs.create("DIMENSION_LIST", references, dtype=h5py.vlen_dtype(h5py.ref_dtype))


def many_groups(file: Any) -> None:
    for number in range(2_001):
        file.create_group(f"g{number}")


def nothing_but_nan(file: Any) -> None:
    file["z"] = np.full((30, 40), np.nan)


CASES: dict[str, tuple[str, Callable[[], bytes], str, str]] = {
    "PNG of 2^31 pixels": ("a.png", lambda: png(2**31 - 1, 1), "TooLargeError", "at most 268,435,456 vertices"),
    "PNG of 2^62 pixels": ("a.png", lambda: png(2**31 - 1, 2**31 - 1), "TooLargeError", "vertices"),
    "PNG that holds next to nothing": (
        "a.png",
        lambda: png(16000, 16000, 16, data=bytes(99)),
        "TooLargeError",
        "expands at most 2048 times",
    ),
    "PNG with too few rows": (
        "a.png",
        lambda: png(64, 64, data=bytes(65 * 9)),
        "FormatError",
        "whole PNG of 4,160 bytes",
    ),
    "PNG whose text bursts": (
        "a.png",
        lambda: png(3, 3, data=bytes(12), extra=chunk(b"zTXt", b"lodestream\0\0" + deflated_zeros(1 << 27))),
        "none",
        "3 x 3 uint8",  # the text is passed over
    ),
    "PNG with a rule of nonsense": (
        "a.png",
        lambda: png(3, 3, data=bytes(12), extra=chunk(b"tEXt", b'lodestream\0{"dtype": "O", "first": [], "step": {}}')),
        "FormatError",
        "a rule of heights",
    ),
    "PNG of a palette": ("a.png", lambda: png(3, 3, kind=3), "FormatError", "grey of 8 or 16 bits, .* got a palette"),
    "PNG of 16-bit colours": ("a.png", lambda: png(3, 3, 16, 2), "FormatError", "got colours of 16 bits"),
    "TIFF of 2^62 pixels": (
        "a.tif",
        lambda: tiff_with(plain_tags(2**31 - 1, 2**31 - 1)),
        "FormatError|TooLargeError",
        "vertices|this GeoTIFF",
    ),
    "TIFF that promises more than follows": (
        "a.tif",
        lambda: tiff_with(plain_tags(15000, 15000)),
        "TooLargeError",
        "expands at most 2048 times",
    ),
    "TIFF of one vast tile": (
        "a.tif",
        lambda: tiff_with(tiled_tags(100, 100, 1 << 15)),
        "TooLargeError",
        "tiles no larger than the image",
    ),
    "TIFF whose directories go in a circle": (
        "a.tif",
        lambda: tiff_with(plain_tags(8, 9), following=8),
        "FormatError|none",  # the first one is a whole image
        "this GeoTIFF|9 x 8 uint8",
    ),
    "TIFF of a million-fold archive": (
        "a.tif",
        lambda: tiff(np.zeros((1, 16384, 8192), np.uint8), compress="zstd", blockysize=16384),
        "TooLargeError",
        "expands at most 2048 times|tiles no larger",
    ),
    "VRT named .tif": ("a.tif", VRT.encode, "FormatError", "this is text that begins with '<VRTDataset"),
    "VRT named .dem": ("a.dem", VRT.encode, "FormatError", "this is text that begins with '<VRTDataset"),
    "VRT named .asc": ("a.asc", VRT.encode, "FormatError", "this is text that begins with '<VRTDataset"),
    "VRT named .hgt": ("N00E000.hgt", VRT.encode, "FormatError", "an SRTM tile of 2,884,802 .* bytes, got 1"),
    "VRT named .nc": ("a.nc", VRT.encode, "FormatError", "this is text that begins with '<VRTDataset"),
    "ASCII grid of 10^18 heights": (
        "a.asc",
        lambda: b"ncols 1000000000\nnrows 1000000000\ncellsize 1\n1 2 3\n",
        "TooLargeError",
        "at most 268,435,456 vertices",
    ),
    "ASCII grid that promises more than follows": (
        "a.asc",
        lambda: b"ncols 10000\nnrows 10000\ncellsize 1\n1 2 3\n",
        "FormatError",
        r"100,000,000 numbers \(10000 x 10000\), got 3",
    ),
    "ASCII grid with more than it says": (
        "a.asc",
        lambda: b"ncols 2\nnrows 2\ncellsize 1\n1 2\n3 4\n5 6\n",
        "FormatError",
        r"4 numbers \(2 x 2\), got 6",
    ),
    "ASCII grid of words": (
        "a.asc",
        lambda: b"ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\nsea sea\nsea land\n",
        "FormatError",
        "GDAL cannot read this ESRI ASCII grid",
    ),
    "ASCII grid of minus one": ("a.asc", lambda: b"ncols -1\nnrows -1\n1\n", "FormatError", "at least two points"),
    "ASCII grid of nodata": (
        "a.asc",
        lambda: b"ncols 2\nnrows 1\nxllcorner 0\nyllcorner 0\ncellsize 1\nNODATA_value 7\n7 7\n",
        "InputError",
        "at least one valid point",
    ),
    "DEM over half the Earth": ("a.dem", lambda: dem(2, 2e7), "FormatError|TooLargeError", "USGS DEM|vertices|expands"),
    "DEM without profiles": ("a.dem", lambda: dem(100, 100.0), "FormatError|InputError", "USGS DEM|valid point"),
    "SRTM tile of nothing": ("N00E000.hgt", lambda: b"\x80\0" * 1201**2, "InputError", "at least one valid point"),
    "NPZ of a million-fold archive": (
        "a.npz",
        lambda: npz({"a.npy": npy(np.zeros((5000, 5000), np.uint8))}),
        "none",
        "5000 x 5000 uint8",
    ),
    "NetCDF of 2^60 values": (
        "a.nc",
        lambda: classic([("y", 2**30), ("x", 2**30)], [0, 1]),
        "FormatError|TooLargeError",
        "vertices|a whole NetCDF",
    ),
    "NetCDF that promises more than follows": (
        "a.nc",
        lambda: classic([("y", 9999), ("x", 9999)], [0, 1]),
        "FormatError",
        "a whole NetCDF",
    ),
    "NetCDF of 2^31 variables": ("a.nc", lambda: classic([("x", 4)], [0, 0], count=2**31 - 1), "FormatError", "NetCDF"),
    "NetCDF of 2^31 records": (
        "a.nc",
        lambda: classic([("t", 0), ("x", 4)], [0, 1], records=2**31 - 1),
        "FormatError|TooLargeError",
        "NetCDF|vertices",
    ),
    "NetCDF with dimensions that are not there": ("a.nc", lambda: classic([("x", 4)], [0, 7]), "FormatError", "NetCDF"),
    "NetCDF of 64-bit data": ("a.nc", lambda: b"CDF\x05" + bytes(99), "FormatError", "got CDF-5"),
    "HDF5 cut short": ("a.nc", lambda: hdf5(nothing_but_nan)[:900], "FormatError", "a whole NetCDF"),
    "HDF5 with a link to a file": ("a.nc", lambda: hdf5(external_link), "FormatError", "without links .* named 'z'"),
    "HDF5 with links in a circle": ("a.nc", lambda: hdf5(soft_links), "FormatError", "without links .* named '[ab]'"),
    "HDF5 with groups in a circle": ("a.nc", lambda: hdf5(circle_of_groups), "FormatError", "groups without a circle"),
    "HDF5 with values in a file": ("a.nc", lambda: hdf5(values_outside), "FormatError", "values inside the file"),
    "HDF5 of other files": ("a.nc", lambda: hdf5(virtual), "FormatError", "values inside the file"),
    "HDF5 that was never written": ("a.nc", lambda: hdf5(never_written), "TooLargeError", "expands at most 2048 times"),
    "HDF5 of a vast chunk": ("a.nc", lambda: hdf5(vast_chunk), "TooLargeError", "chunks no larger than the variable"),
    "HDF5 of a bursting chunk": ("a.nc", lambda: hdf5(bursting_chunk), "TooLargeError", "got one that expands further"),
    "HDF5 deflated twice": ("a.nc", lambda: hdf5(deflated_twice), "FormatError", "deflated once, got 'z'|got '/z'"),
    "HDF5 with dimensions in a circle": ("a.nc", lambda: hdf5(dimension_of_itself), "FormatError|none", ""),
    "HDF5 of many groups": ("a.nc", lambda: hdf5(many_groups), "TooLargeError", "at most 2,000 variables"),
    "HDF5 of NaN everywhere": ("a.nc", lambda: hdf5(nothing_but_nan), "InputError", "at least one valid point"),
    "text of ragged lines": ("a.txt", lambda: b"1 2 3\n" * 9 + b"1 2\n", "FormatError", "got 2 in line 10"),
    "text of one number": ("a.txt", lambda: b"1\n", "FormatError", "at least two points"),
    "text of NaN everywhere": ("a.txt", lambda: b"nan nan\nnan nan\n", "InputError", "at least one valid point"),
}


@pytest.fixture(scope="module")
def refused(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Refusal]:
    """How each case was refused."""
    paths = []
    for number, (name, content, _, _) in enumerate(CASES.values()):
        folder = tmp_path_factory.mktemp(f"case{number}")
        (folder / name).write_bytes(content())
        paths.append((folder / name, dict[str, Any]()))
    return dict(zip(CASES, refusals(paths), strict=True))


@pytest.mark.parametrize("case", CASES)
def test_hostile_files_are_refused_in_time_and_space(refused: dict[str, Refusal], case: str) -> None:
    import re

    _, _, error, message = CASES[case]
    found = refused[case]
    assert re.fullmatch(error, found.error), found
    assert re.search(message, found.message), found
    assert found.memory < 512 * MIB
    assert found.seconds < SECONDS
    if found.error != "none":
        assert re.search("expected|this is |cannot read", found.message)
        assert "\n" not in found.message
