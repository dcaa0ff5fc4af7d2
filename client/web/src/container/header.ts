/** The header section, and the masks that may follow it (docs/format.md, sections 3 and 3.3). */
import { CorruptStreamError, TooLargeError } from "../errors";
import { Layout, plainGrid } from "../grid/layout";
import { type Arrangement, gridsOf, type Patch, wholePatch } from "../grid/multiblock";
import { levelShapes } from "../grid/patches";
import { fittedSteps, INTERFACES, Predictors } from "../transform/predictors";
import { type AttributeKind, type Closed, DTYPES, type DType, type Lattice, type Shape } from "../types";
import { type BlockShape, parseArrangement } from "./arrangement";
import { parseCodecs } from "./codecs";
import { type Extras, type JointChange, NO_EXTRAS, type Plane, parseExtras } from "./extras";
import { FieldReader, LARGEST } from "./fields";
import type { Frame } from "./frames";
import { checkCount, LIMITS } from "./limits";
import { KIND } from "./sections";

/** Most rows or columns of a block that kernels take. */
const LONGEST_AXIS = 2 ** 31 - 1;
/** Rows of a tile, or of a chunk of the residual, times columns, as exponents of two. */
const [LEAST_BITS, MOST_BITS] = [8, 16];
const MOST_BASE = 2 ** 24 - 1;

/** Exponents of two: rows and columns. */
export type Exponents = readonly [number, number];

/** What the section of masks holds. */
export interface MaskData {
  /** What integer points are where there is a hole. */
  readonly hole: bigint;
  /** Of each block, points that are not valid. */
  readonly holes: readonly number[];
  /** Of each block its coded mask; empty where all points are valid. */
  readonly coded: readonly Uint8Array[];
  /** Of each block, holes whose values come back; empty where there are none. */
  readonly kept: readonly number[];
  /** Coded masks of them; empty where they are all or none of the holes. */
  readonly keptCoded: readonly Uint8Array[];
}

const NO_MASKS: MaskData = { hole: 0n, holes: [], coded: [], kept: [], keptCoded: [] };

/** About how many rectangles of 2^exponents points the blocks are cut into. */
export function countRectangles(blocks: readonly BlockShape[], [down, across]: Exponents): number {
  let count = 0;
  for (const { shape } of blocks) {
    count += Math.max(1, Math.floor(shape[0] / 2 ** down)) * Math.max(1, Math.floor(shape[1] / 2 ** across));
  }
  return count;
}

/** What the header section tells. */
class HeaderFields {
  /** Type of the points. */
  declare readonly dtype: DType;
  declare readonly blocks: readonly BlockShape[];
  /** How blocks are coded; null: one block by itself. */
  declare readonly arrangement: Arrangement | null;
  /** Numbers of a point: coordinates, and attributes in the same array. */
  declare readonly pointChannels: number;
  /** The points came as an array (H, W), not (H, W, C). */
  declare readonly flat: boolean;
  declare readonly attributes: readonly AttributeKind[];
  /** One for each channel: of the points, then of each attribute. */
  declare readonly lattices: readonly Lattice[];
  /** The (a, b) of each channel's third steps. */
  declare readonly predictors: readonly Predictors[];
  /** Range of the heights, or diagonal of the box of the points. */
  declare readonly extent: number;
  /** For each channel the levels, as bits, that have no coefficient other than 0. */
  declare readonly empty: readonly number[];
  /** Of a tile, in coefficients of one band. */
  declare readonly tile: Exponents;
  /** Of a chunk of the residual, in points. */
  declare readonly chunk: Exponents;
  /** The coarsest level whose units are large; 0: none are. */
  declare readonly large: number;
  /** The complete stream restores every value bit for bit. */
  declare readonly exact: boolean;
  /** A residual section follows the layers. */
  declare readonly corrected: boolean;
  declare readonly layerCount: number;
  declare readonly codecs: readonly number[];
  /** Rules of x and y, of heights that came with them. */
  declare readonly plane: Plane | null;
  /** How the points at one place, and those that are one vertex, differ from those that the arrangement makes one. */
  declare readonly jointChanges: readonly [JointChange, JointChange] | null;
  /** A section of masks follows. */
  declare readonly masked: boolean;
  /** Base of the quantiser of coordinates, in lattice steps; 0: they are not quantised. */
  declare readonly base: number;
  /** Levels, bands and tiles. */
  declare readonly layout: Layout;
  /** Bytes from the start of the container to the end of the header and the masks. */
  declare readonly length: number;

  constructor(fields: HeaderFields) {
    Object.assign(this, fields);
  }
}

/** What is needed to draw. */
export class Header extends HeaderFields {
  constructor(
    fields: HeaderFields,
    readonly masks: MaskData = NO_MASKS,
  ) {
    super(fields);
  }

  /** The header with the masks of their section, which ends at `length`. */
  withMasks(masks: MaskData, length: number): Header {
    return new Header({ ...this, length }, masks);
  }

  /** Whether the section of masks is still to come. */
  get awaitsMasks(): boolean {
    return this.masked && !this.masks.holes.length;
  }

