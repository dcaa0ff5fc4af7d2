/**
 * A window on its way: what its errors do not exceed, and what is taken for known outside of it.
 *
 * Errors are those of the whole surface's layers, in cells or altogether. So a window must be reconstructed as it would be
 * within the whole: a level counts as known only from the layer on with which all of it is, wherever its tiles lie.
 */
import { ByteBuffer } from "../container/buffer";
import type { Header } from "../container/header";
import type { Index } from "../container/model";
import type { State } from "../container/slices";
import { UNANNOUNCED } from "../entropy/tiles";
import { type Selection, selectedTiles } from "../planning/selection";
import { WindowFigures, windowErrorsFrom, windowSection } from "../planning/window-errors";
import type { Region } from "../types";
import { initialState } from "./progress";

/** The window of a decoder. */
export class WindowState {
  readonly #header: Header;
  readonly #region: Region;
  readonly #inside: Uint8Array; // tiles
  readonly #initial: Int8Array; // (tile, channel)
  readonly #section = new ByteBuffer();
  #figures: WindowFigures;
  #index: Index | null = null;
  #knownFrom: Int32Array | null = null; // (level, channel)

  /** `header` has its masks, `selection` this region. */
  constructor(header: Header, region: Region, selection: Selection) {
    this.#header = header;
    this.#region = region;
    this.#inside = selectedTiles(selection, header);
    this.#initial = initialState(header);
    this.#figures = new WindowFigures(header, region);
  }

  /** Learn from the index with which layer each level is known. */
  follow(index: Index): void {
    this.#index = index;
    this.#knownFrom = knownFrom(index);
  }

  /** Take bytes of the section with the errors of windows; whether they belong to it. Throws `CorruptStreamError`. */
  take(offset: number, data: Uint8Array): boolean {
    const place = this.#index && windowSection(this.#index);
    if (!place || offset < place.offset || offset >= place.offset + place.length) return false;
    if (offset === place.offset + this.#section.length) {
      this.#section.append(data);
      if (this.#section.length === place.length) {
        const windows = windowErrorsFrom(this.#section.peek(place.length).slice(), place.offset, this.#header);
        this.#figures = new WindowFigures(this.#header, this.#region, windows);
      }
    }
    return true;
  }

  /** The errors of a state in the window, and whether they are bounds. */
  figures(made: State): { rms: number; maxError: number; bound: boolean; channels: [] } {
    const layer = made.wholeLevel < 0 && made.number < this.#header.layerCount ? made.number : undefined;
    const { rms, maxError } = this.#figures.within(made, layer);
    return { rms, maxError, bound: !this.#figures.whole && maxError !== 0 && !Number.isNaN(rms), channels: [] };
  }

  /** Set what tiles outside the window tell of their levels in a state, (tile, channel). */
  putOutside(made: State, state: Int8Array): void {
    const header = this.#header;
    const { channels, layout } = header;
    const isKnown = (tile: number, channel: number): boolean => {
      const { level } = layout.tiles[tile]!;
      if (made.complete || Number.isNaN(made.rms)) return true;
      if (made.wholeLevel >= 0) return level <= made.wholeLevel;
      return this.#knownFrom![level * channels + channel]! <= made.number;
    };
    // Where the file comes in its own order, all of the state is known as it is.
    if (!made.complete && !Number.isNaN(made.rms) && made.wholeLevel < 0 && this.#knownFrom === null) return;
    for (let unit = 0; unit < state.length; unit++) {
      const tile = Math.floor(unit / channels);
      if (!this.#inside[tile]) state[unit] = isKnown(tile, unit % channels) ? 0 : this.#initial[unit]!;
    }
  }
}

/** The first layer with which every tile of a level is known, (level, channel). */
function knownFrom({ header, segments }: Index): Int32Array {
  const { channels, layout } = header;
  const missing = initialState(header);
  const first = new Int32Array((header.levels + 1) * channels);
  for (const { tile, channel, top, passes, layer } of segments) {
    const unit = tile * channels + channel;
    if (missing[unit] === UNANNOUNCED) missing[unit] = 2 * top - 1;
    missing[unit] = missing[unit]! - passes;
    first[layout.tiles[tile]!.level * channels + channel] = layer;
  }
  for (let unit = 0; unit < missing.length; unit++) {
    const place = layout.tiles[Math.floor(unit / channels)]!.level * channels + (unit % channels);
    // What no layer has named is known with the last one; what has passes left is never known.
    const from = missing[unit] === UNANNOUNCED ? header.layerCount - 1 : missing[unit] ? header.layerCount : 0;
    first[place] = Math.max(first[place]!, from);
  }
  return first;
}
