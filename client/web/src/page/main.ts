/** The page: a list of surfaces, and one of them opened, by what follows # in the address. */

import type { LodestreamView } from "../view";
import { html, setText } from "../view/dom";
import { formatBytes } from "../view/format";
import type { Progress, SurfaceInfo } from "../view/source";
import { ProblemError, Server } from "./api";
import { type Configuration, configured } from "./configuration";
import { askToken } from "./dialogs";
import icon from "./icon.svg?url";
import { Listing, nameOf } from "./listing";

const server = new Server(new URL(".", location.href).href);
const header = html("header");
let listing: Listing | null = null;
let view: LodestreamView | null = null;
let shown: string | null = null;
let asking: Promise<boolean> | null = null;

/** Asks for a token where one is missing or not good; several requests share one question. */
function allowed(error: ProblemError): Promise<boolean> {
  if (error.code !== "no-token" && error.code !== "bad-token" && error.code !== "small-scope")
    return Promise.resolve(false);
  asking ??= askToken(server.token === null ? "" : `${error.message}.`).then((token) => {
    asking = null;
    if (token !== null) server.token = token;
    return token !== null;
  });
  return asking;
}

function mark(link: boolean): HTMLElement {
  const parts = [html("img", { src: icon, alt: "" }), "Lodestream"];
  return link ? html("a", { class: "mark", href: "#" }, ...parts) : html("span", { class: "mark" }, ...parts);
}

/** Shows a surface in place of whatever is shown. */
function open(src: string, name: string, back: boolean): void {
  closeAll();
  const title = html("h1", {}, name);
  const facts = html("span", { class: "facts" });
  const copy = html("button", { type: "button", class: "plain" }, "Copy link");
  copy.addEventListener("click", async () => {
    await navigator.clipboard.writeText(location.href).catch(() => {});
    setText(copy, "Copied");
    setTimeout(() => setText(copy, "Copy link"), 1500);
  });
  header.replaceChildren(mark(back), title, facts, html("span", { class: "grow" }), copy);
  view = document.createElement("lodestream-view") as LodestreamView;
  view.token = server.token;
  view.setAttribute("share", "");
  if (name !== "") view.setAttribute("name", name);
  view.src = src;
  view.addEventListener("lodestream-info", (event) => {
    const info = (event as CustomEvent<SurfaceInfo>).detail;
    if (name === "") setText(title, info.name || "Surface");
    document.title = `${name || info.name || "Surface"} – Lodestream`;
    const [first] = info.blocks;
    const points = info.blocks.length === 1 && first ? first.shape.join(" × ") : `${info.blocks.length} blocks`;
    setText(
      facts,
      info.size > 0 ? `${points} points, ${formatBytes(info.size)}`.replace("blocks points", "blocks") : points,
    );
  });
  view.addEventListener("lodestream-progress", async (event) => {
    const { state, code, detail } = (event as CustomEvent<Progress>).detail;
    if (state !== "failed" || code === undefined || asking !== null) return;
    if (await allowed(new ProblemError(401, code, detail, ""))) open(src, name, back);
  });
  document.body.replaceChildren(header, html("main", {}, view));
}

function showList(): void {
  closeAll();
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

/** The id of a surface in the part of the address after #; null: the list. */
function asked(): string | null {
  const found = /(?:^#|&)s=([^&]+)/.exec(location.hash)?.[1];
  return found === undefined ? null : decodeURIComponent(found);
}

async function route(): Promise<void> {
  const id = asked();
  if (id === shown && (view !== null || listing !== null)) return;
  shown = id;
  if (id === null) return showList();
  const path = `v1/surfaces/${encodeURIComponent(id)}`;
  try {
    const surface = await server.look(path);
    if (asked() === id) open(server.address(surface.url), nameOf(surface), true);
  } catch (error) {
    shown = null;
    if (await allowed(error as ProblemError)) return route();
    fail(error);
  }
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

function start(configuration: Configuration | null): void {
  if (configuration === null) {
    addEventListener("hashchange", () => void route());
    void route();
    return;
  }
  const address = new URL(configuration.src, document.baseURI);
  if (address.origin !== location.origin)
    throw new Error(`expected a container of this host, got one of ${address.host}`);
  open(address.href, configuration.name, false);
}

configured().then(start).catch(fail);
