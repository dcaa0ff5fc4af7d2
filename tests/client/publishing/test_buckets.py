"""Publishing in emulated buckets: what is there afterwards, and reading it over plain HTTP."""

from __future__ import annotations

import threading
from pathlib import Path

import httpx
import numpy as np
import pytest

from lodestream.stores import open_store
from lodestream_client import Client
from lodestream_client.program import main
from lodestream_client.publishing.publisher import published
from tests.patience import PATIENCE
from tests.stores.emulators import Emulator

HILLS = np.add.outer(np.sin(np.arange(300) / 9), np.cos(np.arange(400) / 7)).astype(np.float32)

pytestmark = pytest.mark.usefixtures("pages")


def test_a_bucket_of_s3_is_enough(tmp_path: Path, s3: Emulator, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "hills.npy", HILLS)
    np.save(tmp_path / "dales.npy", HILLS[:50])
    address = s3.address()
    assert main(["publish", str(tmp_path / "hills.npy"), str(tmp_path / "dales.npy"), address]) == 0
    told = capsys.readouterr()
    page = told.out.strip()
    assert "put-bucket-cors" in told.err
    for secret in ("AWS_SECRET_ACCESS_KEY", "AWS_ACCESS_KEY_ID"):
        assert s3.environment[secret] not in told.out + told.err
    answer = httpx.get(page, trust_env=False, timeout=PATIENCE)
    assert answer.headers["content-type"].startswith("text/html")
    assert "no-cache" in answer.headers["cache-control"]
    with Client(f"{page}#hills").connect(f"{page}#hills") as stream:
        *_, last = stream
    assert np.array_equal(last.surface().points, HILLS)
    container = httpx.head(Client(f"{page}#hills").locate(f"{page}#hills"), trust_env=False, timeout=PATIENCE)
    assert "immutable" in container.headers["cache-control"]
    assert main(["publish", str(tmp_path / "hills.npy"), address]) == 0
    assert "0 B of containers and levels sent" in capsys.readouterr().err
    assert main(["unpublish", "dales", address, "--keep", "0"]) == 0
    assert main(["published", address]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["hills"]
    assert len(list(open_store(address).entries("containers/"))) == 1


def test_a_container_of_azure_is_enough(tmp_path: Path, azure: Emulator, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "hills.npy", HILLS)
    address = azure.address()
    assert main(["publish", str(tmp_path / "hills.npy"), address]) == 0
    told = capsys.readouterr()
    assert azure.environment["AZURE_STORAGE_ACCOUNT_KEY"] not in told.out + told.err
    assert "az storage cors add" in told.err
    (surface,) = published(open_store(address)).surfaces
    assert (surface.name, open_store(address).open(surface.src).size) == ("hills", surface.bytes)
    assert main(["unpublish", "hills", address, "--keep", "0"]) == 0
    assert not list(open_store(address).entries("containers/"))


def test_several_publishers_do_not_lose_each_others_names(tmp_path: Path, s3: Emulator) -> None:
    address, codes = s3.address(), list[int]()
    for number in range(4):
        np.save(tmp_path / f"name-{number}.npy", HILLS[: 10 + number, :10])

    def work(number: int) -> None:
        codes.append(main(["publish", str(tmp_path / f"name-{number}.npy"), address]))

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert codes == [0] * 4
    assert sorted(surface.name for surface in published(open_store(address)).surfaces) == [
        f"name-{number}" for number in range(4)
    ]
