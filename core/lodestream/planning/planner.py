"""Planning what is sent of a container, and in which order: one pure function for server and client.

Only slices of the file are ever sent. So WebSocket streams, HTTP Range, resuming and caching share this module.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import groupby

from ..container.model import ByteRange, Errors, Header, Index
from ..errors import OptionError
from ..target import Region, Target
from .byte_ranges import RangeSet
from .limits import ErrorLimits
from .plan import Mark, Plan, Reason
from .region_first import region_first
from .selection import select, selection_of
from .window_errors import WindowErrors, WindowFigures, wants_window_errors, window_section

__all__ = ["Mark", "Plan", "Reason", "plan"]


def plan(
    index: Index,
    target: Target = Target(),  # noqa: B008 - an immutable value
    cached: RangeSet | None = None,
    *,
    windows: WindowErrors | None = None,
    bounded: bool = True,
) -> Plan:
    """Plan the slices for a receiver with this target that has cached these bytes of the container.

    Of a window, errors before its end are bounds, see `window_errors.WindowFigures`; limits are met where these are.

    Parameters
    ----------
    index : Index
    target : Target
    cached : RangeSet or None
    windows : WindowErrors or None
        The container's own bounds of the errors of windows. Their section then comes behind the index, if the target
        is a window at full resolution.
    bounded : bool
        Whether errors of windows are told. False: they are NaN before the end, as receivers of
        earlier releases expect.

    Raises
    ------
    OptionError
        If there is no such level, region or channel, or not even the first layer fits into the allowed bytes.
    """
    chosen = _whole(index, target, windows, bounded)
    if target.first is not None:
        chosen = region_first(index, chosen, target.first)
    return _less(chosen, cached) if cached else chosen


def _whole(index: Index, target: Target, windows: WindowErrors | None, bounded: bool) -> Plan:
    """Plan a stream of the whole surface."""
    if target.region is not None or target.attributes is not None:
        return _selected(index, target, windows, bounded)
    if target.level is not None:
        finest = index.header.levels
        if target.level > finest:
            raise OptionError(f"expected a level of 0 to {finest}, got {target.level}")
        if target.level < finest:
            if target.order == "level":
                return _by_level(index, target, target.level)
            return _slices_of_layers(index, target.level)
    if target.order == "level":
        return _by_level(index, target, index.header.levels)
    return _prefix(index, target)


def _prefix(index: Index, target: Target) -> Plan:
    """Plan in quality order, which is the order of the file."""
    marks = [Mark(r.end, r.number, r.level, r.end, *r.errors) for r in index.layers]
    if index.residual:
        marks.append(_exact(index, len(marks), index.surface_end))
    marks, ended = _until(marks, target, index.header)
    return Plan((), (ByteRange(0, marks[-1].sent),), (index.metadata,), tuple(marks), ended, prefix=True)


def _exact(index: Index, number: int, size: int) -> Mark:
    """Return the final mark of an exact stream."""
    last = index.levels[-1]
    return Mark(size, number, last.level, size, *last.errors)


def _until(marks: list[Mark], target: Target, header: Header) -> tuple[list[Mark], Reason]:
    """Return the marks up to the first one that meets a limit."""
    limits = ErrorLimits.of(target, header)
    kept: list[Mark] = []
    for mark in marks:
        if target.max_bytes is not None and mark.bytes > target.max_bytes:
            if not kept:
                raise OptionError(
                    f"expected at least the {mark.bytes} bytes of the first layer or level, got {target.max_bytes}"
                )
            return kept, "bytes"
        kept.append(mark)
        if mark is marks[-1]:
            break  # complete, even if it meets a tolerance too
        if (met := limits.met(mark.rms, mark.max_error, mark.channels)) is not None:
            return kept, met
    return kept, "complete"


def _slices_of_layers(index: Index, level: int) -> Plan:
    """Return the slices of levels up to one in quality order: each layer's segments of these levels are contiguous."""
    levels = index.header.layout.tile_levels.data
    ranges, size = [ByteRange(0, index.header.length)], index.header.length
    marks: list[Mark] = []
    for layer, segments in groupby(index.segments, key=lambda segment: segment.layer):
        for segment in segments:
            if levels[segment.tile] <= level:
                _append(ranges, segment.range)
                size += segment.range.length
        record = index.layers[layer]
        if record.level <= level:
            marks.append(Mark(size, layer, record.level, size, *record.errors))
    state = index.levels[level]
    # Layers that add nothing up to this level end where the level does: its own state, with its errors, says it better.
    marks = [mark for mark in marks if mark.sent < size]
    marks.append(Mark(size, level, level, size, *state.errors))
    return Plan((index.index,), tuple(ranges), (index.metadata,), tuple(marks), "level")


def _by_level(index: Index, target: Target, level: int) -> Plan:
    """Plan in level order: level by level the segments of all layers; the complete surface also has its residual."""
    levels = index.header.layout.tile_levels.data
    ranges, size = [ByteRange(0, index.header.length)], index.header.length
    marks: list[Mark] = []
    of_level: list[list[ByteRange]] = [[] for _ in index.levels]
    for segment in index.segments:
        of_level[levels[segment.tile]].append(segment.range)
    for state, places in zip(index.levels[: level + 1], of_level, strict=False):
        for place in places:
            _append(ranges, place)
            size += place.length
        if state.level == index.header.levels and index.residual:
            _append(ranges, index.residual)
            size += index.residual.length
        marks.append(Mark(size, state.level, state.level, size, *state.errors))
    if target.level is not None:
        return Plan((index.index,), tuple(ranges), (index.metadata,), tuple(marks), _level_end(index, level))
    marks, ended = _until(marks, target, index.header)
    return Plan((index.index,), _cut(ranges, marks[-1].sent), (index.metadata,), tuple(marks), ended)


