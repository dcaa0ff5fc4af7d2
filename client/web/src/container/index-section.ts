/**
 * The index: a root, which tells where all sections and pages stand, and pages, which tell it of segments and chunks
 * (docs/format.md, section 11).
 *
 * A page tells of a run of tiles, or of windows of the residual, and needs no other to be understood.
 */
import { CorruptStreamError } from "../errors";
import { COEFFICIENT_BITS } from "../transform/predictors";
import type { ByteRange, Chunk, Errors, LayerRecord, OptionalSection, Segment } from "../types";
import { countWindows } from "./chunks";
import { crc32 } from "./crc";
import { FieldReader } from "./fields";
import type { Frame } from "./frames";
import type { Header } from "./header";
import { checkCount, checkFilled, LIMITS } from "./limits";
import { Index } from "./model";
import { checkMetadataLength, FOOTER_LENGTH, OPTIONAL, sectionStart, WINDOW_ERRORS } from "./sections";

/** Tiles, or windows of the residual, that a page tells of. */
export const PAGE = 256;
// In the first byte of an entry: passes - 1 and layers skipped from which on more bytes tell the rest.
const [MOST_PASSES, MOST_SKIP] = [7, 31];
const CRC = 4; // bytes at the end of a section

/** A page by its place in the container and its CRC-32, which stands at `told` of the container. */
export interface PagePlace {
  readonly range: ByteRange;
  readonly crc: number;
  readonly told: number;
}

/** What the root tells; of segments and chunks it names the pages only. `index` is the place of pages and root. */
export interface Root {
  readonly layers: readonly { readonly range: ByteRange; readonly errors: Errors }[];
  readonly levels: readonly Errors[];
  readonly residual: ByteRange | null;
  readonly metadata: ByteRange;
  readonly optional: readonly OptionalSection[];
  readonly segmentPages: readonly PagePlace[];
  readonly chunkPages: readonly PagePlace[];
  readonly index: ByteRange;
}

const endOf = (range: ByteRange): number => range.offset + range.length;

/** The root of the index of a container with this header, from its section. */
export function parseRoot(frame: Frame, header: Header): Root {
  const fields = new FieldReader(frame.payload, frame.payloadOffset);
  const lengths: { length: number; errors: Errors }[] = [];
  for (let left = toldCount(fields, header.layerCount, "layers"); left > 0; left--) {
    const length = fields.varint();
    lengths.push({ length, errors: fields.errors(header.channels) });
  }
  const levels: Errors[] = [];
  for (let left = toldCount(fields, header.levels + 1, "levels"); left > 0; left--) {
    levels.push(fields.errors(header.channels));
  }
  const start = fields.varint();
  const residual = fields.varint();
  const said = fields.at;
  const metadataLength = fields.varint();
  checkMetadataLength(metadataLength, said, true);
  const optional = parseOptional(fields);
  const counts = [pagesFor(header.layout.tiles.length), residual ? pagesFor(countWindows(header)) : 0];
  const directories = counts.map((count) => parseDirectory(fields, count));
  fields.end();
  const least = emptyLayer(header.channels);
  const filled = lengths.map(({ length }) => length > least);
  checkFilled(filled, lengths.length, frame.offset);

  const places = new Places(start, optional);
  const layers = lengths.map(({ length, errors }) => ({ range: places.next(length), errors }));
  const exact = residual ? places.next(residual) : null;
  const metadata = places.next(metadataLength);
  const pages = places.end();
  if (start !== header.length || (exact !== null) !== header.corrected) {
    throw new CorruptStreamError("expected an index of the layers and levels of the header, got another", frame.offset);
  }
  let length = 0;
  for (const directory of directories) for (const page of directory) length += page.length;
  let first = pages + sectionStart(length);
  if (places.left || first + length + CRC !== frame.offset) {
    throw new CorruptStreamError("expected sections that fill the container up to its index, got others", frame.offset);
  }
  const found = directories.map((directory) =>
    directory.map((page): PagePlace => {
      const range = { offset: first, length: page.length };
      first += page.length;
      return { range, crc: page.crc, told: page.told };
    }),
  );
  return {
    layers,
    levels,
    residual: exact,
    metadata,
    optional,
    segmentPages: found[0]!,
    chunkPages: found[1]!,
    index: { offset: pages, length: frame.end - pages },
  };
}

