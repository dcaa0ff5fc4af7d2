/** The page: a list of surfaces, and one of them opened, by what follows # in the address. */

import { LodestreamView } from "../view";
import { html, setText } from "../view/dom";
import { formatBytes, formatNumber } from "../view/format";
import type { Progress, SurfaceInfo } from "../view/source";
import { type ListedSurface, ProblemError, Server } from "./api";
import { configured, type ShownSurface } from "./configuration";
import { askToken } from "./dialogs";
import icon from "./icon.svg?url";
import { Listing } from "./listing";
import { nameOf } from "./names";
import { copyButton, openIn } from "./open-in";
import { SeriesSlider, seriesOf } from "./series";

const server = new Server(new URL(".", location.href).href);
const header = html("header");
let listing: Listing | null = null;
let view: LodestreamView | null = null;
let shown: string | null = null;
let series: SeriesSlider | null = null;
/** The slider has led here, and keeps the keyboard. */
let moved = false;
let asking: Promise<boolean> | null = null;

/** Asks for a token where one is missing or not good; several requests share one question. */
function allowed(error: ProblemError): Promise<boolean> {
  if (error.code !== "no-token" && error.code !== "bad-token" && error.code !== "small-scope")
    return Promise.resolve(false);
  asking ??= askToken(server.token === null ? "no-token" : error.code, error.message).then((token) => {
    asking = null;
    if (token !== null) server.token = token;
    else if (error.code === "small-scope") server.readsOnly = true;
    listing?.showRights();
    return token !== null;
  });
  return asking;
}

function mark(link: boolean): HTMLElement {
  const parts = [html("img", { src: icon, alt: "" }), "Lodestream"];
  return link ? html("a", { class: "mark", href: "#" }, ...parts) : html("span", { class: "mark" }, ...parts);
}

/**
 * Shows a surface in place of whatever is shown.
 *
 * @param path - Of the surface on the server, or of the name that led to it; null: it is on no server.
 */
function open(src: string, name: string, back: boolean, path: string | null): void {
  closeAll();
  const title = html("h1", {}, name);
  const facts = html("span", { class: "facts" });
  const copy = copyButton("Copy link", () => location.href);
  const maps = html("button", { type: "button", class: "plain", hidden: true }, "Open in");
  if (path !== null) maps.addEventListener("click", () => void openIn(server, path, name, allowed));
  header.replaceChildren(mark(back), title, facts, html("span", { class: "grow" }), maps, copy);
  view = new LodestreamView();
  view.token = server.token;
  view.setAttribute("share", "");
  if (name !== "") view.setAttribute("name", name);
  view.src = src;
  view.addEventListener("lodestream-info", (event) => {
    const info = (event as CustomEvent<SurfaceInfo>).detail;
    maps.hidden = path === null || !info.mapped;
    if (name === "") setText(title, info.name || "Surface");
    document.title = `${name || info.name || "Surface"} – Lodestream`;
    const [first] = info.blocks;
    const points = info.blocks.length === 1 && first ? first.shape.join(" × ") : `${info.blocks.length} blocks`;
    setText(facts, info.blocks.length === 1 ? `${points} points` : points);
  });
  view.addEventListener("lodestream-progress", async (event) => {
    const { state, code, detail } = (event as CustomEvent<Progress>).detail;
    if (state !== "failed" || code === undefined || asking !== null) return;
    if (await allowed(new ProblemError(401, code, detail))) open(src, name, back, path);
  });
  document.body.replaceChildren(header, html("main", {}, view));
}

function showList(): void {
  closeAll();
  series = null; // what is on the server may be other when one is opened again
  document.title = "Lodestream";
  header.replaceChildren(mark(false));
  listing = new Listing(server, allowed);
  document.body.replaceChildren(header, listing.element);
}

function closeAll(): void {
  listing?.close();
  listing = null;
  view?.remove();
  view = null;
}

