"""What of uvicorn and h11 the connections are built on: each member by its name, as it has to be there."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import h11
import pytest
from uvicorn.config import Config
from uvicorn.protocols.http.flow_control import FlowControl
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState

from lodestream_server.connections import connections

#: Methods that are overridden, with the names of their arguments, and whether they are coroutines.
OVERRIDDEN: dict[type, dict[str, tuple[list[str], bool]]] = {
    H11Protocol: {
        "connection_made": (["transport"], False),
        "data_received": (["data"], False),
        "connection_lost": (["exc"], False),
        "handle_websocket_upgrade": (["event"], False),
        "send_400_response": (["msg"], False),
        "shutdown": ([], False),
    },
    WebSocketsSansIOProtocol: {
        "connection_made": (["transport"], False),
        "send": (["message"], True),
        "resume_writing": ([], False),
        "handle_ping": ([], False),
        "handle_close": (["event"], False),
        "handle_pong": (["event"], False),
        "handle_cont": (["event"], False),
    },
}

#: Attributes that are read or set, with what of the source makes them what they are taken for.
ATTRIBUTES: dict[type, dict[str, str]] = {
    H11Protocol: {
        "client": "self.client = get_remote_addr(transport)",
        "conn": "event = self.conn.next_event()",
        "connections": "self.connections.add(self)",
        "cycle": "self.cycle = RequestResponseCycle(",
        "loop": "self.loop = ",
        "scope": "self.scope = {",
        "transport": "self.transport = transport",
    },
    WebSocketsSansIOProtocol: {
        "client": "self.client = get_remote_addr(transport)",
        "conn": "output = self.conn.data_to_send()",
        "frames": "self.frames.append(event.data)",
        "transport": "self.transport = transport",
        "writable": "self.writable.clear()",
        "data_received": "def data_received(self, data: bytes)",
    },
}

#: What is read or set of the request that is being answered.
CYCLE = {
    "disconnected": "self.disconnected = False",
    "message_event": "self.message_event = message_event",
    "response_complete": "self.response_complete = False",
}

#: What else the bounds rest on: who closes what, who stops reading, and how a connection becomes a stream.
RESTS_ON: dict[type, list[str]] = {
    H11Protocol: [
        "self.flow.pause_reading()",
        "self.send_400_response(msg)",
        "protocol.connection_made(self.transport)",
        "self.transport.set_protocol(protocol)",
        "if self.transport.is_closing():",
        "self.loop.call_later(self.timeout_keep_alive, self.timeout_keep_alive_handler)",
    ],
    RequestResponseCycle: [
        "self.transport.close()",
        "if self.disconnected:",
        *CYCLE.values(),
    ],
    FlowControl: ["self._transport.pause_reading()", "self._transport.resume_reading()"],
    WebSocketsSansIOProtocol: ["await self.writable.wait()", "self.transport.pause_reading()", "self.handle_ping()"],
    ServerState: ["self.connections: set["],
}

OURS: dict[type, str] = {H11Protocol: "_Http", WebSocketsSansIOProtocol: "_Stream"}
#: The protocol of asyncio's own that both are beside uvicorn's.
READING = {"get_buffer", "buffer_updated"}


def source(kind: type) -> ast.ClassDef:
    tree = ast.parse(Path(inspect.getfile(connections)).read_text())
    (found,) = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == OURS[kind]]
    return found


def names_of(kind: type) -> tuple[set[str], set[str], set[str]]:
    """The methods and attributes that our class defines, and all that it uses of itself."""
    found = source(kind)
    methods = {node.name for node in found.body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}
    declared = {
        node.target.id for node in found.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    used = {
        node.attr
        for node in ast.walk(found)
        if isinstance(node, ast.Attribute)
        and (
            (isinstance(node.value, ast.Name) and node.value.id == "self")
            or (isinstance(node.value, ast.Call) and ast.unparse(node.value) == "super()")
        )
    }
    return methods, declared, used


@pytest.mark.parametrize("kind", OURS)
def test_every_member_that_is_used_is_named_here(kind: type) -> None:
    theirs = {name for other in kind.__mro__[:-1] for name in vars(other)} - set(vars(object))
    theirs |= {
        node.attr
        for node in ast.walk(ast.parse(inspect.getsource(kind)))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "self"
    }
    methods, declared, used = names_of(kind)
    assert methods & theirs == OVERRIDDEN[kind].keys()
    assert (used | declared) & theirs - methods == ATTRIBUTES[kind].keys()
    # Whatever else our class uses of itself it has made.
    made = {name for name in used if name.startswith("_") and not name.startswith("__")} | READING
    assert used - theirs <= methods | declared | made
    assert not {name for name in used | methods if name.startswith("_")} & theirs, "a private member of uvicorn's"


def test_every_member_of_a_request_that_is_used_is_named_here() -> None:
    used = {
        node.attr
        for node in ast.walk(source(H11Protocol))
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "self.cycle"
    }
    assert used == CYCLE.keys()


@pytest.mark.parametrize("kind", OURS)
def test_uvicorn_has_each_member_as_it_is_taken_for(kind: type) -> None:
    for name, (arguments, waits) in OVERRIDDEN[kind].items():
        method = inspect.getattr_static(kind, name)
        assert inspect.isfunction(method), name
        assert [*inspect.signature(method).parameters] == ["self", *arguments], name
        assert inspect.iscoroutinefunction(method) is waits, name
    text = inspect.getsource(kind)
    for name, words in ATTRIBUTES[kind].items():
        assert words in text, name


@pytest.mark.parametrize("kind", RESTS_ON)
def test_uvicorn_does_what_the_bounds_rest_on(kind: type) -> None:
    text = inspect.getsource(kind)
    for words in RESTS_ON[kind]:
        assert words in text, words


def test_nothing_else_is_built_on_uvicorn() -> None:
    folder = Path(inspect.getfile(connections)).parents[1]
    found = {path.name for path in folder.rglob("*.py") if "uvicorn.protocols" in path.read_text()}
    assert found == {"connections.py"}
    known = inspect.signature(Config).parameters
    assert {"http", "ws", "ws_max_size", "ws_ping_interval", "ws_ping_timeout"} <= known.keys()
    assert {"next_event", "send", "their_state", "our_state"} <= set(dir(h11.Connection))
