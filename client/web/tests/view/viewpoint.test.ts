import { describe, expect, it } from "vitest";
import type { Orbit } from "../../src/view/camera";
import { Framing } from "../../src/view/framing";
import type { Box } from "../../src/view/geometry-messages";
import type { SurfaceInfo } from "../../src/view/source";
import { Viewpoint } from "../../src/view/viewpoint";

const INFO: SurfaceInfo = {
  name: "",
  blocks: [{ shape: [9, 9], closed: [false, false] }],
  levels: 3,
  extent: 6,
  heights: false,
  georeferenced: false,
  geographic: false,
  mapped: false,
  joined: false,
  unit: "",
  planeUnit: "",
  exact: true,
  attributes: [],
  size: 0,
  prices: null,
};
const FRAME = { origin: [0, 0, 0], scale: [0.5, 0.5, 0.5] } as const;
const COARSE: Box = [
  [-1, -1, -1],
  [1, 1, 1],
];
const ASIDE: Box = [
  [-1, -1, -1],
  [3, 3, 1],
];

class Seen {
  poses: { orbit: Orbit; exaggeration: number }[] = [];
  readonly at = new Viewpoint((pose) => this.poses.push(pose));

  get last(): { orbit: Orbit; exaggeration: number } {
    return this.poses.at(-1)!;
  }
}

const framing = (box: Box, info: Partial<SurfaceInfo> = {}, frame: Framing["frame"] = FRAME): Framing =>
  new Framing(frame, box, { ...INFO, ...info });

describe("the camera that nobody has touched", () => {
  it("follows a surface that turns out to lie aside, without a jump", () => {
    const { at, poses } = new Seen();
    at.take(framing(COARSE), 1, 0);
    expect(at.orbit?.target).toEqual([0, 0, 0]);
    at.take(framing(ASIDE), 1, 1000);
    expect(at.orbit?.target).toEqual([0, 0, 0]);
    for (let now = 1000; at.advance(now); now += 16);
    expect(at.orbit?.target).toEqual([0.5, 0.5, 0]);
    const steps = poses.slice(1).map(({ orbit }, k) => Math.abs(orbit.target[0] - poses[k]!.orbit.target[0]));
    expect(steps.length).toBeGreaterThan(20);
    expect(Math.max(...steps)).toBeLessThan(0.05);
  });

  it("stays for small changes, and goes at once where nothing is to move", () => {
    const seen = new Seen();
    seen.at.take(framing(COARSE), 1, 0);
    seen.at.take(framing([COARSE[0], [1.02, 1.02, 1]]), 1, 0);
    expect(seen.at.advance(100)).toBe(false);
    expect(seen.at.orbit?.target).toEqual([0, 0, 0]);
    seen.at.take(framing(ASIDE), 1, null);
    expect(seen.at.orbit?.target).toEqual([0.5, 0.5, 0]);
    expect(seen.poses).toHaveLength(2);
  });

  it("is told in the surface's own coordinates, on its way too", () => {
    const { at } = new Seen();
    expect(at.camera).toBeNull();
    at.take(framing(COARSE), 1, 0, { exaggeration: 4 });
    expect(at.camera?.distance).toBeCloseTo(2 * at.orbit!.distance);
    at.take(framing([COARSE[0], [3, 3, 5]]), 1, 1000);
    at.advance(1250);
    expect(at.camera?.target[0]).toBeCloseTo(0.5);
    expect(at.camera?.target[2]).toBeCloseTo(1);
    for (let now = 1250; at.advance(now); now += 16);
    expect(at.camera?.target).toEqual([1, 1, 2]);
  });

  it("takes the same view into another frame before it follows", () => {
    const { at } = new Seen();
    at.take(framing(COARSE), 1, 0);
    const before = at.framing!.toSurface(at.orbit!, 1);
    at.take(framing(ASIDE, {}, { origin: [1, 1, 0], scale: [0.2, 0.2, 0.2] }), 1, 0);
    const now = at.framing!.toSurface(at.orbit!, 1);
    expect(now.distance).toBeCloseTo(before.distance, 9);
    now.target.forEach((value, k) => {
      expect(value).toBeCloseTo(before.target[k]!, 9);
    });
    while (at.advance(1e6));
    expect(at.orbit?.target.map(Math.abs)).toEqual([0, 0, 0]);
  });
});

