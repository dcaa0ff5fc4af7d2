/** The handler of `lode://` addresses, over a host of files and over messages to a worker. */
import proj4 from "proj4";
import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { InputError, NotFoundError, OptionError, RemoteError, UnavailableError } from "../../src/errors";
import { type LodeProtocolOptions, lodeProtocol, type TileJson } from "../../src/maplibre";
import { Container } from "../../src/maplibre/container";
import type { FromTiles, ToTiles } from "../../src/maplibre/messages";
import { serveTiles } from "../../src/maplibre/serve-tiles";
import type { WorkerLike } from "../../src/transfer/channel";
import { containerOf as goldenContainer } from "../golden";
import { FileHost } from "./file-host";
import { containerOf, goldenFields, unpacked } from "./golden-fields";

const fields = new Map(goldenFields().map((field) => [field.name, field]));
const ROUGH = fields.get("rough terrain in Web Mercator")!;
const UTM = fields.get("rough terrain in UTM")!;

/** What stands for an ImageBitmap in Node: the pixels that it is made of. */
interface Made {
  readonly pixels: Uint8ClampedArray;
  readonly width: number;
  readonly options: ImageBitmapOptions;
}

let host: FileHost;

beforeEach(() => {
  host = new FileHost();
  host.put("rough.lode", containerOf(ROUGH));
  host.put("utm.lode", containerOf(UTM));
  vi.stubGlobal(
    "ImageData",
    class {
      constructor(
        readonly data: Uint8ClampedArray,
        readonly width: number,
      ) {}
    },
  );
  vi.stubGlobal("createImageBitmap", async (image: ImageData, options: ImageBitmapOptions): Promise<Made> => {
    return { pixels: image.data, width: image.width, options };
  });
});
afterEach(() => {
  vi.unstubAllGlobals();
});

/** Ask a handler; `type` is MapLibre's. */
function asking(options: LodeProtocolOptions = {}, headers?: Record<string, string>) {
  const handler = lodeProtocol({ fetch: host.fetch, ...options });
  return {
    json: async (url: string): Promise<TileJson> =>
      (await handler({ url, type: "json", headers }, new AbortController())).data as TileJson,
    tile: async (url: string, abort = new AbortController()): Promise<Made> =>
      (await handler({ url, type: "image", headers }, abort)).data as unknown as Made,
  };
}

function at(template: string, z: number, x: number, y: number): string {
  return template.replace("{z}", String(z)).replace("{x}", String(x)).replace("{y}", String(y));
}

/** Bytes of pixels without their opacity. */
function colours(pixels: Uint8ClampedArray): Uint8Array {
  return Uint8Array.from(pixels.filter((_, i) => i % 4 !== 3));
}

describe("a source", () => {
  it("is described by a TileJSON whose tiles have the bytes of the Python library", async () => {
    const { json, tile } = asking();
    for (const encoding of ["terrain-rgb", "terrarium"] as const) {
      const told = await json(`lode://${host.url("rough.lode")}?encoding=${encoding}&nodata=-7.3`);
      expect(told).toMatchObject({
        tilejson: "3.0.0",
        scheme: "xyz",
        tiles: [`lode://${host.url("rough.lode")}/{z}/{x}/{y}?encoding=${encoding}&nodata=-7.3`],
        minzoom: 0,
        maxzoom: ROUGH.zoom,
        tileSize: 256,
        encoding: encoding === "terrarium" ? "terrarium" : "mapbox",
      });
      told.bounds.forEach((degrees, side) => {
        expect(degrees).toBeCloseTo(ROUGH.bounds[side]!, 9);
      });
      const { z, x, y, ...golden } = ROUGH.tiles.find((one) => one.z === ROUGH.zoom)!;
      const made = await tile(at(told.tiles[0]!, z, x, y));
      expect(made.width).toBe(256);
      expect(made.options).toEqual({ colorSpaceConversion: "none", premultiplyAlpha: "none" });
      expect(Buffer.compare(colours(made.pixels), unpacked(golden[encoding]!))).toBe(0);
      expect(made.pixels.filter((_, i) => i % 4 === 3).every((alpha) => alpha === 255)).toBe(true);
    }
  });

  it("keeps the query of its container, and tiles have the size that is asked for", async () => {
    const address = `${host.url("rough.lode")}?signature=a%2Fb+c&x=1`;
    host.alias(address, "rough.lode");
    const { json, tile } = asking();
    const told = await json(`lode://${address}&size=512`);
    expect(told.tiles).toEqual([`lode://${host.url("rough.lode")}/{z}/{x}/{y}?signature=a%2Fb+c&x=1&size=512`]);
    expect(told).toMatchObject({ tileSize: 512, maxzoom: ROUGH.zoom - 1 });
    expect((await tile(at(told.tiles[0]!, 0, 0, 0))).width).toBe(512);
  });

  it("may be a name on a published page", async () => {
    host.put("view.json", new TextEncoder().encode(JSON.stringify({ surfaces: [{ name: "a b", src: "rough.lode" }] })));
    const { json } = asking();
    const told = await json(`lode://${host.url("index.html")}?nodata=5#a%20b`);
    expect(told.tiles).toEqual([`lode://${host.url("rough.lode")}/{z}/{x}/{y}?nodata=5`]);
  });

  it("has the height of holes outside of it, for which nothing is asked", async () => {
    const { json, tile } = asking();
    const { tiles } = await json(`lode://${host.url("rough.lode")}?encoding=terrarium&nodata=100`);
    const before = host.asked.length;
    const made = await tile(at(tiles[0]!, 9, 3, 500));
    expect(new Set(new Uint32Array(made.pixels.buffer)).size).toBe(1);
    expect([...made.pixels.subarray(0, 4)]).toEqual([128, 100, 0, 255]);
    expect(host.asked.length).toBe(before);
  });
});

