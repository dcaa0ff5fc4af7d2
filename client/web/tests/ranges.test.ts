import fc from "fast-check";
import { describe, expect, it } from "vitest";
import { OptionError } from "../src/errors";
import { RangeSet } from "../src/planning/byte-ranges";
import { absolute, makeTarget, tolerance } from "../src/planning/target";
import { FIRST_WINDOW, SMALL_MESSAGE, Window } from "../src/protocol/flow-control";
import { BASE_CREDIT, MAX_CREDIT, MAX_DATA, MIN_WINDOW } from "../src/protocol/messages";
import { Link, windowFor } from "../src/transfer/pacing";
import { NoStreamError } from "../src/transfer/problems";
import { MemoryStore } from "../src/transfer/store";
import { Transports } from "../src/transfer/transports";
import { run } from "./python";

/** What `tests.core.protocol.windows` prints of a window. */
interface Recorded {
  most: number;
  heard: number;
  begun: boolean;
  steps: [granted: number, arrived: number, now: number, waited: number][];
  sizes: [size: number, due: number][];
}

const place = fc.tuple(fc.nat(60), fc.nat(12));
const bytesOf = (places: Iterable<readonly [number, number]>): Set<number> => {
  const found = new Set<number>();
  for (const [offset, length] of places) for (let byte = offset; byte < offset + length; byte++) found.add(byte);
  return found;
};
const sorted = (bytes: Iterable<number>): number[] => [...bytes].sort((a, b) => a - b);

describe("a set of ranges", () => {
  it("is the set of its bytes, however it was made", () => {
    fc.assert(
      fc.property(fc.array(place), fc.array(place), place, (first, added, [offset, length]) => {
        const made = new RangeSet(first);
        for (const each of added) made.add(...each);
        const bytes = bytesOf([...first, ...added]);
        const ranges = [...made];
        expect(sorted(bytesOf(ranges))).toEqual(sorted(bytes));
        for (const [number, [start]] of ranges.entries()) {
          if (number > 0) expect(start).toBeGreaterThan(ranges[number - 1]![0] + ranges[number - 1]![1]);
        }
        expect(made.total).toBe(bytes.size);
        expect(made.size).toBe(ranges.length);
        expect(made.end).toBe(bytes.size ? Math.max(...bytes) + 1 : 0);
        const asked = bytesOf([[offset, length]]);
        expect(sorted(bytesOf(made.missing(offset, length)))).toEqual(sorted([...asked].filter((b) => !bytes.has(b))));
        expect(sorted(bytesOf(made.overlap(offset, length)))).toEqual(sorted([...asked].filter((b) => bytes.has(b))));
        expect(made.covers(offset, length)).toBe([...asked].every((byte) => bytes.has(byte)));
        const copy = made.copy();
        copy.add(1000, 1);
        expect([...made]).toEqual(ranges);
      }),
    );
  });
});

describe("bytes in memory", () => {
  it("are read as they were written, until they are used", () => {
    fc.assert(
      fc.property(fc.shuffledSubarray([...Array(20).keys()]), fc.boolean(), fc.nat(19), (order, keepAll, until) => {
        const data = Uint8Array.from({ length: 60 }, (_, byte) => byte);
        const store = new MemoryStore(keepAll);
        for (const slice of order) store.write(3 * slice, data.slice(3 * slice, 3 * slice + 3));
        for (const [offset, length] of store.ranges)
          expect(store.read(offset, length)).toEqual(data.slice(offset, offset + length));
        store.used(0, 3 * until);
        const kept = order.filter((slice) => keepAll || slice >= until).sort((a, b) => a - b);
        expect(store.all().map(([offset]) => offset)).toEqual(kept.map((slice) => 3 * slice));
      }),
    );
  });
});

describe("targets", () => {
  it("are checked", () => {
    expect(makeTarget({ untilRms: "0.1%", maxBytes: 7 })).toEqual({
      ...{ untilRms: { value: 1e-3, relative: true }, maxBytes: 7, order: "quality" },
    });
    expect(absolute(tolerance("0.1%"), 500)).toBe(0.5);
    expect(tolerance("7e-2%").value).toBe(7e-4);
    expect(() => tolerance("1e-3d")).toThrow(/0.1% of the extent/);
    expect(absolute(tolerance(2), 500)).toBe(2);
    for (const wrong of ["", "d", "much", "1e-3x", -1, Number.NaN, Number.POSITIVE_INFINITY, "Infinity"]) {
      expect(() => tolerance(wrong)).toThrow(OptionError);
    }
    const outside = [
      [3, 3],
      [0, 1],
    ] as never;
    for (const wrong of [
      { level: -1 },
      { level: 1.5 },
      { level: 1, seconds: 2 },
      { maxBytes: 0 },
      { seconds: 0 },
      { order: "other" as never },
      { region: outside },
      { first: outside },
    ]) {
      expect(() => makeTarget(wrong), JSON.stringify(wrong)).toThrow(OptionError);
    }
  });
});

