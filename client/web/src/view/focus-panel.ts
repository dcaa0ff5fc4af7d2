/** The part of the panel about transmission: errors, curve, slider, target, stop. */

import { html, setText } from "./dom";
import { type CurveAxis, ErrorCurve } from "./error-curve";
import { formatBytes, formatSeconds } from "./format";
import type { Moment, Target } from "./source";
import { detailText, errorText, type FocusState, isWhole, statusText } from "./status";

/** What the panel asks for. */
export interface FocusActions {
  stop(): void;
  resume(): void;
  /** null: the latest moment, and those to come. */
  show(moment: number | null): void;
  setTarget(target: Target): void;
  /** Another rate was chosen. */
  throttle(rate: number | null): void;
  /** A session begins at this rate. */
  limit(rate: number): void;
  endByItself(on: boolean): void;
}

const TARGETS: readonly (readonly [string, string])[] = [
  ["all", "Everything"],
  ["rms", "RMS error"],
  ["max", "Maximum error"],
  ["bytes", "Kilobytes"],
  ["level", "Level"],
];

/** Bytes a second that can be chosen. */
const RATES: readonly (readonly [number, string])[] = [
  [0, "As it comes"],
  [1_000_000, "8 Mbit/s"],
  [125_000, "1 Mbit/s"],
  [32_000, "256 kbit/s"],
  [7_000, "56 kbit/s"],
];

function options(of: readonly (readonly [string | number, string])[]): HTMLOptionElement[] {
  return of.map(([value, text]) => html("option", { value }, text));
}

/** The section "In focus". */
export class FocusPanel {
  private readonly status = html("p", { class: "status", role: "status" });
  private readonly detail = html("p", { class: "detail" });
  private readonly done = html("i");
  private readonly rms = html("dd");
  private readonly max = html("dd");
  private readonly curve = new ErrorCurve();
  private readonly axis = html(
    "select",
    { "aria-label": "Error against" },
    ...options([
      ["bytes", "Against bytes"],
      ["seconds", "Against seconds"],
    ]),
  );
  private readonly slider = html("input", { type: "range", min: 0, max: 0, value: 0, class: "grow", id: "moment" });
  private readonly shown = html("output", { for: "moment" });
  private readonly target = html("select", { id: "target", class: "grow" }, ...options(TARGETS));
  private readonly amount = html("input", {
    type: "number",
    min: 0,
    step: "any",
    class: "grow",
    "aria-label": "Target value",
    hidden: true,
  });
  private readonly attribute = html("select", { class: "grow", id: "attribute" });
  private readonly attributeRow = html(
    "div",
    { class: "row", hidden: true },
    html("label", { for: "attribute" }, "Error of"),
    this.attribute,
  );
  private attributes = "";
  private readonly rate = html("select", { id: "rate", class: "grow" }, ...options(RATES));
  private readonly below = html("input", { type: "checkbox", checked: true, id: "below" });
  private readonly button = html("button", { type: "button", class: "primary" }, "Stop");
  private last: FocusState | null = null;

  readonly element = html(
    "section",
    { "aria-label": "In focus" },
    html("h2", {}, "In focus"),
    this.status,
    this.detail,
    html("div", { class: "bar", "aria-hidden": "true" }, this.done),
    html(
      "dl",
      { class: "figures" },
      html("div", {}, html("dt", {}, "RMS error"), this.rms),
      html("div", {}, html("dt", { class: "max" }, "Maximum error"), this.max),
    ),
    this.curve.element,
    html("div", { class: "row end" }, this.axis),
    html("div", { class: "row" }, html("label", { for: "moment" }, "Moment"), this.slider, this.shown),
    html("div", { class: "row" }, html("label", { for: "target" }, "Target"), this.target, this.amount),
    this.attributeRow,
    html("div", { class: "row" }, html("label", { for: "rate" }, "Link"), this.rate),
    html("div", { class: "row check" }, html("label", {}, this.below, "Stop when the picture looks done")),
    html("div", { class: "row" }, this.button),
  );

  constructor(private readonly actions: FocusActions) {
    this.button.addEventListener("click", () => (this.canStop ? actions.stop() : actions.resume()));
    this.axis.addEventListener("change", () => this.last !== null && this.draw(this.last));
    this.slider.addEventListener("input", () => this.slide(Number(this.slider.value)));
    this.target.addEventListener("change", () => this.chooseTarget());
    this.amount.addEventListener("change", () => this.sendTarget());
    this.rate.addEventListener("change", () => actions.throttle(this.chosenRate));
    this.attribute.addEventListener("change", () => this.sendTarget());
    this.below.addEventListener("change", () => actions.endByItself(this.below.checked));
  }

  /** Whether there is something to stop, also before anything is drawn of it. */
  get canStop(): boolean {
    const state = this.last?.progress.state ?? "connecting";
    return state === "connecting" || state === "receiving" || state === "resuming" || state === "waiting";
  }

  /** Bytes a second at most; null: as it comes. */
  get chosenRate(): number | null {
    return Number(this.rate.value) || null;
  }

