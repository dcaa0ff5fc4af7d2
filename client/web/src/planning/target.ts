/** Targets as callers write them, checked: how far to refine a surface, and in which order. */

import { OptionError } from "../errors";
import type { ChannelLimit, Region, Target, Tolerance } from "../types";

/** An error: a number in the surface's unit, `"0.1%"` (of the extent), or both. */
export type Limit = number | string | Tolerance;

/** An error of the whole surface, or errors of channels by name, each in its own unit. */
export type Limits = Limit | Readonly<Record<string, Limit>>;

/** A target as callers write it. Of errors of channels all have to be met; of other limits the first one counts. */
export interface TargetOptions {
  readonly level?: number | undefined;
  readonly untilRms?: Limits | undefined;
  readonly untilMax?: Limits | undefined;
  readonly maxBytes?: number | undefined;
  readonly seconds?: number | undefined;
  readonly order?: "quality" | "level" | undefined;
  readonly region?: Region | undefined;
  readonly attributes?: readonly string[] | undefined;
  readonly first?: Region | undefined;
}

/**
 * A target whose values are checked.
 *
 * @throws OptionError if a value is not allowed, or values contradict each other.
 */
export function makeTarget(options: TargetOptions = {}): Target {
  const { level, maxBytes, seconds, region, attributes, first } = options;
  const order = options.order ?? "quality";
  const untilRms = ofWhole(options.untilRms);
  const untilMax = ofWhole(options.untilMax);
  const limits = [...ofChannels(options.untilRms, "rms"), ...ofChannels(options.untilMax, "max")];
  limits.sort(([one], [other]) => Number(one > other) - Number(one < other));
  const channels = limits.length > 0 ? limits : undefined;
  const limited = [untilRms, untilMax, channels, maxBytes, seconds].some((limit) => limit !== undefined);
  if (level !== undefined && limited) throw new OptionError("expected either a level or other limits, got both");
  if (level !== undefined && !(Number.isInteger(level) && level >= 0)) {
    throw new OptionError(`expected a level of 0 or more, got ${level}`);
  }
  if (maxBytes !== undefined && !(Number.isInteger(maxBytes) && maxBytes >= 1)) {
    throw new OptionError(`expected a limit of at least one byte, got ${maxBytes}`);
  }
  if (seconds !== undefined && !(seconds > 0)) {
    throw new OptionError(`expected a positive number of seconds, got ${seconds}`);
  }
  if (order !== "quality" && order !== "level") {
    throw new OptionError(`expected order quality or level, got ${JSON.stringify(String(order).slice(0, 80))}`);
  }
  if (region !== undefined) {
    checkSpans(region);
  }
  if (first !== undefined) checkSpans(first);
  if (attributes !== undefined && new Set(attributes).size < attributes.length) {
    const once = new Set<string>();
    const twice = attributes.find((name) => once.size === once.add(name).size);
    throw new OptionError(`expected each attribute once, got ${JSON.stringify(twice?.slice(0, 80))} twice`);
  }
  if (channels !== undefined && (untilRms ?? untilMax) !== undefined) {
    throw new OptionError("expected either an error of the whole surface or errors of channels, got both");
  }
  if (channels !== undefined && region !== undefined) {
    throw new OptionError("expected either errors of channels or a region, of which they are not known, got both");
  }
  const values = { level, untilRms, untilMax, channels, maxBytes, seconds, order, region, attributes, first };
  return Object.fromEntries(Object.entries(values).filter(([, value]) => value !== undefined));
}

function ofWhole(given: Limits | undefined): Tolerance | undefined {
  return given === undefined || byName(given) ? undefined : tolerance(given);
}

function ofChannels(given: Limits | undefined, which: "rms" | "max"): ChannelLimit[] {
  if (given === undefined || !byName(given)) return [];
  return Object.entries(given).map(([name, limit]) => {
    const { value, relative } = tolerance(limit);
    if (relative) {
      throw new OptionError(
        `expected an error of ${name} in its own unit, got ${100 * value}%, which is of the extent`,
      );
    }
    return [name, which, value];
  });
}

/** Whether errors are those of channels; one of these may be called `value`. */
function byName(given: Limits): given is Readonly<Record<string, Limit>> {
  return typeof given === "object" && typeof given.relative !== "boolean";
}

/**
 * Refuse a region that contains no point, whatever the surface.
 *
 * @throws OptionError
 */
export function checkSpans(region: Region): void {
  for (const [start, stop] of region) {
    if (!(Number.isInteger(start) && Number.isInteger(stop) && 0 <= start && start < stop)) {
      throw new OptionError(`expected a region of at least one row and column, counted from 0, got ${start}:${stop}`);
    }
  }
}

/**
 * A tolerance from a number in the surface's unit, from text such as `0.5` or `0.1%` (of the extent), or from itself.
 *
 * @throws OptionError if it is none of these, negative or not finite.
 */
export function tolerance(given: number | string | Tolerance): Tolerance {
  if (typeof given === "object") return checked(given.value, given.relative);
  if (typeof given === "number") return checked(given, false);
  const relative = given.endsWith("%");
  const digits = relative ? given.slice(0, -1) : given;
  // Number("") is 0.
  if (digits.trim() === "" || Number.isNaN(Number(digits))) {
    throw new OptionError(
      `${JSON.stringify(given)} is not an error bound: write 0 or more, such as 0.5, or 0.1% of the extent`,
    );
  }
  // By the exponent, so that the number is that of the decimals without rounding twice.
  const [mantissa, exponent = "0"] = digits.trim().toLowerCase().split("e");
  return checked(relative ? Number(`${mantissa}e${Number(exponent) - 2}`) : Number(digits), relative);
}

/** A tolerance in the unit of a surface with this extent. */
export function absolute(limit: Tolerance, extent: number): number {
  return limit.relative ? limit.value * extent : limit.value;
}

/** Whether two regions are the same, or both left out. */
export function sameRegion(one: Region | undefined, other: Region | undefined): boolean {
  if (one === undefined || other === undefined) return one === other;
  return one.every((span, axis) => span.every((end, side) => end === other[axis]![side]));
}

function checked(value: number, relative: boolean): Tolerance {
  if (!(Number.isFinite(value) && value >= 0)) throw new OptionError(`expected an error of 0 or more, got ${value}`);
  return { value, relative };
}
