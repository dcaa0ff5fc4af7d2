/** The part of the panel about looks: colours, range, exaggeration, lines. */

import { COLOUR_MAPS, isColourMap } from "./colour-maps";
import { html, setText } from "./dom";
import { formatNumber, formatWithin } from "./format";
import type { Field } from "./geometry-messages";
import { fieldName, fieldsOf, type Look, sameField } from "./look";
import type { SurfaceInfo } from "./source";

const KEYS: readonly (readonly [string, string])[] = [
  ["Arrows", "turn"],
  ["Shift + arrows", "move"],
  ["+ and −", "zoom"],
  ["Home, T", "whole surface, from above"],
  ["P or Enter", "values at the centre"],
  ["[ and ]", "earlier, later moment"],
  ["End", "latest moment"],
  ["S", "stop or continue"],
  ["L", "quad lines"],
  ["X and Z", "more, less exaggeration"],
];

/** The section "Look", and the keys. */
export class LookPanel {
  private readonly field = html("select", { id: "field", class: "grow" });
  private readonly map = html(
    "select",
    { id: "map", class: "grow" },
    ...COLOUR_MAPS.map((name) => html("option", { value: name }, name)),
  );
  private readonly low = html("input", {
    type: "number",
    step: "any",
    class: "grow",
    "aria-label": "Colours begin at",
  });
  private readonly high = html("input", { type: "number", step: "any", class: "grow", "aria-label": "Colours end at" });
  private readonly auto = html("button", { type: "button", class: "quiet small" }, "Auto");
  private readonly exaggeration = html("input", {
    type: "range",
    min: -1,
    max: 2,
    step: 0.01,
    class: "grow",
    id: "exaggeration",
  });
  private readonly times = html("output", { for: "exaggeration" });
  private readonly lines = html("input", { type: "checkbox", id: "lines" });
  private readonly home = html("button", { type: "button", class: "quiet" }, "Whole surface");
  private readonly top = html("button", { type: "button", class: "quiet" }, "From above");
  private readonly rangeRow = html(
    "div",
    { class: "row" },
    html("span", { class: "name" }, "Range"),
    this.low,
    this.high,
    this.auto,
  );
  private readonly mapRow = html("div", { class: "row" }, html("label", { for: "map" }, "Colour map"), this.map);
  private fields: Field[] = [];
  private look: Look | null = null;

  readonly element = html(
    "section",
    { "aria-label": "Look" },
    html("h2", {}, "Look"),
    html("div", { class: "row" }, html("label", { for: "field" }, "Coloured by"), this.field),
    this.mapRow,
    this.rangeRow,
    html("div", { class: "row" }, html("label", { for: "exaggeration" }, "Exaggerate"), this.exaggeration, this.times),
    html("div", { class: "row check" }, html("label", {}, this.lines, "Quad lines")),
    html("div", { class: "row" }, this.home, this.top),
  );

  readonly keys = html(
    "section",
    { "aria-label": "Keys" },
    html(
      "details",
      {},
      html("summary", {}, "Keys in the picture"),
      html("dl", { class: "keys" }, ...KEYS.flatMap(([key, what]) => [html("dt", {}, key), html("dd", {}, what)])),
    ),
  );

  /** @param changed - Takes another look; `home`: the camera is asked for. */
  constructor(changed: (look: Look) => void, view: (which: "home" | "top") => void) {
    const change = (by: Partial<Look>): void => {
      if (this.look !== null) changed({ ...this.look, ...by });
    };
    this.field.addEventListener("change", () => {
      const field = this.fields[Number(this.field.value)];
      if (field !== undefined) change({ field });
    });
    this.map.addEventListener("change", () => isColourMap(this.map.value) && change({ map: this.map.value }));
    for (const input of [this.low, this.high]) {
      input.addEventListener("change", () => {
        const [low, high] = [Number(this.low.value), Number(this.high.value)];
        if (this.low.value !== "" && this.high.value !== "" && low < high) change({ range: [low, high] });
      });
    }
    this.auto.addEventListener("click", () => change({ range: null }));
    this.exaggeration.addEventListener("input", () => change({ exaggeration: 10 ** Number(this.exaggeration.value) }));
    this.lines.addEventListener("change", () => change({ lines: this.lines.checked }));
    this.home.addEventListener("click", () => view("home"));
    this.top.addEventListener("click", () => view("top"));
  }

  /** Offers what a surface has. */
  offer(info: SurfaceInfo): void {
    this.fields = fieldsOf(info);
    this.field.replaceChildren(...this.fields.map((field, k) => html("option", { value: k }, fieldName(field, info))));
    if (this.look !== null) this.draw(this.look, [Number.NaN, Number.NaN], false);
  }

  /**
   * Shows a look, and the range that colours have now.
   *
   * @param fitted - Heights have another unit than x and y: what they are exaggerated by is no ratio of lengths.
   */
  draw(look: Look, range: readonly [number, number], fitted: boolean): void {
    this.look = look;
    this.field.value = String(this.fields.findIndex((field) => sameField(field, look.field)));
    this.map.value = look.map;
    const root = this.element.getRootNode() as ShadowRoot;
    for (const [input, value] of [
      [this.low, range[0]],
      [this.high, range[1]],
    ] as const) {
      if (root.activeElement !== input && Number.isFinite(value))
        input.value = look.range === null ? formatWithin(value, range) : formatNumber(value, 7);
    }
    this.auto.hidden = look.range === null;
    this.exaggeration.value = String(Math.log10(look.exaggeration));
    const times = formatNumber(look.exaggeration, 3);
    setText(this.times, fitted ? (times === "1" ? "fitted" : `fitted × ${times}`) : `× ${times}`);
    this.exaggeration.setAttribute("aria-valuetext", fitted ? `fitted, times ${times}` : `times ${times}`);
    this.lines.checked = look.lines;
    this.rangeRow.hidden = look.field.kind === "none";
    this.mapRow.hidden = look.field.kind === "none";
  }
}
