/** Projections by proj4js, which whoever needs them passes in. */

import { InputError } from "../errors";
import type { ForeignTransform } from "./projection";

/** What is used of proj4js: `proj4(wkt)` converts from longitudes and latitudes of WGS 84. */
export type Proj4 = (crs: string) => {
  forward(place: [number, number]): number[];
  inverse(place: [number, number]): number[];
};

/** Transforms by proj4js; without it, what needs it is refused. */
export function transformBy(proj4: Proj4 | undefined): ForeignTransform {
  const known = new Map<string, ReturnType<Proj4>>();
  return async ({ wkt, name, code }, places, back) => {
    const called = `"${name.slice(0, 80)}"${code === undefined ? "" : ` (${code.slice(0, 40)})`}`;
    if (proj4 === undefined) {
      throw new InputError(
        `expected proj4 for heights in the CRS ${called}, got none: pass it, lodeProtocol({ proj4 })`,
      );
    }
    let converter = known.get(wkt);
    if (converter === undefined) {
      try {
        converter = proj4(wkt);
      } catch (error) {
        throw new InputError(`expected a CRS that proj4 understands, got ${called}: ${String(error).slice(0, 120)}`);
      }
      known.set(wkt, converter);
    }
    const convert = back ? converter.inverse : converter.forward;
    const found = new Float64Array(places.length).fill(Number.NaN);
    for (let i = 0; i < places.length; i += 2) {
      try {
        found.set(convert([places[i]!, places[i + 1]!]), i);
      } catch {
        // There is no such place in the CRS.
      }
    }
    return found;
  };
}
