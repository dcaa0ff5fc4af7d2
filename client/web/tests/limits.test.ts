import { beforeAll, describe, expect, it } from "vitest";
import { FrameReader, readIndex } from "../src/container";
import { crc32 } from "../src/container/crc";
import { Decoder } from "../src/decoding";
import { CorruptStreamError } from "../src/errors";
import { loadKernels } from "../src/kernels/instance";
import { containerOf } from "./golden";
import { run } from "./python";

interface Case {
  name: string;
  container: string;
  error: { class: string; offset: number | null } | null;
}

let kernels: WebAssembly.Module;
beforeAll(async () => {
  kernels = await loadKernels();
});

/** The class and offset of what is thrown; null if nothing is. */
async function thrown(run: () => unknown): Promise<Case["error"]> {
  try {
    await run();
  } catch (error) {
    const own = error as CorruptStreamError;
    return { class: own.constructor.name, offset: own.offset };
  }
  return null;
}

describe("containers beyond the limits", () => {
  it("are refused where Python refuses them", async () => {
    const lines = run("tests.web.limits").trim().split("\n");
    const cases = lines.map((line) => JSON.parse(line) as Case);
    expect(cases.filter((one) => one.error === null).length).toBe(3);
    for (const { name, container, error } of cases) {
      const data = new Uint8Array(Buffer.from(container, "base64"));
      const decoder = new Decoder(kernels);
      expect(await thrown(() => decoder.feed(data)), name).toEqual(error);
      const index = await thrown(() =>
        readIndex(async (offset, length) => data.subarray(offset, offset + length), data.length),
      );
      expect(index?.class ?? null, name).toBe(error && "CorruptStreamError");
    }
  });
});

describe("a section that is not known", () => {
  const LONG = 64 * 2 ** 20;
  const PIECE = 2 ** 16;

  /** Its bytes piece by piece: kind, length, zeros, CRC. */
  function* pieces(damaged: boolean): Generator<Uint8Array> {
    const head = Uint8Array.of(200, 0x80, 0x80, 0x80, 0x20);
    yield head;
    let crc = crc32(head);
    const zeros = new Uint8Array(PIECE);
    for (let left = LONG; left > 0; left -= PIECE) {
      crc = crc32(zeros, crc);
      yield zeros;
    }
    const end = new Uint8Array(4);
    new DataView(end.buffer).setUint32(0, damaged ? crc ^ 1 : crc, true);
    yield end.subarray(0, 1);
    yield end.subarray(1);
  }

  it("is checked while it passes, and not kept", () => {
    for (const damaged of [false, true]) {
      const frames = new FrameReader();
      const data = containerOf("two-points");
      const kinds = [...frames.feed(data.subarray(0, 8))];
      expect(kinds).toEqual([]);
      // The header, and nothing after it.
      const end = 8 + 2 + data[9]! + 4;
      expect([...frames.feed(data.subarray(8, end))].map((frame) => frame.kind)).toEqual([1]);
      let held = 0;
      const feed = () => {
        for (const piece of pieces(damaged)) {
          for (const _ of frames.feed(piece)) throw new Error("a section that nobody knows");
          held = Math.max(held, frames.pending);
        }
      };
      if (damaged) expect(feed).toThrow(CorruptStreamError);
      else feed();
      expect(held).toBeLessThanOrEqual(PIECE);
      if (damaged) continue;
      expect(frames.position).toBe(end + 5 + LONG + 4);
      const rest = [...frames.feed(data.subarray(end))].map((frame) => frame.kind);
      expect(rest.slice(-1)).toEqual([5]);
    }
  });
});
