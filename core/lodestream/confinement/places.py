"""Where Python, the libraries that it loads, and their data lie."""

from __future__ import annotations

import os
import sys
from pathlib import Path

__all__ = ["library_places"]

_SYSTEM = (
    *("/lib", "/lib32", "/lib64", "/usr/lib", "/usr/lib32", "/usr/lib64", "/usr/local/lib", "/usr/local/lib64"),
    *("/usr/share/gdal", "/usr/share/proj", "/usr/share/zoneinfo", "/usr/local/share/gdal", "/usr/local/share/proj"),
    *("/etc/ld.so.cache", "/etc/ld.so.preload", "/etc/localtime"),
    *("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom"),
    *("/proc/cpuinfo", "/proc/meminfo", "/sys/devices/system/cpu"),
)

#: Parts of a folder in which Python is installed; beside them there may be anything.
_PARTS = ("bin", "lib", "lib64", "share", "pyvenv.cfg")

#: Variables that say where libraries, or their data, are looked for.
_VARIABLES = ("GDAL_DATA", "GDAL_DRIVER_PATH", "HDF5_PLUGIN_PATH", "LD_LIBRARY_PATH", "PROJ_DATA", "PROJ_LIB")


def library_places(*, processes: bool = False) -> tuple[Path, ...]:
    """Return files and folders that any program in Python may need to read; not all of them exist.

    Parameters
    ----------
    processes : bool
        Whether further processes are started, each of which reads what /proc says of it.
    """
    found = [Path(place) for place in _SYSTEM]
    found.append(Path("/proc" if processes else f"/proc/{os.getpid()}"))
    for prefix in dict.fromkeys((sys.prefix, sys.exec_prefix, sys.base_prefix, sys.base_exec_prefix)):
        found += [Path(prefix) / part for part in _PARTS if prefix not in ("/", "/usr")]
    found += [Path(sys.executable), Path(sys.executable).resolve()]
    found += [Path(place or os.curdir) for place in sys.path]
    for variable in _VARIABLES:
        found += [Path(place) for place in os.environ.get(variable, "").split(os.pathsep) if place]
    return tuple(dict.fromkeys(path.absolute() for path in found))
