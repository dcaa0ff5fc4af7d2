import { PerspectiveCamera, Vector3 } from "three";
import { describe, expect, it } from "vitest";
import { fitted, panned, positionOf, turned, VIEW_ANGLE, wrapped, zoomed } from "../../src/view/camera";
import { COLOUR_MAPS, colourAt, rangeOf, stopsOf, textureOf } from "../../src/view/colour-maps";
import { logScale, withZero } from "../../src/view/error-curve";
import { defaultExaggeration } from "../../src/view/exaggeration";
import { extremes } from "../../src/view/fields";
import {
  formatAt,
  formatBytes,
  formatNumber,
  formatSeconds,
  formatStored,
  formatWithin,
  roundBelow,
} from "../../src/view/format";
import { Geometry } from "../../src/view/geometry";
import type { Component } from "../../src/view/geometry-messages";
import { finestDrawn, firstLevel, pointsAt } from "../../src/view/levels";
import { fieldName, fieldsOf, sameField } from "../../src/view/look";
import type { Grid, SurfaceInfo } from "../../src/view/source";
import { formatView, parseView, type SharedView, withView } from "../../src/view/url-state";

describe("colour maps", () => {
  it.each(COLOUR_MAPS)("%s begins and ends with its table, and is between its stops in between", (name) => {
    const stops = stopsOf(name);
    expect(colourAt(name, 0)).toEqual(stops[0]);
    expect(colourAt(name, 1)).toEqual(stops.at(-1));
    expect(colourAt(name, -3)).toEqual(stops[0]);
    expect(colourAt(name, 7)).toEqual(stops.at(-1));
    const half = colourAt(name, 0.5 / (stops.length - 1));
    expect(half).toEqual([0, 1, 2].map((k) => (stops[0]![k]! + stops[1]![k]!) / 2));
    expect(textureOf(name)).toHaveLength(1024);
  });

  it("have the range of the values, or one around 0", () => {
    expect(rangeOf(3, 8, false)).toEqual([3, 8]);
    expect(rangeOf(-1, 4, true)).toEqual([-4, 4]);
    expect(rangeOf(10, 10, false)).toEqual([5, 15]);
    expect(rangeOf(0, 0, true)).toEqual([-1, 1]);
    expect(rangeOf(Number.NaN, Number.NaN, false)).toEqual([0, 1]);
  });

  it("a trimmed range leaves single values out", () => {
    const values = Float64Array.from({ length: 1000 }, (_, k) => (k === 500 ? 1e9 : k));
    expect(extremes(values, false)).toEqual([0, 1e9]);
    expect(extremes(values, true)[1]).toBeLessThan(1000);
    expect(extremes(Float64Array.of(Number.NaN), false)).toEqual([Number.NaN, Number.NaN]);
  });
});

describe("the view in the address", () => {
  const view: SharedView = {
    camera: { azimuth: -91.3, elevation: 42, distance: 12340, target: [500_013, 4_200_000, 900] },
    field: { kind: "attribute", name: "wet & dry=?#é", component: 2 },
    map: "red-blue",
    range: [-3.5, 1200],
    exaggeration: 2.5,
    lines: true,
  };

  it("comes back as it was", () => {
    expect(parseView(formatView(view))).toEqual({
      ...view,
      camera: { ...view.camera, target: [500_013, 4_200_000, 900] },
    });
    for (const kind of ["height", "slope", "change", "none"] as const) {
      expect(parseView(formatView({ field: { kind } }))).toEqual({ field: { kind } });
    }
  });

  it("is short", () => {
    const camera = {
      azimuth: -91.34567,
      elevation: 42.1111,
      distance: 123.456789,
      target: [1 / 3, 2 / 3, 1e6 / 3] as const,
    };
    expect(formatView({ camera, map: "viridis" }).length).toBeLessThan(70);
    const back = parseView(formatView({ camera })).camera!;
    expect(Math.abs(back.target[2] - camera.target[2])).toBeLessThan(camera.distance / 1000);
  });

  it.each([
    "v=1,2,3",
    "v=0,0,-5,0,0,0",
    "v=0,90,5,0,0,0",
    "v=a,b,c,d,e,f",
    "m=nothing",
    "r=2,1",
    "x=0",
    "x=NaN",
    "c=a:1:%",
    "&&=&",
  ])("leaves out what is not valid: %s", (text) => {
    expect(parseView(text)).toEqual({});
  });

  it("leaves alone what belongs to the page", () => {
    expect(withView("#s=ab%20c&v=1,2,3,4,5,6&x=9", { exaggeration: 2 })).toBe("#s=ab%20c&x=2");
    expect(withView("", { lines: true })).toBe("#l=1");
  });
});

