import { afterEach, expect, it, vi } from "vitest";
import type { FromGeometry, ToGeometry } from "../../src/view/geometry-messages";
import { Session } from "../../src/view/session";
import type { Moment, MomentGrids, Source, SourceEvents, SurfaceInfo } from "../../src/view/source";
import type { Stage } from "../../src/view/stage";

/** A worker that takes no time: each picture is a set of no patches. */
const geometry = vi.hoisted(() => {
  class Geometry {
    onmessage: ((event: { data: unknown }) => void) | null = null;
    postMessage(message: ToGeometry): void {
      if (message.kind !== "picture") return;
      const { picture, level } = message;
      const answer = { kind: "patches", picture, level, fresh: true, patches: [], triangles: 0 };
      queueMicrotask(() => this.onmessage?.({ data: answer as unknown as FromGeometry }));
    }
    terminate(): void {}
  }
  return Geometry;
});
vi.mock("../../src/view/geometry-worker?worker&inline", () => ({ default: geometry }));

afterEach(() => vi.unstubAllGlobals());

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
    events.moment({ number: latest, level: INFO.levels, bytes: latest, seconds: 0, ...errors, complete: latest === 7 });
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
