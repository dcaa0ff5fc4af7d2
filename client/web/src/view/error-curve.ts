/** The error against what it costs: the price list as a line, what has come as dots, on logarithmic axes. */

import { svg } from "./dom";
import { formatBytes, formatNumber, formatSeconds } from "./format";
import type { Moment, Price } from "./source";

const [WIDTH, HEIGHT] = [280, 150];
const [LEFT, RIGHT, TOP, BOTTOM] = [46, 8, 8, 20];

/** What the curve is drawn against. */
export type CurveAxis = "bytes" | "seconds";

/** A scale of one axis: from values to places. */
export interface Scale {
  readonly low: number;
  readonly high: number;
  place(value: number): number;
}

/** A logarithmic scale over whole powers of ten of the positive values; from `start` to `end` in pixels. */
export function logScale(values: readonly number[], start: number, end: number): Scale {
  const positive = values.filter((value) => value > 0 && Number.isFinite(value));
  const low = positive.length > 0 ? Math.floor(Math.log10(Math.min(...positive)) + 1e-9) : 0;
  const top = positive.length > 0 ? Math.ceil(Math.log10(Math.max(...positive)) - 1e-9) : 1;
  const high = Math.max(top, low + 1);
  return {
    low,
    high,
    place(value) {
      const at = value > 0 ? (Math.log10(value) - low) / (high - low) : 0;
      return start + (end - start) * Math.min(Math.max(at, 0), 1);
    },
  };
}

/** Pixels between the lowest power of ten and an error of 0. */
const ZERO = 16;

/** A logarithmic scale with a place below it for 0, if there is one among the values. */
export function withZero(values: readonly number[], bottom: number, top: number): Scale & { readonly zero: boolean } {
  const zero = values.includes(0);
  const scale = logScale(values, zero ? bottom - ZERO : bottom, top);
  return { ...scale, zero, place: (value) => (value > 0 ? scale.place(value) : bottom) };
}

/** What is drawn of one curve. */
export interface CurveData {
  readonly prices: readonly Price[] | null;
  readonly moments: readonly Moment[];
  /** Number of the moment that is shown. */
  readonly shown: number;
  readonly axis: CurveAxis;
  readonly unit: string;
}

/** An SVG that can be drawn anew. */
export class ErrorCurve {
  readonly element = svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", class: "curve" });

  /** Draws the data; an error of 0 lies on a line of its own, below the logarithmic scale. */
  draw({ prices, moments, shown, axis, unit }: CurveData): void {
    const cost = (of: Moment): number => (axis === "bytes" ? of.bytes : of.seconds);
    const priced = axis === "bytes" ? (prices ?? []) : [];
    const known = moments.filter(({ rms }) => !Number.isNaN(rms));
    const errors = [...priced, ...known].flatMap(({ rms, max }) => [rms, max]);
    const x = logScale([...priced.map(({ bytes }) => bytes), ...moments.map(cost)], LEFT, WIDTH - RIGHT);
    const y = withZero(errors, HEIGHT - BOTTOM, TOP);
    const at = (of: { rms: number; max: number }, kind: "rms" | "max", along: number): string =>
      `${x.place(along).toFixed(1)},${y.place(of[kind]).toFixed(1)}`;
    const line = (kind: "rms" | "max") =>
      svg("polyline", { class: `line ${kind}`, points: priced.map((price) => at(price, kind, price.bytes)).join(" ") });
    const dots = (kind: "rms" | "max") =>
      known.map((of) => {
        const [cx, cy] = at(of, kind, cost(of)).split(",");
        return svg("circle", { class: `dot ${kind}`, cx: cx!, cy: cy!, r: 2 });
      });
    const current = moments.find(({ number }) => number === shown);
    const marker =
      current === undefined
        ? null
        : svg("line", {
            class: "marker",
            x1: x.place(cost(current)),
            x2: x.place(cost(current)),
            y1: TOP,
            y2: HEIGHT - BOTTOM,
          });
    this.element.replaceChildren(
      ...axes(x, y, axis),
      line("max"),
      line("rms"),
      ...(marker === null ? [] : [marker]),
      ...dots("max"),
      ...dots("rms"),
    );
    this.element.setAttribute("aria-label", describe(current, axis, unit));
  }
}

function axes(x: Scale, y: Scale & { readonly zero: boolean }, axis: CurveAxis): SVGElement[] {
  const parts: SVGElement[] = [];
  const every = (scale: Scale, most: number): number[] => {
    const step = Math.max(1, Math.ceil((scale.high - scale.low) / most));
    const ticks: number[] = [];
    for (let power = scale.low; power <= scale.high; power += step) ticks.push(10 ** power);
    return ticks;
  };
  for (const value of [...(y.zero ? [0] : []), ...every(y, 4)]) {
    const at = y.place(value);
    parts.push(svg("line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: at, y2: at }));
    parts.push(svg("text", { class: "tick", x: LEFT - 5, y: at + 3, "text-anchor": "end" }, formatNumber(value, 2)));
  }
  const across = every(x, 4);
  across.forEach((value, k) => {
    const at = x.place(value);
    const anchor = k === 0 ? "start" : k === across.length - 1 && at > WIDTH - RIGHT - 20 ? "end" : "middle";
    parts.push(svg("line", { class: "grid", x1: at, x2: at, y1: TOP, y2: HEIGHT - BOTTOM }));
    const text =
      axis === "bytes" ? formatBytes(value).replace(".00", "").replace(/\.0 /, " ") : `${formatNumber(value, 2)} s`;
    parts.push(svg("text", { class: "tick", x: at, y: HEIGHT - 6, "text-anchor": anchor }, text));
  });
  return parts;
}

function describe(shown: Moment | undefined, axis: CurveAxis, unit: string): string {
  if (shown === undefined) return "Error against bytes: nothing is drawn yet";
  const cost = axis === "bytes" ? formatBytes(shown.bytes) : formatSeconds(shown.seconds);
  return `Error against ${axis}: after ${cost}, RMS ${formatNumber(shown.rms)} ${unit}, maximum ${formatNumber(shown.max)} ${unit}`;
}