describe("the camera", () => {
  const orbit = { azimuth: 30, elevation: 20, distance: 4, target: [1, 2, 3] as const };
  const apart = (a: readonly number[], b: readonly number[]): number =>
    Math.hypot(...a.map((value, k) => value - b[k]!));

  it("keeps its distance when it turns, and never tips over", () => {
    expect(apart(positionOf(turned(orbit, 77, -13)), orbit.target)).toBeCloseTo(4, 12);
    expect(turned(orbit, 0, 1000).elevation).toBeLessThan(90);
    expect(wrapped(540)).toBe(-180);
    expect(turned(orbit, 720, 0).azimuth).toBeCloseTo(30, 12);
  });

  it("pans across the line of sight", () => {
    const moved = panned(orbit, 0.2, -0.1);
    const sight = positionOf(orbit).map((value, k) => value - orbit.target[k]!);
    const shift = moved.target.map((value, k) => value - orbit.target[k]!);
    expect(sight.reduce((sum, value, k) => sum + value * shift[k]!, 0)).toBeCloseTo(0, 10);
    expect(apart(moved.target, orbit.target)).toBeGreaterThan(0.1);
  });

  it("zooms towards a place that stays where it is seen", () => {
    const place = [1.5, 2.2, 3.1] as const;
    const nearer = zoomed(orbit, 0.5, place);
    const direction = (of: typeof orbit | typeof nearer) => {
      const position = positionOf(of);
      const to = place.map((value, k) => value - position[k]!);
      return to.map((value) => value / Math.hypot(...to));
    };
    expect(apart(direction(orbit), direction(nearer))).toBeLessThan(1e-12);
  });

  it("sees a whole box, of narrow views too", () => {
    for (const aspect of [0.5, 1, 2]) {
      for (const [azimuth, elevation] of [
        [-90, 42],
        [-60, 25],
        [-90, 89.9],
      ] as const) {
        const orbit = fitted([1, 0.7, 0.2], 0, aspect, azimuth, elevation);
        const seen = [0, 1, 2, 3, 4, 5, 6, 7].map((corner) => {
          const at = [1, 0.7, 0.2].map((half, k) => (corner & (1 << k) ? half : -half));
          const camera = new PerspectiveCamera(VIEW_ANGLE, aspect, 0.01, 100);
          camera.up.set(0, 0, 1);
          camera.position.set(...positionOf(orbit));
          camera.lookAt(0, 0, 0);
          camera.updateMatrixWorld();
          const place = new Vector3(...at).project(camera);
          return Math.max(Math.abs(place.x), Math.abs(place.y));
        });
        expect(Math.max(...seen)).toBeCloseTo(0.9, 6);
      }
    }
    expect(fitted([0, 0, 1], 1.7, 1, -60, 25).distance).toBeGreaterThan(4);
    expect(fitted([0, 0, 0], 0, 1, -60, 25).distance).toBeGreaterThan(1);
  });
});

