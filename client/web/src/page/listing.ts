/** The list of a server's surfaces: search, upload, delete. */

import { arrange, html, setText } from "../view/dom";
import { formatBytes } from "../view/format";
import { type ListedSurface, ProblemError, type Server } from "./api";
import { askDelete } from "./dialogs";
import { matches, nameOf } from "./names";
import { reasonElement } from "./reasons";
import { Uploads } from "./uploads";

/** Milliseconds after which surfaces that are being built are looked at again. */
const POLL = 2000;

/** The list, until `close`. */
export class Listing {
  private readonly search = html("input", { type: "search", placeholder: "Search", "aria-label": "Search surfaces" });
  private readonly message = html("p", { class: "message", role: "status" });
  private readonly rows = html("tbody");
  private readonly table = html(
    "table",
    {},
    html(
      "thead",
      {},
      html(
        "tr",
        {},
        ...["Surface", "Points", "Size", "Added"].map((name, k) =>
          html("th", { scope: "col", class: k % 2 === 1 ? "optional" : "" }, name),
        ),
        html("th", { scope: "col" }, html("span", { class: "hidden-text" }, "Actions")),
      ),
    ),
    this.rows,
  );
  private readonly surfaces = new Map<string, ListedSurface>();
  /** What was drawn of a surface that has not changed since. */
  private drawn = new WeakMap<ListedSurface, HTMLElement>();
  private timer: ReturnType<typeof setTimeout> | undefined;
  private closed = false;
  private readonly uploads: Uploads;
  readonly element: HTMLElement;

  /** @param allowed - Asks for a token if one is needed; false: it was not given. */
  constructor(
    private readonly server: Server,
    private readonly allowed: (error: ProblemError) => Promise<boolean>,
  ) {
    this.uploads = new Uploads(
      server,
      allowed,
      (surface) => {
        const { thumbnail } = this.surfaces.get(surface.id) ?? {};
        this.surfaces.set(surface.id, thumbnail ? { thumbnail, ...surface } : surface);
        this.draw();
        this.poll();
      },
      ({ id }) => {
        this.surfaces.delete(id);
        this.draw();
      },
    );
    this.search.addEventListener("input", () => this.draw());
    this.element = html(
      "main",
      { class: "list" },
      html("div", { class: "title" }, html("h1", {}, "Surfaces"), this.search),
      this.uploads.element,
      html("div", { class: "scroll" }, this.table),
      this.message,
    );
    this.table.hidden = true;
    this.uploads.showRights();
    void this.load();
  }

  /** Uploads files. */
  take(files: FileList): void {
    this.uploads.take(files);
  }

  /** Hides what the token does not allow, as far as the server has said so. */
  showRights(): void {
    this.uploads.showRights();
    this.drawn = new WeakMap();
    this.draw();
  }

  /** Asks the server no more. */
  close(): void {
    this.closed = true;
    clearTimeout(this.timer);
  }

  private async load(): Promise<void> {
    setText(this.message, "Loading");
    let address: string | null = null;
    try {
      do {
        const page: Awaited<ReturnType<Server["page"]>> = await this.server.page(address);
        for (const surface of page.surfaces) this.surfaces.set(surface.id, surface);
        address = page.next;
        this.draw();
      } while (address !== null && !this.closed);
      this.poll();
    } catch (error) {
      if (error instanceof ProblemError && (await this.allowed(error))) return this.load();
      this.fail(error);
    }
  }

  private fail(error: unknown): void {
    setText(this.message, error instanceof Error ? error.message : String(error));
    this.message.classList.add("error");
  }

  /** Looks at surfaces that are not built yet, from time to time. */
  private poll(): void {
    clearTimeout(this.timer);
    const building = [...this.surfaces.values()].filter(({ state }) => state === "queued" || state === "building");
    if (building.length === 0 || this.closed) return;
    this.timer = setTimeout(async () => {
      for (const surface of building.slice(0, 20)) await this.look(surface);
      this.draw();
      this.poll();
    }, POLL);
  }

