/** What a decoder makes of containers, in the plain values that the Python library prints (tests/web). */
import { Decoder, type View } from "../src/decoding";
import { CorruptStreamError, LodestreamError } from "../src/errors";
import type { PointArray, Surface } from "../src/types";
import { digests, type Expected } from "./golden";

/** What `tests.golden.generate.expectations` tells. */
export function expectations(kernels: WebAssembly.Module, container: Uint8Array, detailed = false): Expected {
  const decoder = new Decoder(kernels);
  decoder.feed(container);
  decoder.finish();
  const header = decoder.header!;
  const plane = header.plane !== null;
  const coarser = Array.from({ length: header.levels }, (_, level) => level);
  const details = {
    channels: decoder.layers.map((view) => view.channels.map((errors) => [...errors])),
    partial: decoder.layers
      .slice(0, header.layerCount)
      .map((view) => coarser.map((level) => digests(view.surface(level), plane))),
  };
  return {
    blocks: kinds(decoder.surface()),
    layers: decoder.layers.map((view) => ({
      bytes: view.bytes,
      level: view.level,
      rms: view.rms,
      max: view.maxError,
      sha256: digests(view.surface()),
    })),
    levels: Array.from({ length: header.levels + 1 }, (_, level) =>
      digests(decoder.surface(level), plane && level < header.levels),
    ),
    ...(detailed ? details : {}),
  };
}

function kinds(surface: Surface): Expected["blocks"] {
  return surface.blocks.map(({ shape, closed, mask, points, attributes }) => {
    const kind = (array: PointArray) => ({
      type: array.dtype,
      shape: array.flat ? [...shape] : [...shape, array.components],
    });
    return {
      closed: [...closed],
      holes: mask ? mask.filter((valid) => !valid).length : 0,
      points: kind(points),
      attributes: Object.fromEntries([...attributes].map(([name, array]) => [name, kind(array)])),
    };
  });
}

/** A view in numbers; errors that are not known are null. */
export function figures(view: View): (number | null)[] {
  const known = (error: number) => (Number.isNaN(error) ? null : error);
  return [view.number, view.level, view.bytes, known(view.rms), known(view.maxError)];
}

/** An error as Python tells it; anything but an error of Lodestream is thrown on. */
export function told(error: unknown): { class: string; offset: number | null } {
  if (!(error instanceof LodestreamError)) throw error;
  return { class: error.name, offset: error instanceof CorruptStreamError ? error.offset : null };
}
