/** Containers as sources of terrain of MapLibre GL JS, without a server that makes tiles. */

import { OptionError } from "../errors";
import type { WorkerLike } from "../transfer/channel";
import { sourceOf, templateOf, tileOf } from "./addresses";
import { type Proj4, transformBy } from "./proj4";
import type { TileMaker } from "./tiles";
import { WorkerTiles } from "./worker-tiles";

/** Bytes of decoded heights that are kept. */
const CACHE_BYTES = 64 * 1024 * 1024;

/** Options of `lodeProtocol`. */
export interface LodeProtocolOptions {
  /** proj4js, for heights in other CRS than longitudes and latitudes of WGS 84 and Web Mercator, such as UTM zones. */
  readonly proj4?: Proj4 | undefined;
  /** Bytes of decoded heights that are kept for later tiles, of all containers together; 64 MiB. */
  readonly cacheBytes?: number | undefined;
  /** Whether to work in a worker: by default where there are workers. It may also be what makes one. */
  readonly worker?: boolean | (() => WorkerLike) | undefined;
  /** In place of the platform's own, without a worker. */
  readonly fetch?: typeof globalThis.fetch | undefined;
}

/** What is used of MapLibre's request. */
export interface LodeRequest {
  readonly url: string;
  /** `json`: of the source; otherwise of a tile. */
  readonly type?: string | undefined;
  /** `Authorization: Bearer ...`, which `transformRequest` may add, is the token for a server that wants one. */
  readonly headers?: Readonly<Record<string, string>> | undefined;
}

/** The TileJSON of a source. */
export interface TileJson {
  readonly tilejson: string;
  readonly name: string;
  readonly scheme: string;
  readonly tiles: string[];
  readonly bounds: number[];
  readonly minzoom: number;
  readonly maxzoom: number;
  readonly tileSize: number;
  readonly encoding: string;
}

/** What `maplibregl.addProtocol` takes: it gives the TileJSON of a source, or the picture of a tile. */
export type LodeHandler = (
  request: LodeRequest,
  abort: AbortController,
) => Promise<{ readonly data: TileJson | ImageBitmap }>;

/**
 * A handler of addresses `lode://CONTAINER`, as `maplibregl.addProtocol("lode", lodeProtocol())` takes it.
 *
 *     { type: "raster-dem", url: "lode://https://maps.example.org/alps.lode" }
 *
 * CONTAINER is what `connect` takes; in a page it may be relative. Its query may have `encoding` (`terrain-rgb` or
 * `terrarium`), `size` (256 or 512), `nodata` (metres in holes and outside; 0) and `scale` (metres upwards of one unit of
 * the heights, such as -1). A container stays open: its index is read once, and what a tile needs of it is asked for by
 * Range.
 *
 * The handler throws `OptionError` for what there is not, `InputError` for containers without heights or without a place
 * on the Earth, and what `connect` throws.
 */
export function lodeProtocol(options: LodeProtocolOptions = {}): LodeHandler {
  const { cacheBytes = CACHE_BYTES } = options;
  if (!(cacheBytes >= 0)) throw new OptionError(`expected a cache of 0 bytes or more, got ${cacheBytes}`);
  let made: Promise<TileMaker> | undefined;
  const maker = (): Promise<TileMaker> => {
    made ??= makeTiles(options, cacheBytes);
    return made;
  };
  return async ({ url, type, headers }, { signal }) => {
    const scheme = url.slice(0, url.indexOf("://"));
    const base = globalThis.document?.baseURI;
    const token = tokenIn(headers);
    if (type === "json") {
      const { url: given, scale, query, ...look } = sourceOf(url, base);
      const { size } = look;
      const told = await (await maker()).describe({ url: given, token, scale }, look, signal);
      const { name, bounds, maxzoom, encoding } = told;
      const tiles = [templateOf(scheme, told.url, query)];
      const range = { bounds: [...bounds], minzoom: 0, maxzoom };
      const data = { tilejson: "3.0.0", name, scheme: "xyz", tiles, ...range, tileSize: size, encoding };
      return { data: data satisfies TileJson };
    }
    const { wanted, tile } = tileOf(url, base);
    const { url: given, scale, query: _, ...look } = wanted;
    const pixels = await (await maker()).tile({ url: given, token, scale }, look, tile, signal);
    return { data: await bitmapOf(pixels, look.size) };
  };
}

async function makeTiles({ proj4, worker, fetch }: LodeProtocolOptions, cacheBytes: number): Promise<TileMaker> {
  const foreign = transformBy(proj4);
  if (typeof worker === "function") return new WorkerTiles(worker(), foreign, cacheBytes);
  if (worker && fetch !== undefined) {
    throw new OptionError("expected a fetch of one's own without a worker, got both");
  }
  if (worker ?? (typeof Worker !== "undefined" && fetch === undefined)) {
    const { default: TilesWorker } = await import("./worker?worker&inline");
    return new WorkerTiles(new TilesWorker(), foreign, cacheBytes);
  }
  // Apart, so that a page that has workers does not load the decoder twice.
  const { Tiles } = await import("./tiles");
  return new Tiles(foreign, cacheBytes, fetch);
}

/** Bytes that nobody changes on their way: nothing is transparent, and no colour is converted. */
function bitmapOf(pixels: Uint8ClampedArray<ArrayBuffer>, size: number): Promise<ImageBitmap> {
  return createImageBitmap(new ImageData(pixels, size, size), {
    colorSpaceConversion: "none",
    premultiplyAlpha: "none",
  });
}

function tokenIn(headers: Readonly<Record<string, string>> = {}): string | undefined {
  const [, value] = Object.entries(headers).find(([name]) => name.toLowerCase() === "authorization") ?? [];
  return /^Bearer (.+)$/i.exec(value ?? "")?.[1];
}
