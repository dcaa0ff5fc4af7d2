"""Sections that nobody knows are checked while they pass, and nobody holds them whole."""

from __future__ import annotations

import hashlib
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import lodestream as ls
from lodestream.container import FrameReader, sections
from lodestream.container.writer import CodedLayer, CodedSegment, ContainerWriter
from lodestream.decoding.inspection import inspect
from lodestream.errors import CorruptStreamError, LodestreamError, UnsupportedVersionError
from lodestream.stores import Folder
from lodestream_server.maintenance.containers import check_container

from ..surfaces import index_of, terrain

LONG = 64 << 20
PIECE = 1 << 16
MOST = 8 << 20


@contextmanager
def little_memory() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < MOST
    finally:
        tracemalloc.stop()


def write(path: Path, kind: int, length: int) -> None:
    """A sound container with a section between its layers and another before its metadata."""
    small = ls.encode(terrain((9, 12)))
    index = index_of(small)
    with path.open("wb") as out:
        writer = ContainerWriter(out, index.header)
        for number, layer in enumerate(index.layers):
            own = [s for s in index.segments if s.layer == number]
            coded = [
                CodedSegment(
                    s.tile,
                    s.channel,
                    s.top,
                    s.passes,
                    not any((s.tile, s.channel) == (o.tile, o.channel) and o.layer < number for o in index.segments),
                    small[s.range.offset : s.range.end],
                )
                for s in own
            ]
            writer.layer(CodedLayer(layer.errors, coded))
            if number == 0:
                writer.optional(kind, bytes(length))
        chunks = [small[chunk.range.offset : chunk.range.end] for chunk in index.chunks]
        writer.residual(index.levels[-1].errors, chunks)
        writer.optional(kind, b"as well")
        writer.metadata({})
        writer.end([level.errors for level in index.levels])


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("long") / "long.lode"
    write(path, 200, LONG)
    return path


def read_with(path: Path, feed: Callable[[bytes], object]) -> None:
    with path.open("rb") as file:
        while data := file.read(PIECE):
            feed(data)


def test_a_decoder_lets_it_pass(long: Path) -> None:
    ls.decode(ls.encode(terrain((9, 12))))  # what is compiled or imported once
    decoder = ls.Decoder(max_vertices=1 << 20)
    with little_memory():
        read_with(long, decoder.feed)
        decoder.finish()
    assert decoder.index is not None
    assert [place.kind for place in decoder.index.optional] == [200, 200]
    assert decoder.surface().points.tobytes() == terrain((9, 12)).tobytes()


def test_frames_let_it_pass(long: Path) -> None:
    frames, kinds = FrameReader(), list[int]()
    with little_memory():
        read_with(long, lambda data: kinds.extend(frame.kind for frame in frames.feed(data)))
    assert 200 not in kinds
    assert frames.ended
    assert frames.position == long.stat().st_size - sections.FOOTER_LENGTH


@pytest.mark.parametrize("memory", [None, 1 << 30])
def test_an_inspection_lets_it_pass(long: Path, memory: int | None) -> None:
    with long.open("rb") as file, little_memory():
        found = inspect(file, max_vertices=1 << 20, memory=memory)
    assert found.errors_checked
    assert len(found.index.optional) == 2


def test_fsck_lets_it_pass(long: Path, tmp_path: Path) -> None:
    with long.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    (tmp_path / "containers").mkdir()
    (tmp_path / "containers" / f"{sha256}.lode").symlink_to(long)
    with little_memory():
        assert check_container(Folder(tmp_path), sha256)[0] == "whole"


def test_fsck_holds_no_other_section_whole(tmp_path: Path) -> None:
    """A residual section of 64 MiB, which is wrong, and checked all the same."""
    small = ls.encode(terrain((9, 12)))
    start = small[: index_of(small).layers[-1].end]
    for damaged in (0, 1):
        data = bytearray(start + sections.section(sections.RESIDUAL, bytes(LONG)))
        data[-10] ^= damaged
        sha256 = hashlib.sha256(data).hexdigest()
        path = tmp_path / "containers" / f"{sha256}.lode"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
        del data
        with little_memory():
            state, problem, _ = check_container(Folder(tmp_path), sha256)
        assert state == "bad"
        assert ("kind 3 to match its CRC" in str(problem)) == bool(damaged)


def inspect_path(path: Path) -> None:
    with path.open("rb") as file:
        inspect(file, max_vertices=1 << 20)


READERS: dict[str, Callable[[Path], object]] = {
    "decoder": lambda path: read_with(path, ls.Decoder().feed),
    "inspection": inspect_path,
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("place", ["start", "middle", "end", "crc"])
def test_damage_in_it_is_told_with_its_place(reader: str, place: str, tmp_path: Path) -> None:
    length = 3 * PIECE + 77
    path = tmp_path / "damaged.lode"
    write(path, 200, length)
    data = bytearray(path.read_bytes())
    section = index_of(bytes(data)).optional[0].range
    at = {"start": 4, "middle": length // 2, "end": section.length - 5, "crc": section.length - 1}[place]
    data[section.offset + at] ^= 1
    path.write_bytes(data)
    with pytest.raises(CorruptStreamError, match="kind 200 to match its CRC") as caught:
        READERS[reader](path)
    assert caught.value.offset == section.offset


@pytest.mark.parametrize("piece", [1, 2, 3, 5, 7, 64, 1000, 1 << 20])
def test_pieces_of_any_length(piece: int, tmp_path: Path) -> None:
    path = tmp_path / "pieces.lode"
    write(path, 255, 300)
    data, decoder = path.read_bytes(), ls.Decoder()
    for start in range(0, len(data), piece):
        decoder.feed(data[start : start + piece])
    decoder.finish()
    assert decoder.index is not None
    whole = index_of(data)
    assert (decoder.index.segments, decoder.index.optional) == (whole.segments, whole.optional)
    assert decoder.surface().points.tobytes() == terrain((9, 12)).tobytes()


def test_a_section_that_must_be_known_is_refused_once_it_is_sound() -> None:
    small = ls.encode(terrain((9, 12)))
    start = index_of(small).layers[0].end
    section = sections.section(77, bytes(1000))
    damaged = section[:-1] + bytes([section[-1] ^ 1])
    error: type[LodestreamError]
    for more, error in ((section, UnsupportedVersionError), (damaged, CorruptStreamError)):
        frames, data = FrameReader(), small[:start] + more
        for k in range(0, len(data) - 100, 100):
            list(frames.feed(data[k : k + 100]))
        with pytest.raises(error, match="kind 77"):
            list(frames.feed(data[k + 100 :]))
