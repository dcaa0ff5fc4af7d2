/** Streams from servers of the Python library, over WebSocket and HTTP Range, and over links that break. */
import { afterAll, beforeAll, describe, expect, it } from "vitest";
import WebSocket from "ws";
import { Decoder, decode } from "../src/decoding";
import type { View } from "../src/decoding/view";
import {
  LodestreamError,
  NotFoundError,
  OptionError,
  RemoteError,
  RemoteProtocolError,
  SilenceError,
  UnreachableError,
} from "../src/errors";
import { loadKernels } from "../src/kernels/instance";
import { makeTarget, type TargetOptions } from "../src/planning/target";
import type { Progress, StreamOptions, StreamState } from "../src/transfer/options";
import type { SocketClass } from "../src/transfer/socket";
import { MemoryStore } from "../src/transfer/store";
import { Stream } from "../src/transfer/stream";
import type { Region, Surface } from "../src/types";
import { decoderFor } from "./decoders";
import { type Fault, Faulty, type Served, serve } from "./servers";

let served: Served;
let whole: Surface;

beforeAll(async () => {
  served = await serve();
  whole = await decode(await loadKernels(), served.data);
});
afterAll(() => served?.stop());

const HASTY = { first: 0.002, longest: 0.05 };
const SOCKETS = WebSocket as unknown as SocketClass;

function streamOf(source: string | Blob, target: TargetOptions = {}, options: StreamOptions = {}): Stream<View> {
  const made = makeTarget(target);
  return new Stream(source, made, decoderFor(made), {
    WebSocket: SOCKETS,
    pauses: HASTY,
    closeTimeout: 0.5,
    ...options,
  });
}

async function all(stream: Stream<View>): Promise<View[]> {
  const views: View[] = [];
  for await (const view of stream) views.push(view);
  return views;
}

function expectWhole(view: View): void {
  expect(view.complete).toBe(true);
  expect(view.surface().blocks[0]!.points).toEqual(whole.blocks[0]!.points);
}

/** An answer whose head broke off, as Chromium hands it on: what had come of the head, and no body. */
function cutHead(status: number, headers: Record<string, string>): Response {
  const ok = status >= 200 && status < 300;
  return Object.defineProperties(new Response(null, { headers }), { status: { value: status }, ok: { value: ok } });
}

async function faulty<T>(
  url: string,
  fault: (connection: number) => Fault,
  work: (link: Faulty) => Promise<T>,
): Promise<T> {
  const link = await Faulty.to(url, fault);
  try {
    return await work(link);
  } finally {
    await link.close();
  }
}

const TRANSPORTS: [string, () => string | Blob, StreamOptions][] = [
  ["a WebSocket", () => served.surface, { transport: "ws" }],
  ["HTTP Range of a surface", () => served.surface, { transport: "http" }],
  ["a plain file of a web server", () => served.static, {}],
  ["a Blob", () => new Blob([served.data as Uint8Array<ArrayBuffer>]), {}],
];

