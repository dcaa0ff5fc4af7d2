"""Where a stream stops since its picture looks done, beside where it is done: in Chromium.

The states of a surface are drawn in the page at 1920 x 1080 points by the processor, and compared with the exact one
in the same view: with its colours, its light and one sample a pixel. The page's estimate stands beside the truth. Needs
`make page` and Chromium; `ARGS="pixels"` takes half an hour or more.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream_client import Client
from lodestream_client.viewer.picture_change import DONE
from lodestream_server import running_server

from .arrays import ROOT, fractal
from .measure import gate, note, table

DATA = ROOT.parent / "shared" / "data"
SIZE = (1920, 1080)
_PANEL = (320, 0)  # what the controls take of the window

#: Share of the pixels with which a picture counts as done.
VISIBLE = 0.01
#: States after which the picture has not changed any more, and nothing is to be learned.
_CALM = 3

#: The constants of the rule were fitted with these.
TUNED = (
    "bigtujunga.tif",
    "SainteHelens.dem",
    "topobathy.npz",
    "uneven_sphere_large.fmt",
    "capsule.obj",
    "bijou_gully_subset_5m_edit_dx_filled.asc",
    "lidar_dsm_2m.tif",
    "m6_small.fmt",
    "combxyz.bin",
    "bun000.ply",
    "a knot of 129 x 513",
    "a plate of 257 x 321 with a speed",
    "two waves with a temperature",
    "fractal terrain of 401 x 401, and of 601 x 601 as floats and in whole metres",
)

_STATES = """
async ({ calm }) => {
  const view = document.querySelector("lodestream-view");
  const { stage, session } = view;
  const linear = Float64Array.from({ length: 256 }, (_, k) => {
    const value = k / 255;
    return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
  });
  const f = (t) => (t > 216 / 24389 ? Math.cbrt(t) : ((24389 / 27) * t + 16) / 116);
  const lab = (pixels, k) => {
    const [r, g, b] = [linear[pixels[k]], linear[pixels[k + 1]], linear[pixels[k + 2]]];
    const x = f((0.4124564 * r + 0.3575761 * g + 0.1804375 * b) / 0.95047);
    const y = f(0.2126729 * r + 0.7151522 * g + 0.072175 * b);
    const z = f((0.0193339 * r + 0.119192 * g + 0.9503041 * b) / 1.08883);
    return [116 * y - 16, 500 * (x - y), 200 * (y - z)];
  };
  const different = (a, b) => {
    let [drawn, count] = [0, 0];
    for (let k = 0; k < a.length; k += 4) {
      if (a[k + 3] === 0 && b[k + 3] === 0) continue;
      drawn += 1;
      if ((a[k + 3] === 0) !== (b[k + 3] === 0)) count += 1;
      else if (a[k] !== b[k] || a[k + 1] !== b[k + 1] || a[k + 2] !== b[k + 2]) {
        const [p, q] = [lab(a, k), lab(b, k)];
        if (Math.hypot(p[0] - q[0], p[1] - q[1], p[2] - q[2]) > 5) count += 1;
      }
    }
    return count / Math.max(drawn, 1);
  };
  const drawn = (number) =>
    new Promise((resolve) => {
      const look = (event) => {
        if (event.detail.moment.number !== number) return;
        view.removeEventListener("lodestream-drawn", look);
        const wait = () => (session.busy ? setTimeout(wait, 20) : resolve());
        setTimeout(wait, 50);
      };
      view.addEventListener("lodestream-drawn", look);
    });
  view.viewpoint.place(view.viewpoint.orbit); // the camera follows no other extent any more
  await new Promise((resolve) => setTimeout(resolve, 1000));
  const exact = stage.pictures(Infinity)[1];
  const { pixels } = view.viewpoint.framing.scale(view.viewpoint.orbit, stage.size[1]);
  const states = [];
  let unchanged = 0;
  for (const { number, bytes, max, complete } of session.moments) {
    if (complete || unchanged >= calm) break;
    const came = drawn(number);
    session.show(number);
    await came;
    const truth = different(stage.pictures(Infinity)[1], exact);
    states.push([bytes, truth, String(session.estimate()), pixels > 0 && max * pixels < 1]);
    unchanged = truth < 0.0005 ? unchanged + 1 : 0;
  }
  return { states, camera: view.camera, size: session.moments.at(-1).bytes, scaled: pixels > 0 };
}
"""


@dataclass(frozen=True)
class State:
    """One state of a surface in a view: its bytes, shares of pixels, and whether the error is below a pixel."""

    bytes: int
    truth: float
    estimate: float
    below_pixel: bool


@dataclass(frozen=True)
class Case:
    """A surface in a view, with its states in order, the bytes of all of it, and whether its scale is known."""

    surface: str
    view: str
    states: tuple[State, ...]
    size: int
    scaled: bool

    @property
    def first(self) -> int:
        """Bytes at which the picture is done."""
        return next((state.bytes for state in self.states if state.truth < VISIBLE), self.size)

    def stop(self, *, old: bool = False) -> State:
        """Where the page stops; `old`: where it stopped below a pixel."""
        end = State(self.size, 0.0, 0.0, True)
        return next((state for state in self.states if (state.below_pixel if old else state.estimate < DONE)), end)


def main() -> None:
    """Print the table of stops, and keep its gates."""
    from lodestream.page import assets

    if not assets():
        print("\nskipped: pixels (`make page` builds the page)")
        return
    cases = list(_cases())
    rows = []
    for case in cases:
        stop, old = case.stop(), case.stop(old=True)
        rows.append(
            [
                case.surface,
                case.view,
                f"{case.size:,}",
                f"{case.first:,}",
                f"{stop.bytes:,}",
                f"{stop.bytes / case.first:.2f}",
                f"{100 * stop.estimate:.2f}",
                f"{100 * stop.truth:.2f}",
                f"{old.bytes:,}" if case.scaled else "-",
                f"{100 * old.truth:.2f}" if case.scaled else "-",
            ]
        )
    head = ["surface", "view", "bytes", "done at", "stops at", "ratio", "estimate, %", "truth, %"]
    table("Where a stream stops since its picture looks done", [*head, "below a pixel at", "truth there, %"], rows)
    note(
        f"Pictures of {SIZE[0]} x {SIZE[1]} points in Chromium, drawn by the processor. Estimate and truth: share of "
        "the drawn pixels whose colour is more than 5 (CIE76) away from the exact picture. Below a pixel: the rule "
        "before, with a pixel as large as it is at the point that the camera turns around; - where x and y have no "
        "unit. Other surfaces were used to fit the rule: " + "; ".join(TUNED)
    )
    stops = [case.stop() for case in cases]
    within = sum(stop.truth <= VISIBLE for stop in stops) / len(stops)
    far = sum(stop.truth > 0.03 for stop in stops)
    cheap = sum(case.stop().bytes <= 1.5 * case.first for case in cases) / len(cases)
    gate("pictures of which at most 1 % differ at the stop", 100 * within, at_least=90, unit=" %")
    gate("pictures of which more than 3 % differ at the stop", far, at_most=1)
    gate("stops at 1.5 times the bytes that are needed, or less", 100 * cheap, at_least=80, unit=" %")


def _cases() -> Iterator[Case]:
    from tests.web.browser import Heard, chromium

    with tempfile.TemporaryDirectory() as folder, running_server(Path(folder)) as server, chromium() as browser:
        for name, surface, fields in _surfaces():
            entry = Client(server).upload(surface)
            address = f"{server}/#s={entry.id}"
            camera: Mapping[str, Any] = {}
            for view in ("default", "near", *fields):
                kind, _, field = view.partition(" ")
                extra = {"default": "", "near": _near(camera), "colours:": f"&c={field}"}[kind]
                found = _drawn(browser, Heard(), address + extra)
                camera = found["camera"] if view == "default" else camera
                states = (State(size, truth, float(estimate), old) for size, truth, estimate, old in found["states"])
                case = Case(name, view, tuple(states), found["size"], found["scaled"])
                stop = case.stop()
                figures = f"stops at {stop.bytes:,} with {100 * stop.truth:.2f} %, done at {case.first:,}"
                print(f"{name}, {view}: {figures}", file=sys.stderr, flush=True)
                yield case


def _near(camera: Mapping[str, Any]) -> str:
    """The part of an address that looks at the same place from a quarter of the distance."""
    if not camera:
        return ""
    numbers = (camera["azimuth"], camera["elevation"], camera["distance"] / 4, *camera["target"])
    return "&v=" + ",".join(map(str, numbers))


def _drawn(browser: Any, heard: Any, address: str) -> Any:
    from tests.web.browser import tab

    with tab(browser, heard, (SIZE[0] + _PANEL[0], SIZE[1] + _PANEL[1])) as shown:
        shown.page.set_default_timeout(600_000)
        shown.go(address)
        shown.everything_is_here()
        return shown.page.evaluate(_STATES, {"calm": _CALM})


def _surfaces() -> Iterator[tuple[str, ls.Surface, tuple[str, ...]]]:
    """Names, surfaces, and further views of each."""
    slope = "colours: slope"
    yield "smoother terrain, 513 x 513", ls.Surface(fractal(513, 0.42, rounded=False).astype(np.float32)), (slope,)
    yield "rippled torus, 129 x 385", ls.Surface(_torus(129, 385), (True, True)), (slope,)
    yield "wing with a pressure, 193 x 257", _wing(193, 257), ("colours: a:0:pressure",)
    for name, views in (
        ("jacksboro_fault_dem.npz", (slope,)),
        ("fuji.png", (slope,)),
        ("mountain.obj", ()),
        ("wout_li383_low_res_reference.nc", ()),
        ("capture0001.pcd", ()),
        ("bamboo_pen.obj", ()),
    ):
        path = DATA / name
        if path.exists():
            yield name, ls.read(path, encoding="terrain-rgb") if name == "fuji.png" else ls.read(path), views


def _torus(rows: int, columns: int) -> NDArray[np.float32]:
    """Points of a torus with ripples on one side, (row, column, xyz)."""
    around, along = np.meshgrid(
        np.linspace(0, 2 * np.pi, rows, endpoint=False),
        np.linspace(0, 2 * np.pi, columns, endpoint=False),
        indexing="ij",
    )
    tube = 0.5 + 0.02 * np.exp(2 * np.cos(along) - 2) * np.sin(9 * around) * np.cos(31 * along)
    radius = 2 + tube * np.cos(around)
    points = np.stack([radius * np.cos(along), radius * np.sin(along), tube * np.sin(around)], axis=2)
    return points.astype(np.float32)


def _wing(rows: int, columns: int) -> ls.Surface:
    """The upper side of a swept wing, with a pressure that jumps along a line of its own."""
    span, chord = np.mgrid[0 : 1 : rows * 1j, 0 : 1 : columns * 1j]
    x = 0.5 * span + (1 - 0.6 * span) * chord
    z = (
        0.12
        * (1 - 0.6 * span)
        * (2.97 * np.sqrt(chord) - 1.26 * chord - 3.52 * chord**2 + 2.84 * chord**3 - 1.04 * chord**4)
    )
    shock = 0.55 - 0.1 * span + 0.03 * np.sin(12 * span)
    pressure = (
        -1.1 * np.sqrt(chord) * np.exp(-2 * chord) + 0.4 * np.tanh(60 * (chord - shock)) + 0.05 * np.cos(25 * chord)
    )
    points = np.stack([x, 2 * span, z], axis=2).astype(np.float32)
    return ls.Surface(points, attributes={"pressure": pressure.astype(np.float32)})
