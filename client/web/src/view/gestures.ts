/** Pointer, wheel and keys, as changes of the camera and as commands. */

import { type Orbit, panned, turned, zoomed } from "./camera";

/** What gestures ask for. */
export interface GestureActions {
  orbit(): Orbit;
  setOrbit(orbit: Orbit): void;
  /** The place under the pointer in drawn coordinates with exaggeration, or null. */
  anchor(): readonly [number, number, number] | null;
  /** The pointer is over a place of the canvas, in CSS pixels; null: it has left. */
  point(at: readonly [number, number] | null): void;
  command(name: Command): void;
}

/** Commands that keys give. */
export type Command =
  | "home"
  | "top"
  | "stop"
  | "lines"
  | "earlier"
  | "later"
  | "latest"
  | "probe"
  | "exaggerate"
  | "flatten";

const KEYS: Readonly<Record<string, Command>> = {
  Home: "home",
  t: "top",
  s: "stop",
  l: "lines",
  "[": "earlier",
  "]": "later",
  End: "latest",
  p: "probe",
  Enter: "probe",
  x: "exaggerate",
  z: "flatten",
};

/** Degrees a pixel. */
const TURN = 0.3;

/** Listens to a canvas until the signal is aborted. */
export function listen(canvas: HTMLCanvasElement, actions: GestureActions, signal: AbortSignal): void {
  const pointers = new Map<number, PointerEvent>();
  const apply = (change: (orbit: Orbit) => Orbit): void => actions.setOrbit(change(actions.orbit()));

  const drag = (before: PointerEvent, now: PointerEvent): void => {
    const [x, y] = [now.clientX - before.clientX, now.clientY - before.clientY];
    if (now.buttons & 6 || now.shiftKey || now.ctrlKey) {
      apply((orbit) => panned(orbit, -x / canvas.clientHeight, y / canvas.clientHeight));
    } else {
      apply((orbit) => turned(orbit, -x * TURN, y * TURN));
    }
  };
  const pinch = (still: PointerEvent, before: PointerEvent, now: PointerEvent): void => {
    const apart = (a: PointerEvent): number => Math.hypot(a.clientX - still.clientX, a.clientY - still.clientY);
    apply((orbit) => {
      const moved = panned(
        orbit,
        -(now.clientX - before.clientX) / 2 / canvas.clientHeight,
        (now.clientY - before.clientY) / 2 / canvas.clientHeight,
      );
      return zoomed(moved, apart(before) / Math.max(apart(now), 1));
    });
  };

  canvas.addEventListener(
    "pointerdown",
    (event) => {
      pointers.set(event.pointerId, event);
      canvas.setPointerCapture(event.pointerId);
      canvas.focus({ preventScroll: true });
    },
    { signal },
  );
  canvas.addEventListener(
    "pointermove",
    (event) => {
      const before = pointers.get(event.pointerId);
      actions.point([event.offsetX, event.offsetY]);
      if (before === undefined) return;
      pointers.set(event.pointerId, event);
      const other = [...pointers.values()].find(({ pointerId }) => pointerId !== event.pointerId);
      if (other === undefined) drag(before, event);
      else pinch(other, before, event);
    },
    { signal },
  );
  for (const name of ["pointerup", "pointercancel"] as const) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId), { signal });
  }
  canvas.addEventListener("pointerleave", () => actions.point(null), { signal });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      const factor = Math.exp(Math.min(Math.max(event.deltaY * lines, -400), 400) * 0.0015);
      apply((orbit) => zoomed(orbit, factor, factor < 1 ? actions.anchor() : null));
    },
    { signal, passive: false },
  );
  canvas.addEventListener("keydown", (event) => key(event, apply, actions), { signal });
}

function key(event: KeyboardEvent, apply: (change: (orbit: Orbit) => Orbit) => void, actions: GestureActions): void {
  if (event.altKey || event.metaKey || event.ctrlKey) return;
  const arrows: Readonly<Record<string, readonly [number, number]>> = {
    ArrowLeft: [-1, 0],
    ArrowRight: [1, 0],
    ArrowUp: [0, 1],
    ArrowDown: [0, -1],
  };
  const arrow = arrows[event.key];
  if (arrow !== undefined) {
    if (event.shiftKey) apply((orbit) => panned(orbit, arrow[0] * 0.06, arrow[1] * 0.06));
    else apply((orbit) => turned(orbit, arrow[0] * 5, arrow[1] * 5));
  } else if (event.key === "+" || event.key === "=" || event.key === "PageUp") {
    apply((orbit) => zoomed(orbit, 0.85));
  } else if (event.key === "-" || event.key === "PageDown") {
    apply((orbit) => zoomed(orbit, 1 / 0.85));
  } else {
    const command = KEYS[event.key];
    if (command === undefined) return;
    actions.command(command);
  }
  event.preventDefault();
}
