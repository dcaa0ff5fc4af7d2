/** Addresses of the protocol: `lode://` before the address of a container, and what is wanted of it. */

import { OptionError } from "../errors";
import { sourceUrl } from "../transfer/addresses";
import { ENCODINGS, type Encoding } from "./encodings";
import type { Tile } from "./tile-grid";

/** Pixels along an edge of a tile. */
const SIZES = [256, 512];

/** What a query says beside that of the container. */
const OWN = ["encoding", "size", "nodata", "scale"] as const;

/** What is wanted of a container. */
export interface Wanted {
  /** Address of the container, or what else `connect` takes. */
  readonly url: string;
  readonly encoding: Encoding;
  readonly size: number;
  /** Metres where there are no heights. */
  readonly nodata: number;
  /** Metres upwards of one unit of the heights; undefined: as the container says. */
  readonly scale: number | undefined;
  /** What the query says of this, for addresses of tiles. */
  readonly query: readonly string[];
}

/**
 * Read the address of a source, without the numbers of a tile.
 *
 * @param base What a relative address refers to; in a page the page's own.
 * @throws OptionError if it is no address, or says something that there is not.
 */
export function sourceOf(address: string, base: string | undefined): Wanted {
  const rest = address.slice(address.indexOf("://") + 3);
  const [whole, hash = ""] = rest.split(/(?=#)/, 2) as [string, string?];
  const [path, query] = divided(whole);
  const said = query === "" ? [] : query.split("&");
  const isOwn = (part: string): boolean => (OWN as readonly string[]).includes(part.split("=", 1)[0]!);
  const foreign = said.filter((part) => !isOwn(part));
  const own = said.filter(isOwn);
  const values = new URLSearchParams(own.join("&"));
  const url = sourceUrl(path + (foreign.length > 0 ? `?${foreign.join("&")}` : "") + hash, base);
  const encoding = values.get("encoding") ?? "terrain-rgb";
  if (!(ENCODINGS as string[]).includes(encoding)) {
    throw new OptionError(
      `expected an encoding of ${ENCODINGS.join(", ")}, got ${JSON.stringify(encoding.slice(0, 40))}`,
    );
  }
  const size = numberOf(values, "size") ?? SIZES[0]!;
  if (!SIZES.includes(size)) throw new OptionError(`expected tiles of ${SIZES.join(" or ")} pixels, got ${size}`);
  const nodata = numberOf(values, "nodata") ?? 0;
  return { url, encoding: encoding as Encoding, size, nodata, scale: numberOf(values, "scale"), query: own };
}

/**
 * Read the address of a tile: that of a source, and `/z/x/y` at the end of its path.
 *
 * @throws OptionError as `sourceOf`, or if there are no such numbers.
 */
export function tileOf(address: string, base: string | undefined): { wanted: Wanted; tile: Tile } {
  const [path, query] = divided(address);
  const found = /^(.*)\/(\d{1,2})\/(\d{1,10})\/(\d{1,10})$/.exec(path);
  if (found === null) {
    throw new OptionError(`expected the address of a tile, lode://CONTAINER/{z}/{x}/{y}, got ${address.slice(0, 200)}`);
  }
  const [z, x, y] = found.slice(2).map(Number) as [number, number, number];
  return { wanted: sourceOf(query === "" ? found[1]! : `${found[1]}?${query}`, base), tile: { z, x, y } };
}

/** The address of the tiles of a container that was found there, with {z}, {x} and {y}. */
export function templateOf(scheme: string, url: string, query: readonly string[]): string {
  const [path, foreign] = divided(url);
  const all = [foreign, ...query].filter((part) => part !== "");
  return `${scheme}://${path}/{z}/{x}/{y}${all.length > 0 ? `?${all.join("&")}` : ""}`;
}

/** Before and after the first question mark. */
function divided(address: string): readonly [string, string] {
  const at = address.indexOf("?");
  return at < 0 ? [address, ""] : [address.slice(0, at), address.slice(at + 1)];
}

function numberOf(values: URLSearchParams, name: string): number | undefined {
  const text = values.get(name);
  if (text === null) return undefined;
  const number = Number(text);
  if (text.trim() !== "" && Number.isFinite(number)) return number;
  throw new OptionError(`expected a number as ${name}, got ${JSON.stringify(text.slice(0, 40))}`);
}
