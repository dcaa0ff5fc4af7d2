import { afterEach, expect, it, vi } from "vitest";
import type { FromGeometry, ToGeometry } from "../../src/view/geometry-messages";
import { Session } from "../../src/view/session";
import type { Moment, MomentGrids, Region, Source, SourceEvents, SurfaceInfo } from "../../src/view/source";
import type { Stage } from "../../src/view/stage";

/** A worker that takes no time: each picture is one patch of nothing, which comes from `from`. */
const geometry = vi.hoisted(() => {
  class Geometry {
    static from: Float32Array | null = null;
    static last: Geometry | null = null;
    constructor() {
      Geometry.last = this;
    }
    onmessage: ((event: { data: unknown }) => void) | null = null;
    postMessage(message: ToGeometry): void {
      if (message.kind !== "picture") return;
      const { picture, level } = message;
      const answer = { kind: "patches", picture, level, fresh: true, patches: [{ from: Geometry.from }], triangles: 0 };
      queueMicrotask(() => this.onmessage?.({ data: answer as unknown as FromGeometry }));
    }
    terminate(): void {}
  }
  return Geometry;
});
vi.mock("../../src/view/geometry-worker?worker&inline", () => ({ default: geometry }));

afterEach(() => vi.unstubAllGlobals());

/** Hears of failures alone. */
const UNHEARD = {
  info: () => {},
  moment: () => {},
  progress: () => {},
  refined: () => {},
  drawn: () => {},
  failed: (detail: string) => expect.fail(detail),
  region: () => {},
};

const INFO = { blocks: [{ shape: [33, 33], closed: [false, false] }], levels: 5 } as unknown as SurfaceInfo;

it("moments that come while another is drawn are left out, but for the last", async () => {
  vi.stubGlobal("matchMedia", () => ({ matches: false }));
  let events!: SourceEvents;
  let latest = -1;
  const asked: { moment: number | null; answer: (grids: MomentGrids) => void }[] = [];
  const source = {
    start: (given: SourceEvents) => {
      events = given;
    },
    grids: (moment: number | null) =>
      new Promise<MomentGrids>((resolve) => {
        asked.push({ moment, answer: resolve });
      }),
    stop: () => {},
    close: () => {},
  } as unknown as Source;
  const blends: boolean[] = [];
  const stage = {
    size: [100, 100],
    eye: () => ({}),
    show: (_patches: unknown, _fresh: boolean, blended: boolean, done: () => void) => {
      blends.push(blended);
      done();
    },
  } as unknown as Stage;
  const drawn: number[] = [];
  const told = {
    info: () => {},
    moment: () => {},
    progress: () => {},
    refined: () => {},
    drawn: (_: unknown, { number }: Moment) => drawn.push(number),
    failed: (detail: string) => expect.fail(detail),
    region: () => {},
  };
  const session = new Session(source, stage, told, 1e6);
  const come = (): void => {
    latest += 1;
    const errors = { rms: 9 - latest, max: 9 - latest };
    events.moment({
      number: latest,
      layer: latest,
      region: null,
      level: INFO.levels,
      bytes: latest,
      seconds: 0,
      ...errors,
      attributes: [],
      complete: latest === 7,
    });
  };
  events.info(INFO);
  come();
  expect(asked.length).toBe(1);
  for (let k = 0; k < 4; k += 1) come();
  // Nothing is asked for while a picture is on its way, whatever comes.
  expect(asked.length).toBe(1);
  asked[0]!.answer({ moment: 0, grids: [] });
  await expect.poll(() => asked.length).toBe(2);
  expect(drawn).toEqual([0]);
  for (let k = 0; k < 3; k += 1) come();
  // Which moment is the latest, the source says: more have come since it was asked.
  expect(asked[1]!.moment).toBeNull();
  asked[1]!.answer({ moment: latest, grids: [] });
  await expect.poll(() => drawn).toEqual([0, 7]);
  await new Promise((resolve) => setTimeout(resolve, 50));
  expect(asked.length).toBe(2);
  expect(session.drawnMoment?.number).toBe(7);
  // A moment that is chosen is drawn by itself, however many came after it.
  session.show(3);
  expect(session.awaitsChosen).toBe(true);
  await expect.poll(() => asked.length).toBe(3);
  expect(asked[2]!.moment).toBe(3);
  asked[2]!.answer({ moment: 3, grids: [] });
  await expect.poll(() => drawn).toEqual([0, 7, 3]);
  expect(session.awaitsChosen).toBe(false);
  session.close();
});

