"""Decoding where the compiled kernels are missing: `lodestream.reference` in their place, slow and right everywhere."""

from __future__ import annotations

import functools
import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import reference
from ..container.headers import serialize_header
from ..container.model import Header
from ..container.sections import SIGNATURE
from ..entropy.dequantize import UNANNOUNCED
from ..errors import CorruptStreamError, StreamError
from ..library import why_missing
from ..target import Region
from .reconstruction import Reconstruction, Values

__all__ = ["PlainReconstruction"]

_log = logging.getLogger(__name__)


@functools.cache
def _say_so() -> None:
    _log.warning(
        "Lodestream decodes in plain Python, about a hundred times slower than with its kernels: %s", why_missing()
    )


class PlainReconstruction(Reconstruction):
    """A `Reconstruction` by the reference.

    It is given what the decoder has read and checked: the header, and segments one after another. Windows are cut out
    of the whole surface.
    """

    def __init__(self, header: Header) -> None:
        super().__init__(header)
        section = reference.read_section(serialize_header(header), len(SIGNATURE))
        self._decoder = reference.Decoder(reference.read_header(section.payload))
        #: The number of a segment, and the objects that decoding it changes, with copies of their attributes.
        self._before: tuple[int, list[tuple[Any, dict[str, Any]]]] = -1, []

    def _whole(
        self, length: int, state: NDArray[np.int8], level: int, chosen: NDArray[np.bool_] | None
    ) -> list[Values]:
        header, channels = self.header, []
        with self._lock:
            self._decode(length)
            remaining = np.where(state == UNANNOUNCED, -1, state).ravel().tolist()
            for number in range(header.channels):
                wanted = chosen is None or chosen[number]
                channels.append(self._decoder.channel(number, level, remaining) if wanted else None)
        assert channels[0] is not None  # of the points, which are wanted in any case
        blocks = []
        for block, first in enumerate(channels[0]):
            arrays, channel = [], 0
            for count in (header.point_channels, *(kind.channels for kind in header.attributes)):
                array = np.zeros((*first.shape, count), header.dtypes[channel])
                for component in range(count):
                    if (made := channels[channel]) is not None:
                        array[..., component] = made[block]
                    channel += 1
                arrays.append(array)
            blocks.append(Values(arrays))
        return blocks

    def _window_values(self, length: int, state: NDArray[np.int8], region: Region, chosen: NDArray[np.bool_]) -> Values:
        rows, columns = (slice(*span) for span in region)
        whole = self._whole(length, state, self.header.levels, chosen)[0]
        return Values([np.ascontiguousarray(array[rows, columns]) for array in whole.arrays])

    def _restored(self, known: NDArray[Any], chunk: bytes, offset: int) -> NDArray[Any]:
        try:
            return reference.restore(chunk, known)
        except StreamError as error:
            raise CorruptStreamError(str(error), offset) from None

    def _decode(self, length: int) -> None:
        _say_so()
        while self._taken < length:
            segment = self._queue[self._taken]
            number = segment.tile * self.header.channels + segment.channel
            if self._before[0] == self._taken:  # an interruption left the unit anywhere within the segment
                for thing, attributes in self._before[1]:
                    vars(thing).update(attributes)
            self._before = self._taken, [(thing, _copied(vars(thing))) for thing in self._decoder.changing(number)]
            top = segment.first // 2 + 1 if self._decoder.remaining[number] < 0 else None
            self._decoder.add(reference.Segment(number, segment.passes, top, bytes(segment.data)))
            self._taken += 1
            self._forget(self._taken)


def _copied(attributes: dict[str, Any]) -> dict[str, Any]:
    """What decoding changes is in arrays, in lists, and in lists and tuples of lists; all else it replaces."""
    return {name: _copy(value) for name, value in attributes.items()}


def _copy(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, list | tuple) and value and isinstance(value[0], list):
        return type(value)(map(list, value))
    return list(value) if isinstance(value, list) else value
