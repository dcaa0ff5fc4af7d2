/** The payloads of layers and of the residual section (docs/format.md, sections 6 and 9). */
import { CorruptStreamError } from "../errors";
import { COEFFICIENT_BITS } from "../transform/predictors";
import type { Errors } from "../types";
import { countWindows } from "./chunks";
import { FieldReader } from "./fields";
import type { Header } from "./header";
import { checkFilled } from "./limits";

// In the first byte of an entry: passes - 1 and skipped units from which on more bytes tell the rest.
const [MOST_PASSES, MOST_SKIP] = [7, 15];

/** A segment as a layer's table tells it, of so many bytes; `top` is 0 where an earlier layer told it. */
export interface Entry {
  readonly tile: number;
  readonly channel: number;
  readonly top: number;
  readonly passes: number;
  readonly length: number;
}

/** Errors, entries, and where in the payload the segments start. */
export function parseLayer(
  payload: Uint8Array,
  offset: number,
  header: Header,
): { errors: Errors; entries: Entry[]; start: number } {
  const fields = new FieldReader(payload, offset);
  const errors = fields.errors(header.channels);
  const units = header.layout.tiles.length * header.channels;
  const entries: Entry[] = [];
  let unit = 0;
  let total = 0;
  const count = fields.varint(units);
  checkFilled([count > 0], header.layerCount, offset);
  for (let left = count; left > 0; left--) {
    const start = fields.at;
    const first = fields.byte();
    let passes = (first & 7) + 1;
    if (passes > MOST_PASSES) passes += fields.varint(2 * COEFFICIENT_BITS);
    let skip = first >> 4;
    if (skip === MOST_SKIP) skip += fields.varint(units);
    const length = fields.varint();
    const told = (first & 8) !== 0;
    const top = told ? fields.byte() : 0;
    unit += skip;
    if (unit >= units || top > COEFFICIENT_BITS || length < 1 || (told && !top)) {
      throw new CorruptStreamError(
        `expected one of ${units} units and at most ${COEFFICIENT_BITS} planes, got ${unit}, ${top}`,
        start,
      );
    }
    entries.push({
      tile: Math.floor(unit / header.channels),
      channel: unit % header.channels,
      top,
      passes,
      length,
    });
    total += length;
    unit++;
  }
  if (total !== payload.length - fields.place) {
    throw new CorruptStreamError("expected segments as long as the layer's table says, got another length", offset);
  }
  return { errors, entries, start: fields.place };
}

/** A chunk's bytes and their place in the container. */
export interface PlacedBytes {
  readonly data: Uint8Array;
  readonly offset: number;
}

/** The errors that a residual section, which stands at `offset`, leaves, and its chunks. */
export function parseChunks(
  payload: Uint8Array,
  offset: number,
  header: Header,
): { errors: Errors; chunks: PlacedBytes[] } {
  const fields = new FieldReader(payload, offset);
  const errors = fields.errors(header.channels);
  const lengths: number[] = [];
  for (let left = countWindows(header) * header.channels; left > 0; left--) {
    lengths.push(fields.varint(payload.length));
  }
  const chunks = lengths.map((length): PlacedBytes => {
    const at = fields.at;
    return { data: fields.take(length), offset: at };
  });
  fields.end();
  return { errors, chunks };
}
