/** What is known of a surface beside its stream: metadata and price list, which a container has at its end. */

import { Capacity } from "../container/capacity";
import type { Header } from "../container/header";
import type { Index } from "../container/model";
import { INDEX_GROWTH, indexFrom, readMetadata } from "../container/reader";
import { FOOTER_LENGTH, type Metadata, parseFooter } from "../container/sections";
import { readWindowErrors, type WindowErrors } from "../planning/window-errors";
import { containerUrl, isSurface } from "../transfer/addresses";
import { PART, type PartReader } from "../transfer/parts";
import { attributesIn, placeOf } from "./grids";
import { periodsOf } from "./maps";
import type { Price, SurfaceInfo } from "./source";

/** Metadata and price list. */
export interface Description {
  readonly metadata: Metadata;
  readonly prices: readonly Price[] | null;
  readonly size: number;
  /** Reads the errors of windows; null where the container tells none, or an index or a section is too large. */
  windows(): Promise<WindowErrors | null>;
}

/** Nothing is known. */
export const NO_DESCRIPTION: Description = {
  metadata: {},
  prices: null,
  size: 0,
  windows: () => Promise.resolve(null),
};

/** Bytes at the end of a container that are asked for first, beside a 512th of it: footer, index and metadata of most. */
const TAIL = 2048;
/** The largest end that is asked for; larger indexes come with the stream, if at all. */
const LARGEST_TAIL = 1 << 20;

/**
 * Asks a server, or reads the end of a container.
 *
 * @param header - Of the container, once it is known.
 * @throws Error if neither works; the stream may all the same.
 */
export async function describe(
  url: string | PartReader,
  token: string | null,
  header: Promise<Header>,
): Promise<Description> {
  if (typeof url !== "string") return fromEnd(await openEnd(readingParts(url), await header));
  const headers: Record<string, string> = token === null ? {} : { authorization: `Bearer ${token}` };
  if (isSurface(url)) {
    const answer = await fetch(url, { headers });
    if (!answer.ok) throw new Error(`the server answered ${answer.status}`);
    const described = fromServer((await answer.json()) as Record<string, unknown>);
    return {
      ...described,
      windows: async () => windowsOf(await openEnd(fetching(containerUrl(url), headers), await header)),
    };
  }
  return fromEnd(await openEnd(fetching(containerUrl(url), headers), await header));
}

function fromServer({ metadata, layers, bytes }: Record<string, unknown>): Omit<Description, "windows"> {
  const prices = Array.isArray(layers) && layers.every(isPrice) ? layers : null;
  return { metadata: (metadata ?? {}) as Metadata, prices, size: typeof bytes === "number" ? bytes : 0 };
}

function isPrice(value: unknown): value is Price {
  const { bytes, level, rms, max } = (value ?? {}) as Record<string, unknown>;
  return [bytes, level, rms, max].every((number) => typeof number === "number");
}

/** A container whose end has been read. */
interface Opened {
  readonly size: number;
  /** null: it is too large to be asked for. */
  readonly index: Index | null;
  /** A part of the container, of which the end is there already. */
  read(offset: number, length: number): Promise<Uint8Array>;
}

/** Bytes `first` to `past` of a container, and how many it has. @throws Error if they cannot be had. */
type Reading = (first: number, past: number) => Promise<{ readonly data: Uint8Array; readonly size: number }>;

function fetching(url: string, headers: Record<string, string>): Reading {
  return async (first, past) => {
    const range = { range: `bytes=${first}-${past - 1}` };
    const answer = await fetch(url, { headers: { ...headers, ...range }, cache: "no-store" });
    const size = Number(/\/(\d{1,15})$/.exec(answer.headers.get("content-range") ?? "")?.[1] ?? Number.NaN);
    if (answer.status !== 206 || Number.isNaN(size)) {
      void answer.body?.cancel();
      throw new Error(`expected a part of the container, got ${answer.status}`);
    }
    return { data: await bytesOf(answer, past - first), size };
  };
}

function readingParts(read: PartReader): Reading {
  return async (first, past) => {
    const all = new Uint8Array(past - first);
    for (let at = 0; ; ) {
      const { data, size } = await read(first + at, Math.min(PART, all.length - at));
      if (data.length === 0) throw new Error(`expected ${all.length} bytes of the container, got ${at}`);
      all.set(data, at);
      at += data.length;
      if (at === all.length) return { data: all, size };
    }
  };
}

async function openEnd(part: Reading, header: Header): Promise<Opened> {
  const { size } = await part(0, 1);
  let first = Math.max(0, size - Math.min(TAIL + Math.ceil(size / 512), LARGEST_TAIL));
  let { data } = await part(first, size);
  const footer = parseFooter(data.subarray(data.length - FOOTER_LENGTH), size - FOOTER_LENGTH);
  // The metadata stand right before the index and have at most 64 KiB.
  const start = Math.max(0, footer.index.offset - (1 << 16) - 32);
  const read = async (offset: number, length: number): Promise<Uint8Array> => {
    if (offset >= start && offset < first) {
      data = (await part(offset, size)).data;
      first = offset;
    }
    return offset < first
      ? (await part(offset, offset + length)).data
      : data.subarray(offset - first, offset - first + length);
  };
  if (first > footer.index.offset && size - start > LARGEST_TAIL) return { size, index: null, read };
  // A header of a few bytes can announce any number of tiles, all of which an index lists.
  const capacity = new Capacity();
  capacity.promise(0, [], { masked: 0, tables: header.tables });
  capacity.take(INDEX_GROWTH * footer.index.length);
  const index = indexFrom(await read(footer.index.offset, footer.index.length), footer.index.offset, header);
  return { size, index, read };
}

