"""`Widget`: a surface in a notebook."""

from __future__ import annotations

import asyncio
from typing import Any

import traitlets

from lodestream import page
from lodestream.errors import OptionError, UnavailableError
from lodestream.opening.container import Container
from lodestream.opening.open_source import is_address
from lodestream.quality import Quality
from lodestream.target import Target

from .messages import Answers, Message
from .opening import field_names, limit_of, opened

try:
    from anywidget import AnyWidget
except ModuleNotFoundError:
    raise UnavailableError("expected anywidget, which is not installed: pip install 'lodestream[notebook]'") from None

__all__ = ["Widget"]

_COLOUR_MAPS = ("viridis", "cividis", "terrain", "red-blue", "grey")
_THEMES = ("auto", "light", "dark")


class Widget(AnyWidget):
    """A surface in a notebook, shown by the viewer of `docs/viewer.md`; it is refined while its bytes arrive.

    The bytes come from the kernel over the widget's comm; no port is opened, and a token stays in the kernel. If the
    widget is shown in several places, each receives the bytes separately, and all have the same appearance. ``close()``
    ends all of them.

    Parameters
    ----------
    source : Surface, array, bytes, str or path-like
        A `Surface` or an array of points, shape (row, column) or (row, column, xyz), which is encoded first; a
        container as bytes; the path of a container, or of any file that `lodestream.read` reads; the URL of a surface
        on a server or of a container on any host of files with Range, which the kernel reads.
    target : Target, optional
        Where to stop: one of level, until_rms, until_max and max_bytes. None: everything.
    token : str, optional
        Of the server of a URL.
    quality : Quality, optional
        Precision of a surface that is encoded here; None: exact.
    name : str, optional
        Name of the surface; None: its own name.
    **look
        Values of the attributes below that can be set.

    Attributes
    ----------
    height : str
        Height in the page, as in CSS; a number is taken as pixels. "480px" unless given.
    theme : "auto", "light" or "dark"
        "auto" follows the notebook.
    field : str
        Field that the colours show: "height", "slope", "change", "none", or the name of an attribute. For a vector the
        name means its length, and "name[0]" a component.
    colour_map : str or None
        "viridis", "cividis", "terrain", "red-blue" or "grey"; None: one that suits the field.
    value_range : (float, float) or None
        Values of the first and the last colour; None: the range of the values.
    exaggeration : float or None
        Factor by which heights are multiplied, 0.1 to 100; None: a factor that is chosen from the surface.
    lines : bool
        Whether the quads of the level that is drawn are shown.
    stop_when_done : bool
        Whether the transmission ends once the picture looks done; True unless given.
    target : Target or None
        As above; another one can be set at any time.
    state : str
        State of the transmission: "connecting", "receiving", "resuming", "stopped", "target", "complete" or "failed".
        This attribute and the following ones come from the page, and describe the place where the widget was shown
        last.
    detail : str
        Further information in a sentence, such as the reason of a failure; may be empty.
    bytes_received : int
        Bytes of the surface that have arrived.
    level : int or None
        Finest level of the surface as drawn.
    rms, max_error : float or None
        Errors of the surface as drawn, in the surface's unit; None if they are not known.
    region : ((int, int), (int, int)) or None
        Rows and columns, half-open, in the view, when it shows less than half of the surface.
    selected : dict or None
        The node under the pointer: block, row, column, point, attributes (lists by name), rms, max_error.
    fields : list of str
        Values that `field` can have.
    bytes_sent : int
        Bytes of the container sent over the comm, to all places.

    Raises
    ------
    InputError
        If the source has another type, if an option does not fit it, or if the surface has no such field or level.
    OSError
        If there is no such file.
    StreamError, TooLargeError, NotFoundError, RemoteError, UnreachableError
        If the container is damaged or too large, or cannot be had.
    UnavailableError
        If anywidget is not installed, or the viewer is not built (in a working tree only).

    Examples
    --------
    >>> import lodestream_client, numpy as np
    >>> widget = lodestream_client.Widget(np.arange(63.0).reshape(7, 9), height=300, lines=True)
    >>> widget.state, widget.height, widget.lines
    ('connecting', '300px', True)
    >>> widget.close()
    """

    # A widget that was refused is closed too.
    _shown: Container | None = None
    _later: frozenset[asyncio.Task[None]] = frozenset()

    _esm = traitlets.Unicode().tag(sync=True)
    _program = traitlets.Unicode().tag(sync=True)
    _target = traitlets.Dict().tag(sync=True)
    name = traitlets.Unicode().tag(sync=True)
    height = traitlets.Any("480px").tag(sync=True)
    theme = traitlets.Unicode("auto").tag(sync=True)
    field = traitlets.Unicode("height").tag(sync=True)
    colour_map = traitlets.Unicode(None, allow_none=True).tag(sync=True)
    value_range = traitlets.Tuple(traitlets.CFloat(), traitlets.CFloat(), default_value=None, allow_none=True).tag(
        sync=True
    )
    exaggeration = traitlets.CFloat(None, allow_none=True).tag(sync=True)
    lines = traitlets.Bool(False).tag(sync=True)
    stop_when_done = traitlets.Bool(True).tag(sync=True)
    state = traitlets.Unicode("connecting").tag(sync=True)
    detail = traitlets.Unicode().tag(sync=True)
    bytes_received = traitlets.CInt(0).tag(sync=True)
    level = traitlets.CInt(None, allow_none=True).tag(sync=True)
    rms = traitlets.CFloat(None, allow_none=True).tag(sync=True)
    max_error = traitlets.CFloat(None, allow_none=True).tag(sync=True)
    region = traitlets.Any(None, allow_none=True).tag(sync=True)
    selected = traitlets.Dict(default_value=None, allow_none=True).tag(sync=True)

    def __init__(
        self,
        source: Any,
        *,
        target: Target | None = None,
        token: str | None = None,
        quality: Quality | None = None,
        name: str | None = None,
        **look: Any,
    ) -> None:
        if unknown := sorted(set(look) - _SETTABLE):
            raise OptionError(f"expected options among {', '.join(sorted(_SETTABLE))}, got {', '.join(unknown)}")
        shown = opened(source, token=token, quality=quality, name=name)
        try:
            modules = page.widget_modules()
            if modules is None:
                raise UnavailableError(page.HOW_TO_BUILD)
            widget, element = modules
            self._shown = shown
            self.fields = field_names(shown.header)
            self._answers = Answers(shown.source, element)
            self._chosen = target
            limit = limit_of(target, shown.header)
            esm = widget.read_text(encoding="utf-8")
            super().__init__(_esm=esm, _program=element.name, _target=limit, name=shown.source.name, **look)
        except BaseException:
            shown.close()
            raise
        self.on_msg(self._hear)

    def __repr__(self) -> str:
        return f"<Widget {self.name!r}: {self.state}, {self.bytes_received:,} bytes>"

    @property
    def target(self) -> Target | None:
        """Where the transmission stops."""
        return self._chosen

    @target.setter
    def target(self, target: Target | None) -> None:
        assert self._shown is not None
        self._target = limit_of(target, self._shown.header)
        self._chosen = target

    @property
    def bytes_sent(self) -> int:
        """Bytes of the container sent over the comm, to all places where the widget is shown."""
        return self._answers.sent

    def stop(self) -> None:
        """End the transmission, wherever the widget is shown."""
        self.send({"kind": "command", "command": "stop"})

    def resume(self) -> None:
        """Continue after `stop`, the end of a target, or a failure."""
        self.send({"kind": "command", "command": "resume"})

    def close(self) -> None:
        """Remove the widget wherever it is shown, and close its files and connections."""
        for task in self._later:
            task.cancel()
        super().close()
        if self._shown is not None:
            self._shown.close()

    def _hear(self, _widget: Any, question: Any, _buffers: Any) -> None:
        """Answer a question: at once, or beside the kernel's other work if another machine must be waited for."""
        loop = None
        if self._shown is not None and is_address(self._shown.source.place):
            try:
                loop = asyncio.get_running_loop()
            except RuntimeError:
                loop = None  # no program of notebooks: there is nothing to keep up
        if loop is None:
            self._reply(self._answers.to(question))
            return
        task = loop.create_task(self._answer_later(question))
        self._later |= {task}
        task.add_done_callback(self._forget)

    def _forget(self, task: asyncio.Task[None]) -> None:
        self._later -= {task}

    async def _answer_later(self, question: Any) -> None:
        self._reply(await asyncio.to_thread(self._answers.to, question))

    def _reply(self, answer: Message | None) -> None:
        if answer is not None:
            self.send(*answer)

    @traitlets.validate("field")
    def _check_field(self, proposal: Any) -> str:
        if proposal["value"] not in self.fields:
            raise OptionError(f"expected a field among {', '.join(self.fields)}, got {proposal['value']!r}")
        return str(proposal["value"])

    @traitlets.validate("height")
    def _check_height(self, proposal: Any) -> str:
        value = proposal["value"]
        if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < float("inf"):
            return f"{value:g}px"
        if not isinstance(value, str) or not value.strip():
            raise OptionError(f"expected a height in pixels or as in CSS, such as '60vh', got {value!r}")
        return value

    @traitlets.validate("colour_map")
    def _check_colour_map(self, proposal: Any) -> str | None:
        return _among("colour_map", proposal["value"], (*_COLOUR_MAPS, None))

    @traitlets.validate("theme")
    def _check_theme(self, proposal: Any) -> str | None:
        return _among("theme", proposal["value"], _THEMES)

    @traitlets.validate("value_range")
    def _check_range(self, proposal: Any) -> tuple[float, float] | None:
        value: tuple[float, float] | None = proposal["value"]
        if value is not None and not float("-inf") < value[0] < value[1] < float("inf"):
            raise OptionError(f"expected value_range to be two rising numbers, got {value}")
        return value

    @traitlets.validate("exaggeration")
    def _check_exaggeration(self, proposal: Any) -> float | None:
        value: float | None = proposal["value"]
        if value is not None and not 0.1 <= value <= 100:
            raise OptionError(f"expected an exaggeration of 0.1 to 100, got {value}")
        return value


_SETTABLE = frozenset(
    ("height", "theme", "field", "colour_map", "value_range", "exaggeration", "lines", "stop_when_done")
)


def _among(option: str, value: str | None, allowed: tuple[str | None, ...]) -> str | None:
    if value not in allowed:
        raise OptionError(f"expected {option} among {', '.join(map(str, allowed))}, got {value!r}")
    return value
