import { afterEach, beforeAll, describe, expect, it, vi } from "vitest";
import { decodeMask } from "../src/entropy/mask";
import { TileTable } from "../src/entropy/tile-table";
import { type Plane, Tiles } from "../src/entropy/tiles";
import { axisStep } from "../src/grid/axis";
import { Layout, plainGrid } from "../src/grid/layout";
import { Arena } from "../src/kernels/arena";
import { loadKernels } from "../src/kernels/instance";
import { platformSha256, sha256 } from "../src/kernels/sha256";
import { decodeChunk } from "../src/residual/chunk-coder";
import { allocatePlane, forwardStep, inverseStep } from "../src/transform/pyramid";
import type { DType, Shape } from "../src/types";
import { run } from "./python";

interface StepCase {
  kind: "step";
  axis: 0 | 1;
  length: number;
  closed: boolean;
  clamped: [boolean, boolean];
  stops: boolean;
  shape: Shape;
  predictor: [number, number];
  coefficients: string;
  samples: string;
  line: string;
  stepped: string;
}

interface TilesCase {
  kind: "tiles";
  shape: Shape;
  closed: [boolean, boolean];
  tile: [number, number];
  large: number;
  runs: [number, number, number, string][];
  state: number[];
  known: string;
}

interface MaskCase {
  kind: "mask";
  shape: Shape;
  mask: string;
  data: string;
}

interface ChunkCase {
  kind: "chunk";
  dtype: DType;
  restored: string;
  original: string;
  data: string;
}

type Case = { number: number } & (StepCase | TilesCase | MaskCase | ChunkCase);

const COUNT = Number(process.env.LODESTREAM_CALLS ?? 100);
const SEED = Number(process.env.LODESTREAM_SEED ?? 1);

let kernels: WebAssembly.Module;
let cases: Case[];
beforeAll(async () => {
  kernels = await loadKernels();
  const lines = run("tests.web.kernels", SEED, COUNT).trim().split("\n");
  cases = lines.map((line) => JSON.parse(line) as Case);
});

function bytes(text: string): Uint8Array {
  return new Uint8Array(Buffer.from(text, "base64"));
}

function numbers(text: string): Int32Array {
  return new Int32Array(bytes(text).buffer);
}

/** Calls of one kind, each in an arena of its own. */
function each<Kind extends Case["kind"]>(
  kind: Kind,
  check: (one: Extract<Case, { kind: Kind }>, arena: Arena) => void,
) {
  let count = 0;
  for (const one of cases) {
    if (one.kind !== kind) continue;
    check(one as Extract<Case, { kind: Kind }>, new Arena(kernels));
    count++;
  }
  expect(count).toBe(COUNT);
}

function put(arena: Arena, plane: Plane, values: Int32Array): void {
  for (let row = 0; row < plane.rows; row++) {
    const line = values.subarray(row * plane.columns, (row + 1) * plane.columns);
    arena.i32(plane.address + 4 * row * plane.pitch, plane.columns).set(line);
  }
}

function take(arena: Arena, plane: Plane): Int32Array {
  const values = new Int32Array(plane.rows * plane.columns);
  for (let row = 0; row < plane.rows; row++) {
    values.set(arena.i32(plane.address + 4 * row * plane.pitch, plane.columns), row * plane.columns);
  }
  return values;
}

describe("the kernels give the bits of the Python library", () => {
  it("in steps of the lifting and their inverse", () => {
    each("step", (one, arena) => {
      const step = axisStep(one.length, one.closed, one.clamped, one.stops);
      const plane = allocatePlane(arena, one.shape);
      put(arena, plane, numbers(one.coefficients));
      inverseStep(arena, plane, one.axis, step, one.predictor);
      expect(take(arena, plane), `inverse step ${one.number}`).toEqual(numbers(one.samples));
      if (!step.midpoints) return;
      const stepped = forwardStep(arena, numbers(one.line), step, one.predictor);
      expect(stepped, `forward step ${one.number}`).toEqual(numbers(one.stepped));
    });
  });

  it("in coding passes of random tiles, large units and small, and what they leave known", () => {
    each("tiles", (one, arena) => {
      const layout = new Layout([plainGrid(one.shape, one.closed)], one.tile);
      const tiles = new Tiles(arena, new TileTable(arena, layout, true), 0, one.large);
      tiles.read(
        one.runs.map(([tile, first, passes, data]) => ({ tile, first, last: first - passes + 1, data: bytes(data) })),
      );
      const plane = allocatePlane(arena, one.shape);
      tiles.dequantizeLevels(layout.levels, Int8Array.from(one.state), [plane], layout.levels);
      expect(take(arena, plane), `tiles ${one.number}`).toEqual(numbers(one.known));
    });
  });

  it("in masks", () => {
    each("mask", (one, arena) => {
      expect(decodeMask(arena, bytes(one.data), one.shape, 0), `mask ${one.number}`).toEqual(bytes(one.mask));
    });
  });

  it("in chunks of the residual by every rule", () => {
    const rules = new Set<number>();
    each("chunk", (one, arena) => {
      const data = bytes(one.data);
      if (data.length) rules.add(data[0]! & 3);
      const values = decodeChunk(arena, bytes(one.restored), one.dtype, data, 0);
      expect(values, `chunk ${one.number} of ${one.dtype}`).toEqual(bytes(one.original));
    });
    expect([...rules].sort()).toEqual([0, 1, 2, 3]);
  });
});

describe("SHA-256", () => {
  const text = (value: string) => new TextEncoder().encode(value);
  afterEach(() => vi.unstubAllGlobals());

  it("is that of FIPS 180-4's examples", () => {
    const arena = new Arena(kernels);
    expect(sha256(arena, [])).toBe("e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
    expect(sha256(arena, [text("abc")])).toBe("ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
    const two = text("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq");
    expect(sha256(arena, [two])).toBe("248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1");
  });

  it("does not depend on how bytes are cut, nor on who computes it", async () => {
    const arena = new Arena(kernels);
    const data = Uint8Array.from({ length: 2_500_001 }, (_, i) => (i * i) >> 3);
    const arrays = [data.subarray(0, 1), data.subarray(1, 1_300_000), data.subarray(1_300_000)];
    expect(sha256(arena, arrays)).toBe(sha256(arena, [data]));
    expect(await platformSha256([data])).toBe(sha256(arena, [data]));
    expect(await platformSha256(arrays)).toBe(sha256(arena, [data]));
    expect(await platformSha256([])).toBe(sha256(arena, []));
  });

  it("is left to the kernels where the platform gives none, or cannot", async () => {
    vi.stubGlobal("crypto", {});
    expect(await platformSha256([text("abc")])).toBeNull();
    const digest = () => Promise.reject(new DOMException("no memory", "OperationError"));
    vi.stubGlobal("crypto", { subtle: { digest } });
    expect(await platformSha256([text("abc")])).toBeNull();
  });
});