describe("levels", () => {
  const info: SurfaceInfo = {
    name: "",
    blocks: [{ shape: [4097, 4097], closed: [false, false] }],
    levels: 12,
    extent: 1,
    heights: true,
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

  it("the first picture has about as many points as the view has pixels", () => {
    const level = firstLevel(info, 800 * 600);
    expect(pointsAt(info, level)).toBeLessThanOrEqual(800 * 600);
    expect(pointsAt(info, level + 1)).toBeGreaterThan(800 * 600);
  });

  it("joined blocks are drawn at a level with few enough triangles", () => {
    const level = finestDrawn({ ...info, joined: true }, 4_000_000);
    expect(2 * pointsAt(info, level)).toBeLessThanOrEqual(4_000_000);
    expect(finestDrawn({ ...info, blocks: [{ shape: [9, 9], closed: [true, true] }], joined: true }, 4_000_000)).toBe(
      12,
    );
  });

  it("relief is exaggerated by a round number where it could not be seen", () => {
    expect(defaultExaggeration([1, 0.8, 0.1], true)).toBe(1);
    expect(defaultExaggeration([1, 0.8, 0.01], true)).toBe(10);
    expect(defaultExaggeration([1, 0.8, 0.001], false)).toBe(1);
    expect(defaultExaggeration([1, 1, 0], true)).toBe(1);
  });
});

describe("numbers", () => {
  it("as text", () => {
    expect([0, 812, 34_100, 999_600, 1_200_000].map(formatBytes)).toEqual([
      "0 B",
      "812 B",
      "34.1 kB",
      "1.00 MB",
      "1.20 MB",
    ]);
    expect([0, 1.23456, 1234.56, 0.00123456, Number.NaN].map((value) => formatNumber(value))).toEqual([
      "0",
      "1.235",
      "1235",
      "0.001235",
      "unknown",
    ]);
    expect(formatAt(12.3456, 0.01)).toBe("12.346");
    expect(formatAt(Number.NaN, 1)).toBe("none");
    expect([0.424, 12.4, 200].map(formatSeconds)).toEqual(["0.42 s", "12 s", "3 min 20 s"]);
    expect([0.7, 1, 3, 77].map(roundBelow)).toEqual([0.5, 1, 2, 50]);
  });

  it("as they were stored, without digits that float32 has not", () => {
    expect([503.3, 0.1, -1e-7, 16777217, 1 / 3].map((value) => formatStored(Math.fround(value)))).toEqual([
      "503.3",
      "0.1",
      "-1.0e-7",
      "16777216",
      "0.33333334",
    ]);
    expect([1 / 3, 503.3].map(formatStored)).toEqual(["0.3333333333", "503.3"]);
  });

  it("within a range", () => {
    expect(formatWithin(2.8e-17, [-0.4, 0.4])).toBe("0");
    expect(formatWithin(-1e-9, [-1, 1])).toBe("0");
    expect(formatWithin(1304.6789, [314, 2295])).toBe("1305");
    expect(formatWithin(500_000.1234, [500_000, 500_001])).toBe("500000.12");
    expect(formatWithin(5, [5, 5])).toBe("5");
  });

  it("on a logarithmic axis, 0 at its end", () => {
    const scale = logScale([0, 3, 800], 0, 300);
    expect([scale.low, scale.high]).toEqual([0, 3]);
    expect([0, 1, 10, 1000, 1e9].map((value) => Math.round(scale.place(value)))).toEqual([0, 0, 100, 300, 300]);
    expect(logScale([], 0, 1).high).toBe(1);
  });

  it("0 has a place of its own below the least error", () => {
    const scale = withZero([0, 0.1, 100], 130, 8);
    expect([scale.zero, scale.place(0)]).toEqual([true, 130]);
    expect(scale.place(0.1)).toBe(114);
    expect(scale.place(100)).toBe(8);
    expect(withZero([0.1, 100], 130, 8).place(0.1)).toBe(130);
  });
});

describe("slope", () => {
  it.each([
    ["m", "m", false, true],
    ["METERS", "m", false, true],
    ["m", "", false, true],
    ["m", "°", true, true],
    ["METERS", "°", false, false],
    ["degC", "°", true, false],
    ["ft", "m", false, false],
  ])("of heights in %j over %j, geographic: %j, is offered: %j", (unit, planeUnit, geographic, offered) => {
    const info = { unit, planeUnit, geographic, heights: true, attributes: [] } as unknown as SurfaceInfo;
    expect(fieldsOf(info).some(({ kind }) => kind === "slope")).toBe(offered);
  });
});

describe("an attribute of several components", () => {
  const info: SurfaceInfo = {
    name: "",
    blocks: [{ shape: [2, 2], closed: [false, false] }],
    levels: 1,
    extent: 1,
    heights: true,
    georeferenced: false,
    geographic: false,
    mapped: false,
    joined: false,
    unit: "m",
    planeUnit: "m",
    exact: true,
    attributes: [
      { name: "wind", components: 2 },
      { name: "wet", components: 1 },
    ],
    size: 0,
    prices: null,
  };

  it("offers each, and the length of all", () => {
    expect(fieldsOf(info).map((field) => fieldName(field, info))).toEqual([
      "Height",
      "Slope",
      "Last change",
      "wind, magnitude",
      "wind[0]",
      "wind[1]",
      "wet",
      "Shading only",
    ]);
    const [first, second] = fieldsOf(info).filter(({ kind }) => kind === "attribute");
    expect(sameField(first!, second!)).toBe(false);
    expect(parseView(formatView({ field: first! })).field).toEqual(first);
  });

  it("colours by one of them", () => {
    const grid: Grid = {
      rowsAt: Float64Array.of(0, 1),
      columnsAt: Float64Array.of(0, 1),
      full: [2, 2],
      closed: [false, false],
      points: new Float64Array(12),
      mask: null,
      attributes: [{ name: "wind", components: 2, values: Float64Array.of(3, 4, -6, 8, 0, -1, Number.NaN, 2) }],
    };
    const of = (component: Component) => {
      const geometry = new Geometry();
      const options = { joined: false, geographic: false, heights: true, diagonal: 0, relief: 0, fresh: true };
      geometry.setPicture([grid], options);
      geometry.setField({ kind: "attribute", name: "wind", component });
      return geometry.colouring().range;
    };
    expect([of(0), of(1), of("magnitude")]).toEqual([
      [-6, 3],
      [-1, 8],
      [1, 10],
    ]);
    expect(of(2)).toEqual([Number.NaN, Number.NaN]);
  });
});
