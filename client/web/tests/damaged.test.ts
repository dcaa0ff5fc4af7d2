import { beforeAll, describe, expect, it } from "vitest";
import { Decoder } from "../src/decoding";
import { loadKernels } from "../src/kernels/instance";
import { figures, told } from "./decoded";
import { digests } from "./golden";
import { run } from "./python";

/** Containers with other contents in a field, beside golden files with a bit changed. */
const MUTANTS = Number(process.env.LODESTREAM_MUTANTS ?? 400);
const SEED = Number(process.env.LODESTREAM_SEED ?? 1);
/** As in tests/core/test_hostile_containers.py. */
const MOST_VERTICES = 20_000;

interface Told {
  class: string;
  offset: number | null;
  message: string;
}

interface Case {
  name: string;
  container: string;
  error: Told | null;
  views: number[][];
  surface: string[] | Told | null;
}

let kernels: WebAssembly.Module;
beforeAll(async () => {
  kernels = await loadKernels();
});

describe("damaged containers", () => {
  it("have Python's errors at Python's offsets, and the layers before them", async () => {
    const lines = run("tests.web.damaged", SEED, MUTANTS).trim().split("\n");
    const cases = lines.map((line) => JSON.parse(line) as Case);
    expect(cases.filter((one) => one.error).length).toBeGreaterThan(cases.length / 2);
    const wrong: string[] = [];
    for (const one of cases) {
      try {
        await check(one);
      } catch (error) {
        wrong.push(error instanceof Error ? error.message : String(error));
      }
    }
    expect(wrong).toEqual([]);
  });
});

async function check({ name, container, error, views, surface }: Case): Promise<void> {
  const data = new Uint8Array(Buffer.from(container, "base64"));
  const decoder = new Decoder(kernels, { maxVertices: MOST_VERTICES });
  const found = caught(() => {
    decoder.feed(data);
    decoder.finish();
  });
  expect(found, `${name}: ${error?.message}`).toEqual(error && plain(error));
  expect(decoder.layers.map(figures), name).toEqual(views);
  if (surface === null) return;
  const expected = Array.isArray(surface) ? surface : plain(surface);
  let shown: string[] = [];
  const refused = caught(() => {
    shown = digests(decoder.surface());
  });
  expect(refused ?? shown, `${name}: surface`).toEqual(expected);
  const later = async () => digests(await decoder.view().surfaceAsync());
  expect(await later().catch(told), `${name}: surfaceAsync`).toEqual(expected);
}

function plain({ class: name, offset }: Told) {
  return { class: name, offset };
}

function caught(work: () => void): { class: string; offset: number | null } | null {
  try {
    work();
    return null;
  } catch (error) {
    return told(error);
  }
}
