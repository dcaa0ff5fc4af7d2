/** Tiles that are made in the browser, beside those of the Python library. */
import proj4 from "proj4";
import { describe, expect, it } from "vitest";
import { InputError } from "../../src/errors";
import { BlockCache } from "../../src/maplibre/block-cache";
import { coloured, ENCODINGS } from "../../src/maplibre/encodings";
import { HeightField } from "../../src/maplibre/height-field";
import { transformBy } from "../../src/maplibre/proj4";
import { tileGrid } from "../../src/maplibre/tile-grid";
import { FileHost } from "./file-host";
import { containerOf, type GoldenField, goldenFields, unpacked } from "./golden-fields";

const NEVER = new AbortController().signal;

/** CRS that proj4js does not know. */
const STRANGE: Readonly<Record<string, RegExp>> = {
  "a disk seen from space, with corners beside the Earth": /expected a CRS that proj4 understands, got "unknown"/,
  "a rotated pole, with the Earth's pole inside": /expected a CRS that is no derived one/,
};

const fields = goldenFields();
const known = fields.filter(({ name }) => !(name in STRANGE)).map((field) => [field.name, field] as const);

function open(golden: GoldenField): Promise<HeightField> {
  const host = new FileHost();
  host.put("field.lode", containerOf(golden));
  const source = { url: host.url("field.lode"), token: undefined, scale: golden.scale ?? undefined };
  const cache = new BlockCache(2 ** 24);
  return HeightField.open(source, { foreign: transformBy(proj4), cache, name: "field", fetch: host.fetch });
}

describe.each(known)("%s", (_, golden) => {
  it("has the same bounds, heights and colours", async () => {
    const field = await open(golden);
    golden.bounds.forEach((degrees, side) => {
      expect(field.placement.bounds[side]).toBeCloseTo(degrees, 9);
    });
    expect(field.placement.webZoom(256)).toBe(golden.zoom);
    for (const { z, x, y, heights, ...colours } of golden.tiles) {
      const found = await field.heights(tileGrid({ z, x, y }, 256), NEVER);
      expect(differences(found, new Float32Array(unpacked(heights).buffer)), `zoom ${z}`).toEqual({
        holes: 0,
        steps: 0,
      });
      for (const encoding of ENCODINGS) {
        const wanted = colours[encoding];
        if (wanted === undefined) continue;
        // What is a millionth of a metre off may be rounded to another step.
        expect(otherBytes(coloured(found, encoding, -7.3), unpacked(wanted))).toBeLessThanOrEqual(2);
      }
    }
  });
});

it.each(fields.filter(({ name }) => name in STRANGE))("$name is refused", async (golden) => {
  const refused = open(golden);
  await expect(refused).rejects.toThrow(STRANGE[golden.name]!);
  await expect(refused).rejects.toBeInstanceOf(InputError);
});

/** How many bytes of pixels are others than those of colours without opacity, or are not opaque. */
function otherBytes(pixels: Uint8ClampedArray, colours: Uint8Array): number {
  let count = 0;
  for (let i = 0; i < pixels.length; i++) {
    if (pixels[i] !== (i % 4 === 3 ? 255 : colours[Math.floor(i / 4) * 3 + (i % 4)])) count += 1;
  }
  return count;
}

/** Pixels with a height in one only, and those that differ by more than a millionth of a metre and a step of float32. */
function differences(found: Float32Array, wanted: Float32Array): { holes: number; steps: number } {
  let [holes, steps] = [0, 0];
  found.forEach((height, i) => {
    const other = wanted[i]!;
    if (Number.isNaN(height) !== Number.isNaN(other)) holes += 1;
    else if (Math.abs(height - other) > Math.max(1e-6, Math.abs(other) * 2 ** -23)) steps += 1;
  });
  return { holes, steps };
}