interface Judged {
  session: Session;
  events: SourceEvents;
  source: { stopped: number; resumed: number };
  /** Draws the next layer with this much of the picture changed by it. */
  next(changed: number): Promise<void>;
  look(changed: number): void;
  /** What is in the view now. */
  sees(region: Region | null): void;
}

/** A session whose pictures of 1,000 pixels change as a test says, over five layers of equal levels. */
function judged(region: Region | null = null): Judged {
  vi.stubGlobal("matchMedia", () => ({ matches: true }));
  let events!: SourceEvents;
  let number = -1;
  let changed = 0;
  const counts = { stopped: 0, resumed: 0 };
  const source = {
    start: (given: SourceEvents) => {
      events = given;
    },
    grids: (moment: number | null) => Promise.resolve({ moment: moment ?? number, grids: [] }),
    stop: () => {
      counts.stopped += 1;
    },
    resume: () => {
      counts.resumed += 1;
    },
    setTarget: () => {},
    close: () => {},
  } as unknown as Source;
  const picture = (bright: number): Uint8Array =>
    Uint8Array.from({ length: 4000 }, (_, k) => (k % 4 === 3 ? 255 : k < 4 * bright ? 90 : 60));
  const stage = {
    size: [100, 100],
    eye: () => ({}),
    pictures: () => [picture(0), picture(changed)],
    show: (_patches: unknown, _fresh: boolean, _blended: boolean, done: () => void) => done(),
  } as unknown as Stage;
  const session = new Session(source, stage, UNHEARD, 1e6);
  const prices = [16, 8, 4, 2, 1].map((rms, k) => ({ bytes: k, level: 5, rms, max: 3 * rms }));
  events.info({ ...INFO, attributes: [], exact: true, prices });
  events.progress({ state: "receiving", bytes: 1, planned: 9, rate: 0, detail: "" });
  return {
    session,
    events,
    source: counts,
    async next(share: number): Promise<void> {
      number += 1;
      changed = 1000 * share;
      const { rms, max, level } = prices[number]!;
      const times = { bytes: number, seconds: 0, complete: false };
      events.moment({ number, layer: number, region, level, rms, max, attributes: [], ...times });
      await expect.poll(() => session.drawnMoment?.number).toBe(number);
    },
    sees(seen: Region | null): void {
      geometry.last?.onmessage?.({ data: { kind: "wants", level: 5, region: seen } });
    },
    look(share: number): void {
      changed = 1000 * share;
      session.judge();
    },
  };
}

it("a stream stops when its picture looks done, and goes on when it does not any more", async () => {
  geometry.from = new Float32Array();
  const { session, source, next, look } = judged();
  await next(0); // the first picture has none before it
  expect([source.stopped, session.looksDone]).toEqual([0, false]);
  expect(session.remaining).toBeNaN();
  await next(0.3);
  expect(session.remaining).toBeCloseTo(0.3, 2);
  expect(source.stopped).toBe(0);
  await next(0.004);
  expect([source.stopped, session.looksDone]).toEqual([1, true]);
  look(0.004); // another view of the same
  expect([source.stopped, source.resumed]).toEqual([1, 0]);
  look(0.2); // a view in which the last step shows
  expect([source.resumed, session.looksDone]).toEqual([1, false]);
  await next(0.004);
  expect([source.stopped, session.looksDone]).toEqual([2, true]);
  session.resume(); // the rest is wanted
  expect([source.resumed, session.looksDone, session.endsByItself]).toEqual([2, false, false]);
  await next(0);
  expect(source.stopped).toBe(2);
  session.close();
});

it.each([
  ["a target", (session: Session) => session.setTarget({ rms: 0.5 })],
  ["the checkbox", (session: Session) => Object.assign(session, { endsByItself: false })],
  ["colours by the last change", (session: Session) => session.setField({ kind: "change" })],
  ["an earlier moment that is looked at", (session: Session) => session.show(0)],
])("%s switches the rule off", async (_, off) => {
  geometry.from = new Float32Array();
  const { session, source, next } = judged();
  await next(0);
  off(session);
  if (session.following) {
    await next(0);
    await next(0);
  } else {
    session.judge();
  }
  expect([source.stopped, session.looksDone]).toEqual([0, false]);
  session.close();
});

