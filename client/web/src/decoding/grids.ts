/** Grids of blocks: values of one array, and how they are put together from the grids of patches. */
import type { Header } from "../container/header";
import { isWhole, levelPositions, type NumberedPatch, patchPositions } from "../grid/patches";
import { placesOf as placesIn, spansOf } from "../grid/window";
import { ARRAYS } from "../kernels/arena";
import type { DType, Region, Shape, Values } from "../types";
import { holePattern, patternsOf, wordsOf } from "./bits";

/** Values of a block: (rows, columns, components) in C order. */
export interface Grid {
  readonly dtype: DType;
  readonly shape: Shape;
  readonly components: number;
  readonly values: Values;
}

/** Zeros. */
export function newGrid(dtype: DType, shape: Shape, components: number): Grid {
  return { dtype, shape, components, values: new ARRAYS[dtype](shape[0] * shape[1] * components) };
}

/** Give points where `shown` is 0 the value that says so. */
export function clearGrid(grid: Grid, shown: Uint8Array, hole: bigint): void {
  const patterns = patternsOf(grid.values);
  const pattern = holePattern(grid.dtype, hole);
  const width = grid.components * pattern.length;
  for (let point = 0; point < shown.length; point++) {
    if (shown[point]) continue;
    for (let word = 0; word < width; word++) patterns[point * width + word] = pattern[word % pattern.length]!;
  }
}

/** The bytes of one channel at some points, or its values there replaced by these. */
export function takePoints(grid: Grid, channel: number, points: Int32Array): Uint8Array {
  const from = patternsOf(grid.values);
  const words = wordsOf(grid.dtype);
  const stride = grid.components * words;
  const found = from.slice(0, 0).constructor as new (length: number) => typeof from;
  const taken = new found(points.length * words);
  for (let i = 0; i < points.length; i++) {
    const place = points[i]! * stride + channel * words;
    taken[i * words] = from[place]!;
    if (words === 2) taken[i * words + 1] = from[place + 1]!;
  }
  return new Uint8Array(taken.buffer);
}

/** Replace the values of one channel at some points. */
export function putPoints(grid: Grid, channel: number, points: Int32Array, bytes: Uint8Array): void {
  const to = patternsOf(grid.values);
  const words = wordsOf(grid.dtype);
  const stride = grid.components * words;
  const kind = to.constructor as new (buffer: ArrayBuffer) => typeof to;
  const given = new kind(bytes.slice().buffer);
  for (let i = 0; i < points.length; i++) {
    const place = points[i]! * stride + channel * words;
    to[place] = given[i * words]!;
    if (words === 2) to[place + 1] = given[i * words + 1]!;
  }
}

/** The window of a grid that begins at row and column `first` of one of this shape. */
export function cutGrid(grid: Grid, region: Region, shape: Shape, first: readonly [number, number] = [0, 0]): Grid {
  const [rows, columns] = region;
  const cut = newGrid(grid.dtype, [rows[1] - rows[0], columns[1] - columns[0]], grid.components);
  const from = patternsOf(grid.values);
  const to = patternsOf(cut.values);
  const words = wordsOf(grid.dtype) * grid.components;
  const runs = spansOf(columns, shape[1]);
  let place = 0;
  for (const row of placesIn(rows, shape[0])) {
    for (const [left, right] of runs) {
      const start = ((row - first[0]) * grid.shape[1] + left - first[1]) * words;
      const run = from.subarray(start, start + (right - left) * words);
      to.set(run, place);
      place += run.length;
    }
  }
  return cut;
}

/** A block's grid of a level out of the grids of its patches, `own`; `grids` are those of all patches, as stored. */
export function assemble(
  header: Header,
  own: readonly NumberedPatch[],
  level: number,
  block: Shape,
  grids: readonly Grid[],
): Grid {
  const only = own[0]!;
  const one = grids[only.number]!;
  if (own.length === 1 && isWhole(only.patch, block)) {
    const [down, right] = only.patch.flipped;
    if (!down && !right) return one;
    const turned = newGrid(one.dtype, one.shape, one.components);
    const order = (flipped: boolean, length: number) =>
      Int32Array.from({ length }, (_, i) => (flipped ? length - 1 - i : i));
    placeGrid(turned, one, order(down, one.shape[0]), order(right, one.shape[1]));
    return turned;
  }
  const [rows, columns] = levelPositions(own, header.patches.length, header.layout, level, block);
  const whole = newGrid(one.dtype, [rows.length, columns.length], one.components);
  const [rowPlace, columnPlace] = [placesOf(rows, block[0]), placesOf(columns, block[1])];
  for (const patch of own) {
    const [down, right] = patchPositions(patch, header.patches.length, header.layout, level, block);
    placeGrid(
      whole,
      grids[patch.number]!,
      down.map((row) => rowPlace[row]!),
      right.map((column) => columnPlace[column]!),
    );
  }
  return whole;
}

/** For each row or column of a block its number among those that are shown. */
function placesOf(shown: Int32Array, length: number): Int32Array {
  const places = new Int32Array(length);
  for (let i = 0; i < shown.length; i++) places[shown[i]!] = i;
  return places;
}

/** Put a grid's rows and columns at these rows and columns of another. */
function placeGrid(to: Grid, from: Grid, rows: Int32Array, columns: Int32Array): void {
  const target = patternsOf(to.values);
  const source = patternsOf(from.values);
  const words = wordsOf(from.dtype) * from.components;
  let place = 0;
  for (const row of rows) {
    for (const column of columns) {
      const start = (row * to.shape[1] + column) * words;
      for (let word = 0; word < words; word++) target[start + word] = source[place++]!;
    }
  }
}
