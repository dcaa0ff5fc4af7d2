"""Text metadata of rasters: tags of the dataset and of its bands, descriptions, units, and the meaning of cells.

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
    """Return the text metadata of an open dataset, as GDAL gives them.

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
    facts = _BandFacts.of(dataset)
    for name, number in {"": band, **attributes}.items():
        words = _band(dataset, facts, number, name)
        if words:
            bands[name] = words
    if bands:
        metadata["bands"] = bands
    return metadata


class _BandFacts(NamedTuple):
    """Facts of all bands, read once: rasterio reads all bands whenever one is asked for."""

    descriptions: Sequence[str | None]
    units: Sequence[str | None]
    scales: Sequence[float]
    offsets: Sequence[float]
    colors: Sequence[Any]

    @staticmethod
    def of(dataset: Any) -> _BandFacts:
        return _BandFacts(dataset.descriptions, dataset.units, dataset.scales, dataset.offsets, dataset.colorinterp)


def _band(dataset: Any, facts: _BandFacts, number: int, name: str) -> dict[str, Any]:
    words: dict[str, Any] = {}
    place = number - 1
    if name:  # the heights have these as metadata of their own
        description = facts.descriptions[place] or ""
        if description not in (name, "") or (not description and name != f"band_{number}"):
            words["description"] = description
        if facts.units[place]:
            words["unit"] = facts.units[place]
        if (facts.scales[place], facts.offsets[place]) != (1.0, 0.0):
            words |= {"scale": float(facts.scales[place]), "offset": float(facts.offsets[place])}
    color = facts.colors[place].name
    if color not in _USUAL and not (color == "gray" and not name):
        words["color"] = color
    tags = _tags(dataset, number)
    if tags:
        words["tags"] = tags
    return words


def _tags(dataset: Any, band: int) -> Tags:
    """Return the tags of a band, or of the dataset (0), by namespace; a note is issued of tags that are no text."""
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
    """Write the text metadata of a surface into an open dataset.

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
    for number, words in enumerate(described, 1):
        if words["description"]:
            dataset.set_band_description(number, words["description"])
        tags, stale = _fresh(_written(words.get("tags")), bands[number - 1], mask if number == 1 else None)
        if stale:
            warn(f"GeoTIFF is written without {listing(stale)} of band {number}, which describe other values")
        _set_tags(dataset, number, tags)
    dataset.units = tuple(words["unit"] for words in described)
    dataset.scales = tuple(words["scale"] for words in described)
    dataset.offsets = tuple(words["offset"] for words in described)
    colors = [getattr(ColorInterp, words["color"], None) for words in described]
    if any(colors):
        dataset.colorinterp = [color or known for color, known in zip(colors, dataset.colorinterp, strict=True)]


def _described(metadata: Mapping[str, Any], name: str, number: int) -> dict[str, Any]:
    """Return the description of one band, whatever types the metadata have."""
    bands = metadata.get("bands")
    words = bands.get(name) if isinstance(bands, Mapping) else None
    words = dict(words) if isinstance(words, Mapping) else {}
    if not name:
        words |= {key: metadata.get(key) for key in ("description", "unit", "scale", "offset")}
    elif "description" not in words:
        words["description"] = "" if name == f"band_{number}" else name
    texts = {key: str(words.get(key) or "") for key in ("description", "unit", "color")}
    scale, offset = _finite(words.get("scale"), 1.0), _finite(words.get("offset"), 0.0)
    return {**texts, "scale": scale, "offset": offset, "tags": words.get("tags")}


def _finite(value: Any, otherwise: float) -> float:
    number = float(value) if isinstance(value, int | float) else otherwise
    return number if math.isfinite(number) else otherwise


def _written(tags: Any) -> Tags:
    """Return the tags in the metadata that can be written."""
    result: Tags = {}
    for namespace, values in tags.items() if isinstance(tags, Mapping) else ():
        if isinstance(values, Mapping) and namespace not in _MADE_UP:
            texts = {key: value for key, value in values.items() if isinstance(key, str) and isinstance(value, str)}
            if texts:
                result[str(namespace)] = texts
    return result


def _fresh(tags: Tags, values: NDArray[Any], mask: NDArray[np.bool_] | None) -> tuple[Tags, list[str]]:
    """Return the tags of a band without statistics of other values, such as those of a finer level."""
    plain = tags.get("", {})
    stale = [key for key in plain if key.startswith(_STATISTICS)]
    if not stale:
        return tags, []
    try:
        stated = [float(plain[key]) for key in (_LEAST, _GREATEST)]
    except (KeyError, ValueError):
        stated = [math.nan, math.nan]
    actual = _range(values, mask)
    if actual is not None and np.allclose(stated, actual, _NEAR, 0):
        return tags, []
    return {**tags, "": {key: value for key, value in plain.items() if key not in stale}}, stale


def _range(values: NDArray[Any], mask: NDArray[np.bool_] | None) -> tuple[float, float] | None:
    """Return the smallest and the largest of the valid, finite values; None without any."""
    ends: list[float] = []
    for rows in rows_at_once(values.shape):
        finite = np.isfinite(values[rows])
        valid = values[rows][finite if mask is None else finite & mask[rows]]
        if valid.size:
            ends += [float(valid.min()), float(valid.max())]
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
    """Return a list, in words, of text metadata that the written dataset does not have."""
    lost = _lost_tags(_tags(dataset, 0), metadata.get("tags"), "")
    if str(metadata.get("area_or_point", "")) == "Point" != dataset.tags().get(_AREA_OR_POINT):
        lost.append("area_or_point")
    facts = _BandFacts.of(dataset)
    for number, name in enumerate(names, 1):
        words, place = _described(metadata, name, number), number - 1
        there = {
            "description": facts.descriptions[place] or "",
            "unit": facts.units[place] or "",
            "scale": facts.scales[place],
            "offset": facts.offsets[place],
            "color": facts.colors[place].name if words["color"] else "",
        }
        of = f" of band {number}"
        lost += [key + of for key, value in there.items() if value != words[key]]
        lost += _lost_tags(_tags(dataset, number), words["tags"], of)
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
        present = there.get(str(namespace), {})
        lost += [
            f"tag {namespace} {key}{of}".replace("  ", " ")
            for key, value in values.items()
            if present.get(key) != value and not str(key).startswith(_STATISTICS)
        ]
    return lost
