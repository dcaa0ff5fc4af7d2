"""Uploads in parts on disk: any order of requests, errors and restarts, compared with a model in memory."""

from __future__ import annotations

import asyncio
import errno
import hashlib
import os
import shutil
import stat
import tempfile
import threading
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.errors import InputError, NotFoundError
from lodestream_server.problems import BusyError, LockedError, WrongOffsetError
from lodestream_server.store import durable, partial_uploads
from lodestream_server.store.partial_uploads import Declared, PartialUpload, PartialUploads
from tests.examples import examples
from tests.patience import PATIENCE
from tests.server.store.disks import FullDisk

BODY = bytes(range(1, 61))
DECLARED = Declared("anna", len(BODY), (("name", "x"),), "a.npy", hashlib.sha256(BODY).hexdigest(), "")


class LostError(Exception):
    """The connection broke."""


async def blocks(data: bytes, error: Exception | None = None) -> AsyncIterator[bytes]:
    for start in range(0, len(data), 7):
        yield data[start : start + 7]
    if error is not None:
        raise error


def on(folder: Path) -> PartialUploads:
    return PartialUploads(folder, 8, 3600.0)


async def sent(upload: PartialUpload, offset: int, data: bytes, error: Exception | None = None) -> None:
    async with upload.continued(offset):
        await upload.append(blocks(data, error))


#: What a client or the machine does: send so many bytes, break off after so many, find the disk full, ...
STEPS = st.one_of(
    st.tuples(st.just("send"), st.integers(0, 30)),
    st.tuples(st.just("break"), st.integers(0, 30)),
    st.tuples(st.just("full"), st.integers(0, 12)),
    st.tuples(st.just("wrong"), st.integers(0, 70)),
    st.tuples(st.just("restart"), st.just(0)),
    st.tuples(st.just("kill"), st.integers(1, 9)),
    st.tuples(st.just("complete"), st.just(0)),
    st.tuples(st.just("finish"), st.just(0)),
    st.tuples(st.just("remove"), st.just(0)),
)


