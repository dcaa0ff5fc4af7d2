/** What the WKT of a CRS (either version) says of itself, without a library of projections. */

import { InputError } from "../errors";

/** A part of a WKT: `KEYWORD[value, ...]`. A word without brackets is one without values. */
interface Part {
  readonly keyword: string;
  readonly values: readonly (string | Part)[];
  /** As it is written. */
  readonly text: string;
}

/** What is known of a CRS. */
export interface Crs {
  /** WKT of its horizontal part, which is all of it unless it is a compound one. */
  readonly flat: string;
  /** Of the horizontal part, for people. */
  readonly name: string;
  /** Such as EPSG:4326; undefined: it does not say. */
  readonly code: string | undefined;
  /** Whether x and y are degrees. */
  readonly degrees: boolean;
  /** Metres upwards of one unit of its heights, negative for depths; undefined if it has no vertical axis. */
  readonly vertical: number | undefined;
}

/** No CRS has a longer one. */
const LONGEST = 1 << 16;
const DEEPEST = 32;

const COMPOUND = ["COMPOUNDCRS", "COMPD_CS"];
const VERTICAL = ["VERTCRS", "VERTICALCRS", "VERT_CS"];
const GEOGRAPHIC = ["GEOGCRS", "GEOGRAPHICCRS", "GEODCRS", "GEODETICCRS", "GEOGCS"];
const PROJECTED = ["PROJCRS", "PROJECTEDCRS", "PROJCS"];
const UNITS = ["ANGLEUNIT", "LENGTHUNIT", "UNIT"];
const DATUMS = ["DATUM", "GEODETICDATUM", "TRF", "ENSEMBLE"];
/** Names of the datum of GPS, without what is no letter and no digit. */
const WGS84 = /^(d?wgs(19)?84(ensemble)?|worldgeodeticsystem1984(ensemble)?)$/;

/**
 * Read a CRS.
 *
 * @throws InputError if this is no WKT, or none of a CRS on the Earth's surface.
 */
export function readCrs(wkt: string): Crs {
  let whole = parsed(wkt);
  while (whole.keyword === "BOUNDCRS") whole = child(child(whole, ["SOURCECRS"]), [...GEOGRAPHIC, ...PROJECTED]);
  const isCompound = COMPOUND.includes(whole.keyword);
  const flat = isCompound ? child(whole, [...GEOGRAPHIC, ...PROJECTED]) : whole;
  const isGeographic = GEOGRAPHIC.includes(flat.keyword);
  const name = typeof flat.values[0] === "string" ? flat.values[0] : "";
  if (!isGeographic && !PROJECTED.includes(flat.keyword)) {
    throw new InputError(
      `expected a CRS on the Earth's surface, got ${flat.keyword.slice(0, 40)} "${name.slice(0, 60)}"`,
    );
  }
  if (parts(flat).some(({ keyword }) => keyword === "DERIVINGCONVERSION")) {
    throw new InputError(`expected a CRS that is no derived one, got "${name.slice(0, 60)}"`);
  }
  const degrees = isGeographic && Math.abs(unitOf(flat) - Math.PI / 180) < 1e-9;
  if (isGeographic && !degrees)
    throw new InputError(`expected a geographic CRS in degrees, got "${name.slice(0, 60)}"`);
  return { flat: flat.text, name, code: codeOf(flat, isGeographic), degrees, vertical: verticalOf(whole) };
}

/** Its identifier; of one that has none, but whose degrees are those of WGS 84, EPSG:4326. */
function codeOf(flat: Part, isGeographic: boolean): string | undefined {
  const id = parts(flat).find(({ keyword }) => keyword === "ID" || keyword === "AUTHORITY");
  if (id !== undefined) return id.values.slice(0, 2).map(word).join(":").toUpperCase();
  if (!isGeographic) return undefined;
  const datum = parts(flat).find(({ keyword }) => DATUMS.includes(keyword));
  const meridian = parts(flat).find(({ keyword }) => keyword === "PRIMEM");
  const isGreenwich = meridian === undefined || Number(word(meridian.values[1])) === 0;
  const called = word(datum?.values[0])
    .toLowerCase()
    .replace(/[^a-z0-9]/g, "");
  return isGreenwich && WGS84.test(called) ? "EPSG:4326" : undefined;
}

