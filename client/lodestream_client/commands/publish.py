"""``lodestream publish``, ``unpublish`` and ``published``: surfaces in a folder or a bucket that any browser shows."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodestream.errors import FormatError, FormatWarning, OptionError, StreamError, TooLargeError, UnavailableError
from lodestream.quality import Quality
from lodestream.target import Target

from ..requests.addresses import is_url
from ..terminal.interrupts import interruptible
from ..terminal.output import human_size, note, print_json, progress_bar, say, say_columns
from .arguments import Subparsers, add_command, add_json_option
from .building_options import BuildingOptions, add_memory_option
from .decode import DecodeOptions, decode_file
from .encode import EncodeOptions, encode_files
from .inputs import holds_container, named
from .surface_options import SurfaceOptions, add_surface_options, surface_options
from .values import parse_days, parse_http

if TYPE_CHECKING:
    from ..publishing.published_list import PublishedSurface
    from ..publishing.publisher import Publication, Removed

__all__ = ["PublishOptions", "register", "run", "run_published", "run_unpublish"]

# Of a container that anybody may have listed.
_MOST_BYTES = 2**63

_NO_OPTIONS = SurfaceOptions(Quality(), "auto", None, {})


@dataclass(frozen=True)
class PublishOptions:
    """What is published, and where.

    Attributes
    ----------
    files : tuple of str
        Each is a surface: a container, or any file that `encode` reads; ``-`` is standard input.
    store : str
        Folder, or URL of a bucket and a prefix.
    surface : SurfaceOptions
        How files that are no container become one.
    memory : int or None
        Bytes to encode and decode in.
    levels : bool
        Whether each level becomes a file of its own.
    public_url : str or None
        Where the objects of the store are read.
    keep : timedelta
        How long containers stay that others have replaced.
    json : bool
    """

    files: tuple[str, ...]
    store: str
    surface: SurfaceOptions
    memory: int | None
    levels: bool
    public_url: str | None
    keep: timedelta
    json: bool


def register(subparsers: Subparsers) -> None:
    """Add the sub-commands."""
    parser = add_command(
        subparsers,
        "publish",
        run,
        "publish surfaces in a bucket or a folder, with a page that shows them",
        "Each FILE is a surface: a container, or any file that encode reads, which is encoded first. Its name leads\n"
        "to it: PAGE#NAME opens it in a browser, lodestream pull PAGE#NAME receives it. Publishing under the same\n"
        "name again replaces it. No server is needed: any host of files that answers Range will do. What is there\n"
        "already is not sent again. Credentials of a bucket come from the environment (AWS_..., AZURE_...). The last\n"
        "line of standard output is the address of the page.",
    )
    parser.add_argument("files", nargs="+", metavar="FILE", help="container or other file; - for standard input")
    parser.add_argument(
        "store", metavar="STORE", help="s3://BUCKET/PREFIX, az://CONTAINER/PREFIX, abfss://..., or a folder"
    )
    parser.add_argument(
        "--levels",
        action="store_true",
        help="write each level of a raster as a cloud-optimised GeoTIFF too, which QGIS and GDAL open by its address",
    )
    parser.add_argument(
        "--public-url",
        type=parse_http,
        metavar="URL",
        help="where the objects are read, if not at the store's own address: of a CDN, or of the host of a folder",
    )
    _add_keep_option(parser)
    add_surface_options(parser)
    add_memory_option(parser.add_argument_group("surfaces larger than memory"))
    add_json_option(parser)
    parser = add_command(
        subparsers,
        "unpublish",
        run_unpublish,
        "remove names from a published bucket or folder",
        "Containers that no name leads to any more are removed when their days are over, at this or a later publish.",
    )
    parser.add_argument("names", nargs="+", metavar="NAME", help="name of a surface")
    parser.add_argument("store", metavar="STORE", help="bucket and prefix, or folder, as of publish")
    _add_keep_option(parser)
    parser = add_command(
        subparsers,
        "published",
        run_published,
        "list what is published in a bucket or a folder",
        "One line for each surface: name, bytes, key of its container, title.",
    )
    parser.add_argument("store", metavar="STORE", help="bucket and prefix, or folder, as of publish; or the page's URL")
    add_json_option(parser)


def _add_keep_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--keep",
        type=parse_days,
        default=timedelta(days=7),
        metavar="DAYS",
        help="how long a container stays that another one has replaced, so that streams of it come to their end "
        "(default: 7)",
    )


@interruptible()
def run(args: argparse.Namespace) -> int:
    """Encode what is no container, publish, and print the address of the page."""
    from lodestream.page import HOW_TO_BUILD, assets
    from lodestream.stores import open_store

    from ..publishing.page_address import cors_rule, page_address
    from ..publishing.publisher import check_use, publish

    options = _options(args)
    pages = assets()
    if not pages:
        raise UnavailableError(HOW_TO_BUILD)
    store = open_store(options.store)
    check_use(store)  # an encoding may take long
    with _publications(options) as publications, progress_bar() as bar:
        task = bar.add_task("publishing", total=1.0, figures="")
        done = publish(store, publications, pages, options.keep, lambda share: bar.update(task, completed=share))
    page = page_address(options.store, options.public_url)
    rule = cors_rule(options.store)
    if options.json:
        print_json(
            {
                "page": page,
                "surfaces": [_report(surface, page) for surface in done.surfaces],
                "sent": done.sent,
                "removed": done.removed.containers,
                "cors": rule,
            }
        )
        return 0
    for surface in done.surfaces:
        note(f"{surface.name}: {human_size(surface.bytes)}, {page}#{_fragment(surface.name)}")
    note(f"{human_size(done.sent)} of containers and levels sent")
    _note_removed(done.removed)
    if rule is not None:
        note(f"for pages of other origins, allow them once: {rule}")
    say(page)
    return 0


def run_unpublish(args: argparse.Namespace) -> int:
    """Remove names from the list."""
    from lodestream.stores import open_store

    from ..publishing.publisher import unpublish

    _check_store(args)
    removed = unpublish(open_store(args.store), args.names, args.keep)
    note(f"not published any more: {', '.join(args.names)}")
    _note_removed(removed)
    return 0


def _note_removed(removed: Removed) -> None:
    if removed.containers:
        note(f"{removed.containers} old containers removed")
    if removed.failure is not None:
        note(f"not all old containers could be removed, which a later publish does: {removed.failure}")


def run_published(args: argparse.Namespace) -> int:
    """Print one line for each surface."""
    surfaces = _listed(args.store)
    if args.json:
        print_json({"surfaces": surfaces})
    elif surfaces:
        say_columns([_row(surface) for surface in surfaces])
    else:
        note("no surfaces")
    return 0


def _listed(store: str) -> Sequence[Mapping[str, Any]]:
    from lodestream.page import INDEX

    if is_url(store):
        from ..client import Client

        with Client(store) as client:
            return client.list_published(store)
    from lodestream.stores import open_store

    from ..publishing.publisher import published

    found = published(open_store(store.removesuffix(f"/{INDEX}")))  # what publish prints will do, too
    return [surface.document() for surface in found.surfaces]


def _row(surface: Mapping[str, Any]) -> tuple[str, ...]:
    size = surface.get("bytes")
    return (
        str(surface["name"]),
        human_size(size) if isinstance(size, int) and 0 <= size < _MOST_BYTES else "-",
        str(surface["src"]),
        str(surface.get("title") or ""),
    )


def _options(args: argparse.Namespace) -> PublishOptions:
    from ..publishing.published_list import check_name

    _check_store(args)
    options = surface_options(args)
    if options.name is not None and len(args.files) > 1:
        args.parser.error(f"argument --name: expected one FILE, got {len(args.files)}")
    if "-" in args.files and options.name is None:
        args.parser.error("standard input (-) needs a --name")
    try:
        names = [_name(file, options) for file in args.files]
        for name in names:
            check_name(name)
    except OptionError as error:
        args.parser.error(str(error))
    for name in names:
        if names.count(name) > 1:
            args.parser.error(f"expected files of different names, got {name} twice")
    files = tuple(args.files)
    return PublishOptions(files, args.store, options, args.memory, args.levels, args.public_url, args.keep, args.json)


def _check_store(args: argparse.Namespace) -> None:
    """End the program if STORE is none for sure."""
    if is_url(args.store):
        args.parser.error("expected a folder, or a bucket such as s3://BUCKET/PREFIX, last, got the address of a host")
    if "://" not in args.store and Path(args.store).is_file():
        args.parser.error(f"expected a folder, or a bucket such as s3://BUCKET/PREFIX, last, got the file {args.store}")


def _name(file: str, options: SurfaceOptions) -> str:
    return Path(file.rstrip("/")).stem if options.name is None else options.name


@contextmanager
def _publications(options: PublishOptions) -> Iterator[list[Publication]]:
    """Yield what to publish; files of other formats are encoded, and levels written, into a temporary folder."""
    from ..publishing.publisher import Publication

    with tempfile.TemporaryDirectory(prefix="lodestream-publish-") as temporary:
        publications = []
        for number, file in enumerate(options.files):
            folder = Path(temporary) / str(number)
            folder.mkdir()
            container = _container(file, folder, options)
            title, finest = _described(container, file)
            name = _name(file, options.surface)
            levels = _levels(file, container, finest, folder, options) if options.levels else {}
            publications.append(Publication(name, None if title == name else title, container, levels))
        yield publications


def _container(file: str, folder: Path, options: PublishOptions) -> Path:
    """Return the container of a file: the file itself, or what it is encoded into, in a folder."""
    if file == "-":
        path = folder / "input"
        with path.open("wb") as copy:
            shutil.copyfileobj(sys.stdin.buffer, copy)
    else:
        path = Path(file)
    if holds_container(path):
        if replace(options.surface, name=None) != _NO_OPTIONS:
            raise OptionError(
                "expected no --precision, --rms, --effort, --closed, --nodata, --crs, --format or -o, got one "
                f"for {file}, which is a container and is published as it is"
            )
        return path
    container = folder / "surface.lode"
    building = BuildingOptions(options.memory, None, None)
    encode_files(EncodeOptions((str(path),), str(container), options.surface, building, json=options.json))
    return container


def _described(container: Path, file: str) -> tuple[str | None, int]:
    """Return the title of a container and the number of its finest level."""
    import lodestream as ls

    try:
        index = ls.open(container).index
    except (StreamError, TooLargeError) as error:
        raise named(error, file) from None
    title: Any = index.metadata_values.get("name")
    return (title if isinstance(title, str) and title else None), index.header.levels


def _levels(file: str, container: Path, finest: int, folder: Path, options: PublishOptions) -> dict[int, Path]:
    """Write the levels of a container as files; those that cannot be on an even grid are left out, with a note."""
    levels: dict[int, Path] = {}
    with warnings.catch_warnings():
        for level in range(finest, -1, -1):
            path = folder / f"{level}.cog.tif"
            asked = DecodeOptions(str(container), str(path), Target(level=level), None, False, options.memory, False)
            try:
                decode_file(asked)
            except FormatError as error:
                words = str(error).removeprefix(f"{path}: ")
                if level == finest:
                    raise FormatError(f"{file}: --levels: {words}") from None
                note(f"{file}: level {level} and coarser ones have no file: {words}")
                break
            levels[level] = path
            # Of coarser levels it is always the same, and said once.
            warnings.simplefilter("ignore", FormatWarning)
    if len(levels) > 1:
        note(f"{file}: in files of levels coarser than {finest}, a node may be off by up to a cell of its level")
    return levels


def _report(surface: PublishedSurface, page: str) -> dict[str, Any]:
    return {**surface.document(), "container_sha256": surface.container, "page": f"{page}#{_fragment(surface.name)}"}


def _fragment(name: str) -> str:
    from urllib.parse import quote

    return quote(name, safe="")
