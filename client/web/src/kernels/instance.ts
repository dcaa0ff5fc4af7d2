/** The WebAssembly module of the kernels of decoding, compiled once, and instances of it with memory of their own. */
import { UnavailableError } from "../errors";
import { KERNELS_HEX } from "./module";

/** Addresses and counts are unsigned numbers of 32 bits, `i64` arrays of pairs of them; kernels/*.c say what each means. */
export interface KernelExports {
  readonly memory: WebAssembly.Memory;
  readonly __heap_base: WebAssembly.Global<"i32">;
  passes(
    trellis: number,
    bands: number,
    bandsCount: number,
    runs: number,
    runsCount: number,
    known: number,
    sign: number,
    early: number,
    size: number,
    flags: number,
    flagsCount: number,
    models: number,
    modelsCount: number,
    data: number,
    dataCount: number,
    state: number,
    budget: number,
  ): number;
  dequantize(
    known: number,
    sign: number,
    early: number,
    size: number,
    bands: number,
    bandsCount: number,
    windows: number,
    steps: number,
    numbers: number,
    numbersCount: number,
    state: number,
    stateCount: number,
    finer: number,
    out: number,
    rows: number,
    columns: number,
    pitch: number,
    firstRow: number,
    firstColumn: number,
  ): number;
  lift(
    axis: number,
    x: number,
    rows: number,
    columns: number,
    pitch: number,
    midpoints: number,
    run: number,
    table: number,
    a: number,
    b: number,
    from: number,
    work: number,
    workCount: number,
  ): number;
  forward(
    x: number,
    length: number,
    midpoints: number,
    run: number,
    table: number,
    a: number,
    b: number,
    work: number,
  ): void;
  mask(
    rows: number,
    columns: number,
    first: number,
    last: number,
    field: number,
    fieldCount: number,
    model: number,
    data: number,
    dataCount: number,
    state: number,
  ): number;
  store_values(
    coordinates: number,
    rows: number,
    columns: number,
    pitch: number,
    points: number,
    pointsType: number,
    channels: number,
    channel: number,
    decimal: number,
    origin: number,
    step: number,
    scale: number,
  ): number;
  differences(
    line: number,
    differences: number,
    exponents: number,
    marks: number,
    count: number,
    most: number,
    specials: number,
    model: number,
    memory: number,
    data: number,
    dataCount: number,
    stored: number,
    storedCount: number,
    used: number,
  ): number;
  offsets(
    bases: number,
    restored: number,
    count: number,
    bits: number,
    places: number,
    model: number,
    data: number,
    dataCount: number,
  ): number;
  to_line(
    rule: number,
    argument: number,
    values: number,
    type: number,
    count: number,
    line: number,
    exponents: number,
  ): void;
  from_line(
    rule: number,
    argument: number,
    line: number,
    differences: number,
    values: number,
    type: number,
    count: number,
  ): void;
  offset_bases(values: number, count: number, step: number, bases: number, places: number): void;
  sha256(state: number, data: number, blocks: number): void;
  offset_values(places: number, count: number, patterns: number): void;
}

/** What a kernel returns where lengths or places do not fit each other: a fault of the program, never of a stream. */
const REFUSED = -(2 ** 31);

let compiled: Promise<WebAssembly.Module> | null = null;

/** The module, compiled once. It can be posted to workers. Throws `UnavailableError` where there is no WebAssembly. */
export function loadKernels(): Promise<WebAssembly.Module> {
  compiled ??= compile();
  return compiled;
}

async function compile(): Promise<WebAssembly.Module> {
  const bytes = Uint8Array.from({ length: KERNELS_HEX.length / 2 }, (_, k) =>
    Number.parseInt(KERNELS_HEX.slice(2 * k, 2 * k + 2), 16),
  );
  try {
    return await WebAssembly.compile(bytes);
  } catch (error) {
    const said = error instanceof Error ? error.message : String(error);
    throw new UnavailableError(`expected WebAssembly with SIMD, got: ${said}`);
  }
}

/** A result of a kernel; throws where it refused its arguments. */
export function accepted(result: number, name: string): number {
  if (result === REFUSED) throw new Error(`${name}: lengths or places do not fit each other`);
  return result;
}