/** The index of a container with this header, from its two sections. */
export function parseIndex(pages: Frame, root: Frame, header: Header): Index {
  const told = parseRoot(root, header);
  if (pages.offset !== told.index.offset || pages.end !== root.offset) {
    throw new CorruptStreamError("expected the pages of an index before its root, got others", pages.offset);
  }
  const ranges = told.layers.map((layer) => layer.range);
  const segments = parseSegments(pagesOf(pages, told.segmentPages), header, ranges);
  checkFilled(
    segments.map((own) => own.length > 0),
    segments.length,
    pages.offset,
  );
  let finest = 0;
  const layers = told.layers.map(({ range, errors }, number): LayerRecord => {
    for (const segment of segments[number]!) finest = Math.max(finest, header.layout.tiles[segment.tile]!.level);
    return { number, offset: range.offset, end: endOf(range), level: finest, errors };
  });
  return new Index({
    header,
    layers,
    levelErrors: told.levels,
    segments: segments.flat(),
    residual: told.residual,
    chunks: told.residual ? parseChunkList(pagesOf(pages, told.chunkPages), header, told.residual) : [],
    metadata: told.metadata,
    index: told.index,
    size: root.end + FOOTER_LENGTH,
    optional: told.optional,
  });
}

function pagesFor(things: number): number {
  return Math.ceil(things / PAGE);
}

/** Places of sections one after another, with optional ones anywhere between them. */
class Places {
  #place: number;
  readonly #optional: OptionalSection[];

  constructor(start: number, optional: readonly OptionalSection[]) {
    this.#place = start;
    this.#optional = [...optional].reverse();
  }

  /** Optional sections that stand nowhere between the others. */
  get left(): number {
    return this.#optional.length;
  }

  /** Where the sections end that were taken, and optional ones after them. */
  end(): number {
    for (let next = this.#optional.at(-1); next?.range.offset === this.#place; next = this.#optional.at(-1)) {
      this.#place += next.range.length;
      this.#optional.pop();
    }
    return this.#place;
  }

  /** The place of the next section, which is so long. */
  next(length: number): ByteRange {
    const place = { offset: this.end(), length };
    this.#place = endOf(place);
    return place;
  }
}

/** A count that is known already, so that nothing is read by another. */
function toldCount(fields: FieldReader, count: number, what: string): number {
  const start = fields.at;
  const told = fields.varint();
  if (told !== count) throw new CorruptStreamError(`expected ${count} ${what} of an index, got ${told}`, start);
  return told;
}

/** Bytes of the section of a layer that has no segments. */
function emptyLayer(channels: number): number {
  const payload = 8 + (channels > 1 ? 4 * channels : 0) + 1; // errors, the number of segments
  return sectionStart(payload) + payload + CRC;
}

function parseOptional(fields: FieldReader): OptionalSection[] {
  const start = fields.at;
  const count = fields.varint();
  checkCount(count, LIMITS.optional, "optional sections", start);
  const found: OptionalSection[] = [];
  for (let left = count; left > 0; left--) {
    const at = fields.at;
    const kind = fields.byte();
    const range = { offset: fields.varint(), length: fields.varint() };
    if (kind < OPTIONAL || range.length < 6) {
      throw new CorruptStreamError(`expected an optional section, got kind ${kind} of ${range.length} bytes`, at);
    }
    found.push({ kind, range });
  }
  const windows = found.filter(({ kind }) => kind === WINDOW_ERRORS).length;
  checkCount(windows, 1, "sections of errors of windows", start);
  return found;
}

/** Length and CRC-32 of each page, and where that stands. */
function parseDirectory(fields: FieldReader, count: number): { length: number; crc: number; told: number }[] {
  const found: { length: number; crc: number; told: number }[] = [];
  for (let left = toldCount(fields, count, "pages"); left > 0; left--) {
    const length = fields.varint();
    const told = fields.at;
    found.push({ length, crc: fields.u32(), told });
  }
  return found;
}

/** Pages out of their section, each checked by its CRC. */
function pagesOf(frame: Frame, places: readonly PagePlace[]): FieldReader[] {
  return places.map(({ range, crc }) => {
    const start = range.offset - frame.payloadOffset;
    const page = frame.payload.subarray(start, start + range.length);
    if (crc32(page) !== crc) {
      throw new CorruptStreamError("expected a page that matches its CRC, got other bytes", range.offset);
    }
    return new FieldReader(page, range.offset);
  });
}

