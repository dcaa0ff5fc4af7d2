/** Nodes of coarser levels lie where they stand in the finest grid, wherever x and y follow rules or are axes. */
import fc from "fast-check";
import { beforeAll, expect, it } from "vitest";
import { coordinatesOf, levelMetadata, placementOf, windowMetadata } from "../src/coordinates/height-fields";
import { Decoder } from "../src/decoding/decoder";
import { loadKernels } from "../src/kernels/instance";
import { containerOf, NAMES } from "./golden";

let kernels: WebAssembly.Module;
beforeAll(async () => {
  kernels = await loadKernels();
});

it.each(NAMES.filter((name) => name.startsWith("plane")))("x and y of %s at every level", (name) => {
  const decoder = new Decoder(kernels);
  decoder.feed(containerOf(name));
  const header = decoder.header!;
  const [full] = decoder.surface().blocks;
  for (let level = 0; level < header.levels; level++) {
    const [block] = decoder.surface(level).blocks;
    if (header.plane === null) continue;
    const { values } = block!.points;
    let node = 0;
    for (const row of block!.rows) {
      for (const column of block!.columns) {
        if (!block!.mask || block!.mask[node]) {
          const place = 3 * (row * header.shape[1] + column);
          expect([...values.slice(3 * node, 3 * node + 2)]).toEqual([...full!.points.values.slice(place, place + 2)]);
        }
        node++;
      }
    }
  }
});

/** None that is so small that half of it is not exact: steps of levels are multiples by powers of two. */
const number = fc.double({ min: -1e3, max: 1e3, noNaN: true }).map((value) => (Math.abs(value) < 1e-300 ? 0 : value));

/** Every so many samples of an axis, and the last one of an open axis. */
function placesAt(length: number, step: number, closed: boolean): Int32Array {
  const places = Array.from({ length: Math.ceil(length / step) }, (_, k) => step * k);
  if (!closed && places.at(-1) !== length - 1) places.push(length - 1);
  return Int32Array.from(places);
}

it("coordinates of levels are those of their places", () => {
  fc.assert(
    fc.property(
      fc.tuple(fc.integer({ min: 2, max: 40 }), fc.integer({ min: 2, max: 40 })),
      fc.tuple(fc.boolean(), fc.boolean()),
      fc.constantFrom(1, 2, 4, 8),
      fc.constantFrom("none", "geotransform", "axes", "list", "ends"),
      fc.array(number, { minLength: 80, maxLength: 80 }),
      (shape, closed, step, kind, values) => {
        const [a, b, c, d, e, f] = values as [number, number, number, number, number, number];
        const metadata = {
          none: {},
          geotransform: { geotransform: [a, b, c, d, e, f] },
          axes: { axes: { x: [a, b, false], y: [c, d, 10] } },
          list: { axes: { x: [...values.slice(0, shape[0]), "values"], y: [a, b], rows: "x" } },
          ends: { axes: { x: [a, b, true], y: [c, d, true] } },
        }[kind];
        const places = [placesAt(shape[0], step, closed[0]), placesAt(shape[1], step, closed[1])] as const;
        const coarse = [places[0].length, places[1].length] as const;
        const full = coordinatesOf(placementOf(metadata), shape);
        const found = coordinatesOf(placementOf(levelMetadata(metadata, false, shape, closed, places)), coarse);
        const size = values.reduce((most, value) => Math.max(most, Math.abs(value)), 1) * 100;
        for (const channel of [0, 1] as const) {
          const [whole, own] = [full[channel], found[channel]];
          places[0].forEach((row, i) => {
            places[1].forEach((column, j) => {
              const wanted =
                whole.values[(whole.rows === 1 ? 0 : row) * whole.columns + (whole.columns === 1 ? 0 : column)]!;
              const value = own.values[(own.rows === 1 ? 0 : i) * own.columns + (own.columns === 1 ? 0 : j)]!;
              if ("axes" in metadata) expect(value).toBe(wanted);
              else expect(Math.abs(value - wanted)).toBeLessThanOrEqual(1e-14 * size);
            });
          });
        }
      },
    ),
  );
});

it("a list with the first number again says how long the step over the seam is", () => {
  const axes = { x: [0, 4, 20, 24, 40, 44, 360, "values"], y: [0, 1] };
  const places = [Int32Array.of(0, 1), Int32Array.of(0, 2, 4)] as const;
  const level = levelMetadata({ axes }, true, [2, 6], [false, true], places);
  expect(level.axes).toEqual({ x: [0, 20, 40, 360, "values"], y: [0, 1] });
  const at = (start: number, ...columns: number[]) =>
    windowMetadata(
      { axes },
      {
        shape: [2, 6],
        inside: [
          [0, 2],
          [start, start + columns.length],
        ],
        closed: [false, columns.length === 6],
        full: [2, 6],
        axes,
        places: [Int32Array.of(0, 1), Int32Array.from(columns)],
      },
    ).axes;
  expect(at(4, 4, 5, 6, 7)).toEqual({ x: [40, 44, 360, 364, "values"], y: [0, 1] });
  // A window of the whole axis is closed too.
  expect(at(4, 4, 5, 6, 7, 8, 9)).toEqual({ x: [40, 44, 360, 364, 380, 384, 400, "values"], y: [0, 1] });
});