describe.each(TRANSPORTS)("over %s", (name, source, options) => {
  it("a stream ends with the original", async () => {
    const stream = streamOf(source(), {}, options);
    const views = await all(stream);
    expectWhole(views.at(-1)!);
    expect(stream.ended).toBe("complete");
    expect(stream.state).toMatchObject({ phase: "ended", ended: "complete" });
    const { reception } = stream;
    expect(reception.dataBytes).toBe(reception.cached.total);
    expect((reception.decoder as ReturnType<typeof decoderFor>).metadata).toMatchObject({ name: "terrain" });
  });

  it.each<[TargetOptions, string]>([
    [{ untilRms: "1%" }, "rms"],
    [{ untilMax: 30 }, "max"],
    [{ maxBytes: 3000 }, "bytes"],
    [{ level: 3 }, "level"],
    [{ maxBytes: 5000, order: "level" }, "bytes"],
  ])("%j ends with %s", async (target, ended) => {
    const stream = streamOf(source(), target, options);
    const views = await all(stream);
    expect(stream.ended).toBe(ended);
    const last = views.at(-1)!;
    if (target.maxBytes !== undefined) expect(last.bytes).toBeLessThanOrEqual(target.maxBytes);
    if (target.untilMax !== undefined) expect(last.maxError).toBeLessThanOrEqual(30);
    expect(stream.progress.received).toBe(stream.progress.planned);
    if (target.order !== "level") expect(last.bytes).toBe(stream.progress.received);
  });

  it("what a target cannot have is refused", async () => {
    await expect(all(streamOf(source(), { level: 99 }, options))).rejects.toThrow(/expected a level of 0 to/);
    const outside: Region = [
      [0, 999],
      [0, 1],
    ];
    await expect(all(streamOf(source(), { region: outside }, options))).rejects.toThrow(OptionError);
  });

  it("leaving the loop stops", async () => {
    const stream = streamOf(source(), {}, { ...options, window: 1024, limitRate: 20_000 });
    for await (const view of stream) {
      expect(view.number).toBe(0);
      break;
    }
    expect(stream.ended).toBe("stopped");
    expect(await stream.next()).toEqual({ value: undefined, done: true });
  });

  it("another target after the end goes on with what is cached", async () => {
    const stream = streamOf(source(), { maxBytes: 3000 }, options);
    await all(stream);
    const cached = stream.reception.dataBytes;
    stream.aim({ level: 6 });
    await all(stream);
    expect(stream.ended).toBe("level");
    stream.aim({});
    const views = await all(stream);
    expect(stream.ended).toBe("complete");
    expectWhole(views.at(-1)!);
    expect(cached).toBeGreaterThan(0);
    expect(stream.reception.dataBytes).toBe(stream.reception.cached.total);
    expect(() => stream.aim({ attributes: [] })).toThrow(/another stream/);
  });

  it("another target on the way takes the place of the first", async () => {
    const stream = streamOf(source(), {}, { ...options, limitRate: 60_000 });
    let aimed = false;
    for await (const view of stream) {
      if (!aimed && view.number >= 2) {
        aimed = true;
        stream.aim({ maxBytes: 9000 });
      }
    }
    expect(stream.ended).toBe("bytes");
    expect(stream.progress.planned).toBeLessThanOrEqual(9000);
    if (name === "a WebSocket") expect(stream.progress.connections).toBe(1);
  });

  it("the window of a level comes alone, and is cut out of the level", async () => {
    const region: Region = [
      [5, 40],
      [12, 30],
    ];
    const decoder = new Decoder(await loadKernels());
    decoder.feed(served.data);
    const level = decoder.header!.levels - 1;
    const own = decoder.surface(level).blocks[0]!;
    const [rows, columns] = ([0, 1] as const).map((axis) => {
      const lines = axis ? own.columns : own.rows;
      const [start, stop] = region[axis];
      return [...lines].flatMap((place, number) => (place >= start && place < stop ? [number] : []));
    });
    const wanted = rows!.flatMap((row) =>
      columns!.map((column) => Number(own.points.values[row * own.shape[1] + column])),
    );
    const stream = streamOf(source(), { region, level }, options);
    const last = (await all(stream)).at(-1)!;
    expect(stream.ended).toBe("level");
    expect(last.bound).toBe(true);
    const shown = last.surface().blocks[0]!;
    expect(shown.shape).toEqual([rows!.length, columns!.length]);
    expect([...shown.points.values].map(Number)).toEqual(wanted);
    expect([...last.window(region, level).blocks[0]!.points.values].map(Number)).toEqual(wanted);
    expect(() => last.surface(level + 1)).toThrow(/level of 0 to/);
    expect(stream.reception.dataBytes).toBe(stream.reception.cached.total);
    expect(() => stream.aim({ region, level: level - 1 })).toThrow(/another stream/);
  });

  it("a region comes first, once it is looked at", async () => {
    const region: Region = [
      [0, 20],
      [0, 20],
    ];
    const stream = streamOf(source(), {}, { ...options, limitRate: 60_000, window: 2000 });
    let before = 0;
    let exact = 0;
    for await (const view of stream) {
      if (view.number === 1) stream.focus(region);
      const shown = view.window(region).blocks[0]!.points.values;
      const own = decodedWindow(region);
      if (Buffer.from(bytes(shown)).equals(Buffer.from(bytes(own))) && exact === 0) exact = view.bytes;
      before = view.bytes;
    }
    expect(stream.ended).toBe("complete");
    if (name === "a WebSocket") expect(exact).toBeLessThan(0.9 * before);
    expect(stream.reception.dataBytes).toBe(stream.reception.cached.total);
  });
});

function bytes(values: ArrayBufferView): Uint8Array {
  return new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
}

function decodedWindow([rows, columns]: Region): Int16Array {
  const { shape, points } = whole.blocks[0]!;
  const cut: number[] = [];
  for (let row = rows[0]; row < rows[1]; row++) {
    for (let column = columns[0]; column < columns[1]; column++) {
      cut.push(Number(points.values[row * shape[1] + column]));
    }
  }
  return Int16Array.from(cut);
}

