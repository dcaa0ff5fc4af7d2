from __future__ import annotations

import os
import re
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import pytest

from lodestream.errors import InputError, UnavailableError
from lodestream.stores import Folder, Store, StoreError, open_store
from lodestream.stores.addresses import place_of
from lodestream.stores.bucket import Bucket
from lodestream.stores.connections import Limits, Place, endpoint_of, parsed
from tests.patience import PATIENCE
from tests.stores.emulators import Emulator


@pytest.fixture(autouse=True)
def _environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in os.environ:
        if name.startswith(("AWS_", "AZURE_")):
            monkeypatch.delenv(name)
    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "account")


@pytest.mark.parametrize("address", ["store", "a/b", ".", "c:\\store", "C:/store", "a:b", "./s3:/a"])
def test_whatever_has_no_scheme_is_a_folder(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    store = open_store(address)
    assert isinstance(store, Folder)
    assert store.describe() == str(tmp_path / address)
    assert open_store(Path("s3://bucket")).describe() == str(tmp_path / "s3:" / "bucket")


def test_a_folder_stays_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    store = open_store("store")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    store.create("a", b"1")
    assert (tmp_path / "store" / "a").read_bytes() == b"1"


@pytest.mark.parametrize(
    ("address", "described"),
    [
        ("s3://bucket", "s3://bucket"),
        ("s3://my.bucket-1/", "s3://my.bucket-1"),
        ("S3://bucket/a/b/", "s3://bucket/a/b"),
        ("az://container/a", "az://container/a"),
        ("az://$web/a", "az://$web/a"),
        (
            "abfss://container@account.dfs.core.windows.net/a/b",
            "abfss://container@account.dfs.core.windows.net/a/b",
        ),
        ("abfss://container@account.blob.core.windows.net", "abfss://container@account.dfs.core.windows.net"),
    ],
)
def test_a_bucket_says_its_address(address: str, described: str) -> None:
    store = open_store(address)
    assert store.describe() == described
    assert repr(store) == f"Bucket({described!r})"


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("", "got nothing"),
        ("gs://bucket/a", "begins with s3://, az://, abfss://, got another one"),
        ("http://SECRET@host/a", "got another one"),
        ("SECRET://bucket/a", "got another one"),
        ("file:///store", "got another one"),
        ("memory://store", "got another one"),
        ("s3:/maps/SECRET", "a slash is missing after s3:, expected an address such as s3://bucket/prefix; put"),
        ("S3:maps/SECRET", "two slashes are missing after s3:, expected .*; put ./ before a folder"),
        ("az:/maps/SECRET", "put ./ before a folder"),
        ("abfss:/maps@SECRET", "put ./ before a folder"),
        ("gs:/maps/SECRET", "put ./ before a folder"),
        ("file:/SECRET", "put ./ before a folder"),
        ("s3://", "got another bucket"),
        ("s3:///a", "got another bucket"),
        ("s3://key:SECRET@bucket/a", "credentials come from the environment"),
        ("s3://SECRET@bucket/a", "credentials come from the environment"),
        ("s3://bucket:9000/a", "credentials or a port"),
        ("az://account:SECRET@container/a", "credentials come from the environment"),
        ("abfss://container:SECRET@account.dfs.core.windows.net/a", "got another bucket, container or account"),
        ("abfss://container@account.example.org/a", "got another bucket, container or account"),
        ("abfss://container/a", "got another bucket, container or account"),
        ("s3://bucket/a?SECRET=1", "query or fragment"),
        ("az://container/a?sv=1&sig=SECRET", "query or fragment"),
        ("az://container?sig=SECRET", "query or fragment"),
        ("s3://bucket/a#SECRET", "query or fragment"),
        ("s3://bu/a", "got another bucket"),
        ("s3://bucket_/a", "got another bucket"),
        ("az://Container/a", "got another bucket"),
        ("s3://SECRET_/a", "got another bucket"),
        ("az://SECRET/a", "got another bucket"),
        ("abfss://SECRET@account.dfs.core.windows.net/a", "got another bucket, container or account"),
        ("abfss://container@SECRET.dfs.core.windows.net/a", "got another bucket, container or account"),
        ("s3://bucket/AKIA:SECRET@x/y", "expected a prefix"),
        ("az://container/a/key:SECRET", "expected a prefix"),
        ("abfss://container@account.dfs.core.windows.net/a/SECRET%2f", "expected a prefix"),
        ("s3://bucket/SECRET//b", "expected a prefix"),
        ("s3://bucket/../SECRET", "expected a prefix"),
        ("s3://bucket/a%2fb", "expected a prefix"),
        ("s3://bucket/a b", "expected a prefix"),
        ("s3://bucket/" + "a/" * 200, "at most 300 characters"),
    ],
)
def test_other_addresses_are_refused_and_no_credential_is_repeated(address: str, message: str) -> None:
    refusals: list[Callable[[str], object]] = [open_store, place_of]
    if address:
        refusals += [Bucket, parsed]
    for refuse in refusals:
        with pytest.raises(InputError, match=message) as caught:
            refuse(address)
        assert "secret" not in "".join(traceback.format_exception_only(caught.value)).lower()
        assert caught.value.__context__ is None, "nor in what led to it"


