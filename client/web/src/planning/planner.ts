/**
 * What to send of a container, and in which order: one pure function.
 *
 * A server makes the same plan; a client that reads by HTTP Range or from a file makes its own.
 */

import type { Header } from "../container/header";
import type { Index } from "../container/model";
import { OptionError } from "../errors";
import type { ByteRange, LevelRecord, Region, Target } from "../types";
import type { RangeSet } from "./byte-ranges";
import { ErrorLimits } from "./limits";
import { type Ended, endOf, type Mark, type Plan } from "./plan";
import { regionFirst } from "./region-first";
import { select } from "./selection";
import { type Figures, type WindowErrors, WindowFigures, wantsWindowErrors, windowSection } from "./window-errors";

/** What a plan of a window takes from beside the index. */
export interface WindowOptions {
  /** The container's own bounds of the errors of windows; their section then comes behind the index. */
  readonly windows?: WindowErrors | null;
  /** Whether errors of windows are told; false: NaN before the end, as servers of earlier releases plan. */
  readonly bounded?: boolean;
}

/**
 * The slices that a receiver with this target gets, if it holds these bytes of the container.
 *
 * Of a window, errors before its end are bounds, see `WindowFigures`; limits are met where these are.
 *
 * @throws OptionError if there is no such level or region, or not even the first layer fits into the allowed bytes.
 */
export function plan(index: Index, target: Target = {}, cached?: RangeSet, options: WindowOptions = {}): Plan {
  let chosen = whole(index, target, options);
  if (target.first !== undefined) chosen = regionFirst(index, chosen, target.first);
  return cached === undefined || cached.size === 0 ? chosen : less(chosen, cached);
}

function whole(index: Index, target: Target, options: WindowOptions): Plan {
  if (target.region !== undefined || target.attributes !== undefined) return selected(index, target, options);
  const finest = index.header.layout.levels;
  if (target.level !== undefined) {
    checkLevel(target.level, finest);
    if (target.level < finest) {
      return target.order === "level" ? byLevel(index, target, target.level) : slicesOfLayers(index, target.level);
    }
  }
  return target.order === "level" ? byLevel(index, target, finest) : prefix(index, target);
}

function checkLevel(level: number, finest: number): void {
  if (level > finest) throw new OptionError(`expected a level of 0 to ${finest}, got ${level}`);
}

/** Quality order: the file's own. */
function prefix(index: Index, target: Target): Plan {
  const marks: Mark[] = index.layers.map((record) => ({
    sent: record.end,
    number: record.number,
    level: record.level,
    bytes: record.end,
    rms: record.errors.rms,
    maxError: record.errors.maximum,
    channels: record.errors.channels,
  }));
  if (index.residual !== null) {
    const end = index.residual.offset + index.residual.length;
    marks.push(markOfLevel(index.levels[index.levels.length - 1]!, end, marks.length));
  }
  const [kept, ended] = until(marks, target, index.header);
  const length = kept[kept.length - 1]!.sent;
  return {
    before: [],
    ranges: [{ offset: 0, length }],
    after: [index.metadata],
    marks: kept,
    ended,
    prefix: true,
  };
}

/** The marks up to the first limit met. */
function until(marks: readonly Mark[], target: Target, header: Header): [Mark[], Ended] {
  const limits = new ErrorLimits(target, header);
  const kept: Mark[] = [];
  for (const [number, mark] of marks.entries()) {
    if (target.maxBytes !== undefined && mark.bytes > target.maxBytes) {
      if (kept.length === 0) {
        throw new OptionError(
          `expected at least the ${mark.bytes} bytes of the first layer or level, got ${target.maxBytes}`,
        );
      }
      return [kept, "bytes"];
    }
    kept.push(mark);
    if (number === marks.length - 1) break;
    const met = limits.met(mark);
    if (met !== undefined) return [kept, met];
  }
  return [kept, "complete"];
}

