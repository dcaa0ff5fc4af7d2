/** Both ends of a stream without I/O, joined by queues: what is promised holds in whatever order messages cross. */
import fc from "fast-check";
import { describe, expect, it } from "vitest";
import { readIndex } from "../src/container";
import type { View } from "../src/decoding/view";
import { CorruptStreamError, RemoteError, RemoteProtocolError, TruncatedStreamError } from "../src/errors";
import { endOf } from "../src/planning/plan";
import { plan } from "../src/planning/planner";
import { makeTarget, type TargetOptions } from "../src/planning/target";
import { BASE_CREDIT, type Segments } from "../src/protocol/messages";
import { parse, serialize } from "../src/protocol/wire";
import { Download } from "../src/transfer/download";
import { RangeDownload, type RangeRequest } from "../src/transfer/range-download";
import { ReceiverState } from "../src/transfer/receiver-state";
import { MemoryStore } from "../src/transfer/store";
import type { Region, Target } from "../src/types";
import { decoderFor } from "./decoders";
import { containerOf } from "./golden";
import { run } from "./python";
import { hex, recording } from "./recording";
import { Sender, slicesOf } from "./sender";

const DATA: Record<string, Uint8Array> = Object.fromEntries(
  run("tests.web.samples")
    .trim()
    .split("\n")
    .map((line) => {
      const { name, container } = JSON.parse(line) as { name: string; container: string };
      return [name, new Uint8Array(Buffer.from(container, "base64"))];
    }),
);
const KINDS = Object.keys(DATA);
const indexOf = (data: Uint8Array) =>
  readIndex(async (offset, length) => data.subarray(offset, offset + length), data.length);
const INDEX = Object.fromEntries(await Promise.all(KINDS.map(async (kind) => [kind, await indexOf(DATA[kind]!)])));

const NEAR: Region = [
  [0, 60],
  [0, 70],
];
const FAR: Region = [
  [150, 180],
  [100, 139],
];
const TARGETS: TargetOptions[] = [
  {},
  { order: "level" },
  { level: 0 },
  { level: 5 },
  { level: 5, order: "level" },
  { untilRms: "0.5%" },
  { untilRms: 0.5 },
  { untilMax: "5%" },
  { maxBytes: 4000 },
  { maxBytes: 6000, order: "level" },
  { untilRms: 0 },
  { region: NEAR },
  { first: FAR },
];

const reception = (target: Target, store?: MemoryStore) => new ReceiverState(target, decoderFor(target), { store });

/** A client and a server joined by queues, one step of one of them at a time. */
class Link {
  readonly server: Sender;
  readonly client: Download<View>;
  readonly toServer: Uint8Array[] = [];
  readonly toClient: Uint8Array[] = [];
  readonly views: View[] = [];
  afterStop = 0;
  stopped = false;

  constructor(
    kind: string,
    readonly reception: ReceiverState<View>,
    window = BASE_CREDIT,
  ) {
    this.server = new Sender(INDEX[kind]!, DATA[kind]!);
    this.client = new Download(reception, { window });
    this.flush();
  }

  flush(): void {
    this.toServer.push(...this.client.dataToSend());
  }

  act(work: () => void): void {
    work();
    this.flush();
  }

  serve(): boolean {
    const message = this.server.next();
    if (message !== undefined) this.toClient.push(message);
    return message !== undefined;
  }

  hear(): void {
    this.server.receive(this.toServer.shift()!);
  }

  take(): void {
    const message = this.toClient.shift()!;
    const event = parse(message);
    if (this.stopped && event.type === "segments") this.afterStop += event.data.length;
    this.views.push(...this.client.receive(message));
    this.flush();
  }

  /** One step that is possible, by a number; false: there is none. */
  step(choice: number): boolean {
    const steps: (() => unknown)[] = [];
    if (this.toServer.length > 0) steps.push(() => this.hear());
    if (this.toClient.length > 0) steps.push(() => this.take());
    if (steps.length === 0) return this.serve();
    if (choice % (steps.length + 1) === steps.length) this.serve();
    else steps[choice % (steps.length + 1)]!();
    return true;
  }

