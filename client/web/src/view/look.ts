/** How a surface looks: what it is coloured by, with which map and range. */

import { type ColourMapName, rangeOf } from "./colour-maps";
import type { Colouring, Component, Field } from "./geometry-messages";
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

/** The most components of one attribute that can be chosen. */
const MOST_COMPONENTS = 16;

/** Units of length as metadata write them. */
const METRES = /^(m|met(er|re)s?)$/i;

/** Whether z may have the unit of x and y, without which there is no angle to the horizontal. */
export function hasSlope({ unit, planeUnit, geographic, heights }: SurfaceInfo): boolean {
  // x and y of a geographic CRS are drawn in metres.
  if (planeUnit === "°") return geographic && heights && (unit === "" || METRES.test(unit));
  if (planeUnit === "" || planeUnit === "cells" || unit === "") return true;
  return unit === planeUnit || (METRES.test(unit) && METRES.test(planeUnit));
}

/** What a surface can be coloured by. */
export function fieldsOf(info: SurfaceInfo): Field[] {
  const attributes = info.attributes.flatMap(({ name, components }) => {
    const each = Array.from({ length: Math.min(components, MOST_COMPONENTS) }, (_, component) => component);
    const all: Component[] = components > 1 ? ["magnitude", ...each] : each;
    return all.map((component): Field => ({ kind: "attribute", name, component }));
  });
  const slope: Field[] = hasSlope(info) ? [{ kind: "slope" }] : [];
  return [{ kind: "height" }, ...slope, { kind: "change" }, ...attributes, { kind: "none" }];
}

/** Whether two fields are the same. */
export function sameField(a: Field, b: Field): boolean {
  if (a.kind !== "attribute" || b.kind !== "attribute") return a.kind === b.kind;
  return a.name === b.name && a.component === b.component;
}

/** How a field of a surface is called. */
export function fieldName(field: Field, info: SurfaceInfo | null): string {
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
      if ((info?.attributes.find(({ name }) => name === field.name)?.components ?? 1) === 1) return field.name;
      return field.component === "magnitude" ? `${field.name}, magnitude` : `${field.name}[${field.component}]`;
  }
}

/** The range that colours span: the one that was chosen, else that of the values. */
export function shownRange(look: Look, { range }: Colouring): [number, number] {
  return look.range === null ? rangeOf(range[0], range[1], isCentred(look.field)) : [look.range[0], look.range[1]];
}

/** What the legend says of a look; null: nothing. */
export function legendOf(
  { field, map }: Look,
  range: readonly [number, number],
  info: SurfaceInfo | null,
  fitted = false,
): LegendData | null {
  if (field.kind === "none") return null;
  const unit = info?.unit ?? "";
  const own = field.kind === "slope" ? "degrees" : field.kind === "attribute" ? "" : unit;
  const note =
    field.kind === "attribute"
      ? "Grey: no value"
      : field.kind === "slope" && fitted
        ? "If z has the unit of x and y"
        : "";
  return { title: fieldName(field, info), unit: own, map, range, note };
}
