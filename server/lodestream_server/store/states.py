"""The states of a surface, and the only ways from one to another.

::

                    ┌──────────────── retry, upload ─────────────────┐
                    v                                                │
    (new) ──────> queued ── begun ──> building ── stuck ──> waiting ─┤
                    ^                 │      │                       │
                    ├─ later ─────────┘      ├── refused ─> failed ──┤
                    │                        └── built ───> ready    │
                    └── lost (its container is gone) ─────────┘──────┘

``queued`` is a manifest without ``built``; ``ready`` and ``failed`` are told by ``built``. Those three follow from the
store. ``building`` and ``waiting``, with its reason and the number of attempts, are known to the writer's index alone:
if that is lost, the surface is queued again. So a build may end of which the index does not know that it began.
"""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

__all__ = ["EDGES", "Event", "State", "WrongTurnError", "after"]

State: TypeAlias = Literal["queued", "building", "waiting", "failed", "ready"]

#: ``begun``: a process works on it. ``later``: it lacks something now, such as room on a disk, or the server ended.
#: ``stuck``: it could not be built, for a reason of the server. ``refused``: a reader refuses the file, for good.
#: ``retry``: somebody asks for another attempt. ``lost``: what was built is no longer there, or no longer read.
Event: TypeAlias = Literal["begun", "later", "stuck", "refused", "built", "retry", "lost"]

#: The state after an event, by the state before and the event.
EDGES: dict[tuple[State, Event], State] = {
    ("queued", "begun"): "building",
    ("queued", "later"): "queued",
    ("queued", "stuck"): "waiting",
    ("queued", "refused"): "failed",
    ("queued", "built"): "ready",
    ("queued", "retry"): "queued",
    ("building", "later"): "queued",
    ("building", "stuck"): "waiting",
    ("building", "refused"): "failed",
    ("building", "built"): "ready",
    ("building", "retry"): "building",
    ("waiting", "retry"): "queued",
    ("failed", "retry"): "queued",
    ("ready", "retry"): "ready",
    ("ready", "lost"): "queued",
}


class WrongTurnError(Exception):
    """An event that cannot happen in this state: a fault of the program."""


def after(state: State, event: Event) -> State:
    """Return the state after an event.

    Raises
    ------
    WrongTurnError
        If there is no such edge.
    """
    found = EDGES.get((state, event))
    if found is None:
        raise WrongTurnError(f"a surface that is {state} cannot be {event}")
    return found


STATES: tuple[State, ...] = get_args(State)
