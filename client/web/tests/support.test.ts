import { beforeAll, describe, expect, it } from "vitest";
import { type AxisStep, axisStep } from "../src/grid/axis";
import { coefficientsNeeded } from "../src/grid/support";
import { Arena } from "../src/kernels/arena";
import { loadKernels } from "../src/kernels/instance";
import { allocatePlane, inverseStep } from "../src/transform/pyramid";

/** Shows the last tap of an update, 2^-24, in both directions, and stays within the limit of the inverse. */
const LARGE = 2 ** 26;
const ENDS: [closed: boolean, clamped: [boolean, boolean]][] = [
  [false, [false, false]],
  [false, [true, false]],
  [false, [false, true]],
  [false, [true, true]],
  [true, [false, false]],
];

let arena: Arena;
beforeAll(async () => {
  arena = new Arena(await loadKernels());
});

/** Which coefficients change which samples, by sample: each is changed by itself. */
function changed(step: AxisStep): boolean[][] {
  const { length } = step;
  const found = Array.from({ length }, () => new Array<boolean>(length).fill(false));
  for (const predictor of [[127, -127] as const, [32, -7] as const]) {
    for (const change of [LARGE, -LARGE]) {
      arena.scope(() => {
        const plane = allocatePlane(arena, [length, length]);
        const at = (row: number) => plane.address + 4 * row * plane.pitch;
        for (let row = 0; row < length; row++) arena.i32(at(row), length)[row] = change;
        inverseStep(arena, plane, 0, step, predictor);
        for (const [row, line] of found.entries()) {
          for (const [column, value] of arena.i32(at(row), length).entries()) if (value !== 0) line[column] = true;
        }
      });
    }
  }
  return found;
}

// As in tests/core/grid/test_support.py.
describe("the coefficients that a sample needs", () => {
  it.each(ENDS)("are those whose change changes it; closed: %s, clamped: %s", (closed, clamped) => {
    for (let length = 1; length < 60; length++) {
      const step = axisStep(length, closed, clamped);
      for (const [place, parts] of changed(step).entries()) {
        const sample = new Uint8Array(length);
        sample[place] = 1;
        const needed = [...coefficientsNeeded(sample, step)].map(Boolean);
        const told = `${length}, sample ${place}`;
        expect(
          parts.every((part, index) => !part || needed[index]),
          told,
        ).toBe(true);
        const asItIs = (step.left && place === 0) || (step.right && place === length - 1);
        if (length > 4 && !(closed && length === 8) && !asItIs) expect(needed, told).toEqual(parts);
      }
    }
  });
});