async function fromEnd(opened: Opened): Promise<Description> {
  const { size, index, read } = opened;
  if (index === null) return { ...NO_DESCRIPTION, size };
  const metadata = readMetadata(await read(index.metadata.offset, index.metadata.length), index.metadata.offset);
  const last = index.layers.at(-1);
  const prices: Price[] = index.layers.map(({ end, level, errors }) => ({
    bytes: end,
    level,
    rms: errors.rms,
    max: errors.maximum,
  }));
  if (index.residual !== null && last !== undefined) {
    const { errors, level } = index.levels.at(-1)!;
    prices.push({ bytes: index.surfaceEnd, level, rms: errors.rms, max: errors.maximum });
  }
  return { metadata, prices, size, windows: () => windowsOf(opened) };
}

async function windowsOf({ index, read }: Opened): Promise<WindowErrors | null> {
  if (index === null) return null;
  return readWindowErrors(index, (offset, length) => {
    if (length > LARGEST_TAIL) throw new Error(`expected errors of windows of at most ${LARGEST_TAIL} bytes`);
    return read(offset, length);
  });
}

/** The body of an answer. @throws Error if it is not of this length: what is longer is not read. */
async function bytesOf(answer: Response, length: number): Promise<Uint8Array> {
  const data = new Uint8Array(length);
  const reader = answer.body?.getReader();
  let at = 0;
  for (;;) {
    const { value } = (await reader?.read()) ?? {};
    if (value === undefined) break;
    if (value.length > length - at) {
      void reader?.cancel();
      throw new Error(`expected ${length} bytes of the container, got more`);
    }
    data.set(value, at);
    at += value.length;
  }
  if (at < length) throw new Error(`expected ${length} bytes of the container, got ${at}`);
  return data;
}

/** A CRS in WKT whose coordinates are degrees. */
const GEOGRAPHIC = /^\s*GEO(GCS|GCRS|DCRS|GRAPHICCRS)/i;

/** Whether x goes on by 360 along a closed axis of heights. */
function goesRound(header: Header, metadata: Metadata): boolean {
  try {
    return header.closed.some((closed, axis) => {
      const last = header.shape[axis]! - 1;
      if (!closed || last < 1) return false;
      const [from] = placeOf(metadata, header, 0, 0);
      const [to] = axis === 0 ? placeOf(metadata, header, last, 0) : placeOf(metadata, header, 0, last);
      return Math.abs((Math.abs(to - from) * (last + 1)) / last - 360) * last < 180;
    });
  } catch {
    return false; // metadata of anybody, of which drawing will say what is wrong
  }
}

/** The unit of x and y, as far as a CRS, angles, or columns that go once round the Earth tell it. */
function planeUnitOf(header: Header, metadata: Metadata): string {
  const crs = typeof metadata.crs === "string" ? metadata.crs : "";
  const [x, y] = periodsOf(metadata);
  if (GEOGRAPHIC.test(crs) || x === 360 || y === 360) return "°";
  const isField = header.pointChannels === 1 && header.blocks.length === 1;
  if (!isField || header.plane !== null) return typeof metadata.unit === "string" ? metadata.unit : "";
  if (metadata.axes === undefined && (metadata.geotransform ?? null) === null) return "cells";
  if (goesRound(header, metadata)) return "°";
  // The unit of a projected CRS is that of its axes, the last one that is named.
  const units = /^\s*PROJ/i.test(crs) ? [...crs.matchAll(/\b(?:LENGTH)?UNIT\s*\[\s*"([^"]{1,40})"/gi)] : [];
  const named = units.at(-1)?.[1] ?? "";
  return /^(metre|meter|m)$/i.test(named) ? "m" : named;
}

/** The description of a surface for those who look at it. */
export function infoOf(header: Header, { metadata, prices, size }: Omit<Description, "windows">): SurfaceInfo {
  const text = (key: string): string => {
    const value = metadata[key];
    return typeof value === "string" ? value : "";
  };
  const heights = header.pointChannels === 1 && header.blocks.length === 1;
  const georeferenced =
    heights && (header.plane !== null || metadata.axes !== undefined || (metadata.geotransform ?? null) !== null);
  return {
    name: text("name"),
    blocks: header.blocks.map(({ shape, closed }) => ({ shape, closed })),
    levels: header.levels,
    extent: header.extent,
    heights,
    georeferenced,
    geographic: heights && GEOGRAPHIC.test(text("crs")),
    mapped: georeferenced && text("crs") !== "",
    joined: header.arrangement !== null,
    unit: text("unit"),
    planeUnit: planeUnitOf(header, metadata),
    // What a mesh was resampled into comes back exactly, and is not the mesh.
    exact: header.exact && metadata.remesh === undefined,
    attributes: attributesIn(header),
    size,
    prices,
  };
}