describe("requests", () => {
  const tiles = ROUGH.tiles.filter(({ z }) => z >= ROUGH.zoom);
  const address = (z: number, x: number, y: number) => `lode://${host.url("rough.lode")}/${z}/${x}/${y}`;

  it("ask for no byte twice, and for the index once", async () => {
    const { tile } = asking();
    const beside = tiles.flatMap(({ z, x, y }) => [-1, 0, 1].map((step) => address(z, x + step, y)));
    await Promise.all(beside.map((url) => tile(url)));
    const { length } = host.asked;
    const ranges = host.asked.toSorted(([one], [other]) => one - other);
    ranges.slice(1).forEach(([first], i) => {
      expect(first).toBeGreaterThanOrEqual(ranges[i]![1]);
    });
    await Promise.all(beside.map((url) => tile(url)));
    expect(host.asked.length).toBe(length);
  });

  it("stop where the tile is left, and what is left does not harm the next", async () => {
    const { tile } = asking();
    const [{ z, x, y }] = tiles as [(typeof tiles)[0]];
    await tile(address(0, 0, 0));
    let signal: AbortSignal | undefined;
    host.before = async (_, own) => {
      signal = own;
      await new Promise((_, reject) => own?.addEventListener("abort", () => reject(own.reason)));
    };
    const abort = new AbortController();
    const left = tile(address(z, x, y), abort);
    await expect.poll(() => signal).toBeDefined();
    abort.abort();
    await expect(left).rejects.toMatchObject({ name: "AbortError" });
    expect(signal!.aborted).toBe(true);
    host.before = async () => {};
    await expect(tile(address(z, x, y))).resolves.toBeDefined();
  });

  it("begin anew where the container has changed", async () => {
    const { tile } = asking();
    await tile(address(0, 0, 0));
    host.put("rough.lode", containerOf(UTM));
    const [{ z, x, y }] = tiles as [(typeof tiles)[0]];
    await expect(tile(address(z, x, y))).rejects.toBeInstanceOf(RemoteError);
    await expect(tile(address(0, 0, 0))).rejects.toThrow(/expected proj4/);
  });

  it("keep of a container what says where things stand, and no more than there may be", async () => {
    const source = { url: host.url("rough.lode"), token: undefined };
    const window = [
      [0, 300],
      [0, 300],
    ] as const;
    const kept = await Container.open(source, host.fetch);
    const never = new AbortController().signal;
    const wanted = await kept.heights(kept.header.levels, window, never);
    const all = host.asked.length;
    await kept.heights(kept.header.levels, window, never);
    expect(host.asked.length).toBe(all);
    const small = await Container.open(source, host.fetch, 1);
    for (let turn = 0; turn < 2; turn++) {
      const before = host.asked.length;
      expect(await small.heights(small.header.levels, window, never)).toEqual(wanted);
      const own = host.asked.slice(before);
      expect(own.length).toBeGreaterThan(0);
      expect(own.every(([first]) => first > 0)).toBe(true);
      expect(own.every(([, past]) => past < containerOf(ROUGH).length)).toBe(true);
    }
  });

  it("carry a token of MapLibre's request in a header", async () => {
    const { tile } = asking({}, { Authorization: "Bearer secret", accept: "*/*" });
    await tile(address(0, 0, 0));
    expect(host.tokens).toEqual(new Set(["Bearer secret"]));
    await asking().tile(address(0, 0, 0));
    expect(host.tokens).toEqual(new Set(["Bearer secret", null]));
  });
});

