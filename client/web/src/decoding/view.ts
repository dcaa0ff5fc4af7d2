/** Views: the states of a surface while its container is being received. */
import type { Plane } from "../container/extras";
import type { Header } from "../container/header";
import type { Metadata } from "../container/sections";
import type { State } from "../container/slices";
import { rint } from "../coordinates/coordinate-rules";
import {
  coordinatesOf,
  type LevelWindow,
  levelMetadata,
  type Nodes,
  planeAnywhere,
  windowMetadata,
} from "../coordinates/height-fields";
import { CorruptStreamError, InputError, OptionError } from "../errors";
import { levelPositions, type Positions, patchesByBlock } from "../grid/patches";
import { contains, placesOf } from "../grid/window";
import {
  checkSelection,
  nodesOfLevel,
  regionAt,
  type Selection,
  selectedChannels,
  selectedTiles,
} from "../planning/selection";
import type { Block, ChannelErrors, Closed, PointArray, Region, Shape, Surface, ViewInfo } from "../types";
import { clearGrid, cutGrid, type Grid, newGrid } from "./grids";
import type { BlockGrids, Known, Reconstruction } from "./reconstruction";

/** What all views of a surface have in common; metadata and digest are filled when they come. */
export interface Shared {
  readonly reconstruction: Reconstruction;
  readonly metadata: Metadata;
  readonly digest: { value: string | null };
  /** The SHA-256 of the complete state, once it was computed, and its surface as `View.verify` left it, until taken. */
  readonly ending: { digest: string | null; verified: { selection: Selection; surface: Surface } | null };
}

/** A block that is not shown whole has holes by itself: points of which a coordinate is not finite. */
interface Shown {
  readonly points: Grid;
  readonly mask: Uint8Array | null;
}

/** One state of a surface. Its points are computed on request, even if more data have arrived since. */
export class View implements ViewInfo {
  readonly number: number;
  readonly level: number;
  readonly bytes: number;
  readonly rms: number;
  readonly maxError: number;
  readonly bound: boolean;
  readonly complete: boolean;
  readonly channels: ChannelErrors;
  readonly #shared: Shared;
  readonly #known: Known;
  readonly #selection: Selection;

  constructor(state: Omit<ViewInfo, never> & Partial<State>, shared: Shared, known: Known, selection: Selection) {
    this.number = state.number;
    this.level = state.level;
    this.bytes = state.bytes;
    this.rms = state.rms;
    this.maxError = state.maxError;
    this.bound = state.bound;
    this.complete = state.complete;
    this.channels = state.channels;
    this.#shared = shared;
    this.#known = known;
    this.#selection = selection;
  }

  /** What is known of the state without decoding it, in plain values. */
  get info(): ViewInfo {
    const { number, level, bytes, rms, maxError, bound, complete, channels } = this;
    return { number, level, bytes, rms, maxError, bound, complete, channels };
  }