  /** Deliver everything in turns, until so many bytes have come or nothing is left to do. */
  run(until = Number.POSITIVE_INFINITY): void {
    while (this.reception.dataBytes < until && (this.serve() || this.toServer.length + this.toClient.length > 0)) {
      while (this.toServer.length > 0) this.hear();
      while (this.toClient.length > 0 && this.reception.dataBytes < until) this.take();
    }
  }
}

/** All that was promised has come, nothing twice, and shows what the target says. */
function checkEnd(received: ReceiverState<View>, kind: string, target: Target): void {
  const chosen = plan(INDEX[kind]!, target);
  const end = endOf(chosen);
  expect(received.ended).toBe(chosen.ended);
  expect(received.dataBytes).toBe(received.cached.total);
  expect(received.received).toBe(end.bytes);
  const view = received.decoder.layers.at(-1)!;
  expect([view.bytes, view.rms, view.maxError]).toEqual([end.bytes, end.rms, end.maxError]);
  const expected = decoderFor(target);
  if (target.first !== undefined) expected.focus(target.first);
  for (const { offset, length } of slicesOf(chosen))
    expected.feedAt(offset, DATA[kind]!.subarray(offset, offset + length));
  const level = target.level;
  expect(same(view, expected.layers.at(-1)!, level)).toBe(true);
}

function same(one: View, other: View, level?: number): boolean {
  const values = [one, other].map((view) => view.surface(level).blocks.map((block) => block.points.values));
  return values[0]!.every((own, block) => Buffer.from(bytes(own)).equals(Buffer.from(bytes(values[1]![block]!))));
}

const bytes = (values: ArrayBufferView): Uint8Array =>
  new Uint8Array(values.buffer, values.byteOffset, values.byteLength);

describe("the exchange in docs/protocol.md", () => {
  it("is what this client says, and ends with the surface", () => {
    const entries = recording();
    const target = makeTarget();
    const received = reception(target);
    let client = new Download(received, { window: 48 });
    let outbox = client.dataToSend();
    for (const entry of entries) {
      if (entry.side === "lost") {
        expect(() => client.connectionLost()).toThrow(TruncatedStreamError);
        client = new Download(received, { window: 48 });
        outbox = client.dataToSend();
      } else if (entry.side === "client") {
        expect(hex(outbox.shift() ?? new Uint8Array())).toBe(hex(entry.message));
      } else {
        client.receive(entry.message);
        outbox.push(...client.dataToSend());
      }
    }
    expect(outbox).toEqual([]);
    expect(received.ended).toBe("complete");
    expect(received.dataBytes).toBe(received.cached.total);
    expect(Buffer.from(containerOf("two-points").subarray(0, 144)).length).toBe(received.cached.total);
  });
});

