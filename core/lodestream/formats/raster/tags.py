"""What GDAL says of a raster in words: tags of the dataset and of its bands, descriptions, units, and what cells are.

In the metadata of a surface these are ``area_or_point``, ``tags`` (a map of namespaces, of which "" is GDAL's own, to
maps of names to texts), ``description`` (of the band of heights), and ``bands``: for each attribute by its name, and
for the heights under "", a map of what there is of ``description`` (where it is not the name), ``unit``, ``scale``,
``offset``, ``color`` (GDAL's colour interpretation) and ``tags``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...scratch import rows_at_once
from ..notes import listing, warn

__all__ = ["describe", "missing", "read_tags"]

_AREA_OR_POINT = "AREA_OR_POINT"
_XML = "xml:"

#: Namespaces that GDAL makes up from the file itself.
_MADE_UP = ("IMAGE_STRUCTURE", "DERIVED_SUBDATASETS", "SUBDATASETS")

#: Colour interpretations that a band has anyway, or that are told in another way (a mask, a colour table).
_USUAL = ("undefined", "palette")

#: Tags of a band that say something of all its values, and how near to the values they must be.
_LEAST, _GREATEST, _STATISTICS = "STATISTICS_MINIMUM", "STATISTICS_MAXIMUM", "STATISTICS_"
_NEAR = 1e-6

#: Names that rasterio has for something else where it takes tags.
_PARAMETERS = ("self", "bidx", "ns")

Tags = dict[str, dict[str, str]]


def read_tags(dataset: Any, band: int, attributes: Mapping[str, int]) -> dict[str, Any]:
    """The metadata of an open dataset that is words, as GDAL gives them.

    Parameters
    ----------
    dataset : rasterio dataset
    band : int
        That of the heights.
    attributes : mapping of str to int
        The bands of the attributes.
    """
    metadata: dict[str, Any] = {}
    tags = _tags(dataset, 0)
    kind = tags.get("", {}).pop(_AREA_OR_POINT, None)
    if kind is not None:
        metadata["area_or_point"] = kind
    if any(tags.values()):
        metadata["tags"] = {namespace: values for namespace, values in tags.items() if values}
    if dataset.descriptions[band - 1]:
        metadata["description"] = dataset.descriptions[band - 1]
    bands = {}
    said = _Said.of(dataset)
    for name, number in {"": band, **attributes}.items():
        found = _band(dataset, said, number, name)
        if found:
            bands[name] = found
    if bands:
        metadata["bands"] = bands
    return metadata


class _Said(NamedTuple):
    """What a dataset says of each band, read once: rasterio asks all bands whenever one is asked for."""

    descriptions: Sequence[str | None]
    units: Sequence[str | None]
    scales: Sequence[float]
    offsets: Sequence[float]
    colors: Sequence[Any]

    @staticmethod
    def of(dataset: Any) -> _Said:
        return _Said(dataset.descriptions, dataset.units, dataset.scales, dataset.offsets, dataset.colorinterp)


def _band(dataset: Any, said: _Said, number: int, name: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    place = number - 1
    if name:  # the heights have these as metadata of their own
        description = said.descriptions[place] or ""
        if description not in (name, "") or (not description and name != f"band_{number}"):
            found["description"] = description
        if said.units[place]:
            found["unit"] = said.units[place]
        if (said.scales[place], said.offsets[place]) != (1.0, 0.0):
            found |= {"scale": float(said.scales[place]), "offset": float(said.offsets[place])}
    color = said.colors[place].name
    if color not in _USUAL and not (color == "gray" and not name):
        found["color"] = color
    tags = _tags(dataset, number)
    if tags:
        found["tags"] = tags
    return found


def _tags(dataset: Any, band: int) -> Tags:
    """The tags of a band, or of the dataset (0), by their namespaces; what is no text is left out, with a note."""
    result: Tags = {}
    for namespace in dict.fromkeys(["", *dataset.tag_namespaces(band)]):
        if namespace in _MADE_UP:
            continue
        try:
            values = dataset.tags(band, ns=namespace or None)
        except ValueError:  # bytes that are no UTF-8, or an entry without a name
            of = f" of {namespace}" * bool(namespace) + f" of band {band}" * (band > 0)
            warn(f"tags{of} left out, which are not text")
            continue
        if namespace.startswith(_XML):
            # rasterio takes the whole text for one name and value, with its own name in front where it wrote that
            values = {namespace: "".join(values.values())}
        if values:
            result[namespace] = {str(key): str(value) for key, value in values.items()}
    return result


def describe(
    dataset: Any,
    metadata: Mapping[str, Any],
    names: Sequence[str],
    bands: Sequence[NDArray[Any]],
    mask: NDArray[np.bool_] | None,
) -> None:
    """Give an open dataset the words of a surface's metadata.

    Parameters
    ----------
    dataset : rasterio dataset
        For writing, whose bands have not been written yet.
    metadata : mapping
    names : sequence of str
        Of the bands: "" for that of the heights, which is the first.
    bands : sequence of arrays
        Their values, shape (row, column).
    mask : bool, shape (row, column), or None
        True where heights are valid.
    """
    from rasterio.enums import ColorInterp

    _set_tags(dataset, 0, _written(metadata.get("tags")))
    if isinstance(metadata.get("area_or_point"), str):
        dataset.update_tags(**{_AREA_OR_POINT: metadata["area_or_point"]})
    described = [_described(metadata, name, number) for number, name in enumerate(names, 1)]
    for number, found in enumerate(described, 1):
        if found["description"]:
            dataset.set_band_description(number, found["description"])
        tags, stale = _fresh(_written(found.get("tags")), bands[number - 1], mask if number == 1 else None)
        if stale:
            warn(f"GeoTIFF is written without {listing(stale)} of band {number}, which describe other values")
        _set_tags(dataset, number, tags)
    dataset.units = tuple(found["unit"] for found in described)
    dataset.scales = tuple(found["scale"] for found in described)
    dataset.offsets = tuple(found["offset"] for found in described)
    colors = [getattr(ColorInterp, found["color"], None) for found in described]
    if any(colors):
        dataset.colorinterp = [color or known for color, known in zip(colors, dataset.colorinterp, strict=True)]


def _described(metadata: Mapping[str, Any], name: str, number: int) -> dict[str, Any]:
    """What there is to say of one band, of whatever types the metadata are."""
    bands = metadata.get("bands")
    found = bands.get(name) if isinstance(bands, Mapping) else None
    found = dict(found) if isinstance(found, Mapping) else {}
    if not name:
        found |= {key: metadata.get(key) for key in ("description", "unit", "scale", "offset")}
    elif "description" not in found:
        found["description"] = "" if name == f"band_{number}" else name
    texts = {key: str(found.get(key) or "") for key in ("description", "unit", "color")}
    scale, offset = _finite(found.get("scale"), 1.0), _finite(found.get("offset"), 0.0)
    return {**texts, "scale": scale, "offset": offset, "tags": found.get("tags")}


def _finite(value: Any, otherwise: float) -> float:
    number = float(value) if isinstance(value, int | float) else otherwise
    return number if math.isfinite(number) else otherwise


def _written(tags: Any) -> Tags:
    """Of what the metadata call tags, those that can be written."""
    result: Tags = {}
    for namespace, values in tags.items() if isinstance(tags, Mapping) else ():
        if isinstance(values, Mapping) and namespace not in _MADE_UP:
            texts = {key: value for key, value in values.items() if isinstance(key, str) and isinstance(value, str)}
            if texts:
                result[str(namespace)] = texts
    return result


def _fresh(tags: Tags, values: NDArray[Any], mask: NDArray[np.bool_] | None) -> tuple[Tags, list[str]]:
    """Tags of a band without statistics of other values than these, such as those of a finer level."""
    own = tags.get("", {})
    stale = [key for key in own if key.startswith(_STATISTICS)]
    if not stale:
        return tags, []
    try:
        told = [float(own[key]) for key in (_LEAST, _GREATEST)]
    except (KeyError, ValueError):
        told = [math.nan, math.nan]
    found = _range(values, mask)
    if found is not None and np.allclose(told, found, _NEAR, 0):
        return tags, []
    return {**tags, "": {key: value for key, value in own.items() if key not in stale}}, stale


def _range(values: NDArray[Any], mask: NDArray[np.bool_] | None) -> tuple[float, float] | None:
    """The least and the largest of the valid, finite values; None where there are none."""
    ends: list[float] = []
    for rows in rows_at_once(values.shape):
        finite = np.isfinite(values[rows])
        own = values[rows][finite if mask is None else finite & mask[rows]]
        if own.size:
            ends += [float(own.min()), float(own.max())]
    return (min(ends), max(ends)) if ends else None


def _set_tags(dataset: Any, band: int, tags: Tags) -> None:
    for namespace, values in tags.items():
        if namespace.startswith(_XML):
            # rasterio writes a name, "=" and a value, hence the text is cut at its own first "="
            text = "".join(values.values())
            name, equal, value = text.partition("=")
            values = {name: value} if equal else {}
        values = {key: value for key, value in values.items() if key not in _PARAMETERS}
        if values:
            dataset.update_tags(band, ns=namespace or None, **values)


def missing(dataset: Any, metadata: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """What of these words a dataset that was written does not have, in words."""
    lost = _lost_tags(_tags(dataset, 0), metadata.get("tags"), "")
    if str(metadata.get("area_or_point", "")) == "Point" != dataset.tags().get(_AREA_OR_POINT):
        lost.append("area_or_point")
    said = _Said.of(dataset)
    for number, name in enumerate(names, 1):
        found, place = _described(metadata, name, number), number - 1
        there = {
            "description": said.descriptions[place] or "",
            "unit": said.units[place] or "",
            "scale": said.scales[place],
            "offset": said.offsets[place],
            "color": said.colors[place].name if found["color"] else "",
        }
        of = f" of band {number}"
        lost += [key + of for key, value in there.items() if value != found[key]]
        lost += _lost_tags(_tags(dataset, number), found["tags"], of)
    bands = metadata.get("bands")
    if isinstance(bands, Mapping):
        lost += [f"what is known of band {name}" for name in bands if name not in names]
    return lost


def _lost_tags(there: Tags, wanted: Any, of: str) -> list[str]:
    if wanted is None:
        return []
    if not isinstance(wanted, Mapping):
        return [f"tags{of}"]
    lost = []
    for namespace, values in wanted.items():
        if not isinstance(values, Mapping):
            lost.append(f"tags {namespace}{of}")
            continue
        found = there.get(str(namespace), {})
        lost += [
            f"tag {namespace} {key}{of}".replace("  ", " ")
            for key, value in values.items()
            if found.get(key) != value and not str(key).startswith(_STATISTICS)
        ]
    return lost