@pytest.mark.parametrize(
    ("address", "place"),
    [
        ("s3://my.maps/alps/", Place("s3", "my.maps", None, "alps/")),
        ("S3://maps", Place("s3", "maps", None, "")),
        ("az://maps/a/b", Place("az", "maps", None, "a/b/")),
        ("abfss://maps@account.dfs.core.windows.net/a", Place("abfss", "maps", "account", "a/")),
        ("maps/alps", None),
        (Path("s3://maps"), None),
    ],
)
def test_the_place_of_a_bucket_is_told_without_opening_it(address: str | Path, place: Place | None) -> None:
    assert place_of(address) == place


def test_an_account_that_is_missing_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AZURE_STORAGE_ACCOUNT_NAME")
    with pytest.raises(StoreError, match="set AZURE_STORAGE_ACCOUNT_NAME"):
        open_store("az://container/a")


@pytest.mark.parametrize(
    ("there", "missing"),
    [("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"), ("AWS_SECRET_ACCESS_KEY", "AWS_ACCESS_KEY_ID")],
)
def test_the_missing_half_of_credentials_is_named(there: str, missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(there, "SECRET")
    with pytest.raises(StoreError, match=f"credentials are incomplete: set {missing} too$"):
        open_store("s3://bucket")


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(UnavailableError, match=re.escape("pip install 'lodestream[stores]'")):
        open_store("s3://bucket")


def test_the_library_is_imported_on_use() -> None:
    script = "import sys, lodestream.stores; lodestream.stores.open_store('x'); print('obstore' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True, timeout=PATIENCE)
    assert ran.stdout == "False\n"


def test_plain_http_needs_an_endpoint_that_says_so(s3: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    store: Store = open_store(s3.address())
    store.create("a", b"1")
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"https://127.0.0.1:{s3.port}")
    with pytest.raises(StoreError, match="does not answer"):
        Bucket(store.describe(), Limits(retries=0, again=0.0)).get("a")
    monkeypatch.setenv("AWS_ENDPOINT_URL_S3", f"HTTP://127.0.0.1:{s3.port}")
    assert open_store(store.describe()).get("a")[0] == b"1"


@pytest.mark.parametrize(
    "endpoint", ["notaurl", "ftp://host", "http://", "http://host:port", "http://a b", "http://[::1", "127.0.0.1:9000"]
)
@pytest.mark.parametrize("variable", ["AWS_ENDPOINT_URL", "AZURE_STORAGE_ENDPOINT"])
def test_an_endpoint_that_is_no_address_is_told_at_once(
    variable: str, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, endpoint)
    with pytest.raises(InputError, match=f"expected the address of a service in {variable}, such as"):
        open_store("s3://maps/alps" if variable.startswith("AWS") else "az://maps/alps")


@pytest.mark.parametrize("endpoint", ["http://127.0.0.1:9000", "https://minio.example/", "http://[::1]:9/account"])
def test_addresses_of_services(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    assert endpoint_of("s3") == endpoint
