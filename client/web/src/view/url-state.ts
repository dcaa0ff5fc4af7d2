/** The view as a short text for the part of an address after #, so that it can be shared. */

import type { Orbit } from "./camera";
import { type ColourMapName, isColourMap } from "./colour-maps";
import type { Field } from "./geometry-messages";

/** What is shared; the camera's target and distance are in the surface's coordinates. */
export interface SharedView {
  camera?: Orbit;
  field?: Field;
  map?: ColourMapName;
  /** Range of the colours; without it that of the values. */
  range?: readonly [number, number];
  exaggeration?: number;
  lines?: boolean;
  /** Bytes a second that are asked for at most. */
  rate?: number;
}

/** A number with as many digits as matter beside a step. */
function short(value: number, step: number): string {
  const digits = Math.min(Math.max(Math.ceil(-Math.log10(step || 1)), 0), 20);
  return String(Number(value.toFixed(digits)));
}

function fieldText(field: Field): string {
  if (field.kind !== "attribute") return field.kind;
  const component = field.component === "magnitude" ? "m" : field.component;
  return `a:${component}:${encodeURIComponent(field.name)}`;
}

/** The text of a view, such as `v=-90,42,12000,500000,4200000,900&c=slope&x=2`. */
export function formatView(view: SharedView): string {
  const parts: string[] = [];
  if (view.camera !== undefined) {
    const { azimuth, elevation, distance, target } = view.camera;
    const step = distance / 2000;
    const numbers = [
      short(azimuth, 0.1),
      short(elevation, 0.1),
      Number(distance.toPrecision(4)),
      ...target.map((t) => short(t, step)),
    ];
    parts.push(`v=${numbers.join(",")}`);
  }
  if (view.field !== undefined) parts.push(`c=${fieldText(view.field)}`);
  if (view.map !== undefined) parts.push(`m=${view.map}`);
  if (view.range !== undefined) parts.push(`r=${view.range.map((value) => Number(value.toPrecision(6))).join(",")}`);
  if (view.exaggeration !== undefined) parts.push(`x=${Number(view.exaggeration.toPrecision(4))}`);
  if (view.lines === true) parts.push("l=1");
  if (view.rate !== undefined) parts.push(`b=${view.rate}`);
  return parts.join("&");
}

function numbersOf(text: string | null, count: number): number[] | null {
  const numbers = text?.split(",").map((part) => (part.trim() === "" ? Number.NaN : Number(part))) ?? [];
  return numbers.length === count && numbers.every(Number.isFinite) ? numbers : null;
}

function fieldOf(text: string | null): Field | undefined {
  if (text === "height" || text === "slope" || text === "change" || text === "none") return { kind: text };
  const found = /^a:(\d{1,6}|m):(.+)$/s.exec(text ?? "");
  if (found === null) return undefined;
  try {
    const component = found[1] === "m" ? "magnitude" : Number(found[1]);
    return { kind: "attribute", component, name: decodeURIComponent(found[2]!) };
  } catch {
    return undefined;
  }
}

/** Reads `formatView` back; what is not valid is left out, since anybody can write an address. */
export function parseView(text: string): SharedView {
  const given = new Map(
    text.split("&").map((part): [string, string] => {
      const at = part.indexOf("=");
      return at < 0 ? [part, ""] : [part.slice(0, at), part.slice(at + 1)];
    }),
  );
  const get = (key: string): string | null => given.get(key) ?? null;
  const view: SharedView = {};
  const camera = numbersOf(get("v"), 6);
  if (camera !== null && camera[2]! > 0 && Math.abs(camera[1]!) < 90) {
    const [azimuth, elevation, distance, x, y, z] = camera as [number, number, number, number, number, number];
    view.camera = { azimuth, elevation, distance, target: [x, y, z] };
  }
  const field = fieldOf(get("c"));
  if (field !== undefined) view.field = field;
  const map = get("m");
  if (map !== null && isColourMap(map)) view.map = map;
  const range = numbersOf(get("r"), 2);
  if (range !== null && range[0]! < range[1]!) view.range = [range[0]!, range[1]!];
  const [exaggeration] = numbersOf(get("x"), 1) ?? [];
  if (exaggeration !== undefined && exaggeration >= 0.01 && exaggeration <= 1000) view.exaggeration = exaggeration;
  if (get("l") === "1") view.lines = true;
  const [rate] = numbersOf(get("b"), 1) ?? [];
  if (rate !== undefined && rate > 0) view.rate = rate;
  return view;
}

/** Keys of `formatView`; others in an address belong to the page. */
const KEYS = new Set(["v", "c", "m", "r", "x", "l", "b"]);

/** An address's part after #, with another view in it and what else there was. */
export function withView(hash: string, view: SharedView): string {
  const others = hash
    .replace(/^#/, "")
    .split("&")
    .filter((part) => part !== "" && !KEYS.has(part.split("=", 1)[0]!));
  return `#${[...others, formatView(view)].filter((part) => part !== "").join("&")}`;
}