describe("a stop", () => {
  it("takes effect at once, and the bytes end within the credit", async () => {
    const stream = streamOf(served.surface, {}, { transport: "ws", window: 1024 });
    let seen = 0;
    let came = 0;
    for await (const _ of stream) {
      seen += 1;
      if (seen === 3) {
        came = stream.reception.dataBytes;
        await stream.stop();
      }
    }
    expect(seen).toBe(3);
    expect(stream.ended).toBe("stopped");
    expect(stream.reception.dataBytes - came).toBeLessThanOrEqual(1024);
  });

  it("of a slow answer ends the request", async () => {
    const signals: AbortSignal[] = [];
    const watched: typeof fetch = (input, init) => {
      signals.push(init!.signal!);
      return fetch(input, init);
    };
    const stream = streamOf(served.static, {}, { limitRate: 5000, fetch: watched });
    for await (const view of stream) {
      if (view.number !== 1) continue;
      expect(signals.at(-1)!.aborted).toBe(false);
      void stream.stop();
    }
    expect(stream.ended).toBe("stopped");
    expect(signals.at(-1)!.aborted).toBe(true);
    expect(stream.reception.dataBytes).toBeLessThan(served.data.length);
  });

  it("before it begins asks nobody", async () => {
    const stream = streamOf("http://127.0.0.1:1/v1/surfaces/0");
    await stream.stop();
    expect(await all(stream)).toEqual([]);
    expect(stream.ended).toBe("stopped");
  });

  it("comes by itself after so many seconds", async () => {
    for (const source of [served.surface, served.static]) {
      const stream = streamOf(source, {}, { limitRate: 4000 });
      expect((await stream.next()).done).toBe(false);
      stream.aim({ seconds: 0.4 });
      const views = await all(stream);
      expect(stream.ended).toBe("seconds");
      for (const view of views) expect(view.complete).toBe(false);
      const another = streamOf(source, { seconds: 0.4 }, { limitRate: 4000 });
      await all(another);
      expect(another.ended).toBe("seconds");
    }
  });
});

describe("a token", () => {
  it.each(["ws", "http"] as const)("is given over %s, and wanted", async (transport) => {
    const addresses: string[] = [];
    const watched = class extends WebSocket {
      constructor(url: string, protocols: string[]) {
        addresses.push(url);
        super(url, protocols);
      }
    } as unknown as SocketClass;
    const stream = streamOf(served.closed, {}, { transport, token: served.token, WebSocket: watched });
    expectWhole((await all(stream)).at(-1)!);
    for (const address of addresses) expect(address).not.toContain("?");
    const without = all(streamOf(served.closed, {}, { transport }));
    await expect(without).rejects.toMatchObject({ code: "no-token" });
    const wrong = all(streamOf(served.closed, {}, { transport, token: `${served.token}x` }));
    await expect(wrong).rejects.toMatchObject({ code: "bad-token" });
  });
});

