"""The sub-commands of ``lodestream``, one module for each or for a small group.

Each module has ``register(subparsers)``, which adds its sub-commands and sets ``run``: a callable that takes the parsed
arguments and returns the exit code. Whatever is slow to import is imported inside ``run``.
"""

from __future__ import annotations