function verticalOf(whole: Part): number | undefined {
  const owner = COMPOUND.includes(whole.keyword) ? parts(whole).find((part) => VERTICAL.includes(part.keyword)) : whole;
  if (owner === undefined) return undefined;
  const axis = parts(owner).find((part) => part.keyword === "AXIS" && /^(up|down)$/i.test(word(part.values[1])));
  if (axis === undefined) return undefined;
  const metres = unitIn(axis) ?? unitOf(owner);
  return /^down$/i.test(word(axis.values[1])) ? -metres : metres;
}

/** Metres or radians of the unit of a CRS: its own, or that of its first axis; 1 if it has none. */
function unitOf(crs: Part): number {
  const axis = parts(crs).find(({ keyword }) => keyword === "AXIS");
  return unitIn(crs) ?? (axis === undefined ? undefined : unitIn(axis)) ?? 1;
}

function unitIn(owner: Part): number | undefined {
  const unit = parts(owner).find(({ keyword }) => UNITS.includes(keyword));
  const factor = Number(word(unit?.values[1]));
  return unit !== undefined && factor > 0 ? factor : undefined;
}

function parts(owner: Part): Part[] {
  return owner.values.filter((value) => typeof value !== "string");
}

function child(owner: Part, keywords: readonly string[]): Part {
  const found = parts(owner).find(({ keyword }) => keywords.includes(keyword));
  if (found === undefined) throw new InputError(`expected a CRS within ${owner.keyword}, got none`);
  return found;
}

function word(value: string | Part | undefined): string {
  return value === undefined ? "" : typeof value === "string" ? value : value.keyword;
}

const TOKEN = /\s*(?:"((?:[^"]|"")*)"|([^\s",[\]()]+)|([[(])|([\])])|(,))/y;

function parsed(wkt: string): Part {
  if (wkt.length > LONGEST) throw new InputError("expected the WKT of a CRS, got a longer text");
  let place = 0;
  const next = (): { text?: string; word?: string; mark: string } => {
    TOKEN.lastIndex = place;
    const found = TOKEN.exec(wkt);
    if (found === null) throw new InputError(`expected the WKT of a CRS, got "${wkt.slice(0, 60)}"`);
    place = TOKEN.lastIndex;
    const [, text, bare] = found;
    if (text !== undefined) return { text: text.replaceAll('""', '"'), mark: "" };
    return bare === undefined ? { mark: found[0].trim() } : { word: bare, mark: "" };
  };
  const part = (depth: number, start: number, keyword: string): Part => {
    const values: (string | Part)[] = [];
    for (;;) {
      const begin = place;
      const { text, word: bare, mark } = next();
      if (text !== undefined) values.push(text);
      else if (bare !== undefined) {
        const after = place;
        const follows = next();
        if (/^[[(]$/.test(follows.mark) && depth < DEEPEST) {
          const lead = /^\s*/.exec(wkt.slice(begin, after))![0].length;
          values.push(part(depth + 1, begin + lead, bare.toUpperCase()));
        } else {
          place = after;
          values.push({ keyword: bare, values: [], text: bare });
        }
      } else throw new InputError(`expected the WKT of a CRS, got "${wkt.slice(0, 60)}"`);
      const { mark: end } = next();
      if (end === "]" || end === ")") return { keyword, values, text: wkt.slice(start, place) };
      if (end !== "," || mark !== "") throw new InputError(`expected the WKT of a CRS, got "${wkt.slice(0, 60)}"`);
    }
  };
  const { word: keyword = "" } = next();
  const { mark } = next();
  if (keyword === "" || !/^[[(]$/.test(mark))
    throw new InputError(`expected the WKT of a CRS, got "${wkt.slice(0, 60)}"`);
  return part(0, 0, keyword.toUpperCase());
}
