"""Every code of an error: its status over HTTP, its title, what it means and what to do; the page that says so."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from lodestream.protocol.messages import CODES

__all__ = ["MEANINGS", "PAGE", "Meaning", "address"]

#: Path of the page of codes on a server.
PAGE = "/errors"


class Meaning(NamedTuple):
    """What a code says.

    Attributes
    ----------
    status : int
        Of the answer over HTTP.
    title : str
        Of the problem document, or of the message ``error`` of a stream.
    advice : str
        A paragraph: what it means and what to do. Code is between backticks.
    """

    status: int
    title: str
    advice: str


# What each code of a stream means; its title is a part of the protocol.
_OF_STREAMS = {
    "bad-message": "A message of the client cannot be read, or says something that cannot be. This is a fault of the "
    "client: please report it to those who wrote it. A server tells the version of the protocol in the subprotocol.",
    "out-of-turn": "The client sent a message that the state of the stream does not allow, such as `credit` before "
    "`open`. This is a fault of the client.",
    "no-token": "The server lets nobody do this without a token. Send one as `Authorization: Bearer ...`; the command "
    "line takes it from `--token` or `LODESTREAM_TOKEN`. Whoever runs the server makes one with "
    "`lodestream token create`.",
    "bad-token": "The server does not know the token: it is mistyped, has expired or was revoked, or belongs to "
    "another server. Ask for a new one.",
    "small-scope": "The token is good, but not for this. Reading needs the scope `read`, uploading and deleting "
    "`write`, the figures of the server and other people's surfaces `admin`. Ask for a token with that scope.",
    "not-found": "There is no surface, name, container, tile or page at this address. Surfaces are deleted by their "
    "owners, and some time after a name has come to lead to another one. `lodestream list` says what there is.",
    "idle": "The client sent nothing, or read nothing, for too long, or much too slowly, and the server has given up. "
    "Try again; a slow upload may need a better connection, and a stream continues where it broke off.",
    "not-ready": "The surface is queued or being built. Wait: `GET` of the surface says how far the build is. "
    "The answer has `Retry-After`.",
    "other-container": "What the client holds is of another container than the one that the surface has now. Drop it, "
    "and begin again without it. The Python client does so by itself where it may.",
    "bad-held": "The list of slices that the client says it holds is not in order, not within the file, or too long. "
    "This is a fault of the client.",
    "failed": "The file that was uploaded cannot become a surface, and building it again would not help; the reason is "
    "in `detail` and in the surface's `reason`. Mend the file, or choose other options, and upload it again.",
    "waiting": "The surface could not be built for a reason that is not its file's, such as a lack of memory or time; "
    "it is in `detail` and in the surface's `reason`. Retry the build when that has changed: `lodestream retry`, or "
    "`POST` to the surface's `retry`.",
    "bad-target": "The surface cannot do what was asked of it: it has no such level or attribute, it does not reach so "
    "far, or its first layer has more bytes already. Ask for something that its description says it has.",
    "unsupported-version": "Client and server speak different versions of the protocol, or a container is of a version "
    "that this server does not read. Update the older of the two.",
    "too-many": "You have as much in progress as one caller may have, or more would leave too little for others. Wait "
    "until some of it is done; the answer has `Retry-After`, and says what there is too much of.",
    "message-too-large": "A message of the client is longer than any that the protocol knows. This is a fault of the "
    "client.",
    "damaged": "The stored container is damaged. What was received before is right. Whoever runs the server repairs it "
    "with `lodestream fsck --repair`, which builds it again from the upload.",
    "busy": "The server has as much in progress as it can handle, its store does not answer, or another server of the "
    "same bucket writes. Try again after the time in `Retry-After`.",
    "internal": "Something went wrong that nobody has foreseen. Nothing is told of it here; the server's log has it, "
    "beside the id in the header `X-Request-ID`.",
    "restarting": "The server is being stopped or started. Try again in a few seconds; clients of the project do.",
}

# Codes of streams whose close code is not 4000 plus the status.
_STATUSES = {"message-too-large": 413, "internal": 500, "restarting": 503}

#: Every code of a problem document or of a stream's ``error``; those of `CODES` have a close code there.
MEANINGS: Mapping[str, Meaning] = {
    **{
        word: Meaning(_STATUSES.get(word, code.close - 4000), code.title, _OF_STREAMS[word])
        for word, code in CODES.items()
    },
    "bad-request": Meaning(
        400,
        "Not a valid request",
        "The bytes that came are no valid request of HTTP/1.1. Look at the client, or at a proxy before the server.",
    ),
    "gone": Meaning(
        400,
        "The client disconnected",
        "The connection ended before the request was complete. Nobody reads this answer; it is counted and logged.",
    ),
    "foreign-origin": Meaning(
        403,
        "Pages of other sites may not do this",
        "A page of another site asked, and only this server's own page may. Whoever runs the server allows others with "
        "the setting `LODESTREAM_ORIGINS`.",
    ),
    "read-only": Meaning(
        403,
        "This server only reads",
        "Several servers share the data, and this one never changes them. Send what changes something to the address "
        "of one that writes.",
    ),
    "not-owner": Meaning(
        403,
        "Only its owner and an admin may do this",
        "The surface or name was made with another token. Use that one, or one with the scope `admin`.",
    ),
    "bad-method": Meaning(
        405,
        "There is no such method here",
        "The address is right, but not the method. The header `Allow` says which there are.",
    ),
    "wrong-offset": Meaning(
        409,
        "The bytes are not the next ones of the upload",
        "The upload has fewer or more bytes than the client believes; `Upload-Offset` says how many. Go on there.",
    ),
    "wrong-version": Meaning(
        412,
        "The request does not name the version of the protocol",
        "Requests about resumable uploads have the header `Tus-Resumable: 1.0.0`. The client is none of tus, or one of "
        "another version.",
    ),
    "too-large": Meaning(
        413,
        "The request, or what it asks for, is too large",
        "`detail` says which limit is exceeded. Send or ask for less, such as a coarser level; or whoever runs the "
        "server raises the limit.",
    ),
    "wrong-type": Meaning(
        415,
        "The body has another type",
        "A part of a resumable upload has the header `Content-Type: application/offset+octet-stream`. This is a fault "
        "of the client.",
    ),
    "requested-range-not-satisfiable": Meaning(
        416,
        "The file has no such bytes",
        "The range begins behind the end of the file, whose size is in `Content-Range`.",
    ),
    "bad-file": Meaning(
        422,
        "The file cannot be read, or the level not be written, in this format",
        "Of an upload: the file is damaged or empty, its format is unknown, or this server does not read it "
        "(`GET /v1/formats`). Of a level: the format cannot hold this surface. `detail` says what is wrong.",
    ),
    "bad-input": Meaning(
        422,
        "The input cannot be used",
        "What was sent can be read but not be used. `detail` says why.",
    ),
    "bad-option": Meaning(
        422,
        "An option does not exist, or its value is not valid",
        "A parameter of the address, or an option of the upload, is unknown or has a value that it cannot have. "
        "`detail` says which, and what there is.",
    ),
    "locked": Meaning(
        423,
        "Another request is at work on this upload",
        "Two requests send the same upload; one of them goes on. A client that has lost its connection asks for the "
        "offset first (`HEAD`), which ends the request that was lost.",
    ),
    "no-websocket": Meaning(
        426,
        "A stream needs a WebSocket",
        "The address of a stream is opened as a WebSocket (`ws://`, `wss://`), with the subprotocol `lodestream.v1`. "
        "If the client did so, a proxy before the server does not pass on `Upgrade`. Without WebSocket a surface is "
        "read from its `container`, with `Range`.",
    ),
    "unavailable": Meaning(
        501,
        "This server lacks a library that this needs",
        "The format needs a library that is not installed where the server runs; `detail` names it.",
    ),
    "damaged-name": Meaning(
        503,
        "It cannot be read where the name leads",
        "What the server has stored of the name is damaged. An admin makes it lead to a surface again, or deletes it.",
    ),
    "disk-full": Meaning(
        507,
        "The disk is full",
        "Nothing was stored. Try again when surfaces were deleted, or the disk was enlarged.",
    ),
    "full": Meaning(
        507,
        "There is no space for more",
        "There are as many surfaces as allowed, they take as much space as allowed, or the disk has no room for this "
        "one. `detail` says which. Delete surfaces that are not needed, or ask whoever runs the server.",
    ),
}


def address(code: str, root: str) -> str:
    """Return the address of the paragraph about a code: the ``type`` of a problem document.

    It has no scheme and no host, as RFC 9457 allows: behind a proxy only the client knows the host's name. `root` is
    the path at which the application is.
    """
    return f"{root}{PAGE}#{code}"
