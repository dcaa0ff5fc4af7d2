/** The legend of the colours, the scale bar and the arrow to the north. */

import { type ColourMapName, stopsOf } from "./colour-maps";
import { html, setText, svg } from "./dom";
import { formatNumber, formatWithin, roundBelow } from "./format";

/** What the legend says. */
export interface LegendData {
  readonly title: string;
  readonly unit: string;
  readonly map: ColourMapName;
  readonly range: readonly [number, number];
  /** A sentence below; may be empty. */
  readonly note: string;
}

let legends = 0;

function nextId(): string {
  legends += 1;
  return `lodestream-legend-${legends}`;
}

/** A bar of colours with numbers below it. */
export class Legend {
  private readonly title = html("div", { class: "legend-title" });
  private readonly gradient = svg("linearGradient", { id: nextId() });
  private readonly ticks = [0, 1, 2].map(() => html("span"));
  private readonly note = html("div", { class: "legend-note" });
  readonly element = html(
    "div",
    { class: "legend" },
    this.title,
    svg(
      "svg",
      { viewBox: "0 0 160 10", preserveAspectRatio: "none", class: "legend-bar", "aria-hidden": "true" },
      svg("defs", {}, this.gradient),
      svg("rect", { width: 160, height: 10, fill: `url(#${this.gradient.id})` }),
    ),
    html("div", { class: "legend-ticks" }, ...this.ticks),
    this.note,
  );

  /** Shows other data; null: no legend. */
  draw(data: LegendData | null): void {
    this.element.hidden = data === null;
    if (data === null) return;
    const { title, unit, map, range, note } = data;
    setText(this.title, unit === "" ? title : `${title} (${unit})`);
    setText(this.note, note);
    const stops = stopsOf(map);
    this.gradient.replaceChildren(
      ...stops.map((colour, k) =>
        svg("stop", { offset: k / (stops.length - 1), "stop-color": `rgb(${colour.join(",")})` }),
      ),
    );
    const values = [range[0], (range[0] + range[1]) / 2, range[1]];
    this.ticks.forEach((tick, k) => {
      setText(tick, formatWithin(values[k]!, range));
    });
  }
}

/** A bar of a round length at the distance of the camera's target, and an arrow to the north. */
export class ScaleBar {
  private readonly bar = svg("path", { class: "scale-line" });
  private readonly text = svg("text", { class: "scale-text", x: 0, y: 10 });
  private readonly scale = svg("svg", { class: "scale", viewBox: "0 0 130 24", role: "img" }, this.text, this.bar);
  private readonly needle = svg("g", {}, svg("path", { class: "north", d: "M0 -13 L5 8 L0 4 L-5 8 Z" }));
  private readonly north = svg(
    "svg",
    { class: "compass", viewBox: "-18 -18 36 36", role: "img", "aria-label": "North" },
    svg("circle", { class: "compass-ring", r: 16.5 }),
    this.needle,
  );
  readonly element = html("div", { class: "scales" }, this.north, this.scale);

  /**
   * @param pixels - Pixels of a length of 1 in the unit, at the camera's target; 0: no scale.
   * @param azimuth - Of the camera, in degrees; null: no north.
   */
  draw(pixels: number, unit: string, azimuth: number | null): void {
    this.north.toggleAttribute("hidden", azimuth === null);
    if (azimuth !== null) this.needle.setAttribute("transform", `rotate(${(azimuth + 90).toFixed(1)})`);
    this.scale.toggleAttribute("hidden", !(pixels > 0));
    if (!(pixels > 0)) return;
    const length = roundBelow(120 / pixels);
    const width = length * pixels;
    const text = lengthText(length, unit);
    setText(this.text, text);
    this.scale.setAttribute("aria-label", `Scale: the bar is ${text} long`);
    this.bar.setAttribute("d", `M0.5 15 V21 H${width.toFixed(1)} V15`);
  }
}

function lengthText(length: number, unit: string): string {
  if (unit === "m" && length >= 1000) return `${formatNumber(length / 1000)} km`;
  if (unit === "°") return `${formatNumber(length)}°`;
  return `${formatNumber(length)} ${unit}`.trim();
}