describe("a link that breaks", () => {
  const cuts =
    (...bytesDown: number[]) =>
    (number: number): Fault =>
      bytesDown[number] === undefined ? {} : { cutDown: bytesDown[number] };

  it.each(["ws", "http", "auto"] as const)("again and again costs only what was under way: %s", async (transport) => {
    const states: StreamState[] = [];
    await faulty(served.surface, cuts(4000, 700, 4000, 250, 6000), async (link) => {
      const onState = (state: StreamState) => void states.push(state);
      const stream = streamOf(link.url, {}, { transport, window: 2000, onState });
      const views = await all(stream);
      expectWhole(views.at(-1)!);
      expect(views.map((view) => view.number)).toEqual(views.map((_, number) => number));
      expect(stream.reception.dataBytes).toBe(stream.reception.cached.total);
      expect(link.connections).toBeGreaterThanOrEqual(4);
    });
    const phases = states.map((state) => state.phase);
    expect(phases[0]).toBe("connecting");
    expect(phases).toContain("reconnecting");
    expect(phases.at(-1)).toBe("ended");
    expect(states.find((state) => state.phase === "reconnecting")).toMatchObject({ problem: expect.any(String) });
  });

  it.each<TargetOptions>([{ level: 5 }, { order: "level" }, { maxBytes: 9000 }])("%j survives it", async (target) => {
    const expected = await all(streamOf(served.surface, target, { transport: "ws" }));
    await faulty(served.surface, cuts(2000, 1500, 3500), async (link) => {
      const stream = streamOf(link.url, target, { transport: "ws", window: 500 });
      const views = await all(stream);
      expect(views.map((view) => view.info)).toEqual(expected.map((view) => view.info));
      expect(stream.reception.dataBytes).toBe(stream.reception.cached.total);
    });
  });

  it("and falls silent is replaced", async () => {
    await Promise.all(
      (["ws", "http"] as const).map((transport) =>
        faulty(
          served.surface,
          (number) => (number === 0 ? { cutDown: 6000, vanish: true } : {}),
          async (link) => {
            const stream = streamOf(link.url, {}, { transport, silence: 3, closeTimeout: 0.1, window: 2000 });
            expectWhole((await all(stream)).at(-1)!);
            expect(stream.reception.dataBytes).toBe(stream.reception.cached.total);
          },
        ),
      ),
    );
  });

  it("for good is told after the deadline, and what has come stays", async () => {
    for (const source of [served.surface, served.static]) {
      await faulty(
        source,
        (number) => ({ cutDown: number === 0 ? 6000 : 0 }),
        async (link) => {
          const stream = streamOf(link.url, {}, { deadline: 0.6, window: 2000 });
          await expect(all(stream)).rejects.toThrow(LodestreamError);
          expect(stream.ended).toBe("truncated");
          expect(stream.reception.decoder.layers.length).toBeGreaterThan(0);
        },
      );
    }
  });

  it("another address goes on with what is kept", async () => {
    const store = new MemoryStore(true);
    const first = await faulty(served.surface, cuts(8000), async (link) => {
      const stream = streamOf(link.url, {}, { transport: "ws", window: 2000, deadline: 0, store });
      await expect(all(stream)).rejects.toThrow(LodestreamError);
      return stream.reception;
    });
    const cached = store.ranges.total;
    expect(cached).toBeGreaterThan(3000);
    for (const source of [served.surface, served.static]) {
      const again = new MemoryStore(true);
      for (const [offset, data] of store.all()) again.write(offset, data);
      const { container, size } = first;
      const came: number[] = [];
      const onBytes = (_: number, data: Uint8Array) => void came.push(data.length);
      const stream = streamOf(source, {}, { store: again, container, size, onBytes });
      expectWhole((await all(stream)).at(-1)!);
      expect(stream.reception.dataBytes).toBe(stream.reception.cached.total - cached);
      expect(came.reduce((sum, length) => sum + length, 0)).toBe(stream.reception.dataBytes);
    }
  });

  it.each([
    [2, {}],
    [20, {}],
    [200, {}],
    [206, {}],
    [206, { etag: '"0123' }],
    [206, { "content-range": "bytes 0-" }],
    [206, { "content-range": "bytes 0-99/1" }],
    [301, {}],
    [307, { "content-length": "0" }],
  ])("in the head of an answer of status %s and %j is not the end", async (status, headers) => {
    let asked = 0;
    const cut: typeof fetch = async (input, init) => {
      asked += 1;
      return asked <= 2 ? cutHead(status, headers) : fetch(input, init);
    };
    const views = await all(streamOf(served.static, {}, { fetch: cut }));
    expectWhole(views.at(-1)!);
    expect(asked).toBe(3);
  });

  it("in every head ends it, and it says so", async () => {
    const cut = async (): Promise<Response> => cutHead(206, { etag: '"0123' });
    await expect(all(streamOf(served.static, {}, { fetch: cut }))).rejects.toThrow(UnreachableError);
  });
});