it("a layer of a region is none of what is seen beside it", async () => {
  geometry.from = new Float32Array();
  const inside: Region = [
    [4, 9],
    [5, 8],
  ];
  const { session, source, next, sees, look } = judged([
    [0, 10],
    [0, 10],
  ]);
  sees(inside);
  await next(0);
  await next(0.004);
  expect([source.stopped, session.looksDone]).toEqual([1, true]);
  sees([
    [4, 15],
    [5, 8],
  ]);
  look(0); // nothing has changed there, since nothing has come
  expect([source.resumed, session.looksDone]).toEqual([1, false]);
  expect(session.remaining).toBeNaN();
  sees(inside);
  look(0);
  expect([source.stopped, session.looksDone]).toEqual([2, true]);
  sees(null);
  look(0);
  expect([source.resumed, session.looksDone]).toEqual([2, false]);
  session.close();
});

it("without a picture before nothing is known of the step", async () => {
  geometry.from = null;
  const { session, source, next } = judged();
  await next(0);
  await next(0);
  expect(session.remaining).toBeNaN();
  expect(source.stopped).toBe(0);
  session.close();
});

it("what is drawn is drawn afresh where another description of it comes", async () => {
  vi.stubGlobal("matchMedia", () => ({ matches: true }));
  let events!: SourceEvents;
  const asked: ((grids: MomentGrids) => void)[] = [];
  const source = {
    start: (given: SourceEvents) => {
      events = given;
    },
    grids: () => new Promise<MomentGrids>((resolve) => asked.push(resolve)),
    close: () => {},
  } as unknown as Source;
  const stage = {
    size: [100, 100],
    eye: () => ({}),
    show: (_patches: unknown, _fresh: boolean, _blended: boolean, done: () => void) => done(),
  } as unknown as Stage;
  const session = new Session(source, stage, UNHEARD, 1e6);
  const post = vi.spyOn(geometry.last!, "postMessage");
  const fresh = (): boolean[] =>
    post.mock.calls.flatMap(([message]) => (message.kind === "picture" ? [message.options.fresh] : []));
  events.info(INFO);
  const errors = { rms: 1, max: 1, attributes: [] };
  events.moment({ number: 0, layer: 0, region: null, level: 5, bytes: 1, seconds: 0, complete: false, ...errors });
  events.info({ ...INFO }); // while the grids of the first are on their way
  asked[0]!({ moment: 0, grids: [] });
  await expect.poll(() => asked.length).toBe(2);
  asked[1]!({ moment: 0, grids: [] });
  await expect.poll(() => fresh()).toEqual([true, true]);
  await expect.poll(() => session.drawnMoment?.number).toBe(0);
  events.info({ ...INFO });
  await expect.poll(() => asked.length).toBe(3);
  asked[2]!({ moment: 0, grids: [] });
  await expect.poll(() => fresh()).toEqual([true, true, true]);
  events.moment({ number: 1, layer: 1, region: null, level: 5, bytes: 2, seconds: 0, complete: true, ...errors });
  await expect.poll(() => asked.length).toBe(4);
  asked[3]!({ moment: 1, grids: [] });
  await expect.poll(() => session.drawnMoment?.number).toBe(1);
  expect(fresh()).toEqual([true, true, true, false]);
  session.close();
});

it("what is drawn is a level finer than the data, as far as there are levels", async () => {
  vi.stubGlobal("matchMedia", () => ({ matches: true }));
  let events!: SourceEvents;
  const levels: number[] = [];
  const source = {
    start: (given: SourceEvents) => {
      events = given;
    },
    grids: (_: number | null, level: number) => {
      levels.push(level);
      return Promise.resolve({ moment: levels.length - 1, grids: [] });
    },
    close: () => {},
  } as unknown as Source;
  const stage = {
    size: [100, 100],
    eye: () => ({}),
    show: (_patches: unknown, _fresh: boolean, _blended: boolean, done: () => void) => done(),
  } as unknown as Stage;
  const session = new Session(source, stage, UNHEARD, 1e6);
  events.info(INFO);
  for (const [number, level] of [0, 3, 4, 5].entries()) {
    const errors = { rms: 9 - number, max: 9 - number, attributes: [] };
    const times = { bytes: number, seconds: 0, complete: false };
    events.moment({ number, layer: number, region: null, level, ...errors, ...times });
    await expect.poll(() => session.drawnMoment?.number).toBe(number);
  }
  expect(levels).toEqual([1, 4, 5, 5]);
  session.close();
});
