/** The values under the pointer, as text. */

import { html } from "./dom";
import { formatAt, formatNumber, formatStored } from "./format";
import type { Session } from "./session";
import type { Moment, NodeValues, SurfaceInfo } from "./source";
import { errorText } from "./status";

type Ray = { origin: [number, number, number]; direction: [number, number, number] };

/** Asks for the values under a ray, one question at a time, and shows them. */
export class Probe {
  /** The last place that was found, in the surface's coordinates. */
  at: readonly [number, number, number] | null = null;
  private waiting: Ray | null = null;
  private last: Ray | null = null;
  private busy = false;

  /**
   * @param element - Where the values are shown.
   * @param changed - Called when `at` is another place.
   * @param found - Called with the values that are shown; null: none are any more.
   */
  constructor(
    private readonly element: HTMLElement,
    private readonly changed: () => void,
    private readonly found: (values: NodeValues | null) => void,
  ) {}

  /** Shows that nothing is under the pointer. */
  clear(): void {
    if (this.at !== null) this.found(null);
    this.at = null;
    this.changed();
    this.element.replaceChildren(
      html("span", { class: "dim" }, "Point at the surface, or press P in the picture, to read its values."),
    );
  }

  /** Shows what a ray meets; null: nothing. */
  point(session: Session, ray: Ray | null): void {
    this.waiting = ray;
    this.last = ray;
    if (ray !== null && !this.busy) void this.ask(session);
    if (ray !== null) return;
    if (this.at !== null) this.found(null);
    this.at = null;
    this.changed();
  }

  /** Reads the same place again, where one is shown: the surface that is drawn has changed. */
  again(session: Session): void {
    if (this.at !== null) this.point(session, this.last);
  }

  private async ask(session: Session): Promise<void> {
    this.busy = true;
    try {
      while (this.waiting !== null) {
        const ray = this.waiting;
        this.waiting = null;
        const hit = await session.pick(ray);
        const { info, drawnMoment: moment } = session;
        if (hit === null || info === null || moment === null) {
          this.clear();
          continue;
        }
        this.at = hit.at;
        this.changed();
        const [row, column] = [Math.round(hit.row), Math.round(hit.column)];
        const { shape } = info.blocks[hit.block]!;
        const values = await session.source
          .valuesAt(moment.number, hit.block, row % shape[0], column % shape[1])
          .catch(() => null);
        if (values === null) this.clear();
        else {
          this.show(values, info, moment);
          this.found(values);
        }
      }
    } finally {
      this.busy = false;
    }
  }

  private show(of: NodeValues, info: SurfaceInfo, moment: Moment): void {
    const part = (name: string, value: string): HTMLElement =>
      html("span", {}, html("span", { class: "dim" }, `${name} `), html("b", {}, value));
    // As many digits as the error leaves, of a surface that is not exact.
    const step = of.max > 0 ? of.max / 10 : 0;
    const text = (value: number): string => (step > 0 ? formatAt(value, step) : formatStored(value));
    const names = ["x", "y", info.heights ? "height" : "z"];
    const unit = (k: number): string =>
      k > 1 || info.planeUnit === "cells" ? (k > 1 ? info.unit : "") : info.planeUnit;
    this.element.replaceChildren(
      part(info.blocks.length > 1 ? `block ${of.block}, row` : "row", `${of.row}`),
      part("column", `${of.column}`),
      ...of.point.map((value, k) =>
        part(
          names[k] ?? `channel ${k}`,
          `${k < 2 && info.heights ? formatNumber(value, 10) : text(value)} ${unit(k)}`.trim(),
        ),
      ),
      ...of.attributes.map(([name, values]) =>
        part(name, values.map((value) => (Number.isNaN(value) ? "none" : formatStored(value))).join(", ")),
      ),
      part("error at most", info.exact && moment.complete && of.max === 0 ? "0: exact" : errorText(of.max, info.unit)),
      part("RMS", errorText(of.rms, info.unit)),
      html("span", { class: "dim" }, whereText(of)),
    );
    // The picture above does not change its size with every other number of lines.
    this.element.style.minHeight = `${Math.max(this.element.offsetHeight, Number.parseFloat(this.element.style.minHeight) || 0)}px`;
  }
}

/** What the errors that are told belong to. */
function whereText({ within, max }: NodeValues): string {
  if (!(max > 0)) return "";
  return within === null ? "errors of the whole surface" : `errors of the ${within.join(" × ")} points around it`;
}
