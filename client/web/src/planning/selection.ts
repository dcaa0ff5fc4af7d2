/** Which segments and pieces of a container are needed for a window or for some attributes. */

import type { Capacity } from "../container/capacity";
import { pieceWindows } from "../container/chunks";
import type { Header } from "../container/header";
import type { Index } from "../container/model";
import { OptionError } from "../errors";
import { checkRegion, neededTiles } from "../grid/support";
import { DTYPE_BYTES, type Piece, type Region, type Segment, type Shape, type Span } from "../types";

/** The requested part of a surface: a window of its points, and attributes by name; without them all. */
export interface Wish {
  readonly region?: Region | undefined;
  readonly attributes?: readonly string[] | undefined;
}

/** Segments in file order, and pieces of exactness by number, that a wish takes; `whole`: they are all there are. */
export interface Selection {
  readonly segments: readonly Segment[];
  readonly pieces: ReadonlyMap<number, Piece>;
  readonly whole: boolean;
}

/** Refuse a region or attributes that the surface does not have. Throws `OptionError`. */
export function checkWish(wish: Wish, header: Header): void {
  if (wish.region) {
    if (header.blocks.length > 1) {
      throw new OptionError(`expected a surface of one block for a region, got ${header.blocks.length} blocks`);
    }
    checkRegion(wish.region, header.shape);
  }
  const names = header.attributes.map((kind) => kind.name);
  for (const name of wish.attributes ?? []) {
    if (!names.includes(name)) {
      throw new OptionError(`expected attributes among ${names.join(", ") || "none"}, got ${name}`);
    }
  }
}

/** Which channels are wanted. */
export function wishedChannels(wish: Wish, header: Header): boolean[] {
  const chosen = Array.from({ length: header.pointChannels }, () => true);
  for (const kind of header.attributes) {
    const wanted = wish.attributes?.includes(kind.name) ?? true;
    for (let left = Math.max(kind.components, 1); left > 0; left--) chosen.push(wanted);
  }
  return chosen;
}

/** Which tiles are wanted: 1 or 0 for each. */
export function wishedTiles(wish: Wish, header: Header): Uint8Array {
  // In a block that meets itself, what is shared may lie on the other side.
  if (!wish.region || header.arrangement) return new Uint8Array(header.layout.tiles.length).fill(1);
  return neededTiles(header.layout, restoredRegion(header, wish.region));
}

/** What has to be decoded for a region of the only block: a piece of exactness restores all of its own window. */
export function restoredRegion(header: Header, region: Region): Region {
  if (!header.corrected) return region;
  const [rows, columns] = ([0, 1] as const).map((axis): Span => {
    const size = 2 ** header.piece[axis];
    const [start, stop] = region[axis];
    return [Math.floor(start / size) * size, Math.min(Math.ceil(stop / size) * size, header.shape[axis])];
  });
  return [rows!, columns!];
}

/** Refuse what takes more memory than there may be; `level` is the finest level that is wanted, if not all of them. */
export function checkSize(wish: Wish, header: Header, capacity: Capacity, level?: number): void {
  const wanted = wishedChannels(wish, header);
  const sizes = header.dtypes.filter((_, channel) => wanted[channel]).map((dtype) => DTYPE_BYTES[dtype]);
  const { layout } = header;
  let shapes: Shape[];
  if (wish.region && !header.arrangement) {
    const [rows, columns] = restoredRegion(header, wish.region);
    shapes = [[rows[1] - rows[0], columns[1] - columns[0]]];
  } else if (level !== undefined && level < layout.levels) {
    shapes = layout.grids.map((_, grid) => layout.shape(grid, level));
  } else {
    shapes = header.blocks.map((block) => block.shape);
  }
  let vertices = 0;
  for (const [rows, columns] of shapes) vertices += rows * columns;
  let masked = 0;
  if (header.masked) for (const { shape } of header.blocks) masked += shape[0] * shape[1];
  const grids = shapes.map((shape) => ({ shape, sizes }));
  capacity.promise(vertices, grids, { masked, tables: header.tables });
}

/** What of a container a wish takes. Throws `OptionError` where the surface does not have it. */
export function select(index: Index, wish: Wish): Selection {
  const { header } = index;
  checkWish(wish, header);
  const pieces = new Map<number, Piece>();
  if (!wish.region && !wish.attributes) {
    index.pieces.forEach((piece, number) => {
      if (piece.range.length) pieces.set(number, piece);
    });
    return { segments: index.segments, pieces, whole: true };
  }
  const tiles = wishedTiles(wish, header);
  const channels = wishedChannels(wish, header);
  const segments = index.segments.filter((segment) => tiles[segment.tile] && channels[segment.channel]);
  let number = 0;
  for (const window of index.pieces.length ? pieceWindows(header) : []) {
    const piece = index.pieces[number]!;
    const touches = !wish.region || (meets(wish.region[0], window.rows) && meets(wish.region[1], window.columns));
    if (piece.range.length && touches && channels[window.channel]) pieces.set(number, piece);
    number++;
  }
  return { segments, pieces, whole: false };
}

function meets(one: Span, other: Span): boolean {
  return one[0] < other[1] && other[0] < one[1];
}
