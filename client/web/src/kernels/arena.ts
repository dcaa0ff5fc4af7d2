/**
 * Memory of the kernels: an instance of the module, whose memory is given out from the bottom up.
 *
 * What is taken first stays; what is taken within `scope` is free again when that ends. Views of memory are only valid
 * until memory is taken again, since it may move when it grows; addresses stay.
 */
import { TooLargeError } from "../errors";
import type { DType, Values } from "../types";
import type { KernelExports } from "./instance";

const ALIGNED = 64;
const PAGE = 65536;
/** WebAssembly addresses so many bytes. */
const MOST = 2 ** 32 - PAGE;

/** An address in the memory of an arena. */
export type Address = number;

/** Memory of one instance of the kernels. */
export class Arena {
  readonly kernels: KernelExports;
  #next: number;
  #used: number; // beyond it nothing was ever given out: all is zero

  constructor(module: WebAssembly.Module) {
    this.kernels = new WebAssembly.Instance(module).exports as unknown as KernelExports;
    this.#next = align(this.kernels.__heap_base.value);
    this.#used = this.#next;
  }

  /** Bytes that are given out or were, those of the stack included. */
  get bytes(): number {
    return this.kernels.memory.buffer.byteLength;
  }

  /** So many bytes that may hold anything. Throws `TooLargeError` where there are no more. */
  take(bytes: number): Address {
    const address = this.#next;
    const end = align(address + bytes);
    const missing = end - this.kernels.memory.buffer.byteLength;
    if (missing > 0) {
      if (end > MOST) throw new TooLargeError(`expected memory of at most ${MOST} bytes, got ${end}`);
      try {
        // A quarter more than is wanted, so that memory seldom moves.
        const spare = Math.min(end / 4, MOST - end);
        this.kernels.memory.grow(Math.ceil((missing + spare) / PAGE));
      } catch {
        throw new TooLargeError(`expected ${end} bytes of memory for the kernels, got no more than ${this.bytes}`);
      }
    }
    this.#next = end;
    this.#used = Math.max(this.#used, end);
    return address;
  }

  /** So many zero bytes. */
  zeros(bytes: number): Address {
    const used = this.#used;
    const address = this.take(bytes);
    if (address < used) this.u8(address, Math.min(bytes, used - address)).fill(0);
    return address;
  }

  /** Do something; the memory that it takes is free again afterwards. */
  scope<T>(work: () => T): T {
    const before = this.#next;
    try {
      return work();
    } finally {
      this.#next = before;
    }
  }

  /** A copy of bytes. */
  put(data: Uint8Array): Address {
    const address = this.take(data.length);
    this.u8(address, data.length).set(data);
    return address;
  }

  /** Whole numbers of less than 2^53 as i64. */
  putI64(numbers: ArrayLike<number>): Address {
    const address = this.take(8 * numbers.length);
    const words = this.i32(address, 2 * numbers.length);
    for (let i = 0; i < numbers.length; i++) {
      const number = numbers[i]!;
      words[2 * i] = number;
      words[2 * i + 1] = Math.floor(number / 2 ** 32);
    }
    return address;
  }

  /** The i64 at an address, as a number; exact below 2^53. */
  i64(address: Address): number {
    const [low, high] = this.i32(address, 2);
    return high! * 2 ** 32 + (low! >>> 0);
  }

  /** A view of so many numbers. */
  u8(address: Address, count: number): Uint8Array {
    return new Uint8Array(this.kernels.memory.buffer, address, count);
  }

  /** A view of so many numbers. */
  i8(address: Address, count: number): Int8Array {
    return new Int8Array(this.kernels.memory.buffer, address, count);
  }

  /** A view of so many numbers. */
  i32(address: Address, count: number): Int32Array {
    return new Int32Array(this.kernels.memory.buffer, address, count);
  }

  /** A view of so many values of a type. */
  values(dtype: DType, address: Address, count: number): Values {
    return new ARRAYS[dtype](this.kernels.memory.buffer, address, count);
  }
}

/** The array that holds values of each type. */
export const ARRAYS = {
  int8: Int8Array,
  int16: Int16Array,
  int32: Int32Array,
  int64: BigInt64Array,
  uint8: Uint8Array,
  uint16: Uint16Array,
  uint32: Uint32Array,
  uint64: BigUint64Array,
  float32: Float32Array,
  float64: Float64Array,
} as const;

function align(bytes: number): number {
  return Math.ceil(bytes / ALIGNED) * ALIGNED;
}
