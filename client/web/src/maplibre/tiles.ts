/** Makes tiles of containers: the work behind the protocol, in a worker or in the same thread. */

import { OptionError, SilenceError, UnreachableError } from "../errors";
import { BlockCache } from "./block-cache";
import { coloured, type Encoding, mapLibreName } from "./encodings";
import { type FieldSource, HeightField } from "./height-field";
import type { ForeignTransform } from "./projection";
import { type Tile, tileGrid } from "./tile-grid";

/** Zooms beyond the one of the data: clients enlarge the tiles of the last one themselves. */
const MORE_ZOOMS = 1;

/** Containers that stay open. */
const MOST_OPEN = 16;

/** What is asked of a field's tiles. */
export interface Look {
  readonly encoding: Encoding;
  /** Pixels along an edge. */
  readonly size: number;
  readonly nodata: number;
}

/** What a TileJSON says of a field, and where the container was found. */
export interface Described {
  readonly url: string;
  readonly name: string;
  readonly bounds: readonly number[];
  readonly maxzoom: number;
  readonly encoding: string;
}

/** Makes tiles. */
export interface TileMaker {
  /** @throws LodestreamError if the container cannot be had, or has no heights with a place; or the signal's reason. */
  describe(source: FieldSource, look: Look, signal: AbortSignal): Promise<Described>;
  /**
   * The pixels of a tile: red, green, blue and 255.
   *
   * @throws OptionError if there is no such tile; otherwise as `describe`.
   */
  tile(source: FieldSource, look: Look, tile: Tile, signal: AbortSignal): Promise<Uint8ClampedArray<ArrayBuffer>>;
}

/** Containers that are open, and their blocks. */
export class Tiles implements TileMaker {
  private readonly open = new Map<string, Promise<HeightField>>();
  private readonly cache: BlockCache;
  private opened = 0;

  /**
   * @param cacheBytes Of decoded heights, of all containers together.
   * @param fetch In place of the platform's own.
   */
  constructor(
    private readonly foreign: ForeignTransform,
    cacheBytes: number,
    private readonly fetch?: typeof globalThis.fetch,
  ) {
    this.cache = new BlockCache(cacheBytes);
  }

  async describe(source: FieldSource, { encoding, size }: Look): Promise<Described> {
    const { url, name, placement } = await this.field(source);
    const [west, south, east, north] = placement.bounds;
    // Clients cut bounds at the dateline.
    const bounds = east > 180 ? [-180, south, 180, north] : [west, south, east, north];
    return { url, name, bounds, maxzoom: placement.webZoom(size), encoding: mapLibreName(encoding) };
  }

  async tile(
    source: FieldSource,
    { encoding, size, nodata }: Look,
    tile: Tile,
    signal: AbortSignal,
  ): Promise<Uint8ClampedArray<ArrayBuffer>> {
    const field = await this.field(source);
    const finest = field.placement.webZoom(size) + MORE_ZOOMS;
    if (tile.z > finest) throw new OptionError(`expected a zoom of 0 to ${finest} for these heights, got ${tile.z}`);
    const grid = tileGrid(tile, size);
    try {
      return coloured(await field.heights(grid, signal), encoding, nodata);
    } catch (error) {
      // A container that has changed, or is gone, is opened anew for the next tile.
      const isBroken = error instanceof UnreachableError || error instanceof SilenceError;
      if (!isBroken && !signal.aborted) await this.forget(source, field);
      throw error;
    }
  }

  private async field(source: FieldSource): Promise<HeightField> {
    const key = keyOf(source);
    let field = this.open.get(key);
    if (field === undefined) {
      this.opened += 1;
      const { foreign, cache, fetch } = this;
      field = HeightField.open(source, { foreign, cache, fetch, name: String(this.opened) });
    }
    this.open.delete(key);
    this.open.set(key, field);
    const [oldest] = this.open.keys();
    if (this.open.size > MOST_OPEN) this.open.delete(oldest!);
    try {
      return await field;
    } catch (error) {
      if (this.open.get(key) === field) this.open.delete(key);
      throw error;
    }
  }

  private async forget(source: FieldSource, failed: HeightField): Promise<void> {
    const key = keyOf(source);
    const field = this.open.get(key);
    if (field !== undefined && (await field.catch(() => failed)) === failed && this.open.get(key) === field) {
      this.open.delete(key);
    }
  }
}

function keyOf({ url, token, scale }: FieldSource): string {
  return JSON.stringify([url, token, scale]);
}
