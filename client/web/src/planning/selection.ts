/** Which segments and chunks of a container are needed for a window or for some attributes. */

import type { Capacity } from "../container/capacity";
import { chunkPlaces } from "../container/chunks";
import type { Header } from "../container/header";
import type { Index } from "../container/model";
import { OptionError } from "../errors";
import { levelPositions, type Positions, patchesByBlock } from "../grid/patches";
import { neededTiles } from "../grid/support";
import { aligned, among, checkRegion, hullOf, meets } from "../grid/window";
import { type Chunk, DTYPE_BYTES, type Region, type Segment, type Shape } from "../types";

/**
 * The requested part of a surface: a window of its points, in rows and columns of the full grid, and attributes by name;
 * without them all. `level` is the finest that is wanted: a window then has the points of this level in the region.
 */
export interface Selection {
  readonly region?: Region | undefined;
  readonly attributes?: readonly string[] | undefined;
  readonly level?: number | undefined;
}

/** Segments in file order, and chunks of the residual by number, that a selection takes; `whole`: these are all. */
export interface SelectedSlices {
  readonly segments: readonly Segment[];
  readonly chunks: ReadonlyMap<number, Chunk>;
  readonly whole: boolean;
}

/** Refuse a region, a level or attributes that the surface does not have. Throws `OptionError`. */
export function checkSelection(selection: Selection, header: Header): void {
  const { levels } = header;
  const level = selection.level ?? levels;
  if (!(Number.isInteger(level) && level >= 0 && level <= levels)) {
    throw new OptionError(`expected a level of 0 to ${levels}, got ${level}`);
  }
  if (selection.region) {
    if (header.blocks.length > 1) {
      throw new OptionError(`expected a surface of one block for a region, got ${header.blocks.length} blocks`);
    }
    checkRegion(selection.region, header.shape, header.blocks[0]!.closed);
    regionAt(header, selection.region, level);
  }
  const names = header.attributes.map((kind) => kind.name);
  for (const name of selection.attributes ?? []) {
    if (!names.includes(name)) {
      throw new OptionError(`expected attributes among ${names.join(", ") || "none"}, got ${name}`);
    }
  }
}

/** As `checkSelection`, and refuse a region that has one point of the level only, which is no surface. */
export function checkSurface(selection: Selection, header: Header): void {
  checkSelection(selection, header);
  if (!selection.region) return;
  const level = selection.level ?? header.levels;
  if (regionAt(header, selection.region, level).every(([start, stop]) => stop - start === 1)) {
    const [[top, bottom], [left, right]] = selection.region;
    throw new OptionError(
      `expected a region with at least two points of level ${level}, got rows ${top}:${bottom}, columns ` +
        `${left}:${right}, where that level has one: ask for a larger region or for a finer level`,
    );
  }
}

/** Which channels are wanted. */
export function selectedChannels(selection: Selection, header: Header): boolean[] {
  const chosen = Array.from({ length: header.pointChannels }, () => true);
  for (const kind of header.attributes) {
    const wanted = selection.attributes?.includes(kind.name) ?? true;
    for (let left = Math.max(kind.components, 1); left > 0; left--) chosen.push(wanted);
  }
  return chosen;
}

/** Which tiles are wanted: 1 or 0 for each. */
export function selectedTiles(selection: Selection, header: Header): Uint8Array {
  const { layout } = header;
  const level = selection.level ?? header.levels;
  if (!selection.region) return new Uint8Array(layout.tiles.length).fill(1);
  // In a block that meets itself, what is shared may lie on the other side.
  if (header.arrangement) return new Uint8Array(layout.tiles.length).fill(1, 0, layout.tilesOf(level)[1]);
  return neededTiles(layout, restoredRegion(header, selection.region, level), level);
}

/** The rows and columns of the full grid at which the nodes of a level of the only block stand. */
export function nodesOfLevel(header: Header, level: number): Positions {
  const own = patchesByBlock(header.patches, 1)[0]!;
  return levelPositions(own, header.patches.length, header.layout, level, header.shape);
}

/**
 * The rows and columns of a level of the only block that stand in a region; along a closed axis they may go on across the
 * seam, as those of the region. Throws `OptionError` where none does.
 */
export function regionAt(header: Header, region: Region, level: number): Region {
  if (level === header.levels) return region;
  const window = among(region, header.shape, nodesOfLevel(header, level));
  if (window === null) {
    const [[top, bottom], [left, right]] = region;
    throw new OptionError(
      `expected a region with points of level ${level}, got rows ${top}:${bottom}, columns ${left}:${right}, where ` +
        "that level has none: ask for a larger region or for a finer level",
    );
  }
  return window;
}

/**
 * Rows and columns of a level that have to be decoded for a region of the only block; at full resolution a chunk of the
 * residual restores all of its own window.
 */
export function restoredRegion(header: Header, region: Region, level: number = header.levels): Region {
  if (level === header.levels && header.corrected) {
    return aligned(region, header.shape, [2 ** header.chunk[0], 2 ** header.chunk[1]]);
  }
  return regionAt(header, region, level);
}

/** Refuse what takes more memory than there may be. */
export function checkSize(selection: Selection, header: Header, capacity: Capacity): void {
  const wanted = selectedChannels(selection, header);
  const sizes = header.dtypes.filter((_, channel) => wanted[channel]).map((dtype) => DTYPE_BYTES[dtype]);
  const { layout } = header;
  const level = selection.level ?? layout.levels;
  let shapes: Shape[];
  if (selection.region && !header.arrangement) {
    const [rows, columns] = hullOf(restoredRegion(header, selection.region, level), layout.shape(0, level));
    shapes = [[rows[1] - rows[0], columns[1] - columns[0]]];
  } else if (level < layout.levels) {
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

/** What of a container a selection takes. Throws `OptionError` where the surface does not have it. */
export function select(index: Index, selection: Selection): SelectedSlices {
  const { header } = index;
  checkSurface(selection, header);
  const chunks = new Map<number, Chunk>();
  if (!selection.region && !selection.attributes) {
    index.chunks.forEach((chunk, number) => {
      if (chunk.range.length) chunks.set(number, chunk);
    });
    return { segments: index.segments, chunks, whole: true };
  }
  const tiles = selectedTiles(selection, header);
  const channels = selectedChannels(selection, header);
  const segments = index.segments.filter((segment) => tiles[segment.tile] && channels[segment.channel]);
  let number = 0;
  const corrected = !selection.region || (selection.level ?? header.levels) === header.levels;
  for (const window of index.chunks.length && corrected ? chunkPlaces(header) : []) {
    const chunk = index.chunks[number]!;
    const touches =
      !selection.region ||
      (meets(selection.region[0], window.rows, header.shape[0]) &&
        meets(selection.region[1], window.columns, header.shape[1]));
    if (chunk.range.length && touches && channels[window.channel]) chunks.set(number, chunk);
    number++;
  }
  return { segments, chunks, whole: false };
}