@examples(30)
@given(steps=st.lists(STEPS, max_size=12))
def test_whatever_happens_what_was_told_is_there(steps: list[tuple[str, int]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(_compared(Path(folder), steps))


async def _compared(folder: Path, steps: list[tuple[str, int]]) -> None:
    uploads, told, surface = on(folder / "partial"), 0, None
    name: str | None = (await uploads.create(DECLARED)).id
    for step, count in steps:
        if name is None:
            name, told, surface = (await uploads.create(DECLARED)).id, 0, None
        it = uploads.get(name, "anna")
        assert it.offset == told
        if step == "remove":
            async with it.settled():
                await uploads.remove(it)
            name = None
        elif step == "wrong" and count != told:
            with pytest.raises(WrongOffsetError):
                await sent(it, count, b"x")
        elif step in ("restart", "kill"):
            if step == "kill" and surface is None:  # bytes that were written and never told
                beyond = BODY[told : told + count]
                with (it.folder / "0").open("r+b") as file:
                    file.seek(told)
                    file.write(beyond)
            uploads = on(folder / "partial")
            # There may be more than was told: what was written before an error, or the end.
            reached = uploads.get(name, "anna").offset
            assert reached >= told
            told = reached
        elif step == "finish" and told == len(BODY) and surface is None:
            surface = "0" * 20
            async with it.settled():
                await it.finish(surface)
        elif surface is None and step in ("send", "break", "full"):
            told = await _sent(it, told, step, count)
        elif step == "complete" and told == len(BODY) and surface is None:
            _check_whole(it, folder / f"whole-{len(list(folder.iterdir()))}")
        if name is not None:
            it = uploads.get(name, "anna")
            assert (it.offset, it.declared.surface) == (told, surface)
            assert uploads.kept("anna") == (told if surface is None else 0)
            assert uploads.count("anna") == ((1, 1) if surface is None else (0, 0))
            assert surface is not None or (it.folder / "0").read_bytes()[:told] == BODY[:told]
        else:
            assert uploads.count("anna") == (0, 0)
            assert list((folder / "partial").iterdir()) == []


async def _sent(it: PartialUpload, told: int, step: str, count: int) -> int:
    """Send something in one of the ways; how many bytes are there then."""
    data = BODY[told : told + count] if step != "full" else BODY[told:]
    if step == "send":
        await sent(it, told, data)
        return told + len(data)
    if step == "break":
        with pytest.raises(LostError):
            await sent(it, told, data, LostError())
        return told + len(data)
    usual, durable.disk = durable.disk, FullDisk(count)
    try:
        await sent(it, told, data)
        return told + len(data)
    except OSError:
        assert told <= it.offset <= told + len(data)
        return it.offset
    finally:
        durable.disk = usual


def _check_whole(it: PartialUpload, folder: Path) -> None:
    folder.mkdir()
    upload = it.whole(folder)
    assert (folder / "0").read_bytes() == BODY
    assert (upload.size, upload.names) == (len(BODY), ["a.npy"])
    whole = hashlib.sha256(BODY + len(BODY).to_bytes(8, "big"))
    assert upload.digest.hexdigest() == whole.hexdigest()


def run(folder: Path, test: Callable[[PartialUploads, PartialUpload], Any], declared: Declared = DECLARED) -> None:
    async def begin() -> None:
        uploads = on(folder)
        await test(uploads, await uploads.create(declared))

    asyncio.run(begin())


def test_a_file_of_another_hash_is_none(tmp_path: Path) -> None:
    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        await sent(it, 0, BODY[::-1])
        folder = tmp_path / "whole"
        folder.mkdir()
        with pytest.raises(InputError, match=f"to have the SHA-256 {DECLARED.sha256}, and has [0-9a-f]{{64}}"):
            it.whole(folder)

    run(tmp_path / "partial", test)


def test_a_request_that_waits_is_ended_by_one_that_asks(tmp_path: Path) -> None:
    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        begun = asyncio.Event()

        async def slow() -> AsyncIterator[bytes]:
            yield BODY[:9]
            begun.set()
            await asyncio.Event().wait()

        async def send() -> None:
            async with it.continued(0):
                await it.append(slow())

        sending = asyncio.create_task(send())
        await begun.wait()
        with pytest.raises(LockedError):
            await sent(it, 0, BODY)

        async def ask() -> int:
            async with it.settled():
                return it.offset

        assert tuple(await asyncio.gather(ask(), ask(), ask())) == (9, 9, 9)
        with pytest.raises(LockedError):
            await sending
        # Whoever waited for one that was removed meanwhile finds none.
        async with it.settled():
            waiting = asyncio.create_task(ask())
            await asyncio.sleep(0)
            await uploads.remove(it)
        with pytest.raises(NotFoundError):
            await waiting

    run(tmp_path, test)


def test_one_that_has_not_begun_to_wait_is_ended_too(tmp_path: Path) -> None:
    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        async def look() -> None:
            async with it.settled():
                pass

        async def silent() -> AsyncIterator[bytes]:
            await asyncio.Event().wait()
            yield b""

        async with asyncio.timeout(30):
            async with it.continued(0):
                looking = asyncio.create_task(look())
                await asyncio.sleep(0)  # as while its limits are checked
                with pytest.raises(LockedError):
                    await it.append(silent())
            await looking
        await sent(it, 0, BODY)
        assert it.is_complete

    run(tmp_path, test)


def test_another_owner_finds_nothing(tmp_path: Path) -> None:
    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        for owner in ("bert", None):
            with pytest.raises(NotFoundError):
                uploads.get(it.id, owner)
        await sent(it, 0, BODY[:20])
        assert (uploads.count("bert"), uploads.kept("bert"), uploads.kept("anna")) == ((1, 0), 0, 20)

    run(tmp_path, test)


def test_what_is_finished_is_remembered_up_to_a_number(tmp_path: Path) -> None:
    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        finished = [it, *[await uploads.create(DECLARED) for _ in range(10)]]
        for upload in finished:
            await sent(upload, 0, BODY)
            async with upload.settled():
                await upload.finish("0" * 20)
        last = await uploads.create(DECLARED)
        assert {path.name for path in tmp_path.iterdir()} == {upload.id for upload in (*finished[-8:], last)}

    run(tmp_path, test)


def test_several_may_remove_the_same_ones_at_once(tmp_path: Path) -> None:
    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        others = [it, *[await uploads.create(DECLARED) for _ in range(5)]]
        for upload in others:
            upload.touched = 0.0
        await asyncio.gather(*[uploads.expire() for _ in range(3)])
        assert list(tmp_path.iterdir()) == []

    run(tmp_path, test)


def test_what_is_made_while_another_one_is_removed_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    making, removing = threading.Event(), threading.Event()

    def make_folder(folder: Path) -> Path:
        assert making.wait(PATIENCE)
        return durable.make_folder(folder)

    def discard(path: Path) -> None:
        assert removing.wait(PATIENCE)
        durable.discard(path)

    async def test(uploads: PartialUploads, over: PartialUpload) -> None:
        monkeypatch.setattr(partial_uploads, "make_folder", make_folder)
        monkeypatch.setattr(partial_uploads, "discard", discard)
        over.touched = 0.0
        beginning, expiring = asyncio.create_task(uploads.create(DECLARED)), asyncio.create_task(uploads.expire())
        await asyncio.sleep(0)
        assert uploads.count(None) == (1, 0)  # of the one that is made, and both wait for their threads
        making.set()
        made = await beginning
        removing.set()
        await expiring
        await sent(uploads.get(made.id, "anna"), 0, BODY)

    run(tmp_path, test)


@pytest.mark.parametrize("sent_before", [0, 20])
def test_what_was_removed_by_somebody_else_is_missing(tmp_path: Path, sent_before: int) -> None:
    folder = tmp_path / "scratch" / "partial"
    folder.parent.mkdir()

    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        await sent(it, 0, BODY[:sent_before])
        other = await uploads.create(DECLARED)
        shutil.rmtree(folder.parent)
        with pytest.raises(NotFoundError):
            await sent(it, sent_before, BODY[sent_before:])
        with pytest.raises(NotFoundError):
            async with other.settled():
                pass
        await uploads.expire()
        assert (uploads.count(None), uploads.kept("anna")) == ((0, 0), 0)
        # Others begin.
        again = await uploads.create(DECLARED)
        await sent(again, 0, BODY)
        assert stat.S_IMODE(folder.parent.stat().st_mode) == 0o700

    run(folder, test)


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES])
def test_what_cannot_be_looked_at_now_is_not_taken_for_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        await sent(it, 0, BODY[:20])
        old = await uploads.create(DECLARED)
        old.touched = 0.0
        look = os.stat

        def failing(path: Any, *given: Any, **options: Any) -> os.stat_result:
            if path == it.folder / "0":
                raise OSError(number, os.strerror(number))
            return look(path, *given, **options)

        with monkeypatch.context() as patch:
            patch.setattr(os, "stat", failing)
            await uploads.expire()
        assert [path.name for path in tmp_path.iterdir()] == [it.id]  # what is due goes
        await sent(it, 20, BODY[20:])
        assert it.is_complete

    run(tmp_path, test)


