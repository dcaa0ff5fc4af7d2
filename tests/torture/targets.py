"""What strangers send: containers, messages, uploads. A target takes any bytes, or refuses them as it documents.

Anything else that is raised is a fault, as are a hang and memory that grows. The same targets are used by hypothesis in
``make test`` and by the fuzzer in ``make torture``.
"""

from __future__ import annotations

import functools
import io
import itertools
import random
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

import lodestream as ls
from lodestream import formats
from lodestream.container import FrameReader, Header, headers, read_index, sections
from lodestream.container.frames import section_extent
from lodestream.container.index import parse_root
from lodestream.container.sections import FOOTER_LENGTH, SIGNATURE
from lodestream.errors import (
    FormatWarning,
    InputError,
    LodestreamError,
    StreamError,
    TooLargeError,
    UnsupportedVersionError,
)
from lodestream.planning.planner import plan
from lodestream.protocol.connection import State
from lodestream.protocol.messages import (
    Bye,
    Credit,
    End,
    Error,
    Event,
    Layer,
    MessageError,
    Open,
    Opened,
    Segments,
    Stop,
)
from lodestream.protocol.wire import parse, serialize
from lodestream.transfer.sender import Sender
from lodestream_server.builds.options import SurfaceOptions, check
from lodestream_server.store.uploads import Upload, take_apart

__all__ = ["EDGES", "KINDS", "TARGETS", "Edit", "Target", "edit", "mutate"]

#: Read by other people's compiled code (GDAL, HDF5, VTK), which they fuzz. A server runs it in a process that may die;
#: here such files are only recognised.
_FOREIGN = {"cgns", "esri-ascii", "geotiff", "glb", "netcdf", "png", "srtm-hgt", "stl", "usgs-dem", "vtk", "vts"}

_BOUNDARY = b"torture"
_LARGEST = 1 << 16


@dataclass(frozen=True)
class Target:
    """Something that takes bytes from strangers.

    Attributes
    ----------
    name : str
    corpus : callable
        Bytes that it takes.
    run : callable
        Tries some bytes; True when they were taken, False when they were refused as documented.
    mend : callable
        Makes checksums right, so that what stands behind them is reached.
    """

    name: str
    corpus: Callable[[], tuple[bytes, ...]]
    run: Callable[[bytes], bool]
    mend: Callable[[bytes], bytes]


@dataclass(frozen=True)
class Edit:
    """A change of some bytes.

    Attributes
    ----------
    kind : "flip", "set", "drop", "copy", "number" or "cut"
    place, source : float
        Where, from 0 to 1 of the bytes, and where what is copied stands.
    length : int
        Bytes that are dropped or copied.
    value : int
        What is written; of a flip, which bit.
    """

    kind: str
    place: float
    source: float
    length: int
    value: int


#: What can be done to bytes, the usual kinds more often.
KINDS = ("flip", "flip", "set", "set", "drop", "copy", "number", "cut")

#: Numbers at which programs go wrong.
EDGES = (0, 1, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**63 - 1, 2**64 - 1)


def edit(data: bytes, edits: Iterable[Edit]) -> bytes:
    """The bytes with some changes, one after another."""
    out = bytearray(data)
    for change in edits:
        place = int(change.place * len(out))
        if change.kind == "flip" and place < len(out):
            out[place] ^= 1 << change.value % 8
        elif change.kind == "set":
            out[place : place + 1] = bytes([change.value % 256])
        elif change.kind == "drop":
            del out[place : place + change.length]
        elif change.kind == "copy":
            source = int(change.source * len(out))
            out[place:place] = out[source : source + change.length]
        elif change.kind == "number":
            order: Literal["little", "big"] = "little" if change.length % 2 else "big"
            out[place : place + 8] = change.value.to_bytes(8, order)
        elif change.kind == "cut":
            del out[place:]
    return bytes(out[:_LARGEST])


def mutate(data: bytes, random_: random.Random) -> bytes:
    """The bytes with a few changes at random."""
    edits = [
        Edit(
            random_.choice(KINDS),
            random_.random(),
            random_.random(),
            random_.choice((1, 2, 4, 8, random_.randrange(1, 64))),
            random_.choice((*EDGES, random_.getrandbits(32))),
        )
        for _ in range(random_.choice((1, 1, 1, 2, 4)))
    ]
    return edit(data, edits)


@functools.cache
def _surfaces() -> tuple[ls.Surface, ...]:
    # Small, so that there is time for many.
    rows, columns = np.mgrid[0:6, 0:5].astype(np.float64)
    heights = np.round(50 * np.sin(rows / 3) * np.cos(columns / 2), 2)
    holes = heights.astype(np.float32)
    holes[2:4, 3:5] = np.nan
    xyz = np.stack((columns, rows, heights), axis=-1)
    return (
        ls.Surface((heights * 10).astype(np.int16), metadata={"name": "whole metres"}),
        ls.Surface(holes),
        ls.Surface(np.sin(xyz), closed=(False, True)),
        ls.Surface(heights.astype(np.float32), attributes={"land": (heights > 0).astype(np.uint8), "t": np.sqrt(rows)}),
        ls.Surface(np.full((3, 4), 7.0)),
        ls.Surface(blocks=[ls.Block(xyz), ls.Block(xyz + np.array([6.0, 0.0, 0.0]))]),
        ls.Surface(heights.reshape(-1, 1, 1).repeat(2, axis=2)),
    )