/** The path of the surface, or of the name, in the part of the address after #; null: the list. */
function asked(): string | null {
  const [, kind, found] = /(?:^#|&)([sn])=([^&]+)/.exec(location.hash) ?? [];
  if (found === undefined) return null;
  return `v1/${kind === "s" ? "surfaces" : "names"}/${encodeURIComponent(unescaped(found))}`;
}

function unescaped(text: string): string {
  try {
    return decodeURIComponent(text);
  } catch {
    return text; // anybody can write an address
  }
}

async function route(): Promise<void> {
  const path = asked();
  if (path === shown && (view !== null || listing !== null)) return;
  shown = path;
  if (path === null) return showList();
  try {
    const surface = await server.look(path);
    if (asked() !== path) return;
    open(server.address(surface.url), nameOf(surface), true, path);
    await showSeries(surface);
  } catch (error) {
    if (asked() !== path) return; // whoever looks at something else is not led back
    shown = null;
    if (await allowed(error as ProblemError)) return route();
    fail(error);
  }
}

/** Puts the slider over the surfaces of a series below the header, if an open surface is in one. */
async function showSeries(surface: ListedSurface): Promise<void> {
  if (!series?.show(surface.id)) {
    series = null;
    if (surface.series === undefined) return;
    const path = shown;
    const surfaces = seriesOf(surface, await server.all());
    if (shown !== path || surfaces.length < 2) return;
    series = new SeriesSlider(surfaces, ({ id }) => {
      moved = true;
      location.hash = `s=${encodeURIComponent(id)}`;
    });
    series.show(surface.id);
  }
  header.after(series.element);
  if (moved) series.focus();
  moved = false;
}

function fail(error: unknown): void {
  closeAll();
  header.replaceChildren(mark(true));
  const text = error instanceof Error ? error.message : String(error);
  document.body.replaceChildren(
    header,
    html("main", { class: "list" }, html("p", { class: "message error", role: "alert" }, text)),
  );
}

/** The name of a published surface in the part of the address after #; null: none is asked for. */
function askedName(): string | null {
  const [name] = location.hash.slice(1).split("&", 1);
  if (!name || name.includes("=")) return null; // what has a value tells how a surface is looked at
  return unescaped(name);
}

/** Shows the surfaces of a published page: the one whose name is asked for, the only one, or a list. */
async function showConfigured(surfaces: readonly ShownSurface[]): Promise<void> {
  const asked = askedName();
  const only = surfaces.length === 1 && asked === null ? surfaces[0] : surfaces.find(({ name }) => name === asked);
  if (asked !== null && only === undefined) throw new Error(`Nothing is published here under the name ${asked}.`);
  if (only === undefined) return showChoice(surfaces);
  const { src, title, progress } = only;
  if (progress !== null) return showMaking(surfaces, title, progress);
  const address = new URL(src, document.baseURI);
  if (address.origin !== location.origin)
    throw new Error(`expected a container of this host, got one of ${address.host}`);
  open(address.href, title, surfaces.length > 1, null);
}

function showChoice(surfaces: readonly ShownSurface[]): void {
  closeAll();
  header.replaceChildren(mark(false));
  const items = surfaces.map(({ name, title, bytes }) =>
    html(
      "li",
      {},
      html("a", { href: `#${encodeURIComponent(name)}` }, title),
      bytes === null ? null : ` ${formatBytes(bytes)}`,
    ),
  );
  document.body.replaceChildren(
    header,
    html(
      "main",
      { class: "list" },
      html("div", { class: "title" }, html("h1", {}, "Surfaces")),
      html("ul", { class: "choice" }, ...items),
    ),
  );
}

/** A container that is being made: looks again twice a second. */
function showMaking(surfaces: readonly ShownSurface[], name: string, progress: number): void {
  const text = `Encoding: ${formatNumber(Math.floor(100 * progress))} %`;
  const status = document.querySelector(".making [role=status]");
  const bar = document.querySelector<HTMLProgressElement>(".making progress");
  if (status !== null && bar !== null) {
    setText(status, text);
    bar.value = progress;
  } else {
    header.replaceChildren(mark(false), html("h1", {}, name));
    const made = html("progress", { max: 1, value: progress, "aria-label": `Encoding of ${name}` });
    document.body.replaceChildren(
      header,
      html("main", { class: "list making" }, html("p", { class: "message", role: "status" }, text), made),
    );
  }
  setTimeout(() => {
    configured()
      .then((found) => showConfigured(found ?? surfaces))
      .catch(fail);
  }, 500);
}

function start(surfaces: ShownSurface[] | null): void {
  if (surfaces === null) {
    addEventListener("hashchange", () => void route());
    void route();
    return;
  }
  addEventListener("hashchange", () => void showConfigured(surfaces).catch(fail));
  showConfigured(surfaces).catch(fail);
}

// A list takes files wherever they are dropped; elsewhere they would be opened by the browser in the place of this page and its transfers.
for (const name of ["dragover", "drop"] as const) {
  addEventListener(name, (event) => {
    if (event.defaultPrevented || !event.dataTransfer?.types.includes("Files")) return;
    event.preventDefault();
    if (listing === null || server.readsOnly) event.dataTransfer.dropEffect = "none";
    else if (name === "drop") listing.take(event.dataTransfer.files);
  });
}

configured().then(start).catch(fail);