  /** Looks at a surface again. What has been learned of it meanwhile is newer than the answer. */
  private async look(known: ListedSurface): Promise<void> {
    const { id, url } = known;
    let found: ListedSurface | null = known;
    try {
      found = await this.server.listed(url);
    } catch (error) {
      if (error instanceof ProblemError && error.status === 404) found = null;
    }
    if (this.surfaces.get(id) !== known) return;
    if (found === null) this.surfaces.delete(id);
    else this.surfaces.set(id, found);
  }

  private draw(): void {
    const all = [...this.surfaces.values()].sort((a, b) => (a.created < b.created ? 1 : -1));
    const found = all.filter((surface) => matches(surface, this.search.value.trim()));
    this.table.hidden = found.length === 0;
    const rows = found.slice(0, 500).map((surface) => {
      const row = this.drawn.get(surface) ?? this.row(surface);
      this.drawn.set(surface, row);
      return row;
    });
    arrange(this.rows, rows);
    this.message.classList.remove("error");
    const hidden = found.length > 500 ? `${found.length - 500} more: search for them.` : "";
    setText(
      this.message,
      all.length === 0
        ? "There are no surfaces yet."
        : found.length === 0
          ? "No surface has that in its name."
          : hidden,
    );
  }

  private row(surface: ListedSurface): HTMLElement {
    const name = nameOf(surface);
    const ready = surface.state === "ready";
    const called = html("span", { class: "called", title: name }, name);
    const title = ready ? html("a", { href: `#s=${encodeURIComponent(surface.id)}` }, called) : called;
    const state = ready ? "" : stateText(surface);
    const remove = html("button", { type: "button", class: "plain", "aria-label": `Delete ${name}` }, "Delete");
    remove.addEventListener("click", () => void this.remove(surface, name));
    const actions = html("td", { class: "actions" });
    const mayWrite = !this.server.readsOnly;
    if (mayWrite && surface.state === "waiting") {
      const retry = html(
        "button",
        { type: "button", class: "plain", "aria-label": `Retry the build of ${name}` },
        "Retry",
      );
      retry.addEventListener("click", () => void this.retry(surface));
      actions.append(retry);
    }
    if (mayWrite) actions.append(remove);
    const stopped = surface.state === "failed" || surface.state === "waiting";
    const told = stopped ? reasonElement(state) : state === "" ? null : html("span", { class: "sub" }, state);
    return html(
      "tr",
      {},
      html("td", { class: "name" }, html("div", { class: "entry" }, picture(surface), title, told)),
      html(
        "td",
        { class: "number optional" },
        surface.shape ? surface.shape.join(" × ") : ready ? "several blocks" : "",
      ),
      html("td", { class: "number" }, formatBytes(surface.bytes ?? surface.upload_bytes)),
      html("td", { class: "number optional" }, new Date(surface.created).toLocaleDateString()),
      actions,
    );
  }

  private async remove(surface: ListedSurface, name: string): Promise<void> {
    if (!(await askDelete(name))) return;
    await this.change(async () => {
      await this.server.delete(surface.url);
      this.surfaces.delete(surface.id);
    });
  }

  private async retry(surface: ListedSurface): Promise<void> {
    await this.change(async () => {
      await this.server.retry(surface.url);
      this.surfaces.set(surface.id, await this.server.listed(surface.url));
    });
    this.poll();
  }

  private async change(action: () => Promise<void>): Promise<void> {
    try {
      await action();
      this.draw();
    } catch (error) {
      if (error instanceof ProblemError && (await this.allowed(error))) return this.change(action);
      this.fail(error);
    }
  }
}

/** The thumbnail of a surface, or what stands in its place. The name beside it says what it shows. */
function picture({ thumbnail }: ListedSurface): HTMLElement {
  if (!thumbnail) return html("span", { class: "picture" });
  return html("img", { class: "picture", src: thumbnail, alt: "", width: 96, height: 72 });
}

function stateText(surface: ListedSurface): string {
  if (surface.state === "queued") return "Waiting for its build";
  if (surface.state === "building") return `Building: ${Math.round(100 * surface.progress)} %`;
  return `${surface.state[0]!.toUpperCase()}${surface.state.slice(1)}${surface.reason ? `: ${surface.reason}` : ""}`;
}