  /** Rows and columns of the first block: of the only one, where there is one. */
  get shape(): Shape {
    return this.blocks[0]!.shape;
  }

  /** Which axes of the first block wrap. */
  get closed(): Closed {
    return this.blocks[0]!.closed;
  }

  /** Numbers at a point, attributes included. */
  get channels(): number {
    return this.lattices.length;
  }

  /** Of the channels, how many are coordinates: 1 (heights), 2 (planar) or 3 (xyz). */
  get geometric(): number {
    return Math.min(this.pointChannels, 3);
  }

  /** Number L of the finest level, the surface itself. */
  get levels(): number {
    return this.layout.levels;
  }

  /** Name of each channel: z of heights; x, y, z; of an attribute its name, numbered where it has components. */
  get channelNames(): string[] {
    const own = this.pointChannels === 1 ? ["z"] : ["x", "y", "z"].slice(0, this.pointChannels);
    for (let number = 0; own.length < this.pointChannels; number += 1) own.push(`attribute_${number}`);
    const others = this.attributes.flatMap(({ name, components }) =>
      components > 0 ? Array.from({ length: components }, (_, part) => `${name}_${part}`) : [name],
    );
    return [...own, ...others];
  }

  /** Type of each channel. */
  get dtypes(): DType[] {
    const own = Array.from({ length: this.pointChannels }, () => this.dtype);
    const others = this.attributes.flatMap((kind) =>
      Array.from({ length: Math.max(kind.components, 1) }, () => kind.dtype),
    );
    return [...own, ...others];
  }

  /** What is coded as a grid each, interfaces apart. */
  get patches(): readonly Patch[] {
    return this.arrangement?.patches ?? [wholePatch(0, this.shape, this.closed)];
  }

  /** Rows and columns of a level of the only block; null where there are several. */
  levelShape(level: number): Shape | null {
    return this.blocks.length > 1 ? null : levelShapes(this.patches, this.layout, level, [this.shape])[0]!;
  }

  /** About how many tiles and chunks all channels have, and blocks: told without laying them out. */
  get tables(): number {
    const tiles = countRectangles(this.blocks, this.tile);
    const kept = this.masks.kept.some((count) => count > 0);
    const chunks = this.corrected ? countRectangles(this.blocks, this.chunk) * (kept ? 2 : 1) : 0;
    return (16 + this.blocks.length + 2 * tiles + chunks) * this.channels;
  }
}

/** The header from its section's payload, which stands at `offset`; the section ends at `length`. */
export function parseHeader(payload: Uint8Array, offset: number, length: number): Header {
  const fields = new FieldReader(payload, offset);
  const codecs = parseCodecs(fields);
  const flags = fields.byte();
  const code = fields.byte();
  const dtype = DTYPES[code];
  if (dtype === undefined) {
    throw new CorruptStreamError(`expected a type below ${DTYPES.length}, got ${code}`, offset);
  }
  const pointChannels = fields.varint();
  const layerCount = fields.varint();
  checkCount(layerCount, LIMITS.layers, "layers", offset);
  const tile = exponentsOf(fields.byte());
  const chunk = exponentsOf(fields.byte());
  const large = fields.byte();
  const base = fields.varint(MOST_BASE);
  const extent = fields.number();
  let arrangement: Arrangement | null = null;
  let blocks: BlockShape[];
  if (flags & 64) {
    ({ blocks, arrangement } = parseArrangement(fields));
  } else {
    const shape: Shape = [fields.varint(), fields.varint()];
    blocks = [{ shape, closed: [(flags & 1) !== 0, (flags & 2) !== 0] }];
  }
  let points = 0;
  for (const { shape } of blocks) points += shape[0] * shape[1];
  const extras: Extras =
    flags & 128 ? parseExtras(fields.take(fields.varint(payload.length)), offset, points) : NO_EXTRAS;
  let channels = pointChannels;
  for (const kind of extras.attributes) channels += Math.max(kind.components, 1);
  checkCount(channels, LIMITS.channels, "channels", offset);
  const few = pointChannels === 0 || layerCount === 0 || ((flags & 4) !== 0 && pointChannels !== 1) || points < 2;
  if (few || points * channels > LARGEST) {
    const got = `${points} x ${channels}, ${layerCount} layers`;
    throw new CorruptStreamError(`expected points, channels and layers, got ${got}`, offset);
  }
  let longest = 0;
  for (const { shape } of blocks) longest = Math.max(longest, ...shape);
  if (longest > LONGEST_AXIS) {
    throw new TooLargeError(`expected at most ${LONGEST_AXIS} rows and columns of a block, got ${longest}`);
  }
  checkExponents("tiles", tile, blocks, points, offset);
  checkExponents("chunks", chunk, blocks, points, offset);
  if (!(Number.isFinite(extent) && extent >= 0)) {
    throw new CorruptStreamError(`expected an extent of 0 or more, got ${extent}`, offset);
  }
  const lattices: Lattice[] = [];
  for (let channel = 0; channel < channels; channel++) lattices.push(parseLattice(fields));
  const grids = arrangement === null ? [plainGrid(blocks[0]!.shape, blocks[0]!.closed)] : gridsOf(arrangement);
  const layout = new Layout(grids, tile);
  const errors = channels * (layerCount + layout.levels + 1);
  checkCount(errors, LIMITS.errors, "errors of channels in layers and levels", offset);
  const empty = lattices.map(() => fields.varint(2 ** (layout.levels + 1) - 1));
  const predictors = parsePredictors(fields, layout, channels, Math.min(pointChannels, 3), offset);
  fields.end();
  return new Header({
    dtype,
    blocks,
    arrangement,
    pointChannels,
    flat: (flags & 4) !== 0,
    attributes: extras.attributes,
    lattices,
    predictors,
    extent,
    empty,
    tile,
    chunk,
    large,
    exact: (flags & 8) !== 0,
    corrected: (flags & 16) !== 0,
    layerCount,
    codecs,
    plane: extras.plane,
    jointChanges: extras.jointChanges,
    masked: (flags & 32) !== 0,
    base,
    layout,
    length,
  });
}