describe("what is refused", () => {
  it.each<[string, unknown, RegExp]>([
    ["rough.lode/0/0/0?encoding=webp", OptionError, /expected an encoding of terrain-rgb, terrarium, got "webp"/],
    ["rough.lode/0/0/0?size=300", OptionError, /expected tiles of 256 or 512 pixels, got 300/],
    ["rough.lode/0/0/0?nodata=low", OptionError, /expected a number as nodata, got "low"/],
    ["rough.lode/0/0/0?scale=0", OptionError, /expected a scale that is not 0/],
    ["rough.lode/1/2/0", OptionError, /expected a tile of zoom 1 of x and y to 1, got 2, 0/],
    ["rough.lode/29/0/0", OptionError, /expected a zoom of 0 to \d+ for these heights, got 29/],
    ["rough.lode", OptionError, /expected the address of a tile, lode:\/\/CONTAINER\/\{z\}\/\{x\}\/\{y\}/],
    ["other.lode/0/0/0", NotFoundError, /other\.lode/],
    [
      "utm.lode/0/0/0",
      InputError,
      /expected proj4 for heights in the CRS "[^"]*UTM zone 11N" \(EPSG:32611\), got none: pass it, lodeProtocol\(\{ proj4 \}\)/,
    ],
    ["plain.lode/0/0/0", InputError, /expected heights with a CRS, got none: encode with --crs/],
    ["blocks.lode/0/0/0", InputError, /expected one block of heights for a map, got \d+ blocks/],
    ["points.lode/0/0/0", InputError, /got points with an x and a y of their own/],
  ])("%s", async (address, kind, words) => {
    host.put("plain.lode", goldenContainer("heights-int16"));
    host.put("blocks.lode", goldenContainer("cube-sphere"));
    host.put("points.lode", goldenContainer("cylinder-even"));
    const { tile } = asking();
    const refused = tile(`lode://https://files.example/${address}`);
    await expect(refused).rejects.toThrow(words);
    await expect(refused).rejects.toBeInstanceOf(kind);
  });

  it("is told of options at once", async () => {
    expect(() => lodeProtocol({ cacheBytes: -1 })).toThrow(OptionError);
    await expect(asking({ worker: true }).tile("lode://https://files.example/a/0/0/0")).rejects.toThrow(/got both/);
  });
});

describe("a worker", () => {
  /** One whose messages are copied, as between threads. */
  function worker(): WorkerLike {
    const made: WorkerLike = { postMessage: () => {}, terminate: () => {}, onmessage: null, onerror: null };
    vi.stubGlobal("fetch", host.fetch);
    const take = serveTiles((message, transfer) => {
      const data: FromTiles = structuredClone(message, { transfer });
      setTimeout(() => made.onmessage?.({ data } as MessageEvent), 0);
    });
    made.postMessage = (message, transfer = []) => {
      const data = structuredClone(message, { transfer }) as ToTiles;
      setTimeout(() => take(data), 0);
    };
    return made;
  }

  it("makes the same tiles, with projections of the page", async () => {
    const [own, local] = [asking({ proj4, worker: () => worker(), fetch: undefined }), asking({ proj4 })];
    const address = `lode://${host.url("utm.lode")}`;
    const [told, wanted] = [await own.json(address), await local.json(address)];
    expect(told).toEqual(wanted);
    const { z, x, y } = UTM.tiles.find((tile) => tile.z === UTM.zoom)!;
    const url = at(told.tiles[0]!, z, x, y);
    expect((await own.tile(url)).pixels).toEqual((await local.tile(url)).pixels);
  });

  it("tells what is wrong, and is left at once", async () => {
    const { tile } = asking({ worker: () => worker(), fetch: undefined });
    await expect(tile(`lode://${host.url("utm.lode")}/0/0/0`)).rejects.toThrow(/expected proj4/);
    await expect(tile(`lode://${host.url("other.lode")}/0/0/0`)).rejects.toBeInstanceOf(NotFoundError);
    const abort = new AbortController();
    const left = tile(`lode://${host.url("rough.lode")}/0/0/0`, abort);
    await Promise.resolve();
    abort.abort();
    await expect(left).rejects.toMatchObject({ name: "AbortError" });
  });

  it("that fails is told of", async () => {
    const made = worker();
    const posted: unknown[] = [];
    made.postMessage = (message) => void posted.push(message);
    const { tile } = asking({ worker: () => made, fetch: undefined });
    const asked = tile(`lode://${host.url("rough.lode")}/0/0/0`);
    await expect.poll(() => posted).toHaveLength(2); // it begins, and is asked
    made.onerror?.({ message: "no room" } as ErrorEvent);
    await expect(asked).rejects.toThrow(/the worker failed: no room/);
    await expect(asked).rejects.toBeInstanceOf(UnavailableError);
    await expect(tile(`lode://${host.url("rough.lode")}/0/0/0`)).rejects.toBeInstanceOf(UnavailableError);
  });
});
