import { afterEach, expect, it, vi } from "vitest";
import { Comm } from "../src/notebook/comm";
import { fieldOf, nameOf } from "../src/notebook/fields";
import type { Buffers, Model } from "../src/notebook/model";
import { type Program, programOf } from "../src/notebook/program";
import { themeOf } from "../src/notebook/theme";
import widget from "../src/notebook/widget";
import { type Appearance, changesOf, sharedWith, withAppearance } from "../src/view/appearance";
import { fieldName, fieldsOf, type Look } from "../src/view/look";
import type { SurfaceInfo } from "../src/view/source";

afterEach(() => vi.unstubAllGlobals());

type Heard = (content: Record<string, unknown>, buffers?: Buffers) => void;

/** A model whose messages are kept; `say` is what the kernel says. */
function fakeModel(): {
  model: Model;
  sent: Record<string, unknown>[];
  say: Heard;
  heard: Set<Heard>;
  lost: Set<() => void>;
} {
  const sent: Record<string, unknown>[] = [];
  const heard = new Set<Heard>();
  const lost = new Set<() => void>();
  const of = (event: string): Set<Heard | (() => void)> => (event === "msg:custom" ? heard : lost);
  const model: Model = {
    get: () => undefined,
    set: () => {},
    save_changes: () => {},
    on: (event, callback) => of(event).add(callback),
    off: (event, callback) => of(event).delete(callback),
    send: (content) => sent.push(content as Record<string, unknown>),
  };
  return { model, sent, say: (...given) => [...heard].map((callback) => callback(...given)), heard, lost };
}

it("answers go to the place that has asked, whatever their order", async () => {
  const { model, sent, say } = fakeModel();
  const [one, other] = [new Comm(model, () => {}), new Comm(model, () => {})];
  const parts = [one.read(0, 2), other.read(2, 2), one.read(4, 2)];
  expect(new Set(sent.map(({ id }) => id)).size).toBe(3);
  const memory = Uint8Array.of(0, 0, 1, 2, 3, 4, 5, 6).buffer;
  const buffers = [new DataView(memory, 2, 2), new Uint8Array(memory, 4, 2), memory.slice(6)];
  for (const k of [2, 0, 1]) say({ kind: "part", id: sent[k]!.id, size: 6, tag: "t" }, [buffers[k]!]);
  const came = await Promise.all(parts);
  expect(came.map(({ data, size, tag }) => [[...data], size, tag])).toEqual([
    [[1, 2], 6, "t"],
    [[3, 4], 6, "t"],
    [[5, 6], 6, "t"],
  ]);
});

it("a refusal says why, and closing says so to all that wait", async () => {
  const { model, sent, say, heard } = fakeModel();
  const comm = new Comm(model, () => {});
  const [refused, empty, waiting] = [comm.read(0, 2), comm.program(), comm.read(9, 2)];
  say({ kind: "refused", id: sent[0]!.id, detail: "it has changed", code: "other-container" });
  say({ kind: "program", id: sent[1]!.id }, []);
  comm.close();
  await expect(refused).rejects.toMatchObject({ message: "it has changed", code: "other-container" });
  await expect(empty).rejects.toThrow("expected bytes from the kernel");
  await expect(waiting).rejects.toThrow("the widget was closed");
  expect(heard.size).toBe(0);
});

it("what waits for a kernel that dies is refused, and another one is asked anew", async () => {
  const { model, sent, say, lost } = fakeModel();
  const comm = new Comm(model, () => {});
  const waiting = [comm.read(0, 2), comm.program()];
  for (const tell of lost) tell();
  for (const one of waiting) await expect(one).rejects.toThrow("the kernel is gone: run the cell again");
  const again = comm.read(0, 2);
  say({ kind: "part", id: sent[2]!.id, size: 6, tag: "t" }, [Uint8Array.of(1, 2)]);
  expect([...(await again).data]).toEqual([1, 2]);
  comm.close();
  expect(lost.size).toBe(0);
});

it("commands are for every place", () => {
  const { model, say } = fakeModel();
  const told: string[] = [];
  for (const place of ["a", "b"]) new Comm(model, (command) => told.push(`${place} ${command}`));
  say({ kind: "command", command: "stop" });
  expect(told).toEqual(["a stop", "b stop"]);
});

it("the program is asked for once in a page, and again after it did not come", async () => {
  vi.stubGlobal("customElements", { get: () => undefined, define: () => {} });
  let asked = 0;
  const fails = () => {
    asked += 1;
    return Promise.reject(new Error("the kernel is gone"));
  };
  await expect(programOf("view-1.js", fails)).rejects.toThrow("the kernel is gone");
  const both = [programOf("view-1.js", fails), programOf("view-1.js", fails)];
  for (const one of both) await expect(one).rejects.toThrow("the kernel is gone");
  expect(asked).toBe(2);
});

