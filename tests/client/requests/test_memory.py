"""What is in memory, and containers, on their way to a server: whole, bit for bit, and never encoded twice."""

from __future__ import annotations

import asyncio
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.container.digest import DIGEST
from lodestream.container.metadata import MAX_BYTES, packed
from lodestream.errors import FormatWarning, InputError, OptionError, RemoteError
from lodestream_client import AsyncClient, Client
from lodestream_client.requests.api import Description
from tests.core.container.forgery import index_of, with_layer_errors

from ..asked import asked
from ..commands.test_program import HEAVY, loaded_after
from ..conftest import Run, make_terrain
from ..test_surfaces_of_all_kinds import pulled, values


def block(number: int, closed: tuple[bool, bool] = (False, True)) -> ls.Block:
    """Part of a tube with holes, and attributes of several types and shapes."""
    z, turn = np.meshgrid(np.arange(21.0) + 20 * number, np.arange(32) * np.pi / 16, indexing="ij")
    points = np.stack(((9 + np.sin(z / 7)) * np.cos(turn), (9 + np.sin(z / 7)) * np.sin(turn), z), axis=-1)
    mask = np.ones(z.shape, bool)
    mask[7:10, 3 + number : 9] = False
    rows, columns = np.indices(z.shape)
    attributes: dict[str, Any] = {
        "kind": (rows % 5).astype(np.uint8),
        "count": (rows * columns - 200).astype(np.int64) << 40,
        "heat": np.where(rows % 6 == 0, np.nan, np.sqrt(columns)).astype(np.float32),
        "flow": np.random.default_rng(number).normal(size=(*z.shape, 3)),
    }
    for array in attributes.values():
        array[~mask] = 0
    return ls.Block(points, closed, mask=mask, attributes=attributes)


def raster() -> ls.Surface:
    """A raster with all that a map needs to know."""
    heights = np.round(make_terrain(40, 50)).astype(np.int16)
    mask = np.ones(heights.shape, bool)
    mask[12:17, 30:41] = False
    heights[~mask] = -32768
    metadata = {
        "name": "Jacksboro Fault",
        "crs": 'LOCAL_CS["somewhere"]',
        "geotransform": [500000.0, 30.0, 0.0, 4000000.0, 0.0, -30.0],
        "nodata": -32768,
        "unit": "m",
        "recognised": "a raster",
        "more": {"list": [1, 2.5, "three", None, True], "bytes": b"ab"},
    }
    slope = np.where(mask, np.abs(np.gradient(heights)[0]), np.nan)
    return ls.Surface(heights, mask=mask, attributes={"slope": slope}, metadata=metadata)


SURFACES: dict[str, Callable[[], ls.Surface]] = {
    "raster": raster,
    "blocks": lambda: ls.Surface(blocks=[block(0), block(1)], metadata={"name": "tube", "crs": "LOCAL_CS[]"}),
    "closed": lambda: ls.Surface(blocks=[block(3)]),
    "curve": lambda: ls.Surface(np.random.default_rng(2).normal(size=(70, 1, 2)), (True, False)),
    "channels": lambda: ls.Surface(np.random.default_rng(2).normal(size=(9, 8, 6)).astype(np.float32)),
}


def container_of(surface: Description) -> bytes:
    return Client(surface.url).fetch_range(surface.url, 0, int(surface.details["bytes"]))


@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
@pytest.mark.parametrize("kind", SURFACES)
@pytest.mark.long
def test_a_surface_in_memory_goes_whole(server: str, kind: str, asynchronous: bool) -> None:
    given = SURFACES[kind]()
    metadata = dict(given.metadata)
    told: list[tuple[str, float]] = []

    def progress(stage: str, fraction: float) -> None:
        told.append((stage, fraction))

    if asynchronous:
        made = asyncio.run(asked(server, lambda it: it.upload(given, progress=progress)))
    else:
        made = Client(server).upload(given, progress=progress)
    local = ls.encode(given)
    assert container_of(made) == local
    back = pulled(made.url)
    assert values(back) == values(given)
    assert back.metadata == given.metadata == metadata
    assert made.details["errors"] == "checked"
    assert made.details["name"] == given.metadata.get("name", "surface.lode")
    assert made.details["filenames"] == ["surface.lode"]
    stages = [stage for stage, _ in told]
    if not asynchronous or kind == "raster":  # the second time it is there already
        order = [stage for stage in dict.fromkeys(stages) if stage != "building"]
        assert order == ["encoding", "sending"]
    assert [f for stage, f in told if stage == "encoding"][-1] == 1.0