describe("the camera that somebody has placed", () => {
  const placed: Orbit = { azimuth: 10, elevation: 20, distance: 3, target: [0.1, 0, 0] };

  it("does not move by itself, until all is to be shown again", () => {
    const { at } = new Seen();
    at.take(framing(COARSE), 1, 0);
    at.take(framing(ASIDE), 1, 0);
    at.advance(100);
    at.place(placed);
    expect(at.advance(200)).toBe(false);
    at.take(framing(COARSE), 1, 300);
    at.resize(2);
    at.advance(1e6);
    expect(at.orbit).toEqual(placed);
    at.goHome();
    expect(at.orbit?.target).toEqual([0, 0, 0]);
    at.take(framing(ASIDE), 2, null);
    expect(at.orbit?.target).toEqual([0.5, 0.5, 0]);
  });

  it("stays where it is drawn if the coordinates become others", () => {
    const { at, poses } = new Seen();
    at.take(framing(COARSE), 1, 0);
    at.place(placed);
    const count = poses.length;
    at.relocate();
    const kilometres = { origin: [7000, 9000, 0], scale: [0.0005, 0.0005, 0.5] } as const;
    const box: Box = [
      [6000, 8000, -1],
      [8000, 10_000, 1],
    ];
    at.take(framing(box, {}, kilometres), 1, 0);
    expect(at.orbit).toEqual(placed);
    expect(at.camera).toEqual(at.framing?.toSurface(placed, at.exaggeration));
    expect(poses.length).toBeGreaterThan(count); // so that an address has it
  });

  it("is that of an address", () => {
    const { at } = new Seen();
    at.take(framing(COARSE), 1, 0, { camera: placed, exaggeration: 4 });
    expect(at.isHeld).toBe(true);
    at.take(framing(ASIDE), 1, null);
    expect(at.framing?.toSurface(at.orbit!, 4)).toEqual(placed);
    expect(at.exaggeration).toBe(4);
  });
});

describe("exaggeration", () => {
  const box = (height: number): Box => [
    [0, 0, 0],
    [100, 100, height],
  ];
  const frame = { origin: [50, 50, 0], scale: [0.02, 0.02, 0.02] } as const;
  const city = { heights: true, extent: 10 };

  it("is that of the whole surface from the first picture on, which may be flat", () => {
    const { at } = new Seen();
    at.take(framing(box(0.1), city, frame), 1, 0);
    expect(at.exaggeration).toBe(1);
    at.take(framing(box(10), city, frame), 1, null);
    expect(at.exaggeration).toBe(1);
    expect(at.isChosen).toBe(false);
  });

  it("follows with the camera, by steps", () => {
    const seen = new Seen();
    seen.at.take(framing(box(1), { heights: true, extent: 1 }, frame), 1, 0);
    expect(seen.at.exaggeration).toBe(10);
    seen.at.take(framing(box(10), city, frame), 1, 0);
    expect(seen.at.exaggeration).toBe(1);
    expect(seen.last.exaggeration).toBe(10);
    seen.at.advance(250);
    expect(seen.last.exaggeration).toBeCloseTo(Math.sqrt(10), 6);
    seen.at.advance(1000);
    expect(seen.last.exaggeration).toBe(1);
  });

  it("stays as somebody chose it, and what is looked at stays in the middle", () => {
    const seen = new Seen();
    seen.at.take(framing(box(10), city, frame), 1, 0);
    seen.at.place({ azimuth: 0, elevation: 30, distance: 2, target: [0, 0, 0.05] });
    seen.at.exaggerate(3);
    expect(seen.last.orbit.target[2]).toBeCloseTo(0.15, 12);
    seen.at.take(framing(box(1), { heights: true, extent: 1 }, frame), 1, null);
    expect(seen.at.exaggeration).toBe(3);
  });
});
