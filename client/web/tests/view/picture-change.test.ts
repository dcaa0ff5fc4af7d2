import { describe, expect, it } from "vitest";
import { remainingShare } from "../../src/view/ending";
import { type PictureChange, pictureChange, shareAbove } from "../../src/view/picture-change";
import type { Moment, SurfaceInfo } from "../../src/view/source";
import { run } from "../python";

interface Told {
  before: string;
  now: string;
  drawn: number;
  bins: number[];
  above: number[];
  layers: [rms: number, level: number][];
  steps: [first: number, last: number, level: number, finest: number, share: number | null][];
}

const bytes = (text: string): Uint8Array => new Uint8Array(Buffer.from(text, "base64"));
const pixels = (...colours: [number, number, number, number][]): Uint8Array => Uint8Array.from(colours.flat());

function moment(layer: number, level: number, rms: number, attributes: number[] = []): Moment {
  return {
    number: layer,
    layer,
    region: null,
    level,
    bytes: layer,
    seconds: 0,
    rms,
    max: 3 * rms,
    attributes,
    complete: false,
  };
}

function surface(given: Partial<SurfaceInfo>): SurfaceInfo {
  return { levels: 5, exact: true, prices: null, attributes: [], ...given } as SurfaceInfo;
}

describe("the change of a picture", () => {
  it("is the distance of colours in L*a*b*", () => {
    const at = (change: PictureChange): number => change.bins.findIndex((count) => count > 0);
    const bin = (distance: number): number => Math.floor(4 * Math.log2(distance / 2 ** -4));
    const black = pixels([0, 0, 0, 255]);
    // Published values: white is L* = 100; sRGB red (53.24, 80.09, 67.20), blue (32.30, 79.19, -107.86).
    expect(at(pictureChange(black, pixels([255, 255, 255, 255])))).toBe(bin(100));
    expect(at(pictureChange(black, pixels([255, 0, 0, 255])))).toBe(bin(Math.hypot(53.24, 80.09, 67.2)));
    expect(at(pictureChange(black, pixels([0, 0, 255, 255])))).toBe(bin(Math.hypot(32.3, 79.19, 107.86)));
    expect(at(pictureChange(black, black))).toBe(0);
  });

  it("counts what is drawn, and what is drawn in one picture only as visible", () => {
    const before = pixels([0, 0, 0, 0], [9, 9, 9, 255], [9, 9, 9, 255], [1, 2, 3, 0]);
    const now = pixels([0, 0, 0, 255], [9, 9, 9, 255], [9, 9, 9, 0], [3, 2, 1, 0]);
    const change = pictureChange(before, now);
    expect(change.drawn).toBe(3);
    expect(shareAbove(change, 1e6)).toBeCloseTo(2 / 3, 12);
    expect(shareAbove(pictureChange(pixels([1, 1, 1, 0]), pixels([2, 2, 2, 0])), 5)).toBe(0);
  });

  it("and the estimate are those of the Python library", () => {
    const lines = run("tests.web.changes").trim().split("\n");
    expect(lines.length).toBe(6);
    for (const line of lines) {
      const told = JSON.parse(line) as Told;
      const change = pictureChange(bytes(told.before), bytes(told.now));
      expect(change.drawn).toBe(told.drawn);
      expect([...change.bins]).toEqual(told.bins);
      [0.01, 0.1, 2, 5, 37, 1e4].forEach((distance, k) => {
        expect(shareAbove(change, distance)).toBeCloseTo(told.above[k]!, 12);
      });
      const prices = told.layers.map(([rms, level], k) => ({ bytes: 10 * k, level, rms, max: 3 * rms }));
      for (const [first, last, level, finest, share] of told.steps) {
        // What is no layer is the exact end in Python, and complete here.
        if (last >= prices.length) continue;
        const step = { before: moment(first, first, 1), now: moment(last, level, 1), finest };
        const estimate = remainingShare(change, step, surface({ prices }), { kind: "height" });
        if (share === null) expect(estimate).toBeNaN();
        else expect(estimate).toBeCloseTo(share, 12);
      }
    }
  });
});

