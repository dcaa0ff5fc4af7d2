"""Answers of the library for buckets: what it raises becomes one class, whose text can have no credential in it."""

from __future__ import annotations

import logging
import os
import re
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Literal, TypeVar

from .errors import StoreError

__all__ = ["RequestError", "ask", "check_process", "wait_for"]

_log = logging.getLogger(__name__)

_T = TypeVar("_T")

_STATUS = re.compile(r"status code: (\d{3})\b", re.ASCII)
# In the body of an answer, or as the library tells those of a request for deletes, whose status is 200.
_CODE = re.compile(r"(?:<Code>|\(code: )([A-Za-z]{1,60})(?:</Code>|\))", re.ASCII)
# Of an object in a list, as Rust writes a text: without control characters.
_UNLISTED = re.compile(r'path: "((?:[^"\\\n]|\\.){1,200})')
_LACKING = re.compile(r"\bMissing (AccessKeyId|SecretAccessKey)\b", re.ASCII)
_RETRIED = re.compile(r"\bafter [1-9]\d* retries", re.ASCII)

#: The variables of the two halves of credentials, as the library calls them.
_VARIABLES = {"AccessKeyId": "AWS_ACCESS_KEY_ID", "SecretAccessKey": "AWS_SECRET_ACCESS_KEY"}
#: Codes of stores without the bucket or container itself.
_NO_BUCKET = ("NoSuchBucket", "ContainerNotFound")
#: Codes for credentials that are over, or were never any.
_EXPIRED = ("ExpiredToken", "InvalidToken", "TokenRefreshRequired")
#: Codes for what the credentials do not allow.
_DENIED = ("AccessDenied", "AllAccessDisabled", "InvalidAccessKeyId", "SignatureDoesNotMatch")
#: Codes for a request to another region than the bucket's.
_OTHER_REGION = ("PermanentRedirect", "AuthorizationHeaderMalformed", "IllegalLocationConstraintException")
#: Where machines of clouds ask for the credentials of their role.
_ROLE = ("169.254.169.254", "169.254.170.2", "fd00:ec2::254")

#: What a store with such a status may still do when it is asked again.
_AGAIN = (408, 429)
_CONDITIONS = (409, 412)

_CREDENTIALS = "check the credentials in the environment (AWS_..., AZURE_...) or the role of this machine"

#: Seconds in which Windows notices Ctrl-C.
_LOOK = 0.5
#: Seconds that a call has to end after an interrupt.
_FAREWELL = 2.0

Kind = Literal["absent", "condition", "refused", "unknown"]


class RequestError(Exception):
    """What went wrong with a request to a bucket.

    Parameters
    ----------
    kind : str
        ``absent``: there is no such object. ``condition``: a condition was not met, or another write was on its way.
        ``refused``: the store does not do it, and did nothing. ``unknown``: it is not known what the store did.
    words : str
        For a message, without a credential.
    denied : bool
        Whether the caller may not do it.
    """

    def __init__(self, kind: Kind, words: str, *, denied: bool = False) -> None:
        super().__init__(words)
        self.kind = kind
        self.words = words
        self.denied = denied


_first_process: int | None = None


def check_process() -> None:
    """Check that this process was not forked from one that used the library: it would wait for ever.

    Raises
    ------
    StoreError
        If it was.
    """
    global _first_process
    _first_process = _first_process or os.getpid()
    if _first_process != os.getpid():
        raise StoreError(
            "a store in a bucket was used before this process was forked, so it cannot be used here: open stores in "
            "processes that are spawned, or fork before the first one is opened"
        )


def wait_for(answer: Future[_T]) -> _T:
    """Wait for a call in another thread and return what it returns; Ctrl-C ends the wait, on Windows too."""
    while not answer.done():
        wait([answer], _LOOK)
    return answer.result()


