/** Uploading files: by drop or by choice, with the progress of transfer and build. */

import { html, setText } from "../view/dom";
import { formatBytes } from "../view/format";
import { type ListedSurface, ProblemError, type Server } from "./api";

/** Milliseconds between questions about a build. */
const POLL = 700;

/** The place where files are dropped, and the uploads in progress below it. */
export class Uploads {
  private readonly input = html("input", {
    type: "file",
    multiple: true,
    id: "files",
    class: "hidden-text",
    tabindex: -1,
    "aria-label": "Files to upload",
  });
  private readonly list = html("ul", { class: "uploads", "aria-label": "Uploads" });
  private readonly drop: HTMLElement;
  readonly element: HTMLElement;

  /**
   * @param allowed - Asks for a token if one is needed; false: it was not given.
   * @param changed - Called when a surface was made or is ready.
   */
  constructor(
    private readonly server: Server,
    private readonly allowed: (error: ProblemError) => Promise<boolean>,
    private readonly changed: (surface: ListedSurface) => void,
  ) {
    const choose = html("button", { type: "button" }, "Choose files");
    choose.addEventListener("click", () => this.input.click());
    this.drop = html(
      "div",
      { class: "drop" },
      html("p", { class: "hint" }, "Drop a surface anywhere on this page: a grid, raster, mesh or container file."),
      choose,
      this.input,
    );
    this.element = html("div", {}, this.drop, this.list);
    this.input.addEventListener("change", () => {
      this.take(this.input.files);
      this.input.value = "";
    });
    for (const name of ["dragenter", "dragover"] as const) {
      this.drop.addEventListener(name, (event) => {
        event.preventDefault();
        this.drop.classList.add("over");
      });
    }
    for (const name of ["dragleave", "drop"] as const)
      this.drop.addEventListener(name, () => this.drop.classList.remove("over"));
  }

  /** Shows the place for files only where the token may write. */
  showRights(): void {
    this.drop.hidden = this.server.readsOnly;
  }

  /** Uploads files. */
  take(files: FileList | null): void {
    if (this.server.readsOnly) return;
    for (const file of files ?? []) void this.upload(file);
  }

  private async upload(file: File): Promise<void> {
    const what = html("span", { class: "what", role: "status" }, "Waiting");
    const bar = html("progress", { class: "bar", max: 1, value: 0, "aria-label": `Upload of ${file.name}` });
    const cancel = html("button", { type: "button", class: "plain" }, "Cancel");
    const item = html("li", {}, html("span", { class: "name" }, file.name), cancel, what, bar);
    this.list.prepend(item);
    const controller = new AbortController();
    cancel.addEventListener("click", () => controller.abort());
    // Closing the page would end the transfer.
    const keep = (event: BeforeUnloadEvent): void => event.preventDefault();
    addEventListener("beforeunload", keep);
    let sent = false;
    try {
      const surface = await this.send(file, controller.signal, (bytes) => {
        bar.value = file.size > 0 ? bytes / file.size : 1;
        setText(what, `Sent ${formatBytes(bytes)} of ${formatBytes(file.size)}`);
      }).finally(() => removeEventListener("beforeunload", keep));
      sent = true;
      cancel.remove();
      this.changed(surface);
      await this.build(surface, what, bar);
      item.remove();
    } catch (error) {
      bar.remove();
      cancel.textContent = "Dismiss";
      if (!cancel.isConnected) what.before(cancel);
      cancel.addEventListener("click", () => item.remove());
      setText(what, controller.signal.aborted ? "Cancelled" : sent ? "Uploaded, but not ready" : "Not uploaded");
      if (!controller.signal.aborted)
        item.append(
          html("span", { class: "reason", role: "alert" }, error instanceof Error ? error.message : String(error)),
        );
    }
  }

  private async send(file: File, signal: AbortSignal, progress: (sent: number) => void): Promise<ListedSurface> {
    for (;;) {
      try {
        return await this.server.upload(file, progress, signal);
      } catch (error) {
        if (!(error instanceof ProblemError) || !(await this.allowed(error))) throw error;
      }
    }
  }

  private async build(surface: ListedSurface, what: HTMLElement, bar: HTMLProgressElement): Promise<void> {
    while (surface.state === "queued" || surface.state === "building") {
      bar.value = surface.progress;
      setText(
        what,
        surface.state === "queued" ? "Waiting for its build" : `Building: ${Math.round(100 * surface.progress)} %`,
      );
      await new Promise((resolve) => setTimeout(resolve, POLL));
      surface = await this.server.look(surface.url);
    }
    this.changed(surface);
    if (surface.state !== "ready") throw new Error(surface.reason ?? `The surface is ${surface.state}`);
  }
}
