/** Which coding passes of each tile and channel are still to come. */
import type { Header } from "../container/header";
import { UNANNOUNCED } from "../entropy/tiles";
import { CorruptStreamError } from "../errors";
import { COEFFICIENT_BITS } from "../transform/predictors";

/**
 * Which passes of each tile have been announced so far, and whether a segment continues them.
 *
 * A *state* is the number of coding passes still to come of every unit: int8, (tile, channel), and `UNANNOUNCED` where
 * that is not known.
 */
export class Progress {
  readonly state: Int8Array;
  readonly #top: Int8Array;
  readonly #channels: number;

  constructor(header: Header) {
    this.state = initialState(header);
    this.#top = new Int8Array(this.state.length);
    this.#channels = header.channels;
  }

  /** Whether a unit's bit-planes were told. */
  isKnown(tile: number, channel: number): boolean {
    return this.#top[tile * this.#channels + channel]! > 0;
  }

  /**
   * Note a segment; returns the first of its passes. `top` are the bit-planes of the unit, told with its first segment;
   * 0 with the others. Throws `CorruptStreamError` where the unit was not announced, was announced already, or has not
   * so many passes left.
   */
  advance(tile: number, channel: number, top: number, passes: number, offset: number): number {
    const unit = tile * this.#channels + channel;
    const known = this.#top[unit]!;
    if (!known && this.state[unit] === 0) {
      throw new CorruptStreamError(`expected no segment of tile ${tile}, whose level has zeros only`, offset);
    }
    if (top > 0 === known > 0) {
      const problem = known ? "told again" : "not told";
      throw new CorruptStreamError(
        `expected the planes of tile ${tile} once, at its first segment: ${problem}`,
        offset,
      );
    }
    if (top > COEFFICIENT_BITS) {
      throw new CorruptStreamError(
        `expected at most ${COEFFICIENT_BITS} bit-planes of tile ${tile}, got ${top}`,
        offset,
      );
    }
    if (top) {
      this.#top[unit] = top;
      this.state[unit] = 2 * top - 1;
    }
    const below = this.state[unit]!;
    if (passes > below) {
      throw new CorruptStreamError(`expected at most ${below} more passes of tile ${tile}, got ${passes}`, offset);
    }
    this.state[unit] = below - passes;
    return below - 1;
  }

  /** The present state; once `whole`, a unit that no layer has announced is known to have nothing but zeros. */
  snapshot(whole: boolean): Int8Array {
    return this.state.map((left) => (whole && left === UNANNOUNCED ? 0 : left));
  }
}

/** The state before the first layer: what has no coefficient, or none other than 0 in its whole level, is known. */
export function initialState(header: Header): Int8Array {
  const { channels, geometric, layout } = header;
  const state = new Int8Array(layout.tiles.length * channels).fill(UNANNOUNCED);
  for (const [number, tile] of layout.tiles.entries()) {
    for (let channel = 0; channel < channels; channel++) {
      const bands = channel < geometric ? tile.bands : tile.whole;
      const isEmpty = Math.floor(header.empty[channel]! / 2 ** tile.level) % 2 === 1;
      if (isEmpty || !bands.length) state[number * channels + channel] = 0;
    }
  }
  return state;
}