def _selected(index: Index, target: Target, windows: WindowErrors | None, bounded: bool) -> Plan:
    """Plan a window, or some attributes: segments in file order or level by level, then chunks of residual."""
    chosen = select(index, selection_of(target))
    windows = windows if wants_window_errors(target, index.header) else None
    levels, within = index.header.layout.tile_levels.data, _figures(index, target.region, windows, bounded)
    finest = selection_of(target).finest(index.header)
    segments = [s for s in chosen.segments if levels[s.tile] <= finest]
    if target.order == "level":
        segments.sort(key=lambda segment: levels[segment.tile])
    ranges, size = [ByteRange(0, index.header.length)], index.header.length
    marks: list[Mark] = []
    level = 0
    ended: Reason
    for number, segment in enumerate(segments):
        _append(ranges, segment.range)
        size += segment.range.length
        segment_level = levels[segment.tile]
        level = max(level, segment_level)
        after = segments[number + 1] if number + 1 < len(segments) else None
        if target.order == "level":
            if after is None or levels[after.tile] > segment_level:
                state = index.levels[segment_level]
                marks.append(Mark(size, segment_level, segment_level, size, *within(state.errors)))
        elif after is None or after.layer > segment.layer:
            # Layers without a selected segment are complete as well.
            record = index.layers[-1 if after is None else after.layer - 1]
            if record.level <= finest:
                marks.append(Mark(size, record.number, level, size, *within(record.errors, record.number)))
    if finest < index.header.levels:
        state = index.levels[finest]
        last, ended = Mark(size, finest, finest, size, *within(state.errors)), "level"
    else:
        for chunk in chosen.chunks.values():
            _append(ranges, chunk.range)
            size += chunk.range.length
        state, number = index.levels[-1], len(index.layers) if chosen.chunks else len(index.layers) - 1
        figures = state.errors if target.region is None else Errors(state.rms, state.max_error)
        if bounded or target.region is None:
            figures = within(figures, None if chosen.chunks else number)
        last, ended = Mark(size, number, finest, size, *figures), "complete"
    # A state of the same bytes as the last is the last.
    marks = [mark for mark in marks if mark.sent < size] + [last]
    if target.level is None:
        marks, ended = _until(marks, target, index.header)
    section = window_section(index) if windows is not None and bounded else None
    before = (index.index,) if section is None else (index.index, section)
    return Plan(before, _cut(ranges, marks[-1].sent), (index.metadata,), tuple(marks), ended)


def _figures(index: Index, region: Region | None, windows: WindowErrors | None, bounded: bool) -> Callable[..., Errors]:
    """Return a function from errors of the whole surface (and the layer) to those known of the selection."""
    if region is None:
        return lambda errors, layer=None: errors
    if not bounded:
        return lambda errors, layer=None: Errors(math.nan, math.nan)
    figures = WindowFigures(index.header, region, windows)
    return lambda errors, layer=None: Errors(*figures.within(errors.rms, errors.maximum, layer))


def _level_end(index: Index, level: int) -> Reason:
    """Return the reason for the end of a stream at a level."""
    return "complete" if level == index.header.levels else "level"


def _append(ranges: list[ByteRange], place: ByteRange) -> None:
    """Append a range, merging it with the last one if they are adjacent."""
    if ranges and ranges[-1].end == place.offset:
        ranges[-1] = ByteRange(ranges[-1].offset, ranges[-1].length + place.length)
    else:
        ranges.append(place)


def _cut(ranges: list[ByteRange], length: int) -> tuple[ByteRange, ...]:
    """Cut ranges after ``length`` bytes."""
    kept = []
    for place in ranges:
        kept_length = min(place.length, length)
        if kept_length:
            kept.append(ByteRange(place.offset, kept_length))
        length -= kept_length
    return tuple(kept)


def _less(chosen: Plan, cached: RangeSet) -> Plan:
    """Return the plan without cached bytes; each mark follows the last missing byte before it."""
    missing = [(place, _missing(place, cached)) for place in chosen.ranges]
    marks: list[Mark] = []
    todo = iter(chosen.marks)
    mark = next(todo, None)
    planned = sent = 0
    for place, gaps in missing:
        # Marks and gaps both ascend: each gap is visited once, however many marks there are.
        passed = 0
        while mark is not None and mark.sent <= planned + place.length:
            end = place.offset + mark.sent - planned
            while passed < len(gaps) and gaps[passed].end <= end:
                sent += gaps[passed].length
                passed += 1
            begun = max(end - gaps[passed].offset, 0) if passed < len(gaps) else 0
            # A mark inside a gap is that far into it; a mark in cached bytes is at the end of the gap before it.
            marks.append(replace(mark, sent=sent + begun))
            mark = next(todo, None)
        planned += place.length
        sent += sum(gap.length for gap in gaps[passed:])
    before, after = (
        tuple(gap for place in part for gap in _missing(place, cached)) for part in (chosen.before, chosen.after)
    )
    ranges = tuple(gap for _, gaps in missing for gap in gaps)
    # For a state without errors, cached bytes beyond it count too.
    ahead = chosen.bytes - sent
    marks = [replace(mark, bytes=ahead + mark.sent) if math.isnan(mark.rms) else mark for mark in marks]
    return replace(chosen, before=before, ranges=ranges, after=after, marks=tuple(marks))


def _missing(place: ByteRange, cached: RangeSet) -> list[ByteRange]:
    """Return the parts of a range that are not cached."""
    return [ByteRange(*gap) for gap in cached.missing(place.offset, place.length)]