  /** The finest level that can be shown: of a window the one that was asked for. */
  get #finest(): number {
    const { levels } = this.#shared.reconstruction.header;
    return this.#selection.region ? (this.#selection.level ?? levels) : levels;
  }

  /**
   * The points of a window, at full resolution or at a coarser level; costs time and memory for the window only. `region`
   * has rows and columns of the full grid at any level; along a closed axis it may go on across the seam, as columns
   * 350:370 of 360. The window of a coarser level is cut out of that level's grid, bit for bit as `surface` gives it.
   *
   * Throws `OptionError` where the region is outside the surface or has no point of the level, the surface has several
   * blocks, the view holds another region only, or there is no such level.
   */
  window(region: Region, level: number = this.#finest): Surface {
    const { header } = this.#shared.reconstruction;
    this.#checkLevel(level);
    const selection: Selection = { region, attributes: this.#selection.attributes, level };
    checkSelection(selection, header);
    const shown = this.#selection.region;
    if (shown && !contains(shown, region, header.shape)) {
      throw new OptionError(
        `expected a region inside the one received, ${shown.join(" x ")}, got ${region.join(" x ")}`,
      );
    }
    let { state } = this.#known;
    if (level === header.levels) {
      const wanted = selectedTiles(selection, header);
      state = state.map((left, unit) => (wanted[Math.floor(unit / header.channels)] ? left : 0));
    }
    return new View(this, this.#shared, { length: this.#known.length, state }, selection).surface();
  }

  #checkLevel(level: number): void {
    if (!(Number.isInteger(level) && level >= 0 && level <= this.#finest)) {
      throw new OptionError(`expected a level of 0 to ${this.#finest}, got ${level}`);
    }
  }

  /**
   * The state as a surface, at full resolution or at a coarser level; without `level` of a window that was received at a
   * coarser level that one.
   *
   * Throws `OptionError` where there is no such level; `CorruptStreamError` where the SHA-256 of the complete surface is
   * wrong, or no value is finite.
   */
  surface(level?: number): Surface {
    const { surface, digest } = this.#computed(level);
    const { ending, reconstruction } = this.#shared;
    if (digest !== null) {
      ending.digest ??= reconstruction.digest(valuesOf(surface.blocks));
      this.#check(digest, ending.digest);
    }
    return surface;
  }

  /**
   * Compute the complete surface and hold it to its SHA-256, if that has come; the next `surface` returns it. Throws
   * `CorruptStreamError` where a chunk of the residual does not hold what it should, or the SHA-256 is wrong.
   */
  verify(): void {
    try {
      const surface = this.surface();
      this.#shared.ending.verified = { selection: this.#selection, surface };
    } catch (error) {
      if (!(error instanceof InputError)) throw error; // nothing of this window is valid, which is no damage
    }
  }

  /** As `surface`, but the SHA-256 is the platform's where it has one, which saves a quarter of the time. */
  async surfaceAsync(level?: number): Promise<Surface> {
    const { surface, digest } = this.#computed(level);
    const { ending, reconstruction } = this.#shared;
    if (digest !== null) {
      ending.digest ??= await reconstruction.digestAsync(valuesOf(surface.blocks));
      this.#check(digest, ending.digest);
    }
    return surface;
  }

  #check(wanted: string, found: string): void {
    if (found === wanted) return;
    const { length } = this.#shared.reconstruction.header;
    throw new CorruptStreamError(`expected values with the SHA-256 ${wanted}, got ${found}`, length);
  }

  /** The state as a surface, and the SHA-256 that its values have to have; null where that is not known. */
  #computed(level: number | undefined): { surface: Surface; digest: string | null } {
    const { reconstruction, metadata, digest } = this.#shared;
    const { header } = reconstruction;
    const { region } = this.#selection;
    const asked = level !== undefined;
    const shownLevel = level ?? this.#finest;
    this.#checkLevel(shownLevel);
    const finest = shownLevel === header.levels;
    const window = region ? this.#levelWindow(region, shownLevel) : null;
    let values: Metadata = { ...metadata };
    if (asked) {
      // The grid of that level, without what a seam repeats.
      delete values.seam;
      delete values.turn;
    }
    const chosen = selectedChannels(this.#selection, header);
    const exact = this.complete && finest && header.exact && !region && chosen.every(Boolean);
    const verified = finest ? this.#taken() : null;
    if (verified !== null) {
      const own = window ? windowMetadata(values, window) : values;
      return { surface: { blocks: verified.blocks, metadata: own }, digest: exact ? digest.value : null };
    }
    const levelNodes = this.#nodes(shownLevel);
    const nodes = window ? [wrapped(window.places, header.shape)] : levelNodes;
    const grids = window
      ? [this.#window(region!, shownLevel, window, chosen)]
      : reconstruction.blocks(this.#known, shownLevel, this.#corrected && finest, chosen);
    const closures = header.blocks.map(({ closed }) => window?.closed ?? closed);
    const masks = nodes.map((own, block) => {
      // If no node of a level is valid, what stands under the holes is shown.
      if (!finest && !this.#maskAt(block, levelNodes[block]!)?.includes(1)) return null;
      return this.#maskAt(block, own);
    });
    const keptMasks = this.#corrected && finest ? reconstruction.kept : [];
    let blocks = grids.map((own, block): Block => {
      const mask = masks[block] ?? null;
      const kept = keptMasks[block] ? pick(keptMasks[block], header.blocks[block]!.shape, nodes[block]!) : null;
      if (mask) reconstruction.clear(own, kept ? union(mask, kept) : mask);
      const [points, ...attributes] = own;
      return this.#block(
        validated({ points: points!, mask }, header, region),
        attributes,
        nodes[block]!,
        closures[block]!,
      );
    });
    let plane: Plane | null = header.plane;
    let placed: Nodes = [null, null];
    const only = blocks.length === 1 ? blocks[0]! : null;
    if (!finest && only && header.pointChannels === 1) {
      values = levelMetadata(values, plane !== null, header.shape, header.closed, levelNodes[0]!);
    }
    if (plane && !(finest && !region)) {
      plane = planeAnywhere(plane, header.shape);
      placed = [[...nodes[0]![0]], [...nodes[0]![1]]];
    }
    if (plane && only) {
      const kept = keptMasks[0] ? pick(keptMasks[0], header.shape, nodes[0]!) : null;
      blocks = [withCoordinates(only, plane, placed, kept, header)];
    }
    if (window) values = windowMetadata(values, window);
    return { surface: { blocks, metadata: values }, digest: exact ? digest.value : null };
  }

  /** The complete surface, if `verify` has computed it and nobody has taken it. */
  #taken(): Surface | null {
    const { ending } = this.#shared;
    if (!this.#corrected || ending.verified?.selection !== this.#selection) return null;
    const { surface } = ending.verified;
    ending.verified = null;
    return surface;
  }

  /** Whether the residual is known. */
  get #corrected(): boolean {
    return this.complete && this.#shared.reconstruction.header.corrected;
  }

  /** The window of a level that stands in a region. */
  #levelWindow(region: Region, level: number): LevelWindow {
    const { header } = this.#shared.reconstruction;
    const nodes = nodesOfLevel(header, level);
    const inside = regionAt(header, region, level);
    const [rows, columns] = ([0, 1] as const).map((axis) =>
      placesOf(inside[axis], nodes[axis].length).map((number) => {
        const place = nodes[axis][number]!;
        return place < region[axis][0] ? place + header.shape[axis] : place;
      }),
    );
    const shape: Shape = [nodes[0].length, nodes[1].length];
    return {
      shape,
      inside,
      closed: windowClosed(header.blocks[0]!.closed, shape, inside),
      full: header.shape,
      axes: this.#shared.metadata.axes,
      places: [rows!, columns!],
    };
  }

  /** Which rows and columns of each block stand at the nodes of a level. */
  #nodes(level: number): Positions[] {
    const { header } = this.#shared.reconstruction;
    return patchesByBlock(header.patches, header.blocks.length).map((own, block) =>
      levelPositions(own, header.patches.length, header.layout, level, header.blocks[block]!.shape),
    );
  }

  /** Which of these rows and columns of a block are valid points; null: all. */
  #maskAt(block: number, nodes: Positions): Uint8Array | null {
    const { masks, header } = this.#shared.reconstruction;
    const mask = masks[block];
    return mask ? pick(mask, header.blocks[block]!.shape, nodes) : null;
  }

  /** Points and attributes of a window of a level of the only block. */
  #window(region: Region, level: number, window: LevelWindow, chosen: readonly boolean[]): BlockGrids {
    const { reconstruction } = this.#shared;
    const { header } = reconstruction;
    const corrected = this.#corrected && level === header.levels;
    if (header.arrangement) {
      // A block that meets itself: what its sides share may lie anywhere in it.
      const whole = reconstruction.blocks(this.#known, level, corrected, chosen)[0]!;
      return whole.map((grid) => cutGrid(grid, window.inside, window.shape));
    }
    return reconstruction.window(this.#known, region, level, corrected, chosen);
  }

  #block({ points, mask }: Shown, attributes: readonly Grid[], nodes: Positions, closed: Closed): Block {
    const { header } = this.#shared.reconstruction;
    const named = new Map<string, PointArray>();
    for (const [number, kind] of header.attributes.entries()) {
      if (this.#selection.attributes && !this.#selection.attributes.includes(kind.name)) continue;
      const { dtype, components, values } = attributes[number]!;
      named.set(kind.name, { dtype, components, flat: kind.components === 0, values });
    }
    return {
      shape: points.shape,
      closed,
      points: { dtype: points.dtype, components: points.components, flat: header.flat, values: points.values },
      mask,
      attributes: named,
      rows: nodes[0],
      columns: nodes[1],
    };
  }
}

