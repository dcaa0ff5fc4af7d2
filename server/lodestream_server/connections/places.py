"""Numbers of connections, in total and of each address."""

from __future__ import annotations

import ipaddress
from collections import Counter
from collections.abc import Callable, Sequence

from ..operation.fair_share import exceeds_share
from ..operation.settings import Settings
from .open_files import most_connections

__all__ = ["Places", "network_of"]


def network_of(host: str) -> str:
    """Return the network of a household or machine: the address, of IPv6 its /64 network."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host[:80]
    return str(ipaddress.ip_network((address, 64), strict=False) if address.version == 6 else address)


class Places:
    """Counts connections of all kinds, and refuses those that exceed the limit or the share of their address.

    Connections of a trusted proxy are of many clients, which it limits itself: they have no share.

    Parameters
    ----------
    settings : Settings
    alone : callable
        Returns whether there is nobody to share with.
    """

    def __init__(self, settings: Settings, alone: Callable[[], bool]) -> None:
        self._most = most_connections(settings)
        self._alone = alone
        self._proxies = _networks(settings.trusted_proxies)
        self._any_proxy = "*" in settings.trusted_proxies
        self._taken: Counter[str] = Counter()
        self._all = 0

    def take(self, host: str) -> tuple[int, str, str] | None:
        """Count a connection; return status, code and detail of the answer if it is one too many.

        A connection that is refused counts too, until `leave`.

        Parameters
        ----------
        host : str
            Address of the other side.
        """
        taken, network = self._all, network_of(host)
        by_network = self._taken[network]
        self._taken[network] += 1
        self._all += 1
        if taken >= self._most:
            return 503, "busy", f"expected at most {self._most} connections; try again in a few seconds"
        if exceeds_share(self._most, taken, by_network) and not self._alone() and not self._is_proxy(host):
            return (
                429,
                "too-many",
                f"expected no more connections of {network} than are left for others, got {by_network}, and "
                f"{self._most - taken} of {self._most} are left; close some of them",
            )
        return None

    def leave(self, host: str) -> None:
        """Count a connection less."""
        network = network_of(host)
        self._all -= 1
        self._taken[network] -= 1
        if not self._taken[network]:
            del self._taken[network]

    def _is_proxy(self, host: str) -> bool:
        if self._any_proxy:
            return True
        try:
            address = ipaddress.ip_address(host)
        except ValueError:
            return False
        return any(address in network for network in self._proxies)


def _networks(names: Sequence[str]) -> list[ipaddress.IPv4Network | ipaddress.IPv6Network]:
    networks = []
    for name in names:
        try:
            networks.append(ipaddress.ip_network(name, strict=False))
        except ValueError:  # a name that no address can be compared with
            continue
    return networks