describe("a server that is not one", () => {
  it("does not know Range", async () => {
    const stream = streamOf(served.whole);
    await expect(all(stream)).rejects.toThrow(/does not support Range/);
    await expect(all(streamOf(served.whole))).rejects.toThrow(RemoteProtocolError);
  });

  it("does not have the surface, or the file", async () => {
    const missing = served.surface.replace(/[^/]+$/, "0123456789abcdef0123");
    for (const transport of ["ws", "http", "auto"] as const) {
      await expect(all(streamOf(missing, {}, { transport }))).rejects.toThrow(NotFoundError);
    }
    await expect(all(streamOf(`${served.static}x`))).rejects.toThrow(NotFoundError);
  });

  it.each(["v1/surfaces/0", "a.lode"])("is not there, and is asked a few times only: %s", async (path) => {
    const states: StreamState[] = [];
    const onState = (state: StreamState) => void states.push(state);
    const stream = streamOf(`http://127.0.0.1:9/${path}`, {}, { onState, deadline: 1e6 });
    await expect(all(stream)).rejects.toThrow(UnreachableError);
    // Three attempts by each transport, of which the last one is the end.
    expect(states.filter(({ problem }) => problem !== undefined).length).toBeLessThan(6);
    expect(states.map(({ phase }) => phase)).not.toContain("reconnecting");
  });

  it("says nothing", async () => {
    await faulty(
      served.static,
      () => ({ cutDown: 0, vanish: true }),
      async (link) => {
        const stream = streamOf(link.url, {}, { silence: 0.1, deadline: 0.1 });
        await expect(all(stream)).rejects.toThrow(SilenceError);
      },
    );
  });

  it("lets no WebSocket through, so that HTTP Range is used", async () => {
    const blocked = class extends WebSocket {
      constructor(url: string, protocols: string[]) {
        super(url.replace("/v1/", "/nothing/"), protocols);
      }
    } as unknown as SocketClass;
    const stream = streamOf(served.surface, {}, { WebSocket: blocked });
    expectWhole((await all(stream)).at(-1)!);
    expect(stream.transport).toBe("http");
    const only = all(streamOf(served.surface, {}, { WebSocket: blocked, transport: "ws" }));
    await expect(only).rejects.toThrow(/no WebSocket to/);
  });

  it("is no server's address", () => {
    expect(() => streamOf("ftp://host/a.lode")).toThrow(OptionError);
    expect(() => streamOf("http://host/")).toThrow(/expected a surface's address/);
    expect(() => streamOf("http://host/a.lode", {}, { transport: "ws" })).toThrow(/expected a surface's address/);
    expect(() => streamOf("http://host/a.lode", {}, { limitRate: 0 })).toThrow(OptionError);
    expect(() => streamOf("http://host/a.lode", {}, { silence: Number.NaN })).toThrow(OptionError);
  });
});

describe("a file", () => {
  it("that is no container, or is cut short, is refused as by Python", async () => {
    await expect(all(streamOf(new Blob(["nothing of the kind, but long enough to look at"])))).rejects.toThrow(
      /expected a Lodestream container/,
    );
    const cut = new Blob([served.data.slice(0, 3000) as Uint8Array<ArrayBuffer>]);
    await expect(all(streamOf(cut))).rejects.toThrow(LodestreamError);
    const damaged = served.data.slice();
    damaged[served.data.length >> 1]! ^= 1;
    const stream = streamOf(new Blob([damaged as Uint8Array<ArrayBuffer>]));
    await expect(all(stream)).rejects.toMatchObject({ name: "CorruptStreamError", offset: expect.any(Number) });
    expect(stream.reception.decoder.layers.length).toBeGreaterThan(0);
  });
});

describe("a link that is far away", () => {
  it.each(["ws", "http"] as const)("shows the first view after two round trips: %s", async (transport) => {
    const source = transport === "ws" ? served.surface : served.static;
    await faulty(
      source,
      // The proxy takes connections at once, where a far server takes a round trip.
      () => ({ roundTrips: 1 }),
      async (link) => {
        const stream = streamOf(link.url, {}, transport === "ws" ? { transport } : {});
        expect((await stream.next()).done).toBe(false);
        await stream.close();
      },
    );
  });
});

describe("a limited rate", () => {
  it("is kept, told, and can be changed", async () => {
    const progress: Progress[] = [];
    const onProgress = (now: Progress) => void progress.push(now);
    const stream = streamOf(served.surface, { maxBytes: 4000 }, { transport: "ws", limitRate: 8000, onProgress });
    const began = performance.now();
    await all(stream);
    const passed = (performance.now() - began) / 1000;
    expect(stream.progress.wireBytes / passed).toBeLessThan(8500);
    const last = progress.at(-1)!;
    expect(last.received).toBe(last.planned);
    expect(progress.map((now) => now.wireBytes)).toEqual(
      progress.map((now) => now.wireBytes).toSorted((a, b) => a - b),
    );
    const later = streamOf(served.surface, {}, { transport: "ws", limitRate: 500 });
    for await (const view of later) {
      if (view.number !== 0) continue;
      later.throttle(1); // with which it takes a day
      setTimeout(() => later.throttle(undefined), 50);
    }
    expect(later.ended).toBe("complete");
  });

  it("views that nobody waits for are not kept where only the latest are wanted", async () => {
    const stream = streamOf(served.surface, {}, { transport: "ws", latest: true });
    const seen: View[] = [];
    for await (const view of stream) {
      seen.push(view);
      await expect.poll(() => stream.ended).toBe("complete");
    }
    expectWhole(seen.at(-1)!);
    expect(seen.length).toBeLessThanOrEqual(2);
  });
});

describe("an error of the server", () => {
  it("keeps its code", () => {
    expect(new RemoteError("busy", "later")).toMatchObject({ code: "busy", name: "RemoteError" });
  });
});