/** Rows and columns of a block of this shape where they go on beyond its end with the first ones. */
function wrapped([rows, columns]: Positions, shape: Shape): Positions {
  return [rows.map((row) => row % shape[0]), columns.map((column) => column % shape[1])];
}

/** A mask of a block at some of its rows and columns. */
function pick(mask: Uint8Array, shape: Shape, [rows, columns]: Positions): Uint8Array {
  const picked = new Uint8Array(rows.length * columns.length);
  let count = 0;
  for (const row of rows) for (const column of columns) picked[count++] = mask[row * shape[1] + column]!;
  return picked;
}

function union(one: Uint8Array, other: Uint8Array): Uint8Array {
  return one.map((mark, i) => mark | other[i]!);
}

/** Which axes of a window wrap: those that do in the surface, where the window holds all of them. */
function windowClosed(closed: Closed, shape: Shape, region: Region): Closed {
  const whole = ([0, 1] as const).map((axis) => closed[axis] && region[axis][1] - region[axis][0] === shape[axis]);
  return [whole[0]!, whole[1]!];
}

/** Points with the holes that they have by themselves: a coordinate that is not finite. */
function validated({ points, mask }: Shown, header: Header, region: Region | undefined): Shown {
  let valid = mask;
  const { values, components } = points;
  if (points.dtype === "float32" || points.dtype === "float64") {
    const numbers = values as Float32Array | Float64Array;
    const coordinates = Math.min(components, 3);
    const count = points.shape[0] * points.shape[1];
    for (let point = 0; point < count; point++) {
      for (let k = 0; k < coordinates; k++) {
        if (!Number.isFinite(numbers[point * components + k]!)) {
          if (valid === null || valid === mask) valid = mask ? mask.slice() : new Uint8Array(count).fill(1);
          valid[point] = 0;
        }
      }
    }
  }
  if (valid === null || !valid.includes(0)) return { points, mask: null };
  if (!valid.includes(1)) {
    const what = `${points.shape[0]} x ${points.shape[1]} holes`;
    if (region) throw new InputError(`expected at least one valid point, got ${what}`);
    throw new CorruptStreamError(
      `expected the points of a surface: expected at least one valid point, got ${what}`,
      header.length,
    );
  }
  return { points, mask: valid };
}

