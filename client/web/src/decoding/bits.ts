/**
 * Values as patterns of bits, so that they can be moved without a change: a float that is copied as a number may come
 * out as another NaN, and integers of 64 bits are slow as bigints.
 */
import { DTYPE_BYTES, type DType, type Values } from "../types";

/** Patterns of values: words of 8, 16 or 32 bits, two for each value of 64 bits. */
export type Patterns = Uint8Array | Uint16Array | Uint32Array;

/** Words of a value of a type. */
export function wordsOf(dtype: DType): 1 | 2 {
  return DTYPE_BYTES[dtype] === 8 ? 2 : 1;
}

/** The same memory as patterns. */
export function patternsOf(values: Values): Patterns {
  const { buffer, byteOffset, byteLength } = values;
  if (values.BYTES_PER_ELEMENT === 1) return new Uint8Array(buffer, byteOffset, byteLength);
  if (values.BYTES_PER_ELEMENT === 2) return new Uint16Array(buffer, byteOffset, byteLength / 2);
  return new Uint32Array(buffer, byteOffset, byteLength / 4);
}

/** The pattern of the value that marks holes: NaN in floats, `hole` in integers. */
export function holePattern(dtype: DType, hole: bigint): readonly number[] {
  if (dtype === "float32") return [0x7fc00000];
  if (dtype === "float64") return [0, 0x7ff80000];
  const bits = 8 * DTYPE_BYTES[dtype];
  if (bits < 64) return [Number(BigInt.asUintN(bits, hole))];
  return [Number(BigInt.asUintN(32, hole)), Number(BigInt.asUintN(32, hole >> 32n))];
}
