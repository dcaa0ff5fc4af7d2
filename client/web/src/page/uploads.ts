/** Uploading files: by drop or by choice, with the progress of transfer and build. */

import { html, setText } from "../view/dom";
import { formatBytes } from "../view/format";
import { type Choice, type ListedSurface, ProblemError, type Server } from "./api";
import { choiceName, choiceQuestion } from "./names";
import { reasonElement } from "./reasons";

/** For how long a question about a build waits for its end; so often its progress is shown. */
const SECONDS = 1;

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
   * @param gone - Called when a surface was deleted: its file came again, with the choice that it had lacked.
   */
  constructor(
    private readonly server: Server,
    private readonly allowed: (error: ProblemError) => Promise<boolean>,
    private readonly changed: (surface: ListedSurface) => void,
    private readonly gone: (surface: ListedSurface) => void,
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

  /** @param failed - The surface of the same file that lacked these options. */
  private async upload(
    file: File,
    options: Readonly<Record<string, string>> = {},
    failed: ListedSurface | null = null,
  ): Promise<void> {
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
    let surface: ListedSurface | null = null;
    try {
      surface = await this.send(file, options, controller.signal, (bytes) => {
        bar.value = file.size > 0 ? bytes / file.size : 1;
        setText(what, `Sent ${formatBytes(bytes)} of ${formatBytes(file.size)}`);
      }).finally(() => removeEventListener("beforeunload", keep));
      cancel.remove();
      this.changed(surface);
      if (failed !== null) await this.forget(failed);
      surface = await this.build(surface, what, bar);
      if (surface.state !== "ready") throw new Error(surface.reason ?? `The surface is ${surface.state}`);
      item.remove();
    } catch (error) {
      bar.remove();
      cancel.textContent = "Dismiss";
      if (!cancel.isConnected) what.before(cancel);
      cancel.addEventListener("click", () => item.remove());
      const choices = surface?.choices ?? [];
      if (surface !== null && choices.length > 0) {
        setText(what, "Uploaded; it has more than one surface");
        item.append(
          this.chooser(choices, (choice) => {
            item.remove();
            void this.upload(file, { ...surface?.options, ...choice.options }, surface);
          }),
        );
      } else
        setText(what, controller.signal.aborted ? "Cancelled" : surface ? "Uploaded, but not ready" : "Not uploaded");
      if (!controller.signal.aborted)
        item.append(reasonElement(error instanceof Error ? error.message : String(error), "alert"));
    }
  }

  /** Offers the surfaces of a file. */
  private chooser(choices: readonly Choice[], chosen: (choice: Choice) => void): HTMLElement {
    const names = choices.map((choice, place) => html("option", { value: place }, choiceName(choice)));
    const select = html("select", {}, ...names);
    const use = html("button", { type: "button" }, "Upload again");
    use.addEventListener("click", () => {
      const choice = choices[Number(select.value)];
      if (choice !== undefined) chosen(choice);
    });
    return html(
      "div",
      { class: "chooser" },
      html("label", { class: "question" }, html("span", {}, `${choiceQuestion(choices)}: `), select),
      use,
    );
  }

  /** Deletes a surface that failed, if that is possible. */
  private async forget(failed: ListedSurface): Promise<void> {
    try {
      await this.server.delete(failed.url);
      this.gone(failed);
    } catch (error) {
      if (!(error instanceof ProblemError)) throw error;
    }
  }

  private async send(
    file: File,
    options: Readonly<Record<string, string>>,
    signal: AbortSignal,
    progress: (sent: number) => void,
  ): Promise<ListedSurface> {
    for (;;) {
      try {
        return await this.server.upload(file, options, progress, signal);
      } catch (error) {
        if (!(error instanceof ProblemError) || !(await this.allowed(error))) throw error;
      }
    }
  }

  /** Waits until a build has ended. @returns what became of the surface. */
  private async build(surface: ListedSurface, what: HTMLElement, bar: HTMLProgressElement): Promise<ListedSurface> {
    while (surface.state === "queued" || surface.state === "building") {
      bar.value = surface.progress;
      setText(
        what,
        surface.state === "queued" ? "Waiting for its build" : `Building: ${Math.round(100 * surface.progress)} %`,
      );
      surface = await this.server.listed(surface.url, SECONDS);
    }
    this.changed(surface);
    return surface;
  }
}
