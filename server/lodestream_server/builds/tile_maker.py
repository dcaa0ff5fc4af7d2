"""Tiles for maps and globes: made one at a time by a confined process that is kept, while a client waits for them.

What happens to a request:

======================================  ================================================================================
its container is in a bucket            it is fetched, before the turn of the request
somebody waits for the same tile        it joins (`runner`)
otherwise                               it waits its turn; with an index and blocks in memory a tile takes milliseconds
the client disconnects                  it leaves the queue; a tile that was begun is made to its end
the surface has no CRS, is no block of  422
heights, or an option is wrong
the surface does not reach the tile     404, by the route
it needs too much memory or time        413; the process is started anew
too many requests wait, or the process  429, 503
dies
======================================  ================================================================================
"""

from __future__ import annotations

import logging
from base64 import b64decode
from binascii import Error
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from lodestream.errors import StreamError, TooLargeError

from ..access.access import Caller
from ..access.limits import Limits
from ..operation.settings import Settings
from ..operation.threads import entered
from ..problems import BusyError
from ..store.containers import Containers
from . import tiles
from .answers import ProcessDiedError, Refusal, UnforeseenError
from .fetching import Fetching
from .fork_server import Allowed
from .processes import Call, ForkServer, Keeper, Question
from .runner import Runner
from .tiles import MadeTile, TileOrder

__all__ = ["TileMaker"]

_log = logging.getLogger(__name__)

# Of decoded blocks in the process, which may take so much in all.
_BLOCKS = 64 << 20
_MEMORY = 512 << 20

# Questions to one process: what a file may have done to it does not last.
_QUESTIONS = 2000

_SECONDS = 10.0

# The longest image is one of 512 x 512 pixels of four bytes, which is not compressed; and its base64.
_LONGEST = 2 << 20

# Letters of an address, which begins with the Host of a stranger; each takes six bytes of a question at most.
_LONGEST_ADDRESS = 512

# For so many seconds it counts for whom tiles were made.
_REMEMBERED = 60.0

_Key = tuple[str, TileOrder]


class TileMaker:
    """Makes tiles of containers.

    Parameters
    ----------
    settings : Settings
    containers : Containers
    fork_server : ForkServer
        See `Builder.fork_server`.
    limits : Limits
    """

    def __init__(self, settings: Settings, containers: Containers, fork_server: ForkServer, limits: Limits) -> None:
        self._containers = containers
        self._limits = limits
        service = Call(tiles.service, (_BLOCKS, settings.max_vertices), _SECONDS, allowed=Allowed(memory=_MEMORY))
        keeper = Keeper(fork_server, service, _QUESTIONS)
        self._fetching = Fetching(containers)
        self._runner = Runner[_Key, Question]("tile", 1, _REMEMBERED, keeper, logging.DEBUG)

    async def make(self, container: str, order: TileOrder, caller: Caller) -> bytes:
        """Make what is ordered of a container, and return its bytes: none where the surface does not reach the tile.

        Raises
        ------
        TooManyError, BusyError
            If this caller, or all, have too many requests; BusyError also if the process dies.
        NotFoundError
            If there is no such container.
        InputError, OptionError
            If the surface cannot be shown on a map, or an option is wrong.
        TooLargeError
            If it takes too much memory or time, or its address is too long.
        UnavailableError
            If a library is missing.
        RestartingError
            If the server ends.
        """
        if len(order.address) > _LONGEST_ADDRESS:
            raise TooLargeError(
                f"The address of the tiles has {len(order.address)} letters, and may have {_LONGEST_ADDRESS}"
            )
        with self._limits.tiles.take(caller):
            await self._fetching.fetch(container, caller)
            async with self._runner.job((container, order), caller.key, partial(self._make, container, order)) as made:
                return made

    async def close(self) -> None:
        """Kill the process."""
        await self._fetching.close()
        await self._runner.close()

    async def _make(self, container: str, order: TileOrder, held: ExitStack) -> bytes:
        is_here = self._containers.is_here(container)
        path = await entered(self._containers.local(container), held, is_here=is_here)
        return await self._ask(container, order, path)

    async def _ask(self, container: str, order: TileOrder, path: Path) -> bytes:
        question = Question(tiles.answer, (container, order), path, _LONGEST)
        try:
            made: MadeTile | Refusal = await self._runner.call(question)
        except TimeoutError:
            raise TooLargeError(f"The tile takes longer to make than the {_SECONDS:g} s that it may") from None
        except MemoryError:
            raise TooLargeError(f"The tile needs more than {_MEMORY >> 20} MiB of memory") from None
        except ProcessDiedError as error:
            _log.warning("a tile of %s: %s", container, error)
            raise BusyError("The process that makes tiles was killed; try again soon") from None
        except UnforeseenError as error:
            _log.error("making a tile failed unexpectedly: %s", error.traceback)
            raise
        except FileNotFoundError:
            raise BusyError(f"The container {container} was deleted or stored again meanwhile; try again") from None
        except OSError as error:
            raise BusyError(f"The server's system could not start a process: {error.strerror}") from error
        if isinstance(made, Refusal):
            refusal = made.error()
            if isinstance(refusal, StreamError):
                self._containers.tell_damage(container, refusal)
            raise refusal
        try:
            return b64decode(made.data, validate=True)
        except (Error, ValueError):
            raise BusyError("The process that makes tiles gave an invalid answer; try again") from None