function exponentsOf(byte: number): Exponents {
  return [byte & 15, byte >> 4];
}

function checkExponents(
  name: string,
  exponents: Exponents,
  blocks: readonly BlockShape[],
  points: number,
  offset: number,
): void {
  const sum = exponents[0] + exponents[1];
  // Across a narrow surface long ones would be many, and nearly empty.
  const most = 64 + blocks.length + Math.floor(points / 2 ** Math.max(...exponents));
  if (countRectangles(blocks, exponents) > most || sum < LEAST_BITS || sum > MOST_BITS || Math.min(...exponents) < 1) {
    throw new CorruptStreamError(
      `expected ${name} of 2**${LEAST_BITS} to 2**${MOST_BITS} that fit the surface, ` +
        `got exponents ${exponents[0]} and ${exponents[1]}`,
      offset,
    );
  }
}

function parseLattice(fields: FieldReader): Lattice {
  const start = fields.at;
  const rule = fields.byte();
  const origin = fields.number();
  const step = fields.number();
  if (rule > 1 || !(Number.isFinite(origin) && Number.isFinite(step) && step > 0)) {
    throw new CorruptStreamError(`expected a lattice, got rule ${rule}, origin ${origin}, step ${step}`, start);
  }
  return { rule: rule ? "decimal" : "affine", origin, step };
}

function parsePredictors(
  fields: FieldReader,
  layout: Layout,
  channels: number,
  geometric: number,
  offset: number,
): Predictors[] {
  const fitted = fittedSteps(layout);
  const found: Predictors[] = [];
  let wrong = false;
  for (let channel = 0; channel < channels; channel++) {
    const own = fitted.filter((step) => step.axis < INTERFACES || channel < geometric);
    const predictors = new Predictors(layout.levels);
    const start = fields.at;
    const count = fields.varint();
    if (count !== own.length) {
      throw new CorruptStreamError(`expected predictors of ${own.length} steps, got ${count}`, start);
    }
    for (const step of own) {
      const [a, b] = fields.i8Pair();
      wrong ||= a === -128 || b === -128;
      predictors.set(step, a, b);
    }
    found.push(predictors);
  }
  if (wrong) throw new CorruptStreamError("expected predictors of at most 127 in magnitude, got -128", offset);
  return found;
}

const INTEGER_BITS: Partial<Record<DType, readonly [signed: boolean, bits: number]>> = {
  int8: [true, 8],
  int16: [true, 16],
  int32: [true, 32],
  int64: [true, 64],
  uint8: [false, 8],
  uint16: [false, 16],
  uint32: [false, 32],
  uint64: [false, 64],
};

/** The header with the masks of their section. */
export function parseMasks(header: Header, frame: Frame): Header {
  const { payload, payloadOffset } = frame;
  const fields = new FieldReader(payload, payloadOffset);
  const hole = fields.i64();
  const holes: number[] = [];
  const coded: Uint8Array[] = [];
  for (const { shape } of header.blocks) {
    const count = fields.varint(shape[0] * shape[1]);
    holes.push(count);
    coded.push(count ? fields.take(fields.varint(payload.length)) : new Uint8Array());
  }
  const kept: number[] = [];
  const keptCoded: Uint8Array[] = [];
  for (const count of frame.kind === KIND.keptMasks ? holes : []) {
    const own = fields.varint(count);
    kept.push(own);
    keptCoded.push(own > 0 && own < count ? fields.take(fields.varint(payload.length)) : new Uint8Array());
  }
  fields.end();
  const bits = INTEGER_BITS[header.dtype];
  if (bits) {
    const [signed, count] = bits;
    const fits = signed ? BigInt.asIntN(count, hole) === hole : hole >= 0n && BigInt.asUintN(count, hole) === hole;
    if (!fits) {
      throw new CorruptStreamError(`expected holes as a value of ${header.dtype}, got ${hole}`, payloadOffset);
    }
  }
  return header.withMasks({ hole, holes, coded, kept, keptCoded }, frame.end);
}
