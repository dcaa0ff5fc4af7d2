/** Chunks that turn restored values into the original ones, bit for bit (docs/format.md, section 9). */
import { CorruptStreamError } from "../errors";
import type { Arena } from "../kernels/arena";
import { accepted } from "../kernels/instance";
import { DTYPE_BYTES, DTYPES, type DType } from "../types";

const RULE = { raw: 0, patterns: 1, decimals: 2, offsets: 3 } as const;
const MOST_DECIMALS = 15;
/** Contexts and memory of differences, contexts of offsets, and the most bits of an offset. */
const [DIFFERENCES_MODEL, DIFFERENCES_MEMORY, OFFSETS_MODEL, MOST_BITS] = [294, 1 << 14, 147, 34];
/** Bytes of a chunk of offsets before those that are coded: rule and step. */
const OFFSETS_HEAD = 9;

/**
 * The original values of a chunk, which stands at `offset` of the container, as bytes.
 *
 * `restored` are the bytes of the values that the layers give. Takes memory in proportion to these, whatever the data.
 * Throws `CorruptStreamError` where the data do not hold one difference for each value.
 */
export function decodeChunk(
  arena: Arena,
  restored: Uint8Array,
  dtype: DType,
  data: Uint8Array,
  offset: number,
): Uint8Array {
  if (!data.length) return restored;
  const size = DTYPE_BYTES[dtype];
  const count = restored.length / size;
  if (data.length > 1 + restored.length) {
    throw new CorruptStreamError(
      `expected at most ${1 + restored.length} bytes of residual for ${count} values, got ${data.length}`,
      offset,
    );
  }
  if (data[0] === RULE.raw) {
    if (data.length - 1 !== restored.length) {
      throw new CorruptStreamError(`expected ${restored.length} bytes of values, got ${data.length - 1}`, offset + 1);
    }
    return data.slice(1);
  }
  const rule = data[0]! & 3;
  const argument = data[0]! >> 2;
  if (rule === RULE.offsets) return decodeOffsets(arena, restored, dtype, argument, data, offset);
  const floats = dtype === "float32" || dtype === "float64";
  const limit = rule === RULE.patterns ? 8 * size - 1 : MOST_DECIMALS;
  if (rule === RULE.raw || argument > limit || (rule === RULE.decimals && !floats)) {
    throw new CorruptStreamError(`expected a rule of residual for ${dtype} values, got ${data[0]}`, offset);
  }
  return decodeDifferences(arena, restored, dtype, rule, argument, data, offset);
}

function decodeDifferences(
  arena: Arena,
  restored: Uint8Array,
  dtype: DType,
  rule: number,
  argument: number,
  data: Uint8Array,
  offset: number,
): Uint8Array {
  const size = DTYPE_BYTES[dtype];
  const type = DTYPES.indexOf(dtype);
  const count = restored.length / size;
  const packed = (data[1] ?? 0) | ((data[2] ?? 0) << 8);
  const most = packed & 4095;
  const specials = packed >> 12;
  const { length, start } = readLength(data, 3 + specials * size);
  const end = start + length;
  if (data.length < end) {
    throw new CorruptStreamError(`expected a chunk of at least ${end} bytes, got ${data.length}`, offset + data.length);
  }
  return arena.scope(() => {
    const { kernels } = arena;
    const values = arena.put(restored);
    const line = arena.take(8 * count);
    const differences = arena.take(8 * count);
    const exponents = arena.take(4 * count);
    const marks = arena.zeros(count);
    const model = arena.take(4 * DIFFERENCES_MODEL);
    const memory = arena.take(8 * 3 * DIFFERENCES_MEMORY);
    const coded = arena.put(data.subarray(start, end));
    const stored = arena.put(data.subarray(end));
    const used = arena.take(16);
    kernels.to_line(rule, argument, values, type, count, line, exponents);
    const result = kernels.differences(
      line,
      differences,
      exponents,
      marks,
      count,
      most,
      specials,
      model,
      memory,
      coded,
      length,
      stored,
      data.length - end,
      used,
    );
    accepted(result, "differences");
    const lower = arena.i64(used + 8);
    if (lower !== data.length - end) {
      throw new CorruptStreamError(`expected ${lower} bytes of lower bits, got ${data.length - end}`, offset + end);
    }
    kernels.from_line(rule, argument, line, differences, values, type, count);
    const found = arena.u8(values, restored.length).slice();
    if (specials) {
      const marked = arena.u8(marks, count);
      for (let i = 0; i < count; i++) {
        const special = marked[i]!;
        if (special) found.set(data.subarray(3 + (special - 1) * size, 3 + special * size), i * size);
      }
    }
    return found;
  });
}

function decodeOffsets(
  arena: Arena,
  restored: Uint8Array,
  dtype: DType,
  bits: number,
  data: Uint8Array,
  offset: number,
): Uint8Array {
  if (dtype !== "float32" || bits > MOST_BITS || data.length < OFFSETS_HEAD) {
    throw new CorruptStreamError(`expected a rule of residual for ${dtype} values, got ${data[0]}`, offset);
  }
  const step = new DataView(data.buffer, data.byteOffset + 1, 8).getFloat64(0, true);
  if (!(Number.isFinite(step) && step > 0)) {
    throw new CorruptStreamError(`expected a step above 0, got ${step}`, offset + 1);
  }
  const count = restored.length / 4;
  const length = data.length - OFFSETS_HEAD;
  return arena.scope(() => {
    const values = arena.put(restored);
    const bases = arena.take(8 * count);
    const line = arena.take(8 * count);
    const places = arena.zeros(8 * count);
    const model = arena.take(4 * OFFSETS_MODEL);
    const coded = arena.put(data.subarray(OFFSETS_HEAD));
    arena.kernels.offset_bases(values, count, step, bases, line);
    const read = accepted(arena.kernels.offsets(bases, line, count, bits, places, model, coded, length), "offsets");
    if (length > read) {
      const most = OFFSETS_HEAD + read;
      throw new CorruptStreamError(`expected at most ${most} bytes of residual, got ${data.length}`, offset + most);
    }
    arena.kernels.offset_values(places, count, values);
    return arena.u8(values, restored.length).slice();
  });
}

/** A varint of at most four bytes, and where it ends; bytes missing count as 0. */
function readLength(data: Uint8Array, place: number): { length: number; start: number } {
  let length = 0;
  for (let shift = 0; shift < 28; shift += 7) {
    const byte = data[place++] ?? 0;
    length |= (byte & 127) << shift;
    if (byte < 128) break;
  }
  return { length, start: place };
}