  /**
   * Asks another session for what is chosen, as far as that is not what it does anyway.
   *
   * @param rate - Bytes a second that an address asks for, if it is one of those that can be chosen.
   */
  begin(rate?: number): void {
    this.attribute.value = ""; // another surface may have others
    if (RATES.some(([known]) => known === rate)) this.rate.value = String(rate);
    if (this.target.value !== "all") this.sendTarget();
    this.last = null;
    if (this.chosenRate !== null) this.actions.limit(this.chosenRate);
  }

  /** Chooses a target, as the user would. */
  choose({ rms, max, bytes, level }: Target): void {
    const [kind, amount] =
      (
        [
          ["rms", rms],
          ["max", max],
          ["bytes", bytes === undefined ? undefined : bytes / 1000],
          ["level", level],
        ] as const
      ).find(([, value]) => value !== undefined) ?? (["all", undefined] as const);
    this.target.value = kind;
    this.amount.value = amount === undefined ? "" : String(amount);
    this.amount.hidden = kind === "all";
    this.sendTarget();
  }

  /** Says whether it stops when the picture looks done. */
  setEndsByItself(on: boolean): void {
    this.below.checked = on;
  }

  /** Goes so many moments back or on. */
  step(by: number): void {
    const from = this.last?.following === false ? this.slider.value : this.slider.max;
    const to = Math.min(Math.max(Number(from) + by, 0), Number(this.slider.max));
    this.slider.value = String(to);
    this.slide(to);
  }

  /** Shows another state. */
  draw(state: FocusState): void {
    this.last = state;
    const { info, moments, drawn, progress, following } = state;
    const unit = info?.unit ?? "";
    setText(this.status, statusText(state));
    setText(this.detail, detailText(state));
    this.offer(info?.attributes.map(({ name }) => name) ?? []);
    const total = progress.planned || info?.size || 0;
    this.done.style.width = `${total > 0 ? Math.min(100, (100 * progress.bytes) / total) : 0}%`;
    setText(this.rms, drawn === null ? "–" : errorText(drawn.rms, unit));
    setText(this.max, drawn === null ? "–" : errorText(drawn.max, unit));
    const axis = this.axis.value as CurveAxis;
    this.curve.draw({ prices: info?.prices ?? null, moments, shown: drawn?.number ?? -1, axis, unit });
    const [first, last] = [moments[0]?.number ?? 0, moments.at(-1)?.number ?? 0];
    this.slider.min = String(first);
    this.slider.max = String(last);
    // Whoever follows sees where the picture is, which may take longer to draw than to come.
    if (following) this.slider.value = String(drawn?.number ?? last);
    setText(this.shown, drawn === null ? "" : formatBytes(drawn.bytes));
    // Of the picture, as the label is: the knob may be elsewhere already.
    this.slider.setAttribute("aria-valuetext", drawn === null ? "nothing yet" : momentText(drawn, unit));
    const goOn = progress.state === "failed" ? "Try again" : state.looksDone ? "Get the rest" : "Continue";
    setText(this.button, this.canStop ? "Stop" : goOn);
    this.button.hidden = isWhole(state);
  }

  /** Lets an error be that of an attribute, where there are any. */
  private offer(names: readonly string[]): void {
    const known = JSON.stringify(names);
    if (known !== this.attributes) {
      this.attributes = known;
      const all: [string, string][] = [["", "the surface"], ...names.map((name): [string, string] => [name, name])];
      this.attribute.replaceChildren(...options(all));
    }
    const { value } = this.target;
    this.attributeRow.hidden = names.length === 0 || (value !== "rms" && value !== "max");
  }

  private slide(to: number): void {
    const following = to >= Number(this.slider.max);
    // The panel is drawn with the next frame, and the next key may come sooner.
    if (this.last !== null) this.last = { ...this.last, following };
    this.actions.show(following ? null : to);
  }

  private chooseTarget(): void {
    const kind = this.target.value;
    this.amount.hidden = kind === "all";
    this.offer(this.last?.info?.attributes.map(({ name }) => name) ?? []);
    const drawn = this.last?.drawn;
    const suggestion: Readonly<Record<string, number>> = {
      rms: (drawn?.rms ?? 1) / 4,
      max: (drawn?.max ?? 1) / 4,
      bytes: Math.ceil((drawn?.bytes ?? 10_000) / 500),
      level: this.last?.info?.levels ?? 0,
    };
    if (kind === "all") this.sendTarget();
    else this.amount.value = String(Number((suggestion[kind] ?? 0).toPrecision(2)));
    if (kind !== "all") this.sendTarget();
  }

  private sendTarget(): void {
    const kind = this.target.value;
    const amount = Number(this.amount.value);
    if (kind === "all") this.actions.setTarget({});
    else if (!Number.isFinite(amount) || amount < 0 || this.amount.value === "") return;
    else if (kind === "level")
      this.actions.setTarget({
        level: Math.min(Math.round(amount), this.last?.info?.levels ?? Number.POSITIVE_INFINITY),
      });
    else if (kind === "bytes") this.actions.setTarget({ bytes: Math.round(amount * 1000) });
    else {
      const of = this.attribute.value === "" ? {} : { attribute: this.attribute.value };
      this.actions.setTarget(kind === "rms" ? { rms: amount, ...of } : { max: amount, ...of });
    }
  }
}

function momentText(moment: Moment, unit: string): string {
  return `${formatBytes(moment.bytes)} after ${formatSeconds(moment.seconds)}, RMS error ${errorText(moment.rms, unit)}`;
}
