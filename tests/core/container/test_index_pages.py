"""The index of large containers: several pages, many layers, long skips; the package and the reference agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lodestream as ls
from lodestream.container import Header, sections
from lodestream.container import index as container_index
from lodestream.container.chunks import chunks_of_a_channel
from lodestream.container.model import Errors
from lodestream.container.writer import CodedLayer, CodedSegment, write_container
from lodestream.transform.predictors import default_predictors
from tests import reference

from ..surfaces import index_of, terrain
from .forgery import with_index

SHAPE = 2600, 2500
LAYERS = 90


def large_header(attribute: bool) -> Header:
    """Of a surface of some hundred tiles and windows, which nobody has to encode."""
    heights = terrain((9, 9))
    made = ls.Surface(heights, attributes={"a": heights}) if attribute else ls.Surface(heights)
    known = index_of(ls.encode(made)).header
    header = replace(known, blocks=((SHAPE, (False, False)),), exact=False)
    predictors = np.stack([default_predictors(header.layout)] * header.channels)
    return replace(header, predictors=predictors, empty=(0,) * header.channels)


def written(seed: int, attribute: bool) -> bytes:
    rng = np.random.default_rng(seed)
    header = large_header(attribute)
    units = len(header.layout.tiles) * header.channels
    assert min(units // header.channels, chunks_of_a_channel(header)) > 64
    layers: list[list[CodedSegment]] = [[] for _ in range(LAYERS)]
    for unit in np.flatnonzero(rng.random(units) < rng.choice([0.02, 0.5, 0.9])).tolist():
        tile, channel = divmod(unit, header.channels)
        top = int(rng.integers(1, 29))
        left, begins = 2 * top - 1, True
        for layer in np.flatnonzero(rng.random(LAYERS) < rng.choice([0.01, 0.2])).tolist():
            if left:
                passes = min(int(rng.choice([1, 2, 7, 8, 9, 55])), left)
                data = rng.bytes(int(rng.choice([1, 3, 127, 128, 300])))
                layers[layer].append(CodedSegment(tile, channel, top, passes, begins, data))
                left, begins = left - passes, False
    used = {(segment.tile, segment.channel) for own in layers for segment in own}
    free = (unit for unit in range(units) if divmod(unit, header.channels) not in used)
    for own in layers:  # none may be without segments
        if not own:
            own.append(CodedSegment(*divmod(next(free), header.channels), 1, 1, True, rng.bytes(2)))
    pairs = ((0.5, 1.0),) * header.channels if header.channels > 1 else ()
    errors = [Errors(LAYERS - k, 2.0 * LAYERS, pairs) for k in range(LAYERS)]
    chunks = [rng.bytes(int(rng.choice([0, 1, 200]))) for _ in range(chunks_of_a_channel(header) * header.channels)]
    coded = [CodedLayer(error, own) for error, own in zip(errors, layers, strict=True)]
    levels = [errors[0]] * header.levels + [errors[-1]]
    return write_container(header, coded, levels, chunks, {}, exact=False, optional={200: b"more", 201: b""})


@pytest.mark.parametrize("attribute", [False, True])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.long
def test_an_index_of_several_pages_comes_back(seed: int, attribute: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(container_index, "PAGE", 64)
    monkeypatch.setattr("tests.reference.index.PAGE", 64)
    data = written(seed, attribute)
    index = index_of(data)
    assert [optional.kind for optional in index.optional] == [200, 201]
    assert len(index.layers) == LAYERS
    told = reference.read_container(data)
    channels = index.header.channels
    known = reference.read_index(data, told)
    own = [[s for s in index.segments if s.layer == layer] for layer in range(LAYERS)]
    for layer, record, entries, segments in zip(told.layers, index.layers, known.segments, own, strict=True):
        assert (layer.end, layer.errors.rms) == (record.end, record.rms)
        assert len(layer.segments) == len(entries) == len(segments)
        for found, entry, segment in zip(layer.segments, entries, segments, strict=True):
            place = segment.range
            assert (entry.start, entry.length, entry.check) == (place.offset, place.length, segment.check)
            assert found.data == data[place.offset : place.end] == entry.take(data).data
            assert sections.check_of(found.data) == segment.check
            assert found.unit == entry.unit == segment.tile * channels + segment.channel
            assert (found.passes, entry.top) == (segment.passes, segment.top) == (entry.passes, segment.top)
    chunks = [data[chunk.range.offset : chunk.range.end] for chunk in index.chunks]
    assert told.residual is not None
    assert chunks == told.residual.chunks == [entry.take(data).data for entry in known.chunks]


def test_pages_that_contradict_each_other_are_corrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(container_index, "PAGE", 64)
    data = written(1, False)
    index = index_of(data)
    honest = container_index._segment_pages(index)
    assert len(honest) > 3
    for pages in (honest[:-1], [*honest, honest[-1]], honest[::-1], [honest[0], honest[0], *honest[2:]]):
        with monkeypatch.context() as patch:
            patch.setattr(container_index, "_segment_pages", lambda index, pages=pages: pages)
            other = with_index(data, index)
        with pytest.raises(ls.CorruptStreamError):
            index_of(other)
