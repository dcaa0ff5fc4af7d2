"""A codec of zarr (version 3 of its format): each chunk of two dimensions is a container.

The name of the codec is ``lodestream``. Its configuration may have a ``precision``; without one, chunks come back bit
for bit. A chunk begins with its kind: ``C``, a container follows; or ``Z``, values by zlib, in the order of C
and little-endian, where a container would be longer or could not hold them: all NaN, NaN with unusual bits, doubles
too large for it, or a precision that is too fine for the type. So every chunk can be written.
"""

from __future__ import annotations

import asyncio
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from zarr.abc.codec import ArrayBytesCodec  # this module is for zarr alone, which loads it by its entry point

from ..decoding.decoder import decode
from ..encoding.encoder import encode
from ..errors import CorruptStreamError, InputError, OptionError
from ..surface import DTYPES, Surface
from ..target import Tolerance

if TYPE_CHECKING:
    from zarr.core.array_spec import ArraySpec
    from zarr.core.buffer import Buffer, NDBuffer

__all__ = ["NAME", "LodestreamCodec"]

#: Of the codec, as zarr.json and the entry point have it.
NAME = "lodestream"

_CONTAINER, _PLAIN = b"C", b"Z"


@dataclass(frozen=True)
class LodestreamCodec(ArrayBytesCodec):
    """The codec, as a ``serializer`` of ``zarr.create_array``.

    Chunks have two dimensions longer than one, at the end: (H, W), (1, H, W) and so on. Types are integers of 8 to 64
    bits, float32 and float64.

    Parameters
    ----------
    precision : Tolerance, float, str or None
        Largest error of a value: 0.5, or "1e-4d" (1e-4 times the range of the chunk). None: bit for bit.

    Raises
    ------
    OptionError
        If the precision is no error of 0 or more.
    """

    is_fixed_size = False

    precision: str | None = None

    def __init__(self, *, precision: Tolerance | float | str | None = None) -> None:
        object.__setattr__(self, "precision", None if precision is None else str(Tolerance.of(precision)))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LodestreamCodec:
        """The codec of a configuration in zarr.json.

        Raises
        ------
        OptionError
            If the name or an option is not known.
        """
        options = dict(data.get("configuration") or {})
        unknown = [name for name in options if name != "precision"]
        if data.get("name") != NAME or unknown:
            raise OptionError(f"expected the codec {NAME} with precision alone, got {dict(data)!r:.120}")
        return cls(**options)

    def to_dict(self) -> dict[str, Any]:
        """The configuration for zarr.json."""
        configuration = {} if self.precision is None else {"precision": self.precision}
        return {"name": NAME, "configuration": configuration}

    def validate(self, *, shape: tuple[int, ...], dtype: Any, chunk_grid: Any) -> None:
        """Refuse an array that has no chunks of two dimensions, or values of another type.

        Raises
        ------
        OptionError
        """
        name = dtype.to_native_dtype().name
        if name not in DTYPES:
            raise OptionError(f"expected integers of 8 to 64 bits or float32 or float64 for {NAME}, got {name}")
        chunk = tuple(getattr(chunk_grid, "chunk_shape", ()))
        if len(shape) < 2 or any(length != 1 for length in chunk[:-2]):
            raise OptionError(
                f"expected chunks of two dimensions at the end and 1 along all others for {NAME}, got {chunk or shape}"
            )

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Refuse: how long a chunk becomes depends on its values."""
        raise NotImplementedError

    async def _encode_single(self, chunk_array: NDBuffer, chunk_spec: ArraySpec) -> Buffer | None:
        values = np.asarray(chunk_array.as_numpy_array())
        return chunk_spec.prototype.buffer.from_bytes(await asyncio.to_thread(self._encoded, values))

    async def _decode_single(self, chunk_bytes: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        dtype = chunk_spec.dtype.to_native_dtype()
        values = await asyncio.to_thread(_decoded, chunk_bytes.to_bytes(), chunk_spec.shape, dtype)
        return chunk_spec.prototype.nd_buffer.from_numpy_array(values)

    def _encoded(self, values: NDArray[Any]) -> bytes:
        plane = np.ascontiguousarray(values.reshape(values.shape[-2:]), values.dtype.newbyteorder("="))
        plain = _PLAIN + zlib.compress(plane.astype(plane.dtype.newbyteorder("<"), copy=False).tobytes())
        if plane.size < 2 or (plane.dtype.kind == "f" and not np.isfinite(plane).any()) or _odd_nan(plane):
            return plain
        try:
            container = _CONTAINER + encode(Surface(plane), precision=self.precision)
        except InputError:
            return plain
        return min(container, plain, key=len)


def _odd_nan(plane: NDArray[Any]) -> bool:
    """Whether a NaN has other bits than the one that stands for holes."""
    if plane.dtype.kind != "f":
        return False
    hidden = plane[np.isnan(plane)]
    return bool(
        (hidden.view(f"u{plane.itemsize}") != np.full((), np.nan, plane.dtype).view(f"u{plane.itemsize}")).any()
    )


def _decoded(data: bytes, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    kind, body = data[:1], data[1:]
    if kind == _CONTAINER:
        # As many vertices as the chunk has; a container that announces more is none of this array.
        values = decode(body, max_vertices=max(math.prod(shape), 2)).points
    elif kind == _PLAIN:
        values = _inflated(body, shape, dtype)
    else:
        raise CorruptStreamError(f"expected a chunk of kind {_CONTAINER!r} or {_PLAIN!r}, got {kind!r}", 0)
    if values.dtype != dtype.newbyteorder("=") or values.shape != shape[-2:]:
        raise CorruptStreamError(f"expected {dtype} of shape {shape[-2:]}, got {values.dtype} {values.shape}", 0)
    return values.astype(dtype, copy=False).reshape(shape)


def _inflated(body: bytes, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    size = math.prod(shape) * dtype.itemsize
    decoder = zlib.decompressobj()
    try:
        content = decoder.decompress(body, size)
    except zlib.error as error:
        raise CorruptStreamError(f"expected values compressed by zlib, got others: {error}", 1) from None
    if len(content) != size or not decoder.eof or decoder.unused_data:
        raise CorruptStreamError(f"expected {size} bytes of values, got {len(content)}, or more, or no end of them", 1)
    values = np.frombuffer(content, dtype.newbyteorder("<")).astype(dtype.newbyteorder("="))
    return values.reshape(shape[-2:])