def test_what_is_asked_for_is_done_before_it_is_sent(server: str) -> None:
    given = ls.Surface(blocks=[block(4, (False, False))], metadata={"name": "given"})
    made = Client(server).upload(
        given, precision="0.1%", attribute_precision={"heat": 0.5}, effort="small", name="asked for", closed="cols"
    )
    before = given.blocks[0]
    closed = ls.Block(before.points, (False, True), mask=before.mask, attributes=before.attributes)
    wanted = ls.Surface(blocks=[closed], metadata={"name": "asked for"})
    assert container_of(made) == ls.encode(wanted, "0.1%", attribute_precision={"heat": 0.5}, effort="small")
    assert (made.details["name"], made.details["errors"]) == ("asked for", "told")
    assert (made.details["options"], made.details["closed"]) == ({}, [False, True])
    assert (given.metadata, given.closed) == ({"name": "given"}, (False, False))
    made = Client(server).upload(given, rms=0.01)
    assert container_of(made) == ls.encode(given, rms=0.01)


@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
@pytest.mark.parametrize("before", [None, ["read before"], "mine"], ids=str)
def test_values_at_holes_are_told_in_the_container(server: str, before: Any, asynchronous: bool) -> None:
    given = raster()
    given.attributes["slope"][12, 30:33] = 4
    given.metadata |= {"name": f"{before} {asynchronous}"} | ({} if before is None else {"notes": before})
    metadata = dict(given.metadata)
    note = "values of attributes at 3 holes of the points left out: slope"
    with pytest.warns(FormatWarning, match=f"^{note}$"):
        made = asyncio.run(asked(server, lambda it: it.upload(given))) if asynchronous else Client(server).upload(given)
    # What somebody says under this name is left alone.
    notes = before if isinstance(before, str) else [*(before or ()), note]
    assert Client(made.url).get(made.url).details["metadata"]["notes"] == made.details["metadata"]["notes"] == notes
    assert given.metadata == metadata
    # The note is not repeated: nothing is lost again.
    back = pulled(made.url)
    assert container_of(Client(server).upload(back)) == container_of(made)


def test_a_note_that_has_no_room_is_a_warning_only(server: str) -> None:
    given = raster()
    given.attributes["slope"][12, 30:33] = 4
    given.metadata["long"] = "x" * (MAX_BYTES - len(packed({**given.metadata, "long": "", DIGEST: "0" * 64})) - 10)
    with pytest.warns(FormatWarning, match="at 3 holes"):
        made = Client(server).upload(given)
    assert "notes" not in made.details["metadata"]


