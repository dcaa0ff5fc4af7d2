"""What a GeoTIFF says in words goes into a surface, through a container, and out into a GeoTIFF, as GDAL shows it."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodestream import formats
from lodestream.decoding.decoder import decode
from lodestream.encoding.encode import encode
from lodestream.errors import FormatWarning
from lodestream.surface import Surface

from .test_formats import data

rasterio = pytest.importorskip("rasterio")

PLACE = (500000.0, 30.0, 0.0, 4100000.0, 0.0, -30.0)
MADE_UP = ("IMAGE_STRUCTURE", "DERIVED_SUBDATASETS", "SUBDATASETS")
XMP = '<?xpacket begin="?"?><x:xmpmeta xmlns:x="adobe:ns:meta/">ä</x:xmpmeta>'
RPC = {
    **{f"{name}_{part}": "1" for name in ("LINE", "SAMP", "LAT", "LONG", "HEIGHT") for part in ("OFF", "SCALE")},
    **{f"{name}_{part}_COEFF": " ".join(["1"] * 20) for name in ("LINE", "SAMP") for part in ("NUM", "DEN")},
}


def write(path: Path, area_or_point: str | None = "Area", crs: str | None = "EPSG:32611", dtype: str = "int16") -> None:
    """A GeoTIFF of three bands that says all that one can."""
    from rasterio.enums import ColorInterp

    bands = np.arange(90, dtype=dtype).reshape(3, 5, 6)
    profile = {"driver": "GTiff", "count": 3, "height": 5, "width": 6, "dtype": dtype, "photometric": "minisblack"}
    with (
        rasterio.Env(GDAL_PAM_ENABLED="NO"),
        rasterio.open(path, "w", crs=crs, transform=rasterio.Affine.from_gdal(*PLACE), **profile) as dataset,
    ):
        dataset.update_tags(SURVEY="1999 = été", TIFFTAG_SOFTWARE="a program", LINES="one\ntwo")
        if area_or_point:
            dataset.update_tags(AREA_OR_POINT=area_or_point)
        dataset.update_tags(ns="OURS", key="value")
        dataset.update_tags(ns="RPC", **RPC)
        name, _, rest = XMP.partition("=")
        dataset.update_tags(ns="xml:XMP", **{name: rest})
        dataset.update_tags(1, STATISTICS_MINIMUM="0", STATISTICS_MAXIMUM="29", STATISTICS_MEAN="14.5", METHOD="lidar")
        dataset.update_tags(2, ns="OURS", key="of band 2")
        dataset.set_band_description(1, "bare earth")
        dataset.set_band_description(2, "slope")
        dataset.units = ("m", "degree", "")
        dataset.scales, dataset.offsets = (0.1, 2.0, 1.0), (-5.0, 0.0, 1.5)
        dataset.colorinterp = [ColorInterp.gray, ColorInterp.undefined, ColorInterp.alpha]
        dataset.write(bands)


def told(path: Path) -> dict[str, Any]:
    """All that GDAL says of a file in words."""
    with rasterio.open(path) as dataset:
        return {
            "tags": [
                {
                    ns: dataset.tags(band, ns=ns or None)
                    for ns in {"", *dataset.tag_namespaces(band)}.difference(MADE_UP)
                }
                for band in (0, *dataset.indexes)
            ],
            "descriptions": dataset.descriptions,
            "units": [unit or "" for unit in dataset.units],
            "scales": (dataset.scales, dataset.offsets),
            "colors": [color.name for color in dataset.colorinterp],
            "place": (dataset.transform.to_gdal(), dataset.crs),
        }


@pytest.mark.parametrize("crs", ["EPSG:32611", None])
@pytest.mark.parametrize("area_or_point", ["Area", "Point", None])
def test_gdal_shows_the_same_after_the_journey(tmp_path: Path, area_or_point: str | None, crs: str | None) -> None:
    write(tmp_path / "a.tif", area_or_point, crs)
    surface = formats.read(tmp_path / "a.tif")
    assert list(surface.attributes) == ["slope", "band_3"]
    assert surface.metadata["description"] == "bare earth"
    assert surface.metadata["tags"]["OURS"] == {"key": "value"}
    assert surface.metadata["tags"]["xml:XMP"] == {"xml:XMP": XMP}
    assert surface.metadata["bands"]["slope"] == {
        "unit": "degree",
        "scale": 2.0,
        "offset": 0.0,
        "tags": {"OURS": {"key": "of band 2"}},
    }
    assert surface.metadata["bands"]["band_3"] == {"scale": 1.0, "offset": 1.5, "color": "alpha"}
    back = decode(encode(surface))
    assert {key: back.metadata[key] for key in surface.metadata} == surface.metadata
    formats.write(back, tmp_path / "b.tif")
    assert told(tmp_path / "b.tif") == told(tmp_path / "a.tif")
    assert told(tmp_path / "b.tif")["tags"][0][""].get("AREA_OR_POINT") == surface.metadata.get("area_or_point")


def test_a_point_stands_in_the_middle_of_its_cell_in_the_file(tmp_path: Path) -> None:
    """The tie point is that of the cell's corner for areas, of its centre for points; the geotransform is the same."""
    ties = {}
    for kind in ("Area", "Point"):
        wkt = rasterio.crs.CRS.from_epsg(32611).to_wkt()
        metadata = {"geotransform": list(PLACE), "crs": wkt, "area_or_point": kind}
        formats.write(Surface(np.zeros((3, 4)), metadata=metadata), tmp_path / "a.tif")
        content = (tmp_path / "a.tif").read_bytes()
        start = struct.unpack_from("<I", content, 4)[0]
        for entry in range(struct.unpack_from("<H", content, start)[0]):
            tag, _, _, offset = struct.unpack_from("<HHII", content, start + 2 + 12 * entry)
            if tag == 33922:  # ModelTiepointTag
                ties[kind] = struct.unpack_from("<6d", content, offset)[3:5]
        back = formats.read(tmp_path / "a.tif")
        assert back.metadata["geotransform"] == list(PLACE)
        assert back.metadata["area_or_point"] == kind
    assert ties == {"Area": (500000.0, 4100000.0), "Point": (500015.0, 4099985.0)}


