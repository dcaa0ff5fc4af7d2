/**
 * Errors of windows: for each cell of a surface and each layer a bound of its errors, in an optional section
 * (docs/format.md, section 11). So one can tell how good a state is at some place, and how many layers suffice there.
 */

import { checkOf } from "../container/crc";
import { FieldReader } from "../container/fields";
import { wholeSection } from "../container/frames";
import type { Exponents, Header } from "../container/header";
import type { Index } from "../container/model";
import type { Read } from "../container/reader";
import { CorruptStreamError, OptionError } from "../errors";
import { checkRegion } from "../grid/support";
import type { Region } from "../types";

/** Kind of the section. */
const WINDOW_ERRORS = 128;
// A code is a step of an eighth of an octave: 2^(-k / 8) over 2^16, rounded up; the last one says that there is no error.
const STEPS = [65536, 60097, 55109, 50536, 46341, 42495, 38968, 35734];
const NOTHING = 255;

/** Bounds of the errors of each cell of a surface after each layer. */
export class WindowErrors {
  /** Rows and columns of a cell, as exponents of two. */
  readonly cell: Exponents;
  readonly #header: Header;
  readonly #codes: Uint8Array; // (cell, layer, 2), with a check of two bytes behind each cell

  constructor(header: Header, cell: Exponents, codes: Uint8Array) {
    this.#header = header;
    this.cell = cell;
    this.#codes = codes;
  }

  /**
   * What RMS and maximum error of a window of the only block do not exceed after a layer. `mask` has 1 for each valid
   * point of the block; null: all are. Throws `OptionError` where there is no such region or layer.
   */
  bounds(region: Region, layer: number, mask: Uint8Array | null = null): { rms: number; maximum: number } {
    const { blocks, shape, layerCount, extent } = this.#header;
    if (blocks.length > 1) {
      throw new OptionError(`expected a surface of one block for a region, got ${blocks.length} blocks`);
    }
    checkRegion(region, shape);
    if (!(Number.isInteger(layer) && layer >= 0 && layer < layerCount)) {
      throw new OptionError(`expected a layer of 0 to ${layerCount - 1}, got ${layer}`);
    }
    const [rows, columns] = region;
    const inside = countValid(mask, shape[1], rows[0], rows[1], columns[0], columns[1]);
    if (!inside) return { rms: 0, maximum: 0 };
    const [height, width] = [2 ** this.cell[0], 2 ** this.cell[1]];
    const across = Math.ceil(shape[1] / width);
    let [squares, worst] = [0, 0];
    for (let i = Math.floor(rows[0] / height); i * height < rows[1]; i++) {
      for (let j = Math.floor(columns[0] / width); j * width < columns[1]; j++) {
        const place = (i * across + j) * (2 * layerCount + 2) + 2 * layer;
        const bottom = Math.min((i + 1) * height, shape[0]);
        const right = Math.min((j + 1) * width, shape[1]);
        const count = countValid(mask, shape[1], i * height, bottom, j * width, right);
        squares += count * fractionOf(this.#codes[place]!) ** 2;
        worst = Math.max(worst, fractionOf(this.#codes[place + 1]!));
      }
    }
    // Rounding of these sums is far below the steps of the codes; a bound stays one all the same.
    const rms = Math.sqrt(squares / inside) * (1 + 2 ** -40);
    return { rms: Math.min(rms, worst) * extent, maximum: worst * extent };
  }
}

/** The error that a code stands for, over the surface's extent. */
function fractionOf(code: number): number {
  return code === NOTHING ? 0 : 4 * STEPS[code % 8]! * 2 ** (-16 - Math.floor(code / 8));
}

function countValid(
  mask: Uint8Array | null,
  width: number,
  top: number,
  bottom: number,
  left: number,
  right: number,
): number {
  if (mask === null) return (bottom - top) * (right - left);
  let count = 0;
  for (let row = top; row < bottom; row++) {
    for (let column = left; column < right; column++) count += mask[row * width + column]!;
  }
  return count;
}

/** The errors of windows of a container; null: it does not tell them. Throws `CorruptStreamError`. */
export async function readWindowErrors(index: Index, read: Read): Promise<WindowErrors | null> {
  const section = index.optional.find(({ kind }) => kind === WINDOW_ERRORS);
  if (!section) return null;
  const { offset, length } = section.range;
  const frame = wholeSection(await read(offset, length), offset, WINDOW_ERRORS);
  return parseWindowErrors(frame.payload, frame.payloadOffset, index.header);
}

function parseWindowErrors(payload: Uint8Array, offset: number, header: Header): WindowErrors {
  const fields = new FieldReader(payload, offset);
  const exponents = fields.byte();
  const cell: Exponents = [exponents & 15, exponents >> 4];
  let cells = 0;
  for (const { shape } of header.blocks) {
    cells += Math.ceil(shape[0] / 2 ** cell[0]) * Math.ceil(shape[1] / 2 ** cell[1]);
  }
  const size = 2 * header.layerCount;
  if (fields.left !== cells * (size + 2)) {
    throw new CorruptStreamError(`expected errors of ${cells} cells of ${size + 2} bytes, got ${fields.left}`, offset);
  }
  const codes = fields.take(fields.left);
  for (let number = 0; number < cells; number++) {
    const row = codes.subarray(number * (size + 2), (number + 1) * (size + 2));
    if (checkOf(row.subarray(0, size)) !== (row[size]! | (row[size + 1]! << 8))) {
      throw new CorruptStreamError(`expected errors of cell ${number} that match their check, got others`, offset);
    }
  }
  return new WindowErrors(header, cell, codes.slice());
}