ARRAYS: dict[str, Callable[[], Any]] = {
    "heights": lambda: make_terrain(30, 20),
    "fortran": lambda: np.asfortranarray(make_terrain(20, 31)),
    "big-endian": lambda: make_terrain(20, 32).astype(">f8"),
    "xyz": lambda: np.random.default_rng(5).normal(size=(8, 9, 3)),
    "masked": lambda: np.ma.masked_less(np.round(make_terrain(20, 33)).astype(np.int32), 0),
    "list": lambda: [[1, 2, 3], [4, 5, 7]],
    "tuple of arrays": lambda: (np.arange(5.0), np.arange(5.0) ** 2),
    "memoryview": lambda: make_terrain(9, 8).data,
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays(server: str, kind: str) -> None:
    array = ARRAYS[kind]()
    made = Client(server).upload(array, name=kind)
    assert container_of(made) == ls.encode(ls.Surface(array, metadata={"name": kind}))
    assert made.details["name"] == kind
    assert np.ma.allequal(pulled(made.url).points, np.ma.asarray(array))
    if kind == "masked":
        hidden = pulled(made.url).mask
        assert hidden is not None
        assert np.array_equal(~hidden, np.ma.getmaskarray(array))


def test_the_bytes_of_a_file_are_a_file(server: str) -> None:
    file = io.BytesIO()
    np.save(file, make_terrain(11, 12))
    data = file.getvalue()
    ids = {Client(server).upload(source).id for source in (data, bytearray(data), memoryview(data), io.BytesIO(data))}
    assert len(ids) == 1


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (None, "NoneType"),
        (7, "int"),
        ({"a": 1}, "dict"),
        (io.StringIO("text"), "a file open for text"),
        (object(), "object"),
        ([[1, 2], [3]], "list"),
        ([["a", "b"], ["c", "d"]], "<U1"),
        (np.zeros((3, 3), complex), "complex"),
        (np.zeros(9), "shape"),
        (np.full((4, 4), np.nan), "holes"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
def test_other_sources_are_refused_in_words(source: Any, words: str, asynchronous: bool) -> None:
    def upload() -> Description:
        url = "http://127.0.0.1:9"
        return asyncio.run(asked(url, lambda it: it.upload(source))) if asynchronous else Client(url).upload(source)

    with pytest.raises(InputError, match=f"expected.*{words}"):
        upload()


def test_options_that_have_no_place(terrain_file: Path) -> None:
    heights, url = make_terrain(9, 9), "http://127.0.0.1:9"
    for error, words, sources, options in (
        (
            OptionError,
            "no options of a file's format for a surface in memory, got band",
            [heights],
            {"options": {"band": "1"}},
        ),
        (OptionError, "not both", [heights], {"precision": 1, "rms": 1}),
        (OptionError, "'best'", [heights], {"effort": "best"}),
        (OptionError, "'maybe'", [heights], {"closed": "maybe"}),
        (OptionError, "closed=auto", [ls.Surface(blocks=[block(0), block(1)])], {"closed": "rows"}),
        (OptionError, "'colour'", [heights], {"attribute_precision": {"colour": 1}}),
        (InputError, "as the only source", [heights, heights], {}),
        (InputError, "as the only source", [terrain_file, heights], {}),
        (OptionError, "at least one file", [], {}),
        (InputError, "MessagePack", [ls.Surface(heights, metadata={"a": object()})], {}),
    ):
        with pytest.raises(error, match=words):
            Client(url).upload(*sources, **options)


def test_nothing_is_imported_for_files_that_only_memory_needs() -> None:
    statement = (
        "from lodestream_client.requests import bodies\n"
        "parcel = bodies.prepared(['a.npy', b'bytes', open('/dev/null', 'rb')], bodies.Asked(), None)\n"
        "assert len(parcel.files) == 3"
    )
    assert loaded_after(statement, (*HEAVY, "numpy")) == []


def test_who_gives_up_does_not_wait_for_the_encoder() -> None:
    """The thread ends at its next step, and sends nothing."""
    told: list[float] = []

    async def loop() -> None:
        began = asyncio.Event()
        here = asyncio.get_running_loop()

        def progress(stage: str, fraction: float) -> None:
            told.append(fraction)
            here.call_soon_threadsafe(began.set)

        surface = ls.Surface(np.random.default_rng(3).normal(size=(900, 900, 3)))
        task = asyncio.create_task(AsyncClient("http://127.0.0.1:9").upload(surface, progress=progress))
        await began.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(loop())  # waits for threads
    assert told
    assert max(told) < 1


# Containers.


def test_push_sends_a_container_as_it_is(run: Run, server: str, container_file: Path) -> None:
    code, out, err = run("push", "--quiet", container_file, server, "--name", "as it is")
    assert (code, err) == (0, "")
    url = out.strip()
    made = Client(url).get(url)
    assert container_of(made) == container_file.read_bytes()
    assert (made.details["name"], made.details["metadata"]["name"]) == ("as it is", "terrain")
    assert made.details["filenames"] == [container_file.name]
    out = run("info", url)[1]
    assert "checked by the server" in out
    assert Client(server).upload(container_file.read_bytes(), name="as it is").id == made.id


def test_info_says_whose_word_the_errors_are(run: Run, server: str, tmp_path: Path) -> None:
    honest = ls.encode(make_terrain(20, 25), 0.25)
    (tmp_path / "near.lode").write_bytes(with_layer_errors(honest, 0, 3.0, 1))
    code, out, _ = run("push", tmp_path / "near.lode", server)
    assert code == 0
    assert "stated by the uploader, not checked" in run("info", out.strip())[1]
    shown = Client(server).get(out.strip()).details["layers"][0]["max"]
    assert shown == pytest.approx(3 * index_of(honest).layers[0].max_error, rel=1e-6)


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--precision", "1"), "precision"),
        (("--precision", "kind=1"), "precision"),
        (("--rms", "1"), "rms"),
        (("--effort", "small"), "effort"),
        (("--closed", "none"), "closed"),
        (("-o", "band=1"), "band"),
    ],
    ids=repr,
)
def test_push_of_a_container_with_options(
    run: Run, server: str, container_file: Path, words: tuple[str, ...], what: str
) -> None:
    code, out, err = run("push", container_file, server, *words)
    assert (code, out) == (1, "")
    assert err == f"lodestream: expected no {what} for a container (.lode), which is encoded already\n"


def test_push_of_a_damaged_container(run: Run, server: str, container_file: Path, tmp_path: Path) -> None:
    data = container_file.read_bytes()
    (tmp_path / "cut.lode").write_bytes(data[:-100])
    code, out, err = run("push", tmp_path / "cut.lode", server)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "cut short (at byte" in err
    assert err.startswith("lodestream: cut.lode: expected ")
    with pytest.raises(RemoteError, match="at byte") as caught:
        Client(server).upload(data[:3000] + b"?" + data[3001:])
    assert caught.value.code == "failed"
    code, _, err = run("push", container_file, tmp_path / "cut.lode", server)
    assert code == 1
    assert "A container is uploaded alone" in err


def test_what_was_pulled_can_be_uploaded_again(server: str) -> None:
    """With infinities under holes, and with the joints that only a container tells."""
    z = block(5)
    points = z.points.copy()
    points[3, 3] = np.inf
    given = ls.Surface(blocks=[ls.Block(points, z.closed, mask=z.mask, attributes=z.attributes)])
    first = Client(server).upload(given)
    back = pulled(first.url)
    assert back.joints is not None
    again = Client(server).upload(back, name="again")
    local = ls.decode(container_of(first))
    local.metadata["name"] = "again"
    assert container_of(again) == ls.encode(local)
    assert back.metadata == {}
    assert again.details["errors"] == "checked"
    assert np.isinf(pulled(again.url).points[3, 3]).all()
