/** How a surface looks: what it is coloured by, with which map and range. */

import { type ColourMapName, rangeOf } from "./colour-maps";
import type { Colouring, Field } from "./geometry-messages";
import type { LegendData } from "./legend";
import type { SurfaceInfo } from "./source";

/** What can be chosen. */
export interface Look {
  readonly field: Field;
  readonly map: ColourMapName;
  /** null: that of the values. */
  readonly range: readonly [number, number] | null;
  readonly exaggeration: number;
  readonly lines: boolean;
}

/** The map that suits a field. */
export function mapFor(field: Field, info: SurfaceInfo | null): ColourMapName {
  if (field.kind === "change") return "red-blue";
  if (field.kind === "height" && info?.heights) return "terrain";
  return "viridis";
}

/** Whether the colours of a field are centred at 0. */
export function isCentred(field: Field): boolean {
  return field.kind === "change";
}

/** How a field is called. */
export function fieldName(field: Field): string {
  switch (field.kind) {
    case "none":
      return "Shading only";
    case "height":
      return "Height";
    case "slope":
      return "Slope";
    case "change":
      return "Last change";
    case "attribute":
      return field.component === 0 ? field.name : `${field.name}, component ${field.component}`;
  }
}

/** The range that colours span: the one that was chosen, else that of the values. */
export function shownRange(look: Look, { range }: Colouring): [number, number] {
  return look.range === null ? rangeOf(range[0], range[1], isCentred(look.field)) : [look.range[0], look.range[1]];
}

/** What the legend says of a look; null: nothing. */
export function legendOf({ field, map }: Look, range: readonly [number, number], unit: string): LegendData | null {
  if (field.kind === "none") return null;
  const own = field.kind === "slope" ? "degrees" : field.kind === "attribute" ? "" : unit;
  const note = field.kind === "attribute" ? "Grey: no value" : "";
  return { title: fieldName(field), unit: own, map, range, note };
}
