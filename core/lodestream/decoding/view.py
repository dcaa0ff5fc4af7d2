"""Views: the states of a surface while its container is being received."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.digest import values_digest
from ..errors import CorruptStreamError, InputError, OptionError
from ..grid.patches import level_masks
from ..grid.window import contains, taken, within
from ..joints import Nodes
from ..planning.selection import Selection, region_at
from ..surface import Block, Closed, Surface
from ..target import Region as Window
from ..target import check_integer
from .level_grids import level_nodes, level_positions, with_rules
from .pieces import region_of_window
from .segments import SegmentQueue
from .values import Values, block_of
from .window_metadata import positions, window_closed, window_metadata

__all__ = ["Ending", "View"]


@dataclass
class Ending:
    """What all views of a surface know of its complete state.

    Attributes
    ----------
    promised : str or None
        The SHA-256 that the values must have, once it has come.
    digest : str or None
        The one that they have, once it was computed.
    computed : bool
        Whether `View.verify` has computed the surface.
    verified : list of (Selection, Surface)
        The surface as it was computed, until somebody takes it. Its level is the finest, so the selection names none.
    damage : CorruptStreamError or None
        What was found to be wrong.
    lock : RLock
        Held while the surface is verified, so that of several threads one does it.
    """

    promised: str | None = None
    digest: str | None = None
    computed: bool = False
    verified: list[tuple[Selection, Surface]] = field(default_factory=list)
    damage: CorruptStreamError | None = None
    lock: RLock = field(default_factory=RLock)


@dataclass(frozen=True)
class View:
    """One state of a surface. Its points are computed on request, even if more data have arrived since.

    Attributes
    ----------
    number : int
        Number of the layer, or of the level in level order. The exact end has the next number.
    level : int
        Finest level of which there are decoded data.
    bytes : int
        Bytes received of header, layers and residual.
    rms, max_error : float
        Errors at full resolution, in the surface's unit; NaN where they are not known.
    bound : bool
        Whether `rms` and `max_error` are upper bounds. This is the case if the view is a window and not exact, because
        a container has measured errors of the whole surface, but only bounds for its parts.
    complete : bool
        Whether this is the last state. If it has a residual, its values are verified when they are first requested;
        `CorruptStreamError` then means that the end is damaged, and views before it stay usable.
    channels : tuple of (rms, max_error)
        Errors of each channel, in its unit and in the order of `Header.channel_names`. Empty if there is only one
        channel, for a window, and if they are not known.

    Examples
    --------
    >>> import lodestream, pathlib
    >>> decoder = lodestream.Decoder()
    >>> view = decoder.feed(pathlib.Path("terrain.lode").read_bytes()[:2000])[-1]
    >>> view.complete, view.points.shape, view.points_at(2).shape
    (False, (97, 70), (4, 4))
    >>> view.rms <= view.max_error
    True
    """

    number: int
    level: int
    bytes: int
    rms: float
    max_error: float
    bound: bool
    complete: bool
    _queue: SegmentQueue = field(repr=False, compare=False)
    _length: int = field(repr=False, compare=False)
    _state: NDArray[np.int8] = field(repr=False, compare=False)
    _corrected: bool = field(repr=False, compare=False)
    _metadata: dict[str, Any] = field(repr=False, compare=False)
    _ending: Ending = field(repr=False, compare=False)
    _selection: Selection = field(repr=False, compare=False)
    channels: tuple[tuple[float, float], ...] = field(default=(), repr=False)

    @property
    def points(self) -> NDArray[Any]:
        """The points of the only block at full resolution, with the dtype and shape of the original.

        Raises
        ------
        InputError
            If there are several blocks; use `surface`.
        """
        return self._shown(self._finest).points

    @property
    def _finest(self) -> int:
        """Finest level that can be shown; of a window the level that was asked for."""
        header, selection = self._queue.header, self._selection
        return header.levels if selection.region is None else selection.finest(header)

    def prepare(self) -> None:
        """Decode the bytes received so far in advance, so that the points of this view or a later one come sooner.

        Does not change any result, and does nothing if few bytes are waiting. With two processors or more, another
        thread decodes while the caller continues (``LODESTREAM_THREADS`` sets the number of threads). It is meant for a
        program that shows only the last view, and receives more slowly than it decodes: it calls this for each view
        that it does not show, so that only the last layers are left at the end. Nothing is decoded twice.

        Raises
        ------
        Exception
            An error of an earlier call, from the other thread; once, unless the bytes were decoded since.
        """
        self._queue.prepare(self._length)

    def points_at(self, level: int, block: int | None = None) -> NDArray[Any]:
        """Return the grid of a coarser level, an array with that level's shape.

        Parameters
        ----------
        level : int
        block : int, optional
            Number of the block; needed if there are several.

        Raises
        ------
        OptionError
            If there is no such level or block.
        InputError
            If there are several blocks and none was given.
        """
        surface = self._shown(level)
        if block is None:
            return surface.points
        if not 0 <= block < len(surface.blocks):
            raise OptionError(f"expected a block of 0 to {len(surface.blocks) - 1}, got {block}")
        return surface.blocks[block].points

    def window(self, region: Window, level: int | None = None) -> Surface:
        """Return the points of a window, at full resolution or at a coarser level. Time and memory follow its size.

        If the complete state has to be verified (see `complete`), the first window at full resolution computes the
        whole surface once.

        At full resolution, heights whose values lie on a lattice (integers, decimals) are exact in the window as soon
        as its data have arrived. `points` is exact only when everything has arrived. The window of a coarser level is
        always a part of that level's grid, bit for bit as returned by `surface`.

        Parameters
        ----------
        region : ((int, int), (int, int))
            Rows and columns, half-open, in full-resolution indices at any level; along a closed axis they may go on
            across the seam, as columns 350:370 of 360.
        level : int, optional
            A coarser level; the window then consists of its points that lie in the region. None: full resolution, or
            the finest level of a window that was received at a coarser one.

        Raises
        ------
        OptionError
            If the region is outside the surface or has fewer than two points of the level, the surface has several
            blocks, the view holds another region only, or there is no such level.
        CorruptStreamError
            If the end is damaged, see `complete`.
        """
        header, shown = self._queue.header, self._selection.region
        finest = self._finest
        level = finest if level is None else check_integer("a level", level)
        if not 0 <= level <= finest:
            raise OptionError(f"expected a level of 0 to {finest}, got {level}")
        selection = Selection(region, self._selection.attributes, level)
        selection.check_surface(header)
        if shown is not None and not contains(shown, region, header.shape):
            raise OptionError(f"expected a region inside the one received, {shown}, got {region}")
        state = self._state
        if level == header.levels:
            self.verify()
            state = state.copy()
            state[~selection.tiles(header)] = 0
        return replace(self, _selection=selection, _state=state).surface()

    def surface(self, level: int | None = None, metadata: Mapping[str, Any] | None = None) -> Surface:
        """Return the state as a `Surface`, at full resolution or at a coarser level.

        Parameters
        ----------
        level : int, optional
            A level; None: full resolution, or the finest level of a window that was received at a coarser one. The
            geotransform of a coarser level spans the same area. Files of the finest level repeat the rows and columns
            that the source repeats, files of coarser ones do not.
        metadata : mapping, optional
            Used instead of the container's metadata, which may not have arrived yet.

        Raises
        ------
        OptionError
            If there is no such level.
        CorruptStreamError
            If the SHA-256 of the complete surface is wrong, or no value is finite.
        """
        header = self._queue.header
        shown = self._finest if level is None else level
        surface = self._shown(shown, metadata)
        whole = shown == header.levels and self._selection.region is None
        surface.joints = header.joints if whole else header.joints.at(self._nodes(shown))
        return surface

    def _shown(self, level: int, metadata: Mapping[str, Any] | None = None) -> Surface:
        """Return `surface` without its joints: points alone can be shown sooner."""
        header = self._queue.header
        if not 0 <= level <= self._finest:
            raise OptionError(f"expected a level of 0 to {self._finest}, got {level}")
        values = dict(self._metadata if metadata is None else metadata)
        if level != header.levels:  # the grid of that level, without what a seam repeats
            values = {key: value for key, value in values.items() if key not in ("seam", "turn")}
        if level == header.levels:
            self.verify()
        return self._made(level, values, self._taken() if level == header.levels else None)

    def _made(self, level: int, values: dict[str, Any], kept: Surface | None = None) -> Surface:
        """Return `_shown` with these metadata of the whole surface.

        ``kept``: holes with values, if they are known already.
        """
        if kept is None:
            surface, values = self._positioned(Surface(blocks=self._blocks(level)), values, level)
        else:
            surface, values = kept, self._placed_metadata(values, level)
        self._check_digest(surface, level)
        surface.metadata = values
        return surface

    def verify(self) -> None:
        """Verify, once, a complete state that has a residual: its chunks may be damaged.

        The surface is computed and compared with its SHA-256, now or as soon as that has arrived; the next `surface`
        returns it. For other states nothing is done.

        Raises
        ------
        CorruptStreamError
            If a chunk of the residual is damaged or the SHA-256 is wrong; at every call.
        """
        if not self._corrected or self._queue.dropped:
            return
        ending = self._ending
        with ending.lock:
            if ending.damage is None:
                try:
                    if not ending.computed:
                        self._compute()
                        ending.computed = True
                    self._hold_to_digest()
                except CorruptStreamError as error:
                    ending.damage = error
                    ending.verified.clear()
            if ending.damage is not None:
                raise ending.damage

    def _compute(self) -> None:
        """Compute the complete surface, and its SHA-256 where it may be compared."""
        try:
            surface = self._made(self._queue.header.levels, dict(self._metadata))
        except InputError:
            return  # nothing of this window is valid, which is no damage
        header, ending = self._queue.header, self._ending
        whole = self._selection.region is None and self._selection.channels(header).all()
        if ending.digest is None and header.exact and whole:
            # The SHA-256 may come after the residual: the values need not be computed again then.
            ending.digest = values_digest(surface.blocks)
        ending.verified.append((replace(self._selection, level=None), surface))

    def _taken(self) -> Surface | None:
        """Return the complete surface that `verify` has computed, once; else None."""
        if self._corrected:
            with suppress(IndexError):
                selection, surface = self._ending.verified.pop()
                if selection == replace(self._selection, level=None):
                    return surface
                self._ending.verified.append((selection, surface))
        return None

    def _repr_html_(self) -> str:
        """Return the HTML for a notebook: a small picture, sizes and errors."""
        from ..interop.html import small_level, view_html

        header, region = self._queue.header, self._selection.region
        if region is not None:
            window = self.surface()
            return view_html(self, window, [window.blocks[0].shape])
        return view_html(self, self.surface(small_level(header)), [shape for shape, _ in header.blocks])

    def _blocks(self, level: int) -> list[Block]:
        """Return all blocks at a level, or the window of the only one; without the x and y of height fields."""
        queue, window = self._queue, self._selection.region
        header, chosen = queue.header, self._selection.channels(queue.header)
        corrected = self._corrected and level == header.levels
        masks = level_masks(header.patches, header.layout, level, header.masks)
        if level < header.levels:  # if no node of a level is valid, the values under the holes are shown
            masks = [mask if mask is None or mask.any() else None for mask in masks]
        closures: list[Closed] = [closed for _, closed in header.blocks]
        region = region_of_window(header, level, window)
        values = queue.values(self._length, self._state, region, corrected, chosen)
        if window is not None:
            shape, inside = header.level_shape(level) or header.shape, region_at(header, window, level)
            around = region.spans_in(shape)
            values = {0: Values([within(array, around, inside, shape) for array in values[0].arrays])}
            masks = [None if mask is None else taken(mask, inside, shape) for mask in masks]
            closures = [window_closed(header.closed, shape, inside)]
        return [self._block(values[number].arrays, *of) for number, of in enumerate(zip(closures, masks, strict=True))]

    def _block(self, arrays: Sequence[NDArray[Any]], closed: Closed, mask: NDArray[np.bool_] | None) -> Block:
        """Make a block from its points and attributes, shape (row, column, component) each; ``mask``, (row, column)."""
        header, selection = self._queue.header, self._selection
        finite = selection.region is None and not self._corrected  # the values of a lattice are
        try:
            return block_of(header, arrays, closed, mask, selection.attributes, finite)
        except InputError as error:
            if selection.region is not None:
                raise  # nothing of this window is valid
            raise CorruptStreamError(f"expected the points of a surface: {error}", header.length) from None

    def _positioned(self, surface: Surface, values: dict[str, Any], level: int) -> tuple[Surface, dict[str, Any]]:
        """Return the surface with the x and y of its height field, and the metadata of its level or window."""
        header, region = self._queue.header, self._selection.region
        finest = level == header.levels
        whole = finest and region is None
        surface = with_rules(surface, header, None if whole else self._nodes(level)[0], self._kept(finest))
        return surface, self._placed_metadata(values, level)

    def _placed_metadata(self, values: dict[str, Any], level: int) -> dict[str, Any]:
        """Return the metadata of the grid of a level, or of its window, from those of the whole surface."""
        header, region = self._queue.header, self._selection.region
        if region is not None:
            return window_metadata(values, header, region, level)
        if level < header.levels and len(header.blocks) == 1 and header.point_channels == 1:
            return level_positions(values, header, level)
        return values

    def _hold_to_digest(self) -> None:
        """Compare the SHA-256 of the values with the recorded one, if both are known.

        Raises
        ------
        CorruptStreamError
            If they differ.
        """
        promised, digest = self._ending.promised, self._ending.digest
        if promised is not None and digest is not None and promised != digest:
            problem = f"expected values with the SHA-256 {promised}, got {digest}"
            raise CorruptStreamError(problem, self._queue.header.length)

    def _check_digest(self, surface: Surface, level: int) -> None:
        """Compare the values with the recorded SHA-256 if this is the complete surface and it is exact."""
        header, selection = self._queue.header, self._selection
        if self._ending.promised is None or not self.complete or not header.exact or level != header.levels:
            return
        if selection.region is None and selection.channels(header).all():
            self._ending.digest = self._ending.digest or values_digest(surface.blocks)
            self._hold_to_digest()

    def _nodes(self, level: int) -> list[Nodes]:
        """Return the rows and columns of each block that are shown at a level, or in the window."""
        header, region = self._queue.header, self._selection.region
        if region is not None:
            lines = zip(positions(header, region, level), header.shape, strict=True)
            rows, columns = (line % length for line, length in lines)
            return [(rows, columns)]
        return level_nodes(header, level)

    def _kept(self, finest: bool) -> NDArray[np.bool_] | None:
        """Return the holes of the only block that keep their values."""
        if not (finest and self._corrected):
            return None
        header, region = self._queue.header, self._selection.region
        kept = header.kept_masks[0]
        return kept if kept is None or region is None else taken(kept, region, header.shape)