/** The segments of each layer, by rising number of the unit. */
function parseSegments(pages: readonly FieldReader[], header: Header, layers: readonly ByteRange[]): Segment[][] {
  const tiles = header.layout.tiles.length;
  const found: Segment[][] = layers.map(() => []);
  const ends = layers.map((range) => endOf(range) - CRC);
  let expected: number[] | null = null;
  pages.forEach((fields, number) => {
    const start = fields.at;
    // Segments fill the end of a layer's section, before its CRC.
    const at = layers.map((range, layer) => ends[layer]! - fields.varint(range.length));
    const inside = layers.every((range, layer) => at[layer]! >= range.offset);
    if (!inside || expected?.some((place, layer) => place !== at[layer])) {
      throw new CorruptStreamError("expected segments within their layers, one after another, got others", start);
    }
    const units = Math.min(tiles - number * PAGE, PAGE) * header.channels;
    parseUnits(fields, number * PAGE * header.channels, units, header.channels, at, found);
    if (at.some((place, layer) => place > ends[layer]!)) {
      throw new CorruptStreamError("expected segments that fill their layers, got longer ones", start);
    }
    expected = at;
  });
  const last: readonly number[] | null = expected;
  if (last === null || ends.some((end, layer) => end !== last[layer])) {
    throw new CorruptStreamError("expected segments that fill their layers, got shorter ones", header.length);
  }
  return found;
}

/** The units of a page; `at` is where the next segment of each layer stands. */
function parseUnits(
  fields: FieldReader,
  first: number,
  units: number,
  channels: number,
  at: number[],
  found: Segment[][],
): void {
  let unit = 0;
  while (fields.left) {
    const start = fields.at;
    const count = fields.varint(at.length);
    if (!count) {
      unit += 1 + fields.varint(units);
      continue;
    }
    const tile = Math.floor((first + unit) / channels);
    const channel = (first + unit) % channels;
    const top = fields.byte();
    let layer = -1;
    let left = 2 * top - 1;
    if (unit >= units || top < 1 || top > COEFFICIENT_BITS) {
      throw new CorruptStreamError(
        `expected one of ${units} units and 1 to ${COEFFICIENT_BITS} planes, got ${unit}, ${top}`,
        start,
      );
    }
    for (let k = 0; k < count; k++) {
      const code = fields.byte();
      let passes = (code & 7) + 1;
      let skip = code >> 3;
      if (passes > MOST_PASSES) passes += fields.varint(2 * COEFFICIENT_BITS);
      if (skip === MOST_SKIP) skip += fields.varint(at.length);
      layer += 1 + skip;
      left -= passes;
      const length = fields.varint();
      const check = fields.u16();
      if (layer >= at.length || left < 0 || !length) {
        throw new CorruptStreamError(`expected passes and layers of unit ${first + unit}, got others`, start);
      }
      found[layer]!.push({ layer, tile, channel, top, passes, range: { offset: at[layer]!, length }, check });
      at[layer]! += length;
    }
    unit++;
  }
  if (unit > units) throw new CorruptStreamError(`expected ${units} units, got ${unit}`, fields.at);
}

/** The chunks of the residual section. */
function parseChunkList(pages: readonly FieldReader[], header: Header, residual: ByteRange): Chunk[] {
  const count = countWindows(header) * header.channels;
  const found: Chunk[] = [];
  let at = -1;
  const end = endOf(residual) - CRC;
  for (const fields of pages) {
    const start = fields.at;
    // Chunks fill the end of their section, before its CRC.
    const first = end - fields.varint(residual.length);
    if (first < residual.offset || (at !== -1 && at !== first)) {
      throw new CorruptStreamError("expected chunks within their section, one after another, got others", start);
    }
    at = first;
    for (let left = Math.min(PAGE * header.channels, count - found.length); left > 0; left--) {
      const length = fields.varint(residual.length);
      const check = length ? fields.u16() : 0;
      found.push({ range: { offset: at, length }, check });
      at += length;
    }
    fields.end();
  }
  if (at !== end) {
    throw new CorruptStreamError("expected chunks that fill their section, got others", residual.offset);
  }
  return found;
}