it("a stop that comes while the program is loaded holds", async () => {
  vi.stubGlobal(
    "MutationObserver",
    class {
      observe(): void {}
      disconnect(): void {}
    },
  );
  const page = { dataset: {}, classList: { contains: () => false }, getAttribute: () => null };
  vi.stubGlobal("document", { body: page, documentElement: page });
  const { model, say } = fakeModel();
  for (const [commands, expected] of [
    [["stop"], ["stop"]],
    [["stop", "resume"], []],
  ] as const) {
    const told: string[] = [];
    const element = {
      ...{ dataset: {}, style: {}, info: null, addEventListener: () => {}, setAppearance: () => {} },
      ...{ setAttribute: () => {}, removeAttribute: () => {}, remove: () => {} },
      stop: () => told.push("stop"),
      resume: () => told.push("resume"),
    };
    let load!: (program: Program) => void;
    const loading = new Promise<Program>((resolve) => {
      load = resolve;
    });
    vi.stubGlobal(Symbol.for("lodestream.programs") as unknown as string, new Map([["undefined", loading]]));
    const el = { append: () => told.push("shown") } as unknown as HTMLElement;
    const rendered = widget.render({ model, el });
    for (const command of commands) say({ kind: "command", command });
    load({ fieldName, fieldsOf, show: () => element } as unknown as Program);
    const end = await rendered;
    expect(told).toEqual(["shown", ...expected]);
    say({ kind: "command", command: "resume" });
    expect(told.at(-1)).toBe("resume");
    end();
  }
});

const INFO = {
  heights: true,
  attributes: [
    { name: "rain", components: 1 },
    { name: "wind", components: 2 },
    { name: "height", components: 1 },
  ],
} as unknown as SurfaceInfo;
const PROGRAM = { fieldName, fieldsOf } as Program;

it("fields have the names that Python has for them", () => {
  const names = ["height", "slope", "change", "none", "rain", "wind", "wind[0]", "wind[1]"];
  for (const name of names) expect(nameOf(fieldOf(name, INFO, PROGRAM)!, INFO, PROGRAM)).toBe(name);
  expect(fieldOf("height", INFO, PROGRAM)).toEqual({ kind: "height" });
  expect(fieldOf("wind", INFO, PROGRAM)).toEqual({ kind: "attribute", name: "wind", component: "magnitude" });
  expect(fieldOf("wind[2]", INFO, PROGRAM)).toBeUndefined();
  expect(fieldOf("snow", INFO, PROGRAM)).toBeUndefined();
  expect(fieldOf("rain", null, PROGRAM)).toBeUndefined();
});

it.each([
  [{ jpThemeLight: "true" }, "", "", "light"],
  [{ jpThemeLight: "false" }, "", "", "dark"],
  [{}, "vscode-dark", "", "dark"],
  [{}, "vscode-high-contrast", "", "dark"],
  [{}, "vscode-high-contrast vscode-high-contrast-light", "", "light"],
  [{}, "vscode-light", "", "light"],
  [{}, "", "dark", "dark"],
  [{}, "light", "", "light"],
  [{}, "", "", null],
])("a notebook with %j, %j, %j is %s", (dataset, body, root, theme) => {
  const element = (names: string, data: object = {}): object => ({
    dataset: data,
    classList: { contains: (name: string) => names.split(" ").includes(name) },
    getAttribute: () => null,
  });
  const page = { body: element(body, dataset), documentElement: element(root) } as unknown as Document;
  expect(themeOf(page)).toBe(theme);
});

const LOOK: Look = { field: { kind: "height" }, map: "terrain", range: [1, 2], exaggeration: 3, lines: false };

it("what is set of a look changes that alone, and another field brings its own map and range", () => {
  expect(withAppearance(LOOK, {}, INFO, 1)).toEqual(LOOK);
  expect(withAppearance(LOOK, { lines: true }, INFO, 1)).toEqual({ ...LOOK, lines: true });
  const slope = { kind: "slope" } as const;
  expect(withAppearance(LOOK, { field: slope }, INFO, 1)).toEqual({
    ...LOOK,
    field: slope,
    map: "viridis",
    range: null,
  });
  expect(withAppearance(LOOK, { field: { kind: "height" } }, INFO, 1)).toEqual(LOOK);
  expect(withAppearance({ ...LOOK, map: "grey" }, { map: null, range: null, exaggeration: null }, INFO, 7)).toEqual({
    ...LOOK,
    range: null,
    exaggeration: 7,
  });
});

it("before the first picture, what follows the surface is left out", () => {
  const by: Appearance = { field: { kind: "slope" }, map: null, range: [0, 5], exaggeration: null, lines: true };
  const expected = { field: { kind: "slope" }, range: [0, 5], lines: true };
  expect(sharedWith({ map: "grey", exaggeration: 4 }, by)).toEqual(expected);
  expect(sharedWith({ map: "grey" }, { lines: false })).toEqual({ map: "grey", lines: false });
});

it("what the user has changed is told, and what came with another field follows it", () => {
  expect(changesOf(LOOK, { ...LOOK, lines: true, exaggeration: 4 })).toEqual({ lines: true, exaggeration: 4 });
  const other: Look = { ...LOOK, field: { kind: "slope" }, map: "viridis", range: null };
  expect(changesOf(LOOK, other)).toEqual({ field: { kind: "slope" }, map: null, range: null });
  expect(changesOf(LOOK, { ...LOOK, range: null })).toEqual({ range: null });
});