describe.each(KINDS)("%s", (kind) => {
  it.each(TARGETS)("for %j every order of messages ends where the plan does", (options) => {
    const target = makeTarget(options);
    for (const window of [300, BASE_CREDIT]) {
      const link = new Link(kind, reception(target), window);
      link.run();
      checkEnd(link.reception, kind, target);
      expect(link.server.connection.state).toBe("closed");
      expect(link.client.header!.planned).toBe(endOf(plan(INDEX[kind]!, target)).bytes);
      // Levels that are whole make views beside those of layers, and layers beside those of levels; where a region comes
      // first, the tables of layers come with the rest.
      const shown = link.views.map((view) => view.bytes);
      const marks = target.first === undefined ? plan(INDEX[kind]!, target).marks : [];
      for (const mark of marks) expect(shown).toContain(mark.bytes);
      expect(shown).toEqual(shown.toSorted((a, b) => a - b));
    }
  });

  it("whenever one looks elsewhere, wants something else, and the link breaks, all comes once", () => {
    const turn = fc.tuple(fc.nat(80), fc.constantFrom<Region | undefined>(NEAR, FAR, undefined));
    fc.assert(
      fc.property(
        fc.constantFrom(...TARGETS),
        fc.option(fc.constantFrom(...TARGETS.filter((target) => target.region === undefined)), { nil: undefined }),
        fc.constantFrom(900, 5000, 60_000),
        fc.array(turn, { maxLength: 3 }),
        fc.array(fc.nat(120), { maxLength: 2 }),
        fc.boolean(),
        fc.infiniteStream(fc.nat(2)),
        (options, later, window, turns, cuts, stored, choices) => {
          let target = makeTarget(options);
          const received = reception(target, stored ? new MemoryStore() : undefined);
          const todo = [...turns];
          let aim = target.region === undefined ? later : undefined;
          for (const steps of [...cuts, 1e6]) {
            const link = new Link(kind, received, window);
            let pause = 0;
            for (let step = 0; step < steps; step++) {
              if (todo[0] !== undefined && pause >= todo[0][0] && target.region === undefined) {
                const region = todo.shift()![1];
                if (received.ended === undefined) link.act(() => link.client.focus(region));
                pause = 0;
              } else if (todo.length === 0 && aim !== undefined && pause > 20 && received.ended === undefined) {
                target = makeTarget(aim);
                aim = undefined;
                link.act(() => link.client.retarget(target));
              }
              pause += 1;
              if (!link.step(choices.next().value)) break;
            }
            if (received.ended !== undefined) break;
          }
          // The region that comes first is the last one asked for: without one, no index comes for its sake.
          const { first: _, ...rest } = target;
          const chosen = plan(INDEX[kind]!, rest);
          expect(received.ended).toBe(chosen.ended);
          expect(received.dataBytes).toBe(received.cached.total);
          for (const { offset, length } of slicesOf(chosen)) expect(received.cached.covers(offset, length)).toBe(true);
          expect(received.received).toBeGreaterThanOrEqual(endOf(chosen).bytes);
          if (chosen.ended === "complete") {
            const whole = decoderFor(target);
            whole.feed(DATA[kind]!);
            expect(same(received.decoder.layers.at(-1)!, whole.layers.at(-1)!)).toBe(true);
          }
        },
      ),
      {
        numRuns: Number(process.env.RUNS ?? 60),
        // The region is taken back before the server has heard of it.
        examples: [[{ first: FAR }, undefined, 900, [[0, undefined]], [], false, fc.stream(zeros())]],
      },
    );
  });

  it.each(TARGETS)("for %j answers cut anywhere end where the plan does", (options) => {
    fc.assert(
      fc.property(
        fc.infiniteStream(fc.integer({ min: 1, max: 9000 })),
        fc.array(fc.nat(12), { maxLength: 3 }),
        (sizes, cuts) => {
          const target = makeTarget(options);
          const received = reception(target);
          const download = new RangeDownload(received);
          const served = serveRanges(download, DATA[kind]!, sizes, [...cuts]);
          checkEnd(received, kind, target);
          expect(served.most).toBeLessThanOrEqual(2);
        },
      ),
      { numRuns: 6 },
    );
  });

  it.each(TARGETS)("for %j limits say how many requests are under way, and how few bytes too many come", (options) => {
    const bytes = [BASE_CREDIT, 0].map((gap) => {
      const target = makeTarget(options);
      const received = reception(target);
      const download = new RangeDownload(received, undefined, { requests: 5, gap });
      const served = serveRanges(download, DATA[kind]!, Array(10_000).fill(500).values(), []);
      checkEnd(received, kind, target);
      expect(served.most).toBeLessThanOrEqual(5);
      return received.wireBytes;
    });
    expect(bytes[1]).toBeLessThanOrEqual(bytes[0]!);
  });

  it("answers end where the plan does, whenever one looks elsewhere and wants something else", () => {
    const whole = TARGETS.filter((target) => target.region === undefined);
    const change = fc.oneof(
      fc.constantFrom<{ region: Region | undefined }>({ region: NEAR }, { region: FAR }, { region: undefined }),
      fc.constantFrom(...whole.map((aim) => ({ aim }))),
    );
    fc.assert(
      fc.property(
        fc.constantFrom(...whole),
        fc.array(fc.tuple(fc.nat(15), change), { maxLength: 4 }),
        fc.infiniteStream(fc.integer({ min: 1, max: 6000 })),
        fc.array(fc.nat(12), { maxLength: 2 }),
        (options, changes, sizes, cuts) => {
          let target = makeTarget(options);
          const received = reception(target);
          const download = new RangeDownload(received);
          const todo = changes.map(([pause, what]) => ({ pause, what }));
          serveRanges(download, DATA[kind]!, sizes, [...cuts], (leave) => {
            if (todo[0] === undefined || todo[0].pause-- > 0) return;
            const { what } = todo.shift()!;
            if ("region" in what) received.focus(what.region);
            else {
              target = makeTarget(what.aim);
              received.retarget(target);
            }
            leave();
          });
          const chosen = plan(INDEX[kind]!, target);
          expect(received.ended).toBe(chosen.ended);
          expect(received.dataBytes).toBe(received.cached.total);
          expect(received.received).toBe(endOf(chosen).bytes);
          for (const { offset, length } of slicesOf(chosen)) expect(received.cached.covers(offset, length)).toBe(true);
          if (chosen.ended === "complete") {
            const expected = decoderFor(target);
            expected.feed(DATA[kind]!);
            expect(same(received.decoder.layers.at(-1)!, expected.layers.at(-1)!)).toBe(true);
          }
        },
      ),
      { numRuns: Number(process.env.RUNS ?? 40) },
    );
  });
});