@functools.cache
def _containers() -> tuple[bytes, ...]:
    whole = [ls.encode(surface) for surface in _surfaces()]
    lossy = ls.encode(_surfaces()[0], precision=5.0), ls.encode(_surfaces()[0], rms="1%")
    return (*whole, *lossy)


def _mend_container(data: bytes) -> bytes:
    """Every section's CRC as it should be, as far as the sections can be followed, that of pages and of the footer."""
    out, place = bytearray(data), len(SIGNATURE)
    while len(out) - place > FOOTER_LENGTH:
        try:
            extent = section_extent(bytes(out[place : place + 10]), place)
        except StreamError:
            break
        if extent is None or place + extent[1] > len(out):
            break
        end = place + extent[1]
        out[end - 4 : end] = zlib.crc32(out[place : end - 4]).to_bytes(4, "little")
        place = end
    if len(out) - place == FOOTER_LENGTH:
        out[place + 16 : place + 20] = zlib.crc32(out[place : place + 16]).to_bytes(4, "little")
    _mend_pages(out)
    return bytes(out)


def _mend_pages(out: bytearray) -> None:
    """The CRC of each page of the index, and then that of its root, as far as the root can be read."""
    try:
        frames = {frame.kind: frame for frame in FrameReader().feed(bytes(out))}
        first, last = frames[sections.HEADER], frames[sections.INDEX]
        header = headers.parse_header(first.payload, first.payload_offset, first.end)
        for kind in {sections.MASKS, sections.KEPT_MASKS} & frames.keys():
            header = headers.parse_masks(header, frames[kind])
        root = parse_root(last, header)
    except (StreamError, InputError, KeyError):
        return
    for page in (*root.segment_pages, *root.chunk_pages):
        crc = zlib.crc32(out[page.range.offset : page.range.end])
        out[page.told : page.told + 4] = crc.to_bytes(4, "little")
    out[last.end - 4 : last.end] = zlib.crc32(out[last.offset : last.end - 4]).to_bytes(4, "little")


def _container(data: bytes) -> bool:
    whole = True
    decoder = ls.Decoder()
    try:
        # A header may promise more points than any machine has memory for: not every client wants those.
        for chunk in _chunks(data):
            decoder.feed(chunk)
            if decoder.header is not None and _points(decoder.header) > 1 << 14:
                return False
        decoder.finish()
    except (StreamError, TooLargeError):  # axes may be longer than those that kernels count
        whole = False
    if decoder.layers and zlib.crc32(data) % 4 == 0:
        # What came before the damage is drawn, whatever came after. It takes most of the time: one in four is.
        try:
            decoder.layers[-1].surface()
        except StreamError:
            whole = False  # other values than were encoded, or none that is finite
    try:
        index = read_index(lambda offset, length: data[offset : offset + length], len(data))
        for target in (ls.Target(), ls.Target(level=0), ls.Target(order="level")):
            assert all(0 <= place.offset <= place.end <= len(data) for place in plan(index, target).ranges)
    except (StreamError, InputError):
        whole = False
    return whole


def _points(header: Header) -> int:
    return max(1, header.channels) * sum(rows * columns for (rows, columns), _ in header.blocks)


def _chunks(data: bytes) -> Iterator[bytes]:
    sizes = itertools.cycle((1, 13, 200, 4096))
    place = 0
    while place < len(data):
        size = next(sizes)
        yield data[place : place + size]
        place += size


@functools.cache
def _messages() -> tuple[bytes, ...]:
    targets = (ls.Target(), ls.Target(level=2), ls.Target(until_rms=ls.Tolerance.parse("0.1%"), max_bytes=99))
    opens = [Open(target, credit) for target, credit in zip(targets, (0, 1000, 2**18), strict=True)]
    others: list[Event] = [
        Open(held=((0, 10), (90, 7))),
        Credit(1),
        Credit(2**40),
        Stop(),
        Bye(),
        Opened("ab" * 32, 1000, 900, 1.5, (950, 40), (900, 50), True),
        Segments(7, bytes(range(50))),
        Layer(1, 2, 3, 0.5, 0.25),
        End("complete"),
        Error("idle", "title", "detail"),
    ]
    # Several in a row, each after its length, as a stranger would send them.
    single = [serialize(event) for event in (*opens, *others)]
    talks = [[message] for message in single]
    talks += [[single[1], single[4], single[6]], [single[2], single[4], single[5], single[6], single[7]]]
    talks += [[single[1], single[-2], single[4], single[-1], single[6]]]
    return tuple(map(_join, talks))


