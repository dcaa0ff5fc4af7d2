/** Numbers in bytes: little-endian, whole numbers in groups of seven bits, floats without their last bytes. */
import { CorruptStreamError } from "../errors";
import type { Errors } from "../types";

/** The largest whole number that a field holds, about: JavaScript's numbers are exact up to 2^53. */
export const LARGEST = 2 ** 63 - 1;

const INFINITE_ERROR = 0x7ff00000;
const INFINITE_ROUGH_ERROR = 0x7ff << 5;

const scratch = new DataView(new ArrayBuffer(8));

/**
 * Takes fields from bytes that stand at `offset` of a container.
 *
 * Every method throws `CorruptStreamError` where the bytes end too early.
 */
export class FieldReader {
  readonly data: Uint8Array;
  /** Bytes taken so far. */
  place = 0;
  readonly #offset: number;
  readonly #view: DataView;

  constructor(data: Uint8Array, offset: number) {
    this.data = data;
    this.#offset = offset;
    this.#view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  }

  /** Offset in the container of the next field. */
  get at(): number {
    return this.#offset + this.place;
  }

  /** Bytes that were not taken. */
  get left(): number {
    return this.data.length - this.place;
  }

  /** The next bytes: a view, not a copy. */
  take(count: number): Uint8Array {
    return this.data.subarray(this.#taken(count), this.place);
  }

  /** A whole number of 0 to 255. */
  byte(): number {
    return this.data[this.#taken(1)]!;
  }

  /** A whole number that must not exceed `limit`; not exact above 2^53. */
  varint(limit = LARGEST): number {
    const start = this.at;
    let number = 0;
    let scale = 1;
    for (let count = 1; ; count++) {
      const byte = this.byte();
      number += (byte & 127) * scale;
      scale *= 128;
      if (byte < 128) break;
      if (count === 9) throw new CorruptStreamError("expected a whole number of at most 9 bytes, got more", start);
    }
    if (number > limit) {
      throw new CorruptStreamError(`expected a number of at most ${limit}, got ${number}`, start);
    }
    return number;
  }

  /** An unsigned number of 16 bits. */
  u16(): number {
    return this.#view.getUint16(this.#taken(2), true);
  }

  /** An unsigned number of 32 bits. */
  u32(): number {
    return this.#view.getUint32(this.#taken(4), true);
  }

  /** An unsigned number of 64 bits; not exact above 2^53. */
  u64(): number {
    return Number(this.#view.getBigUint64(this.#taken(8), true));
  }

  /** Two signed numbers of 8 bits. */
  i8Pair(): [number, number] {
    const place = this.#taken(2);
    return [this.#view.getInt8(place), this.#view.getInt8(place + 1)];
  }

  /** A signed number of 64 bits. */
  i64(): bigint {
    return this.#view.getBigInt64(this.#taken(8), true);
  }

  /** A float64 without its last bytes: a count, then so many bytes, the highest first. It may be infinite or NaN. */
  number(): number {
    const start = this.at;
    const count = this.byte();
    if (count > 8) throw new CorruptStreamError(`expected at most 8 bytes of a float64, got ${count}`, start);
    const bytes = this.take(count);
    for (let i = 0; i < 8; i++) scratch.setUint8(i, bytes[i] ?? 0);
    return scratch.getFloat64(0);
  }

  /** RMS and maximum error of the distances and, where there are several channels, of each. */
  errors(channels: number): Errors {
    const [rms, maximum] = this.#pair(4);
    const own: (readonly [number, number])[] = [];
    if (channels > 1) for (let channel = 0; channel < channels; channel++) own.push(this.#pair(2));
    return { rms, maximum, channels: own };
  }

  /** Throws `CorruptStreamError` unless every byte was taken. */
  end(): void {
    if (this.left)
      throw new CorruptStreamError(`expected the end of the section, got ${this.left} more bytes`, this.at);
  }

  /** Where the next bytes begin, which are taken now. */
  #taken(count: number): number {
    if (count > this.left) throw new CorruptStreamError(`expected ${count} more bytes, got ${this.left}`, this.at);
    this.place += count;
    return this.place - count;
  }

  #pair(size: 2 | 4): [number, number] {
    const start = this.at;
    const [rms, worst] = size === 4 ? [this.u32(), this.u32()] : [this.u16(), this.u16()];
    const limit = size === 4 ? INFINITE_ERROR : INFINITE_ROUGH_ERROR;
    if (rms >= limit || worst >= limit) {
      const patterns = `${rms.toString(16)} and ${worst.toString(16)}`;
      throw new CorruptStreamError(`expected errors of 0 or more, got the patterns ${patterns}`, start);
    }
    return [fromUpper(rms, size), fromUpper(worst, size)];
  }
}

/** The number of 0 or more whose highest bits below the sign are these. */
function fromUpper(upper: number, size: 2 | 4): number {
  scratch.setUint32(0, size === 4 ? upper : upper << 15);
  scratch.setUint32(4, 0);
  return scratch.getFloat64(0);
}