def ask(call: Callable[[], _T], stop: Callable[[], None] | None = None) -> _T:
    """Call the library for buckets and return what it returns.

    Parameters
    ----------
    call : callable
        Called in another thread if this is the main one, which Ctrl-C could not interrupt meanwhile.
    stop : callable, optional
        Lets the call end soon after an interrupt.

    Raises
    ------
    RequestError
        If the library raises anything. The failure has no reference to it: its text may hold addresses with signatures.
    StoreError
        In a process that was forked from one that used the library.
    """
    check_process()
    try:
        return call() if threading.current_thread() is not threading.main_thread() else _interruptibly(call, stop)
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:  # also its panics, which are no Exception
        if not isinstance(error, Exception):
            _log.warning("the library for buckets failed: %s", type(error).__name__)
        failure = _failure(type(error).__name__, isinstance(error, FileNotFoundError), str(error))
    raise failure


def _interruptibly(call: Callable[[], _T], stop: Callable[[], None] | None) -> _T:
    """Wait for a call in another thread; an interrupt ends the wait."""
    answer: Future[_T] = Future()

    def run() -> None:
        try:
            answer.set_result(call())
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=run, name="lodestream-store", daemon=True).start()
    try:
        return wait_for(answer)
    except BaseException:
        if stop is not None and not answer.done():
            stop()
            wait([answer], _FAREWELL)
        raise


def _failure(name: str, absent: bool, text: str) -> RequestError:
    status, code = _STATUS.search(text), _CODE.search(text)
    number = int(status[1]) if status else None
    known = " ".join(found[1] for found in (status, code) if found)
    kind = _kind(name, absent, number, code[1] if code else "")
    if kind == "refused" and _RETRIED.search(text):
        kind = "unknown"  # an attempt before may have done it
    denied = _is_denied(name, number, code[1] if code else "")
    return RequestError(kind, _words(name, text, number, code[1] if code else "", known), denied=denied)


def _kind(name: str, absent: bool, status: int | None, code: str) -> Kind:
    if absent and code not in _NO_BUCKET:
        return "absent"
    if name in ("AlreadyExistsError", "PreconditionError") or status in _CONDITIONS:
        return "condition"
    if absent or code in _DENIED or (status is not None and 300 <= status < 500 and status not in _AGAIN):
        return "refused"
    definite = ("PermissionDeniedError", "UnauthenticatedError", "NotSupportedError", "InvalidPathError", "ValueError")
    return "refused" if name in (*definite, "UnknownConfigurationKeyError", "TypeError") else "unknown"


def _is_denied(name: str, status: int | None, code: str) -> bool:
    denials = ("PermissionDeniedError", "UnauthenticatedError")
    return status in (401, 403) or code in (*_DENIED, *_EXPIRED) or name in denials


def _words(name: str, text: str, status: int | None, code: str, known: str) -> str:
    """What a message says of a failure: words of this module, a status, and a code of letters."""
    if any(address in text for address in _ROLE) or "oken request" in text:
        return f"there are no credentials: {_CREDENTIALS}"
    if lacking := _LACKING.search(text):
        return f"the credentials are incomplete: set {_VARIABLES[lacking[1]]} too"
    if "Account must be specified" in text:
        return "there is no account: set AZURE_STORAGE_ACCOUNT_NAME"
    if code in _NO_BUCKET:
        return f"there is no such bucket or container ({known})"
    if code in _OTHER_REGION or (status is not None and 300 <= status < 400) or "redirect" in text:
        return f"the bucket is elsewhere ({known or 'redirected'}): set AWS_REGION to its region"
    if _is_denied(name, status, code):
        return f"the store refuses access ({known or name}): {_CREDENTIALS}"
    if name == "InvalidPathError":
        key = _UNLISTED.search(text)
        return (
            f"it cannot be listed because of the object {key[1] if key else ''!a}, of whose key a part is empty, . or "
            ".., or has a control character: delete that object with another program"
        )
    if known:
        return f"the store answers {known}"
    if "builder error" in text or name in ("UnknownConfigurationKeyError", "ValueError", "TypeError"):
        return "the endpoint or a setting in the environment (AWS_..., AZURE_...) cannot be used"
    return "the store does not answer: check the network and the endpoint, or try again later"