/** The first of what is possible, always. */
function* zeros(): Generator<number> {
  for (;;) yield 0;
}

/** Answer requests little by little, now of the first and now of the second, some of them broken off. */
function serveRanges(
  download: RangeDownload<View>,
  data: Uint8Array,
  sizes: Iterator<number>,
  cuts: number[],
  between: (leave: () => void) => void = () => undefined,
): { most: number; places: [number, number][] } {
  const flights: RangeRequest[] = [];
  const places: [number, number][] = [];
  let most = 0;
  for (let turn = 0; turn < 1e6; turn++) {
    for (;;) {
      const { request } = download.request(turn);
      if (request === undefined) break;
      places.push([request.offset, request.length]);
      const last = Math.min(request.end, data.length) - 1;
      const headers = new Headers({ "Content-Range": `bytes ${request.offset}-${last}/${data.length}`, ETag: '"a"' });
      if (request.headers["If-Range"] !== undefined) expect(request.headers["If-Range"]).toBe('"a"');
      download.answer(request, 206, headers, turn);
      flights.push(request);
    }
    most = Math.max(most, flights.length);
    if (flights.length === 0) return { most, places };
    between(() => {
      for (const each of flights.splice(0)) download.leave(each);
    });
    if (flights.length === 0) continue;
    const request = flights[sizes.next().value % flights.length]!;
    const end = Math.min(request.position + sizes.next().value, request.end, data.length);
    download.receive(request, data.slice(request.position, end));
    if (cuts[0] !== undefined && cuts[0]-- <= 0) {
      cuts.shift();
      for (const each of flights.splice(0)) download.leave(each);
    } else if (end === Math.min(request.end, data.length)) {
      flights.splice(flights.indexOf(request), 1);
      download.finish(request, turn);
    }
  }
  throw new Error("there is no end");
}

describe("a stop", () => {
  it("is followed by no more than the credit that is outstanding, and by no view", () => {
    const link = new Link("integers", reception(makeTarget()), 2000);
    link.run(5000);
    const views = link.views.length;
    link.stopped = true;
    link.act(() => link.client.stop());
    link.run();
    expect(link.afterStop).toBeLessThanOrEqual(2000);
    expect(link.views.length).toBe(views);
    expect(link.reception.ended).toBe("stopped");
    expect(link.server.connection.state).toBe("closed");
  });

  it("may come before anything else, or when the time is over", () => {
    const early = new Link("integers", reception(makeTarget()));
    early.act(() => early.client.stop());
    early.run();
    expect(early.reception.ended).toBe("stopped");
    const late = new Link("integers", reception(makeTarget({ seconds: 2 })), 2000);
    expect(late.client.tick(10)).toBe(2);
    late.run(3000);
    late.act(() => expect(late.client.tick(12)).toBeUndefined());
    late.run();
    expect(late.reception.ended).toBe("seconds");
  });
});