def test_bands_of_one_name_are_told_apart_and_called_the_same_again(tmp_path: Path) -> None:
    profile = {"driver": "GTiff", "count": 4, "height": 3, "width": 4, "dtype": "int16"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(tmp_path / "a.tif", "w", **profile) as dataset:
            dataset.write(np.arange(48, dtype=np.int16).reshape(4, 3, 4))
            for number in (2, 4):
                dataset.set_band_description(number, "twice")
        surface = formats.read(tmp_path / "a.tif")
        assert list(surface.attributes) == ["twice", "band_3", "twice_4"]
        formats.write(surface, tmp_path / "b.tif")
        assert told(tmp_path / "b.tif")["descriptions"] == (None, "twice", None, "twice")


def test_statistics_of_other_values_are_not_written(tmp_path: Path) -> None:
    write(tmp_path / "a.tif")
    surface = formats.read(tmp_path / "a.tif")
    other = Surface(surface.points + 1, attributes=surface.attributes, metadata=surface.metadata)
    with pytest.warns(FormatWarning) as caught:
        formats.write(other, tmp_path / "b.tif")
    assert [str(warning.message) for warning in caught] == [
        "GeoTIFF is written without STATISTICS_MAXIMUM, STATISTICS_MEAN, STATISTICS_MINIMUM of band 1, "
        "which describe other values"
    ]
    assert told(tmp_path / "b.tif")["tags"][1][""] == {"METHOD": "lidar"}


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    tags: dict[str, Any] = {"": {"good": "yes", "a=b": "1", "number": 7}, "RPC": {"LINE_OFF": "far"}, "flat": "text"}
    metadata = {"tags": tags, "bands": {"gone": {"unit": "m"}, "": {"color": "no colour"}}}
    with pytest.warns(FormatWarning) as caught:
        formats.write(Surface(np.zeros((3, 4)), metadata=metadata), tmp_path / "a.tif")
    (note,) = (str(warning.message) for warning in caught)
    for word in ("a=b", "number", "RPC LINE_OFF", "tags flat", "color of band 1", "band gone"):
        assert word in note
    assert formats.read(tmp_path / "a.tif").metadata["tags"][""]["good"] == "yes"
    with pytest.warns(FormatWarning, match="GeoTIFF is written without tags, which GDAL does not write"):
        formats.write(Surface(np.zeros((3, 4)), metadata={"tags": "many"}), tmp_path / "a.tif")


def test_four_bands_of_bytes_are_no_colours(tmp_path: Path) -> None:
    index = np.arange(12, dtype=np.uint8).reshape(3, 4)
    surface = Surface(index, attributes=dict.fromkeys("abc", index[::-1]))
    formats.write(surface, tmp_path / "a.tif")
    back = formats.read(tmp_path / "a.tif")
    assert back.mask is None
    assert list(back.attributes) == ["a", "b", "c"]
    assert "bands" not in back.metadata


def test_what_a_surface_has_not_of_a_geotiff_is_named(tmp_path: Path) -> None:
    from rasterio.control import GroundControlPoint

    profile = {"driver": "GTiff", "count": 1, "height": 3, "width": 4, "dtype": "uint8", "crs": "EPSG:4326"}
    points = [GroundControlPoint(row, row, row, 2 * row, 0) for row in range(4)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(tmp_path / "a.tif", "w", gcps=points, **profile) as dataset:
            dataset.write_colormap(1, {0: (255, 0, 0, 255)})
            dataset.write(np.arange(12, dtype=np.uint8).reshape(1, 3, 4))
        with rasterio.open(tmp_path / "b.tif", "w", **(profile | {"count": 2}), alpha="yes") as dataset:
            dataset.write(np.arange(24, dtype=np.uint8).reshape(2, 3, 4))
    for name, expected in (
        ("a.tif", "^left out the colour table of band 1, 4 ground control points$"),
        ("b.tif", "^left out partial transparency in band 2$"),
    ):
        with pytest.warns(FormatWarning, match=expected):
            formats.read(tmp_path / name)


@pytest.mark.parametrize("name", ["bigtujunga.tif", "lidar_dsm_2m.tif"])
def test_real_files_keep_their_words(tmp_path: Path, name: str) -> None:
    path = data(name)
    formats.write(formats.read(path), tmp_path / "b.tif")
    assert told(tmp_path / "b.tif") == told(path)