/** Quality order of the levels up to one: of each layer the segments that belong to them, which stand together. */
function slicesOfLayers(index: Index, level: number): Plan {
  const { tiles } = index.header.layout;
  const slices = new Slices(index);
  const marks: Mark[] = [];
  const { segments } = index;
  for (const [number, segment] of segments.entries()) {
    if (tiles[segment.tile]!.level <= level) slices.append(segment.range);
    if (segments[number + 1]?.layer === segment.layer) continue;
    const record = index.layers[segment.layer]!;
    if (record.level <= level) {
      marks.push({
        sent: slices.total,
        number: segment.layer,
        level: record.level,
        bytes: slices.total,
        rms: record.errors.rms,
        maxError: record.errors.maximum,
        channels: record.errors.channels,
      });
    }
  }
  const before = marks.filter((mark) => mark.sent < slices.total);
  return {
    before: [index.index],
    ranges: slices.ranges,
    after: [index.metadata],
    marks: [...before, markOfLevel(index.levels[level]!, slices.total)],
    ended: "level",
    prefix: false,
  };
}

/** Level order: level by level, the segments of all layers; the complete surface also has its residual. */
function byLevel(index: Index, target: Target, level: number): Plan {
  const { tiles, levels: finest } = index.header.layout;
  const slices = new Slices(index);
  const marks: Mark[] = [];
  const ofLevel: ByteRange[][] = index.levels.map(() => []);
  for (const segment of index.segments) ofLevel[tiles[segment.tile]!.level]!.push(segment.range);
  for (const state of index.levels.slice(0, level + 1)) {
    for (const place of ofLevel[state.level]!) slices.append(place);
    if (state.level === finest && index.residual !== null) slices.append(index.residual);
    marks.push(markOfLevel(state, slices.total));
  }
  const parts = { before: [index.index], after: [index.metadata], prefix: false };
  if (target.level !== undefined) {
    return { ...parts, ranges: slices.ranges, marks, ended: level === finest ? "complete" : "level" };
  }
  const [kept, ended] = until(marks, target, index.header);
  return { ...parts, ranges: cut(slices.ranges, kept[kept.length - 1]!.sent), marks: kept, ended };
}

/** A window, or some attributes only: segments in file order or level by level, then chunks of the residual. */
function selected(index: Index, target: Target, options: WindowOptions): Plan {
  const chosen = select(index, target);
  const { tiles, levels } = index.header.layout;
  const { bounded = true } = options;
  const windows = wantsWindowErrors(target, index.header) ? (options.windows ?? null) : null;
  const within = figuresOf(index, target.region, windows, bounded);
  const finest = target.level ?? levels;
  checkLevel(finest, levels);
  const levelOf = (tile: number): number => tiles[tile]!.level;
  const segments = chosen.segments.filter((segment) => levelOf(segment.tile) <= finest);
  if (target.order === "level") segments.sort((a, b) => levelOf(a.tile) - levelOf(b.tile));
  const slices = new Slices(index);
  let marks: Mark[] = [];
  let level = 0;
  for (const [number, segment] of segments.entries()) {
    slices.append(segment.range);
    const own = levelOf(segment.tile);
    level = Math.max(level, own);
    const after = segments[number + 1];
    if (target.order === "level") {
      if (after === undefined || levelOf(after.tile) > own) {
        const mark = markOfLevel(index.levels[own]!, slices.total);
        marks.push({ ...mark, ...within(mark) });
      }
    } else if (after === undefined || after.layer > segment.layer) {
      // Layers of which nothing is wanted are there as well.
      const record = after === undefined ? index.layers[index.layers.length - 1]! : index.layers[after.layer - 1]!;
      const { rms, maximum: maxError, channels } = record.errors;
      if (record.level <= finest) {
        const figures = within({ rms, maxError }, record.number);
        marks.push({ sent: slices.total, number: record.number, level, bytes: slices.total, ...figures, channels });
      }
    }
  }
  let last: Mark;
  let ended: Ended;
  if (finest < levels) {
    last = markOfLevel(index.levels[finest]!, slices.total);
    last = { ...last, ...within(last) };
    ended = "level";
  } else {
    for (const chunk of chosen.chunks.values()) slices.append(chunk.range);
    const number = chosen.chunks.size > 0 ? index.layers.length : index.layers.length - 1;
    last = { ...markOfLevel(index.levels[index.levels.length - 1]!, slices.total, number), level: finest };
    if (bounded) last = { ...last, ...within(last, chosen.chunks.size > 0 ? undefined : number) };
    ended = "complete";
  }
  marks = [...marks.filter((mark) => mark.sent < slices.total), last];
  if (target.region !== undefined) marks = marks.map((mark) => ({ ...mark, channels: [] }));
  if (target.level === undefined) [marks, ended] = until(marks, target, index.header);
  const ranges = cut(slices.ranges, marks[marks.length - 1]!.sent);
  const section = windows !== null && bounded ? windowSection(index) : null;
  const before = section === null ? [index.index] : [index.index, section];
  return { before, ranges, after: [index.metadata], marks, ended, prefix: false };
}

