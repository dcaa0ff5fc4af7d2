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
import { WINDOW_ERRORS } from "../container/sections";
import { CorruptStreamError, OptionError } from "../errors";
import { checkRegion, spansOf } from "../grid/window";
import type { ByteRange, Region, Span, Target } from "../types";

// A code is a step of an eighth of an octave: 2^(-k / 8) over 2^16, rounded up; the last one says that there is no error.
const STEPS = [65536, 60097, 55109, 50536, 46341, 42495, 38968, 35734];
const NOTHING = 255;
// A section that is more of the container than this part of it costs a window more than it can save.
const MOST_SHARE = 8;
// Rounding of sums, quotients and roots is far below the steps of the codes; a bound stays one all the same.
const UPWARDS = 1 + 2 ** -40;

/** Bounds of RMS and maximum error. */
export interface Figures {
  readonly rms: number;
  readonly maxError: number;
}

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
    checkRegion(region, shape, blocks[0]!.closed);
    if (!(Number.isInteger(layer) && layer >= 0 && layer < layerCount)) {
      throw new OptionError(`expected a layer of 0 to ${layerCount - 1}, got ${layer}`);
    }
    let inside = 0;
    for (const rows of spansOf(region[0], shape[0])) {
      for (const columns of spansOf(region[1], shape[1])) {
        inside += countValid(mask, shape[1], rows[0], rows[1], columns[0], columns[1]);
      }
    }
    if (!inside) return { rms: 0, maximum: 0 };
    const { squares, worst } = this.sums(region, layer, mask);
    const rms = Math.sqrt(squares / inside) * UPWARDS;
    return { rms: Math.min(rms, worst) * extent, maximum: worst * extent };
  }

  /**
   * Of the cells that a window of the only block touches, after a layer: what the squared errors add up to at most, and
   * the largest error, over the surface's extent. `mask` as for `bounds`.
   */
  sums(region: Region, layer: number, mask: Uint8Array | null): { squares: number; worst: number } {
    const { shape, layerCount } = this.#header;
    const [height, width] = [2 ** this.cell[0], 2 ** this.cell[1]];
    const across = Math.ceil(shape[1] / width);
    let [squares, worst] = [0, 0];
    const columns = touched(region[1], shape[1], width);
    for (const i of touched(region[0], shape[0], height)) {
      for (const j of columns) {
        const place = (i * across + j) * (2 * layerCount + 2) + 2 * layer;
        const bottom = Math.min((i + 1) * height, shape[0]);
        const right = Math.min((j + 1) * width, shape[1]);
        const count = countValid(mask, shape[1], i * height, bottom, j * width, right);
        squares += count * fractionOf(this.#codes[place]!) ** 2;
        worst = Math.max(worst, fractionOf(this.#codes[place + 1]!));
      }
    }
    return { squares, worst };
  }
}

/**
 * What the errors of a window do not exceed, wherever those of the whole surface are known.
 *
 * A maximum of the whole holds in each part. The squares of all errors are at least those of a part, so the RMS of n of N
 * vertices is at most sqrt(N / n) times that of all. Bounds of the cells of the window, where the container has them, are
 * nearer. Masks are not looked at, so that whoever plans need not decode them: all holes may lie in the window. Servers
 * make the same plans, so every sum is added up in the order of the cells.
 */
export class WindowFigures {
  /** Whether the window is all of the surface. */
  readonly whole: boolean;
  readonly #region: Region;
  readonly #windows: WindowErrors | null;
  readonly #extent: number;
  readonly #least: number; // valid points that the window has at least
  readonly #root: number;

  /** `header` is of one block, with the number of its holes. Throws `OptionError` where there is no such region. */
  constructor(header: Header, region: Region, windows: WindowErrors | null = null) {
    checkRegion(region, header.shape, header.blocks[0]!.closed);
    this.#region = region;
    this.#windows = windows;
    this.#extent = header.extent;
    let holes = 0;
    for (const count of header.masks.holes) holes += count;
    const points = header.shape[0] * header.shape[1];
    const inside = (region[0][1] - region[0][0]) * (region[1][1] - region[1][0]);
    this.whole = inside === points;
    // Points of a surface that touches itself are not all vertices: how many a window has is not counted.
    this.#least = header.arrangement ? 0 : Math.max(inside - holes, 0);
    this.#root = this.#least ? Math.sqrt((points - holes) / this.#least) * UPWARDS : Number.POSITIVE_INFINITY;
  }

  /** From errors of the whole surface, and the layer whose they are, if it is one; NaN where they are not known. */
  within(of: Figures, layer?: number): Figures {
    let { rms, maxError } = of;
    if (Number.isNaN(rms) || this.whole) return { rms, maxError };
    rms = rms ? rms * this.#root : 0;
    if (layer !== undefined && this.#windows !== null) {
      const { squares, worst } = this.#windows.sums(this.#region, layer, null);
      maxError = Math.min(maxError, worst * this.#extent);
      if (this.#least) rms = Math.min(rms, Math.sqrt(squares / this.#least) * UPWARDS * this.#extent);
    }
    return { rms: Math.min(rms, maxError), maxError };
  }
}

/** The error that a code stands for, over the surface's extent. */
function fractionOf(code: number): number {
  return code === NOTHING ? 0 : 4 * STEPS[code % 8]! * 2 ** (-16 - Math.floor(code / 8));
}

/** The cells of so many samples of an axis that a window touches, increasing; one at both of its ends counts once. */
function touched(span: Span, length: number, size: number): number[] {
  const cells = new Set<number>();
  for (const [start, stop] of spansOf(span, length)) {
    for (let cell = Math.floor(start / size); cell * size < stop; cell++) cells.add(cell);
  }
  return [...cells].sort((a, b) => a - b);
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

/**
 * Whether a target needs the bounds of the errors of windows: that of a window at full resolution. That of a coarser level
 * has no limits that they could meet sooner, and often takes fewer bytes than they do.
 */
export function wantsWindowErrors(target: Target, header: Header): boolean {
  return target.region !== undefined && (target.level ?? header.levels) === header.levels;
}

/** Where a container tells errors of windows; null where it does not, or at a length that is not worth it. */
export function windowSection(index: Index): ByteRange | null {
  const range = index.optional.find(({ kind }) => kind === WINDOW_ERRORS)?.range;
  return range !== undefined && range.length <= Math.floor(index.size / MOST_SHARE) ? range : null;
}

/** The errors of windows of a container; null: it does not tell them. Throws `CorruptStreamError`. */
export async function readWindowErrors(index: Index, read: Read): Promise<WindowErrors | null> {
  const range = windowSection(index);
  return range && windowErrorsFrom(await read(range.offset, range.length), range.offset, index.header);
}

/** The errors of windows from their section, which stands at `offset`. Throws `CorruptStreamError`. */
export function windowErrorsFrom(section: Uint8Array, offset: number, header: Header): WindowErrors {
  const frame = wholeSection(section, offset, WINDOW_ERRORS);
  return parseWindowErrors(frame.payload, frame.payloadOffset, header);
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