describe("the window", () => {
  it.each([
    [8e3, 0.1],
    [125e3, 0.02],
    [125e3, 0.3],
    [1.25e6, 0.1],
    [12.5e6, 0.02],
  ])("keeps a link of %d bytes/s and %d s busy by little more than it holds", (rate, roundTrip) => {
    const { use, most } = transfer(rate, roundTrip, Math.round(rate * 60));
    expect(most).toBeLessThanOrEqual(Math.max(FIRST_WINDOW, 2.4 * rate * roundTrip));
    expect(use).toBeGreaterThan(0.95);
  });

  it("becomes the largest on a link without limits", () => {
    expect(transfer(1e12, 0.05, 20_000_000).size).toBe(MAX_CREDIT);
  });

  it("is that of the Python library on links of all kinds", () => {
    const lines = run("tests.core.protocol.windows", 300).trim().split("\n");
    expect(lines).toHaveLength(300);
    for (const line of lines) {
      const { most, heard, begun, steps, sizes } = JSON.parse(line) as Recorded;
      const window = new Window();
      window.allow(most);
      window.heard(heard);
      if (begun) window.began(0, heard);
      const found = steps.map(([granted, arrived, now, waited]) => {
        if (granted > 0) window.grant(granted, now);
        window.waited(waited);
        window.arrive(arrived, now);
        return [window.size, window.due(window.size - arrived)];
      });
      expect(found).toEqual(sizes);
    }
  });

  it("stays within its bounds, or as it was set", () => {
    fc.assert(
      fc.property(
        fc.array(fc.tuple(fc.integer({ min: 1, max: 70_000 }), fc.double({ min: 0, max: 3, noNaN: true }))),
        (steps) => {
          const [free, fixed] = [new Window(), new Window(500)];
          free.allow(MAX_CREDIT);
          let now = 0;
          for (const [size, time] of steps) {
            now += time;
            for (const window of [free, fixed]) {
              window.grant(size, now);
              window.arrive(size, now + time / 2);
            }
          }
          expect(free.size).toBeGreaterThanOrEqual(MIN_WINDOW);
          expect(free.size).toBeLessThanOrEqual(MAX_CREDIT);
          expect(fixed.size).toBe(500);
        },
      ),
    );
    const large = new Window(MAX_CREDIT);
    expect(large.size).toBe(BASE_CREDIT); // every server keeps as much
    large.allow(MAX_CREDIT);
    expect([large.size, large.due(MAX_CREDIT - 1), large.due(100)]).toEqual([MAX_CREDIT, 0, MAX_CREDIT - 100]);
    expect(() => new Window(0)).toThrow(OptionError);
    expect(() => new Window(MAX_CREDIT + 1)).toThrow(OptionError);
  });
});

describe("a limited rate", () => {
  it("lets bytes pass one after another", () => {
    const link = new Link(100);
    expect(link.delay(50, 0)).toBe(0.5);
    expect(link.delay(50, 0.1)).toBeCloseTo(0.9);
    expect(link.delay(50, 9)).toBe(0.5);
    expect(windowFor(100)).toBe(1024);
    expect(windowFor(1e9)).toBe(MAX_CREDIT);
  });
});

/** Receive so many bytes over a link: the share of its rate that was used, the most outstanding, the window. */
function transfer(rate: number, roundTrip: number, total: number): { use: number; most: number; size: number } {
  const window = new Window();
  window.allow(MAX_CREDIT);
  let [outstanding, credit] = [window.size, window.size];
  let [free, now, sent, most, largest, ready] = [0, 0, 0, 0, 0, roundTrip];
  window.grant(window.size, 0);
  window.heard(roundTrip);
  window.began(0, roundTrip);
  const events: { at: number; grant: boolean; size: number }[] = [];
  const later = (at: number, grant: boolean, size: number): void => {
    let place = events.length;
    while (place > 0 && events[place - 1]!.at > at) place--;
    events.splice(place, 0, { at, grant, size });
  };
  const send = (): void => {
    while (credit > 0 && sent < total) {
      largest = Math.max(largest, credit);
      const size = Math.min(credit, Math.max(Math.floor(largest / 16), SMALL_MESSAGE), MAX_DATA, total - sent);
      free = Math.max(free, now) + size / rate;
      later(free + roundTrip / 2, false, size);
      credit -= size;
      sent += size;
    }
  };
  now = roundTrip / 2;
  send();
  for (let event = events.shift(); event !== undefined; event = events.shift()) {
    now = event.at;
    if (event.grant) {
      credit += event.size;
      send();
      continue;
    }
    outstanding -= event.size;
    window.waited(now - ready);
    ready = now;
    window.arrive(event.size, now);
    const grant = window.due(outstanding);
    if (grant > 0) {
      window.grant(grant, now);
      outstanding += grant;
      later(now + roundTrip / 2, true, grant);
    }
    most = Math.max(most, outstanding);
  }
  return { use: total / now / rate, most, size: window.size };
}

describe("an address that neither transport reaches", () => {
  it.each([
    ["gone", "gone"],
    ["odd", "odd (and by WebSocket: gone)"],
  ])("is told with each reason once: %s", (reason, told) => {
    const transports = new Transports("http://127.0.0.1:1/v1/surfaces/0", "auto", 0);
    expect(transports.failed(new NoStreamError("gone"), 0, false)).toBe(0);
    expect(() => transports.failed(new NoStreamError(reason), 0, false)).toThrow(new NoStreamError(told));
  });
});