/** What a receiver knows of the errors of its selection, from those of the whole surface, and the layer. */
function figuresOf(
  index: Index,
  region: Region | undefined,
  windows: WindowErrors | null,
  bounded: boolean,
): (of: Figures, layer?: number) => Figures {
  if (region === undefined) return ({ rms, maxError }) => ({ rms, maxError });
  if (!bounded) return () => ({ rms: Number.NaN, maxError: Number.NaN });
  const figures = new WindowFigures(index.header, region, windows);
  return (of, layer) => figures.within(of, layer);
}

function markOfLevel(state: LevelRecord, bytes: number, number: number = state.level): Mark {
  const { rms, maximum: maxError, channels } = state.errors;
  return { sent: bytes, number, level: state.level, bytes, rms, maxError, channels };
}

/** Slices of the surface after its header, joined where they touch; `total` is their length. */
class Slices {
  readonly ranges: ByteRange[];
  total: number;

  constructor(index: Index) {
    this.total = index.header.length;
    this.ranges = [{ offset: 0, length: this.total }];
  }

  append(place: ByteRange): void {
    const last = this.ranges[this.ranges.length - 1]!;
    if (last.offset + last.length === place.offset) {
      this.ranges[this.ranges.length - 1] = { offset: last.offset, length: last.length + place.length };
    } else {
      this.ranges.push(place);
    }
    this.total += place.length;
  }
}

function cut(ranges: readonly ByteRange[], length: number): ByteRange[] {
  const kept: ByteRange[] = [];
  let left = length;
  for (const place of ranges) {
    const taken = Math.min(place.length, left);
    if (taken > 0) kept.push({ offset: place.offset, length: taken });
    left -= taken;
  }
  return kept;
}

/** The plan without what is cached; each mark stands where the last missing byte before it does. */
function less(chosen: Plan, cached: RangeSet): Plan {
  const marks: Mark[] = [];
  const ranges: ByteRange[] = [];
  let todo = 0;
  let planned = 0;
  let sent = 0;
  for (const place of chosen.ranges) {
    const gaps = missing(place, cached);
    // Marks and gaps both go forward: each gap is looked at once, however many marks there are.
    let passed = 0;
    for (; todo < chosen.marks.length; todo++) {
      const mark = chosen.marks[todo]!;
      if (mark.sent > planned + place.length) break;
      const end = place.offset + mark.sent - planned;
      while (passed < gaps.length && gaps[passed]!.offset + gaps[passed]!.length <= end) {
        sent += gaps[passed]!.length;
        passed += 1;
      }
      const begun = passed < gaps.length ? Math.max(end - gaps[passed]!.offset, 0) : 0;
      marks.push({ ...mark, sent: sent + begun });
    }
    planned += place.length;
    for (; passed < gaps.length; passed++) sent += gaps[passed]!.length;
    ranges.push(...gaps);
  }
  // What is cached beyond a state that has no figures of its own counts too.
  const ahead = endOf(chosen).bytes - sent;
  return {
    ...chosen,
    before: chosen.before.flatMap((place) => missing(place, cached)),
    ranges,
    after: chosen.after.flatMap((place) => missing(place, cached)),
    marks: marks.map((mark) => (Number.isNaN(mark.rms) ? { ...mark, bytes: ahead + mark.sent } : mark)),
  };
}

function missing(place: ByteRange, cached: RangeSet): ByteRange[] {
  return [...cached.missing(place.offset, place.length)].map(([offset, length]) => ({ offset, length }));
}