describe("what a server says that is not so", () => {
  const begun = () => {
    const link = new Link("integers", reception(makeTarget()), 5000);
    link.run(3000);
    return link;
  };
  const header = (link: Link) => ({ ...link.client.header! });

  it.each<[string, (link: Link) => Uint8Array, new (...given: never[]) => Error, RegExp]>([
    ["an early end", () => serialize({ type: "end", why: "rms" }), TruncatedStreamError, /bytes of the surface/],
    ["a complete end", () => serialize({ type: "end", why: "complete" }), TruncatedStreamError, /at the end/],
    ["two headers", (link) => serialize(header(link)), RemoteProtocolError, /got header/],
    [
      "bytes beyond the end",
      (link) => serialize({ type: "segments", offset: header(link).size, data: new Uint8Array(1) }),
      RemoteProtocolError,
      /expected bytes of/,
    ],
    [
      "damaged bytes",
      (link) => {
        const next = link.reception.cached.end;
        return serialize({ type: "segments", offset: next, data: DATA.integers!.slice(next, next + 4000).fill(7) });
      },
      CorruptStreamError,
      /at byte/,
    ],
    [
      "a refusal",
      () =>
        serialize({
          type: "error",
          code: "busy",
          title: "The server is busy",
          detail: "Too many read it; try again later",
        }),
      RemoteError,
      /^Too many read it; try again later$/,
    ],
    ["what is not a message", () => new Uint8Array([1, 2, 3]), RemoteProtocolError, /MessagePack map/],
  ])("%s is refused", (_, lie, kind, text) => {
    const link = begun();
    link.toClient.length = 0;
    expect(() => {
      const message = lie(link);
      for (let turn = 0; turn < 3; turn++) {
        link.client.receive(message);
        const event = parse(message) as Segments;
        if (event.type === "segments" && event.offset < DATA.integers!.length) return link.run();
      }
    }).toThrow(text);
    expect(kind.prototype).toBeInstanceOf(Error);
  });

  it("another container than before is refused", () => {
    const link = begun();
    const again = new Download(link.reception, { window: 100 });
    const other = serialize({ ...header(link), container: "0".repeat(64) });
    expect(() => again.receive(other)).toThrow(/the surface has changed/);
    const larger = serialize({ ...header(link), size: header(link).size + 1 });
    const third = new Download(link.reception, { window: 100 });
    expect(() => third.receive(larger)).toThrow(RemoteError);
  });

  it("a close code says what went wrong", () => {
    const link = begun();
    expect(() => link.client.connectionLost(4503, "busy: later")).toThrow(/^later$/);
    expect(() => link.client.connectionLost(4429)).toThrow(/too much in progress/);
    expect(() => link.client.connectionLost(1006)).toThrow(TruncatedStreamError);
  });
});

describe("answers over HTTP that are not what was asked for", () => {
  const asked = () => {
    const download = new RangeDownload(reception(makeTarget()));
    return { download, request: download.request(0).request! };
  };
  it.each<[number, Record<string, string>, RegExp]>([
    [200, {}, /got all of it \(status 200\): the server does not support Range/],
    [206, {}, /expected Content-Range to be bytes 0-..., got none \(a server of another site/],
    [206, { "Content-Range": "bytes 5-10/20" }, /got bytes 5-10\/20/],
    [206, { "Content-Range": "bytes 0-10/2000" }, /expected 262144 bytes from 0 on/],
    [206, { "Content-Range": "bytes 0-10/*" }, /Content-Range/],
    [206, { "Content-Range": "bytes 0-19/20", "Content-Encoding": "gzip" }, /encoded with gzip/],
    [416, {}, /got a shorter file/],
  ])("%i %j", (status, headers, text) => {
    const { download, request } = asked();
    expect(() => download.answer(request, status, new Headers(headers))).toThrow(text);
  });

  it("a file that changes, and a body that is too long or short", () => {
    const data = DATA.integers!;
    const { download, request } = asked();
    const last = Math.min(request.length, data.length) - 1;
    const range = `bytes 0-${last}/${data.length}`;
    download.answer(request, 206, new Headers({ "Content-Range": range, ETag: '"one"' }));
    download.receive(request, data.slice(0, 3000));
    expect(() => download.finish(request)).toThrow(TruncatedStreamError);
    const next = download.request(1).request!;
    expect([next.offset, next.headers["If-Range"]]).toEqual([3000, '"one"']);
    const other = new Headers({ "Content-Range": `bytes 3000-${next.end - 1}/${data.length}`, ETag: '"two"' });
    expect(() => download.answer(next, 206, other)).toThrow(/it has changed/);
    expect(() => download.receive(next, new Uint8Array(next.length + 1))).toThrow(/got more/);
  });
});
