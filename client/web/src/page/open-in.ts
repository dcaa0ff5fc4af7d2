/** The dialog by which maps, globes and QGIS open a surface of a server. */

import { html, setText } from "../view/dom";
import type { ProblemError, Server } from "./api";
import { ask } from "./dialogs";
import { addressesOf, cesiumPage, type Mapped, mapLibrePage, qgisConnections } from "./map-files";

/** Milliseconds for which a button says that it has copied, and for which a file that is saved is kept. */
const SHORTLY = 1500;
const KEPT = 60_000;

/** What a page can load from: the address of a host, or one relative to the page. */
const FOLDER = String.raw`(https?://|\.{0,2}/).+|\.{1,2}`;

/** A button that copies a text. */
export function copyButton(label: string, text: () => string, name?: string): HTMLButtonElement {
  const button = html("button", { type: "button", class: "plain", "aria-label": name ?? false }, label);
  button.addEventListener("click", async () => {
    await navigator.clipboard.writeText(text()).catch(() => {});
    setText(button, "Copied");
    setTimeout(() => setText(button, label), SHORTLY);
  });
  return button;
}

/**
 * Shows the dialog until it is left.
 *
 * @param path - Of the surface, or of a name that leads to it.
 * @param allowed - Asks for a token if one is needed; false: it was not given.
 */
export async function openIn(
  server: Server,
  path: string,
  name: string,
  allowed: (error: ProblemError) => Promise<boolean>,
): Promise<void> {
  try {
    const tiles = await server.tiles(path);
    const mapped = { name, address: server.address(path), ...tiles };
    await show(...choices(mapped), html("p", {}, access(server.token !== null)));
  } catch (error) {
    if (await allowed(error as ProblemError)) return openIn(server, path, name, allowed);
    await show(html("p", { class: "message error", role: "alert" }, (error as Error).message));
  }
}

async function show(...content: HTMLElement[]): Promise<void> {
  const close = html("form", { method: "dialog", class: "actions" }, html("button", {}, "Close"));
  const title = html("h2", { id: "open-in-title" }, "Open in");
  await ask(html("dialog", { class: "open-in", "aria-labelledby": "open-in-title" }, title, ...content, close));
}

function access(wantsToken: boolean): string {
  const origin = "The server must allow the pages' origin (LODESTREAM_ORIGINS).";
  if (!wantsToken) return origin;
  return `${origin} It wants a token, which no file holds: programs must send it in the header Authorization.`;
}

function choices(mapped: Mapped): HTMLElement[] {
  const qgis = html("button", { type: "button" }, "Save a QGIS connection");
  qgis.addEventListener("click", () => save("qgis-connection.xml", "text/xml", qgisConnections(mapped)));
  return [
    ...addressesOf(mapped.address).map(copied),
    library("maplibre", "Folder of MapLibre GL JS 6 (dist)", "Save a MapLibre page", (folder) =>
      mapLibrePage(mapped, folder),
    ),
    library("cesium", "Folder of CesiumJS (Build/Cesium)", "Save a CesiumJS page", (folder) =>
      cesiumPage(mapped, folder),
    ),
    html("div", { class: "row" }, qgis),
    html(
      "p",
      {},
      "Load the connection under XYZ Tiles of QGIS, edit it, and choose Terrarium Terrain RGB as interpretation.",
    ),
  ];
}

function copied([label, address]: [string, string], index: number): HTMLElement {
  const id = `address-${index}`;
  const input = html("input", { type: "text", id, readonly: true, value: address });
  const row = html(
    "div",
    { class: "row" },
    input,
    copyButton("Copy", () => address, `Copy: ${label}`),
  );
  return html("div", {}, html("label", { for: id }, label), row);
}

/** A page that loads a library from where the user says, since this one loads nothing from others. */
function library(id: string, label: string, answer: string, page: (folder: string) => string): HTMLElement {
  const hint = "an address of http or https, or one that begins with ./ or /";
  const input = html("input", { type: "text", id, required: true, pattern: FOLDER, title: hint, spellcheck: "false" });
  const row = html("div", { class: "row" }, input, html("button", {}, answer));
  const form = html("form", {}, html("label", { for: id }, label), row);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    save(`${id}.html`, "text/html", page(input.value.trim()));
  });
  return form;
}

function save(name: string, type: string, text: string): void {
  const href = URL.createObjectURL(new Blob([text], { type }));
  html("a", { href, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(href), KEPT);
}