/** Heights with the x and y that rules give them, in the type of the heights. */
function withCoordinates(block: Block, plane: Plane, nodes: Nodes, kept: Uint8Array | null, header: Header): Block {
  const { shape, points } = block;
  const grid = newGrid(points.dtype, shape, 3);
  const places = coordinatesOf({ rules: plane, swapped: false, nodes }, shape);
  const count = shape[0] * shape[1];
  for (const [channel, { rows, columns, values }] of places.entries()) {
    for (let point = 0; point < count; point++) {
      const row = rows === 1 ? 0 : Math.floor(point / shape[1]);
      const column = columns === 1 ? 0 : point % shape[1];
      put(grid, 3 * point + channel, values[row * columns + column]!);
    }
  }
  for (let point = 0; point < count; point++) grid.values[3 * point + 2] = points.values[point]!;
  const floats = points.dtype === "float32" || points.dtype === "float64";
  if (block.mask && floats) {
    const shown = block.mask.slice();
    for (let point = 0; point < count; point++) {
      // Holes of infinite height have x and y as well.
      const infinite = Math.abs(Number(points.values[point])) === Number.POSITIVE_INFINITY;
      if (kept ? kept[point] : infinite) shown[point] = 1;
    }
    clearGrid(grid, shown, 0n);
  }
  const { mask } = validated({ points: grid, mask: block.mask }, header, undefined);
  const made: PointArray = { dtype: points.dtype, components: 3, flat: false, values: grid.values };
  return { ...block, points: made, mask };
}

/** Put a number into a grid, rounded to its type. */
function put(grid: Grid, place: number, value: number): void {
  const { values } = grid;
  if (values instanceof BigInt64Array || values instanceof BigUint64Array) {
    values[place] = BigInt(Number.isFinite(value) ? rint(value) : 0);
  } else if (grid.dtype === "float32" || grid.dtype === "float64") {
    values[place] = value;
  } else {
    values[place] = rint(value);
  }
}

/** All values as bytes: block by block the points, then each attribute. */
function valuesOf(blocks: readonly Block[]): Uint8Array<ArrayBuffer>[] {
  return blocks
    .flatMap(({ points, attributes }) => [points, ...attributes.values()])
    .map(({ values }) => new Uint8Array(values.buffer as ArrayBuffer, values.byteOffset, values.byteLength));
}