describe("the estimate", () => {
  // Of 100 pixels 10 have changed by about 4, 30 by about 1, and the others not at all.
  const bins = new Uint32Array(48);
  bins.set([60], 0);
  bins.set([30], 16);
  bins.set([10], 24);
  const change = { drawn: 100, bins };

  it("scales the step to what is missing", () => {
    const from = (e1: number, e2: number): number =>
      remainingShare(change, { before: moment(0, 5, e1), now: moment(1, 5, e2), finest: 5 }, surface({}), {
        kind: "height",
      });
    expect(from(1, Math.SQRT1_2)).toBeCloseTo(0, 12); // as much is missing as has come: none by more than 5
    expect(from(2, 1.9)).toBeCloseTo(0.1, 12); // three times as much is missing
    expect(from(2, 1.99)).toBeGreaterThan(0.39); // ten times
    expect(from(10, 1)).toBe(0);
    expect(from(1, 0)).toBe(0);
  });

  it("is not known where errors do not fall or are unknown", () => {
    for (const [e1, e2] of [
      [1, 1],
      [1, 2],
      [Number.NaN, 1],
      [1, Number.NaN],
    ] as const) {
      const step = { before: moment(0, 5, e1), now: moment(1, 5, e2), finest: 5 };
      expect(remainingShare(change, step, surface({}), { kind: "height" })).toBeNaN();
    }
  });

  it("is not known where nothing is drawn, and of a step too small to be seen", () => {
    const step = (e2: number) => ({ before: moment(0, 5, 2), now: moment(1, 5, e2), finest: 5 });
    const nothing = { drawn: 0, bins: new Uint32Array(48) };
    expect(remainingShare(nothing, step(0.1), surface({}), { kind: "height" })).toBeNaN();
    expect(remainingShare(change, step(1.9999), surface({}), { kind: "height" })).toBeNaN();
  });

  it("of colours by an attribute needs its error too", () => {
    const info = surface({
      attributes: [
        { name: "u", components: 1 },
        { name: "t", components: 1 },
      ],
    });
    const step = { before: moment(0, 5, 10, [9, 2]), now: moment(1, 5, 1, [1, 1.99]), finest: 5 };
    expect(remainingShare(change, step, info, { kind: "height" })).toBe(0);
    expect(remainingShare(change, step, info, { kind: "attribute", name: "u", component: 0 })).toBe(0);
    expect(remainingShare(change, step, info, { kind: "attribute", name: "t", component: 0 })).toBeGreaterThan(0.39);
    const unknown = { ...step, now: moment(1, 5, 1, []) };
    expect(remainingShare(change, unknown, info, { kind: "attribute", name: "t", component: 0 })).toBeNaN();
  });

  it("counts levels that are missing by their slopes, as far as the view shows them", () => {
    const prices = [
      { bytes: 1, level: 1, rms: 10, max: 30 },
      { bytes: 2, level: 2, rms: 2, max: 6 },
      { bytes: 3, level: 5, rms: 0, max: 0 },
    ];
    const at = (finest: number, exact = true): number =>
      remainingShare(change, { before: moment(0, 1, 10), now: moment(1, 2, 2), finest }, surface({ prices, exact }), {
        kind: "height",
      });
    expect(at(2)).toBe(0); // 2 / sqrt(96), all at one level
    expect(at(5)).toBeCloseTo(0.1, 12); // 8 times the slope, and finer than the step
    const left = [...prices.slice(0, 2), { bytes: 3, level: 5, rms: 1.99, max: 3 }];
    const lossy = { before: moment(0, 1, 10), now: moment(1, 2, 2), finest: 5 };
    expect(remainingShare(change, lossy, surface({ prices: left, exact: false }), { kind: "height" })).toBe(0);
    expect(remainingShare(change, lossy, surface({ prices: left }), { kind: "height" })).toBeCloseTo(0.1, 12);
  });
});
