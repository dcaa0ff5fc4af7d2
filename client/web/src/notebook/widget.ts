/** The widget of notebooks, as anywidget loads it: the viewer's element, whose bytes come from the kernel. */

import type { LodestreamView, NodeValues, Region } from "../view";
import type { Appearance } from "../view/appearance";
import type { ColourMapName } from "../view/colour-maps";
import type { Moment, Progress, Target } from "../view/source";
import { Comm } from "./comm";
import { fieldOf, nameOf } from "./fields";
import type { Model, Shown } from "./model";
import { type Program, programOf } from "./program";
import { themeOf, watchTheme } from "./theme";

/** Milliseconds between two messages to the kernel about what has come. */
const REST = 200;

/** What Python sets of the look. */
const LOOK = ["field", "colour_map", "value_range", "exaggeration", "lines"] as const;

/** Shows the widget in one place; what it gives ends that. */
async function render({ model, el }: Shown): Promise<() => void> {
  const life = new AbortController();
  let element: LodestreamView | null = null;
  let stopped = false; // while there is no element yet
  const comm = new Comm(model, (command) => {
    stopped = command === "stop";
    if (command === "stop") element?.stop();
    else if (command === "resume") element?.resume();
  });
  try {
    const program = await programOf(String(model.get("_program")), () => comm.program());
    element = place(program, comm, model, el, life.signal);
    if (stopped) element.stop();
  } catch (error) {
    el.textContent = `The surface cannot be shown: ${error instanceof Error ? error.message : String(error)}`;
    el.setAttribute("role", "alert");
  }
  return () => {
    life.abort();
    comm.close();
    element?.remove();
  };
}

function place(program: Program, comm: Comm, model: Model, el: HTMLElement, signal: AbortSignal): LodestreamView {
  const element = program.show(comm.read);
  element.setAttribute("name", String(model.get("name")));
  // Keys of the picture are no shortcuts of the notebook: JupyterLab asks for the attribute, others hear what rises.
  element.dataset.lmSuppressShortcuts = "true";
  for (const kind of ["keydown", "keypress", "keyup"])
    element.addEventListener(kind, (event) => event.stopPropagation());
  const follow = (name: string, take: () => void): void => {
    model.on(`change:${name}`, take);
    signal.addEventListener("abort", () => model.off(`change:${name}`, take));
  };
  const frame = (): void => {
    element.style.height = String(model.get("height"));
    const theme = model.get("theme") === "auto" ? themeOf(document) : String(model.get("theme"));
    if (theme === null) element.removeAttribute("theme");
    else element.setAttribute("theme", theme);
    element.setAttribute("autostop", model.get("stop_when_done") ? "on" : "off");
  };
  for (const name of ["height", "theme", "stop_when_done"]) follow(name, frame);
  signal.addEventListener("abort", watchTheme(document, frame));
  const aim = (): void => {
    element.target = (model.get("_target") ?? {}) as Target;
  };
  follow("_target", aim);
  frame();
  synchroniseLook(program, element, model, follow);
  el.append(element);
  // What is asked for needs a surface that is being received.
  if (Object.keys((model.get("_target") ?? {}) as Target).length > 0) aim();
  report(element, model, signal);
  return element;
}

/** Python's field, colours and so on become the element's, and what the user changes becomes Python's. */
function synchroniseLook(
  program: Program,
  element: LodestreamView,
  model: Model,
  follow: (name: string, take: () => void) => void,
): void {
  const wanted = (names: readonly string[]): Appearance => {
    const field = fieldOf(String(model.get("field")), element.info, program);
    const all = {
      ...(field === undefined ? {} : { field }),
      map: model.get("colour_map") as ColourMapName | null,
      range: model.get("value_range") as [number, number] | null,
      exaggeration: model.get("exaggeration") as number | null,
      lines: model.get("lines") as boolean,
    };
    const keys: Record<string, keyof Appearance> = { colour_map: "map", value_range: "range" };
    return Object.fromEntries(names.map((name) => [keys[name] ?? name, all[keys[name] ?? (name as keyof Appearance)]]));
  };
  // What the user has changed comes back from the kernel as a change, and is in the picture already.
  for (const name of LOOK) follow(name, () => element.setAppearance(defined(wanted([name]))));
  element.setAppearance(defined(wanted(LOOK)));
  element.addEventListener("lodestream-info", () => {
    element.setAppearance(defined(wanted(model.get("exaggeration") === null ? LOOK.slice(0, 3) : LOOK)));
  });
  element.addEventListener("lodestream-look", (event) => {
    const { field, map, range, exaggeration, lines } = (event as CustomEvent<Appearance>).detail;
    if (field !== undefined) model.set("field", nameOf(field, element.info, program));
    if (map !== undefined) model.set("colour_map", map);
    if (range !== undefined) model.set("value_range", range);
    if (exaggeration !== undefined) model.set("exaggeration", exaggeration);
    if (lines !== undefined) model.set("lines", lines);
    model.save_changes();
  });
}

function defined(appearance: Appearance): Appearance {
  return Object.fromEntries(Object.entries(appearance).filter(([, value]) => value !== undefined));
}

/** Tells the kernel what has come, and what the user looks at. */
function report(element: LodestreamView, model: Model, signal: AbortSignal): void {
  let timer: ReturnType<typeof setTimeout> | undefined;
  const told = new Map<string, unknown>();
  const tell = (values: Readonly<Record<string, unknown>>): void => {
    for (const [name, value] of Object.entries(values)) told.set(name, value);
    timer ??= setTimeout(() => {
      timer = undefined;
      for (const [name, value] of told) model.set(name, value);
      told.clear();
      model.save_changes();
    }, REST);
  };
  signal.addEventListener("abort", () => clearTimeout(timer));
  const number = (value: number): number | null => (Number.isFinite(value) ? value : null);
  const hear = <T>(name: string, take: (detail: T) => void): void =>
    element.addEventListener(`lodestream-${name}`, (event) => take((event as CustomEvent<T>).detail));
  hear<Progress>("progress", ({ state, detail, bytes }) => tell({ state, detail, bytes_received: bytes }));
  hear<{ readonly moment: Moment }>("drawn", ({ moment: { rms, max, level } }) =>
    tell({ rms: number(rms), max_error: number(max), level }),
  );
  hear<Region | null>("region", (region) => tell({ region }));
  hear<NodeValues | null>("values", (values) => {
    if (values === null) {
      tell({ selected: null });
      return;
    }
    const { block, row, column, point, attributes, rms, max } = values;
    const named = Object.fromEntries(attributes.map(([name, each]) => [name, each.map(number)]));
    const errors = { rms: number(rms), max_error: number(max) };
    tell({ selected: { block, row, column, point: point.map(number), attributes: named, ...errors } });
  });
}

export default { render };
