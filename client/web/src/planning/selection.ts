/** Which segments and pieces of a container are needed for a window or for some attributes. */

import type { Header } from "../container/header";
import type { Index } from "../container/model";
import { pieceWindows } from "../container/pieces";
import { OptionError } from "../errors";
import type { Piece, Region, Segment, Span, Target } from "../types";
import { checkRegion, neededTiles } from "./reach";

/** The requested part of a surface: a window of its points (left out: all) and attributes by name (left out: all). */
export class Wish {
  constructor(
    readonly region?: Region | undefined,
    readonly attributes?: readonly string[] | undefined,
  ) {}

  /**
   * Refuse a region or attributes that the surface does not have.
   *
   * @throws OptionError
   */
  check(header: Header): void {
    if (this.region !== undefined) {
      if (header.blocks.length > 1) {
        throw new OptionError(`expected a surface of one block for a region, got ${header.blocks.length} blocks`);
      }
      checkRegion(this.region, header.blocks[0]!.shape);
    }
    const names = header.attributes.map((kind) => kind.name);
    for (const name of this.attributes ?? []) {
      if (!names.includes(name)) {
        throw new OptionError(`expected attributes among ${names.join(", ") || "none"}, got ${JSON.stringify(name)}`);
      }
    }
  }

  /** Which channels are wanted; an array (channel). */
  channels(header: Header): boolean[] {
    const chosen = Array<boolean>(header.pointChannels).fill(true);
    for (const kind of header.attributes) {
      const wanted = this.attributes === undefined || this.attributes.includes(kind.name);
      for (let component = 0; component < Math.max(kind.components, 1); component++) chosen.push(wanted);
    }
    return chosen;
  }

  /** Which tiles are wanted; an array (tile) of 0 and 1. */
  tiles(header: Header): Uint8Array {
    // Of a block that meets itself all: what is shared may lie on the other side.
    if (this.region === undefined || header.arrangement !== null) {
      return new Uint8Array(header.layout.tiles.length).fill(1);
    }
    return neededTiles(header.layout, restored(header, this.region));
  }
}

/** What has to be decoded for a region of the only block: a piece of exactness restores all of its own window. */
export function restored(header: Header, region: Region): Region {
  if (!header.corrected) return region;
  const whole = (axis: 0 | 1): Span => {
    const size = 2 ** header.piece[axis];
    const [start, stop] = region[axis];
    return [Math.floor(start / size) * size, Math.min(Math.ceil(stop / size) * size, header.blocks[0]!.shape[axis])];
  };
  return [whole(0), whole(1)];
}

/** The wish in a target. */
export function wishOf(target: Target): Wish {
  return new Wish(target.region, target.attributes);
}

/** Segments in file order, and pieces of exactness by number, that a wish takes. */
export interface Selection {
  readonly segments: readonly Segment[];
  readonly pieces: ReadonlyMap<number, Piece>;
  /** Whether these are all of the container. */
  readonly whole: boolean;
}

/**
 * What of a container a wish takes.
 *
 * @throws OptionError if the surface does not have it.
 */
export function select(index: Index, wish: Wish): Selection {
  const { header } = index;
  const { region } = wish;
  wish.check(header);
  const whole = region === undefined && wish.attributes === undefined;
  const tiles = wish.tiles(header);
  const channels = wish.channels(header);
  const pieces = new Map<number, Piece>();
  if (index.pieces.length > 0) {
    let number = 0;
    for (const window of pieceWindows(header)) {
      const piece = index.pieces[number]!;
      const touches = region === undefined || (meets(region[0], window.rows) && meets(region[1], window.columns));
      if (piece.range.length > 0 && touches && channels[window.channel]) pieces.set(number, piece);
      number += 1;
    }
  }
  if (whole) return { segments: index.segments, pieces, whole };
  const segments = index.segments.filter((segment) => tiles[segment.tile] && channels[segment.channel]);
  return { segments, pieces, whole };
}

function meets(one: Span, other: Span): boolean {
  return one[0] < other[1] && other[0] < one[1];
}
