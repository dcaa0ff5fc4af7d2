/** SHA-256 of bytes that come one array after another: browsers give theirs to pages from https alone. */
import type { Arena } from "./arena";

const BLOCK = 64;
const AT_ONCE = 1 << 20;
const START = [0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19];

/** The SHA-256 of arrays of bytes one after another, in hexadecimal digits. */
export function sha256(arena: Arena, arrays: Iterable<Uint8Array>): string {
  return arena.scope(() => {
    const state = arena.take(4 * START.length);
    arena.i32(state, START.length).set(START);
    const data = arena.take(AT_ONCE);
    let [waiting, total] = [0, 0];
    for (const bytes of arrays) {
      for (let place = 0; place < bytes.length; ) {
        const count = Math.min(bytes.length - place, AT_ONCE - waiting);
        arena.u8(data + waiting, count).set(bytes.subarray(place, place + count));
        waiting += count;
        place += count;
        if (waiting === AT_ONCE) {
          arena.kernels.sha256(state, data, AT_ONCE / BLOCK);
          waiting = 0;
        }
      }
      total += bytes.length;
    }
    // A 1, zeros, and the number of bits fill whole blocks.
    const end = Math.ceil((waiting + 9) / BLOCK) * BLOCK;
    const last = new Uint8Array(end);
    last.set(arena.u8(data, waiting));
    last[waiting] = 0x80;
    new DataView(last.buffer).setBigUint64(end - 8, 8n * BigInt(total));
    arena.kernels.sha256(state, arena.put(last), end / BLOCK);
    const words = [...arena.i32(state, START.length)];
    return words.map((word) => (word >>> 0).toString(16).padStart(8, "0")).join("");
  });
}
