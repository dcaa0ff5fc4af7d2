/**
 * The program that shows surfaces: the module of the viewer's element. It is large, so a page asks a kernel for it once,
 * however many widgets there are; each widget itself brings only this.
 */

import type { PartReader, LodestreamView as View } from "../view";

type Module = typeof import("../view");

/** The program of one version of Lodestream. */
export interface Program extends Pick<Module, "fieldName" | "fieldsOf"> {
  /** An element that shows what gives the bytes. */
  show(read: PartReader): View;
}

/** In the page, for all widgets and all versions of this module, of which each widget has its own. */
const SHARED = Symbol.for("lodestream.programs");

type Programs = Map<string, Promise<Program>>;

/**
 * The program of this name.
 *
 * @param fetch - Asks the kernel for it, if no widget of this page has done so.
 * @throws Error if it does not come, or cannot be run; then the next widget asks again.
 */
export function programOf(name: string, fetch: () => Promise<Uint8Array>): Promise<Program> {
  const page = globalThis as unknown as Record<symbol, Programs | undefined>;
  page[SHARED] ??= new Map();
  const programs = page[SHARED];
  const known = programs.get(name);
  if (known !== undefined) return known;
  const loaded = fetch()
    .then(run)
    .then((module) => makeProgram(module, name));
  programs.set(name, loaded);
  loaded.catch(() => programs.delete(name));
  return loaded;
}

async function run(code: Uint8Array): Promise<Module> {
  const url = URL.createObjectURL(new Blob([code as Uint8Array<ArrayBuffer>], { type: "text/javascript" }));
  try {
    return (await import(/* @vite-ignore */ url)) as Module;
  } finally {
    URL.revokeObjectURL(url);
  }
}

/** Makes the elements of a program; another version may have taken the element's name in this page. */
export function makeProgram(module: Module, name: string): Program {
  const { LodestreamView, LodeSource, fieldName, fieldsOf } = module;
  const readers = new Map<string, PartReader>();
  LodestreamView.sources.push((src) => {
    const read = readers.get(src);
    return read === undefined ? null : new LodeSource(read, null);
  });
  const own = customElements.get("lodestream-view") === LodestreamView;
  const tag = `lodestream-view${own ? "" : `-${name.toLowerCase().replaceAll(/[^a-z0-9]/g, "")}`}`;
  if (customElements.get(tag) === undefined) customElements.define(tag, class extends LodestreamView {});
  let shown = 0;
  return {
    fieldName,
    fieldsOf,
    show(read) {
      shown += 1;
      const src = `widget:${shown}`;
      readers.set(src, read);
      const element = document.createElement(tag) as View;
      element.src = src;
      return element;
    },
  };
}