def test_one_whose_folder_is_removed_while_it_begins_may_begin_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        def lost(folder: Path) -> Path:
            monkeypatch.undo()
            shutil.rmtree(folder.parent)
            return durable.make_folder(folder)

        monkeypatch.setattr(partial_uploads, "make_folder", lost)
        with pytest.raises(BusyError):
            await uploads.create(DECLARED)
        assert uploads.count(None) == (1, 0)  # the first
        await sent(await uploads.create(DECLARED), 0, BODY)

    run(tmp_path / "partial", test)


def test_one_that_is_removed_by_somebody_else_while_it_is_sent_is_missing(tmp_path: Path) -> None:
    folder = tmp_path / "partial"

    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        async def cut() -> AsyncIterator[bytes]:
            yield BODY[:20]
            shutil.rmtree(folder)
            yield BODY[20:]

        with pytest.raises(NotFoundError):
            async with it.continued(0):
                await it.append(cut())
        # What is a surface already is known as long as the server runs.
        done = await uploads.create(DECLARED)
        await sent(done, 0, BODY)
        async with done.settled():
            shutil.rmtree(folder)
            await done.finish("0" * 20)
        await uploads.expire()
        async with uploads.get(done.id, "anna").settled():
            assert done.declared.surface == "0" * 20

    run(folder, test)


@pytest.mark.parametrize("step", range(8))
def test_on_a_full_disk_nothing_begins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    async def begin() -> None:
        uploads = on(tmp_path)
        disk = FullDisk(step)
        monkeypatch.setattr(durable, "disk", disk)
        try:
            await uploads.create(DECLARED)
            assert len(disk.steps) <= step
        except OSError:
            assert (uploads.count(None), list(tmp_path.iterdir())) == ((0, 0), [])

    asyncio.run(begin())


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("0" * 32, b"{"),
        ("1" * 32, b'{"owner": null}'),
        ("2" * 32, b"\xff\xfe"),
        ("x" * 32, None),
        ("3" * 32, b'{"owner": null, "length": 3, "query": [], "filename": null, "sha256": null, "metadata": ""}'),
    ],
)
def test_what_is_no_upload_is_removed(tmp_path: Path, name: str, content: bytes | None) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "0").write_bytes(b"more than three")
    if content is not None:
        (tmp_path / name / "upload.json").write_bytes(content)
    assert on(tmp_path).count(None) == (0, 0)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_read_at_a_start_is_found_at_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(uploads: PartialUploads, it: PartialUpload) -> None:
        await sent(it, 0, BODY[:20])

        def failing(path: Path) -> bytes:
            raise OSError(errno.EIO, "Input/output error")

        with monkeypatch.context() as patch:
            patch.setattr(Path, "read_bytes", failing)
            assert on(tmp_path).count(None) == (0, 0)
        assert on(tmp_path).get(it.id, "anna").offset == 20

    run(tmp_path, test)
