/** MessagePack from strangers: what is decoded is first seen to be no deeper and no longer than it may be. */

import { decode } from "@msgpack/msgpack";

// As deep as Python's library goes.
const DEEPEST = 1024;

/**
 * The value that MessagePack bytes stand for.
 *
 * The library makes room for as many items as an array announces, at every depth, and takes text that is not UTF-8. So
 * the structure is walked first, without making anything.
 *
 * Integers that need 64 bits come as `bigint`.
 *
 * @throws Error if the bytes are not exactly one value, a map has a key that is not text, text is not UTF-8, or values
 * are nested more than 1,024 deep.
 */
export function unpack(data: Uint8Array): unknown {
  const end = new Walker(data).value(0, 0);
  if (end !== data.length) throw new RangeError(`extra ${data.length - end} of ${data.length} bytes`);
  return decode(data, { useBigInt64: true });
}

class Walker {
  private readonly view: DataView;
  private readonly text = new TextDecoder("utf-8", { fatal: true });

  constructor(private readonly data: Uint8Array) {
    this.view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  }

  /** Where the value ends that begins at `at`. */
  value(at: number, depth: number): number {
    if (depth > DEEPEST) throw new RangeError(`values nested more than ${DEEPEST} deep`);
    const head = this.number(at, 1);
    if (head < 0x80 || head >= 0xe0) return at + 1;
    if (head < 0x90) return this.items(at + 1, head & 15, depth, true);
    if (head < 0xa0) return this.items(at + 1, head & 15, depth, false);
    if (head < 0xc0) return this.string(at + 1, head & 31);
    switch (head) {
      case 0xc0:
      case 0xc2:
      case 0xc3:
        return at + 1;
      case 0xc4:
      case 0xc5:
      case 0xc6: {
        const size = 1 << (head - 0xc4);
        return this.bytes(at + 1 + size, this.number(at + 1, size));
      }
      case 0xc7:
      case 0xc8:
      case 0xc9: {
        const size = 1 << (head - 0xc7);
        return this.bytes(at + 2 + size, this.number(at + 1, size));
      }
      case 0xca:
      case 0xce:
      case 0xd2:
        return this.bytes(at + 1, 4);
      case 0xcb:
      case 0xcf:
      case 0xd3:
        return this.bytes(at + 1, 8);
      case 0xcc:
      case 0xd0:
        return this.bytes(at + 1, 1);
      case 0xcd:
      case 0xd1:
        return this.bytes(at + 1, 2);
      case 0xd4:
      case 0xd5:
      case 0xd6:
      case 0xd7:
      case 0xd8:
        return this.bytes(at + 2, 1 << (head - 0xd4));
      case 0xd9:
      case 0xda:
      case 0xdb: {
        const size = 1 << (head - 0xd9);
        return this.string(at + 1 + size, this.number(at + 1, size));
      }
      case 0xdc:
      case 0xdd: {
        const size = head === 0xdc ? 2 : 4;
        return this.items(at + 1 + size, this.number(at + 1, size), depth, false);
      }
      case 0xde:
      case 0xdf: {
        const size = head === 0xde ? 2 : 4;
        return this.items(at + 1 + size, this.number(at + 1, size), depth, true);
      }
      default:
        throw new RangeError(`no value begins with ${head}`);
    }
  }

  private items(at: number, count: number, depth: number, keyed: boolean): number {
    // Each takes a byte at least: what promises more is not walked.
    if (count * (keyed ? 2 : 1) > this.data.length - at) throw new RangeError("more items announced than bytes");
    let end = at;
    for (let number = 0; number < count; number++) {
      if (keyed) end = this.key(end);
      end = this.value(end, depth + 1);
    }
    return end;
  }

  private key(at: number): number {
    const head = this.number(at, 1);
    if (!((head >= 0xa0 && head < 0xc0) || (head >= 0xd9 && head <= 0xdb)))
      throw new TypeError("a key that is not text");
    return this.value(at, 0);
  }

  private string(at: number, length: number): number {
    const end = this.bytes(at, length);
    this.text.decode(this.data.subarray(at, end));
    return end;
  }

  private bytes(at: number, length: number): number {
    if (at + length > this.data.length) throw new RangeError("the end in the middle of a value");
    return at + length;
  }

  private number(at: number, size: number): number {
    this.bytes(at, size);
    if (size === 1) return this.view.getUint8(at);
    return size === 2 ? this.view.getUint16(at) : this.view.getUint32(at);
  }
}