def _join(messages: list[bytes]) -> bytes:
    return b"".join(len(message).to_bytes(2, "big") + message for message in messages)


def _split(data: bytes) -> Iterator[bytes]:
    place = 0
    while place < len(data):
        length = int.from_bytes(data[place : place + 2], "big")
        yield data[place + 2 : place + 2 + length]
        place += 2 + length


def _mend_messages(data: bytes) -> bytes:
    # The last length is made to fit.
    messages = list(_split(data))
    return _join(messages)


def _message(data: bytes) -> bool:
    taken = True
    container, index = _streamed()
    sender = Sender(index, "ab" * 32)
    for message in _split(data):
        try:
            event = parse(message)
        except (MessageError, UnsupportedVersionError):
            taken = False
        else:
            assert parse(serialize(event)) == event
        try:
            sender.receive(message)
        except (MessageError, UnsupportedVersionError) as error:
            sender.fail(getattr(error, "code", "unsupported-version"), str(error))
            taken = False
        for _ in range(10_000):
            answer = sender.next_message()
            if answer is not None:
                parse(answer)
            elif (wanted := sender.wanted()) is not None:
                sender.provide(wanted, container[wanted.offset : wanted.end])
            else:
                break
        else:
            raise AssertionError("expected a sender that waits for credit, got one that goes on and on")
        if sender.state in (State.CLOSED, State.FAILED):
            break
    return taken


@functools.cache
def _streamed() -> tuple[bytes, Any]:
    container = _containers()[0]
    return container, read_index(lambda offset, length: container[offset : offset + length], len(container))


@functools.cache
def _uploads() -> tuple[bytes, ...]:
    """Files of every format that can be made here, raw (0) and as forms (1)."""
    names = [format_.name for format_ in formats.formats() if format_.write]
    files = [_file(surface, name) for surface in _surfaces() for name in names]
    files += [_npz(), _FACES, _OFF, _ASCII_GRID, _PLY, _PLOT3D]
    found = [file for file in files if file is not None and len(file) < 8000]
    return tuple(b"\0" + file for file in found) + tuple(b"\1" + _form(file) for file in found)


_FACES = b"v 0 0 0\nv 1 0 0\nv 2 0 1\nv 0 1 0\nv 1 1 2\nv 2 1 0\nf 1 2 5 4\nf 2 3 6 5\n"
_OFF = b"OFF\n6 2 0\n0 0 0\n1 0 0\n2 0 1\n0 1 0\n1 1 2\n2 1 0\n4 0 1 4 3\n4 1 2 5 4\n"
_ASCII_GRID = b"ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\nNODATA_value -9999\n1 2 3\n4 -9999 6\n"
_PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
    b"property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n1 1 1\n0 1 0\n4 0 1 2 3\n"
)
_PLOT3D = b"1\n3 2 1\n0 1 2 0 1 2\n0 0 0 1 1 1\n0 1 0 2 1 0\n"


def _file(surface: ls.Surface, format_name: str) -> bytes | None:
    out = io.BytesIO()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FormatWarning)
            formats.write_stream(surface, format_name, out)
    except InputError:
        return None  # not every format takes every surface
    return out.getvalue()


def _npz() -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, surface=_surfaces()[0].points)
    return out.getvalue()


def _form(file: bytes) -> bytes:
    head = b'--torture\r\nContent-Disposition: form-data; name="file"; filename="a.npy"\r\n\r\n'
    return head + file + b"\r\n--torture--\r\n"


def _upload(data: bytes) -> bool:
    form, body = data[:1] == b"\1", data[1:]
    with tempfile.TemporaryDirectory(dir=_memory_folder()) as folder:
        upload = Upload(Path(folder), 3)
        try:
            reader = take_apart(upload, f"multipart/form-data; boundary={_BOUNDARY.decode()}" if form else None, "a")
            for chunk in _chunks(body):
                reader.feed(chunk)
            reader.finish()
            format_ = check(upload.paths, [None] * len(upload.paths), SurfaceOptions(None, None, {}))
            if format_.name in _FOREIGN:
                return False
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.simplefilter("ignore", FormatWarning)  # something is left out, as documented
                ls.read(*upload.paths, max_vertices=2000)
        except LodestreamError as error:
            return _refused(error)
        finally:
            upload.abort()
    return True


def _refused(error: LodestreamError) -> bool:
    assert "\n" not in str(error), "an error is one line"
    return False


@functools.cache
def _memory_folder() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def _as_it_is(data: bytes) -> bytes:
    return data


TARGETS = {
    target.name: target
    for target in (
        Target("containers", _containers, _container, _mend_container),
        Target("messages", _messages, _message, _mend_messages),
        Target("uploads", _uploads, _upload, _as_it_is),
    )
}
