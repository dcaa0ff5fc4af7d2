import { beforeAll, describe, expect, it } from "vitest";
import { loadKernels } from "../src/kernels/instance";
import { expectations } from "./decoded";
import { containerOf, EXPECTED, NAMES } from "./golden";

let kernels: WebAssembly.Module;
beforeAll(async () => {
  kernels = await loadKernels();
});

describe("golden containers", () => {
  it.each(NAMES)("%s is the same bit for bit at every layer and level", (name) => {
    expect(expectations(kernels, containerOf(name), "partial" in EXPECTED[name]!)).toEqual(EXPECTED[name]);
  });
});
