/** Errors at which a stream stops, of one surface: what a target names, as numbers and channels. */

import type { Header } from "../container/header";
import { OptionError } from "../errors";
import type { ChannelErrors, Target } from "../types";
import { selectedChannels } from "./selection";
import { absolute } from "./target";

/** The errors of a state; NaN, or no channels, where they are not known. */
export interface StateErrors {
  readonly rms: number;
  readonly maxError: number;
  readonly channels: ChannelErrors;
}

/** The largest error of the channels of a name: several if they are components of an attribute. */
interface NamedLimit {
  readonly channels: readonly number[];
  readonly which: 0 | 1;
  readonly most: number;
}

/** The errors at which to stop, in their units: either of those of the whole surface, or all of those of channels. */
export class ErrorLimits {
  private readonly rms: number | undefined;
  private readonly maxError: number | undefined;
  private readonly channels: readonly NamedLimit[];

  /** @throws OptionError if the surface has no channel or attribute of a name, or the target leaves it out. */
  constructor(target: Target, header: Header) {
    this.rms = target.untilRms && absolute(target.untilRms, header.extent);
    this.maxError = target.untilMax && absolute(target.untilMax, header.extent);
    const names = target.channels === undefined ? new Map<string, number[][]>() : named(target, header);
    this.channels = (target.channels ?? []).flatMap(([name, which, most]) => {
      const groups = names.get(name);
      if (groups === undefined) {
        const wanted = [...names.keys()].join(", ");
        throw new OptionError(`expected an error of one of ${wanted}, got one of ${missing(name, header)}`);
      }
      return groups.map((channels) => ({ channels, which: which === "max" ? (1 as const) : (0 as const), most }));
    });
  }

  /** The first limit that a state with these errors meets. */
  met({ rms, maxError, channels }: StateErrors): "rms" | "max" | "channels" | undefined {
    if (this.rms !== undefined && rms <= this.rms) return "rms";
    if (this.maxError !== undefined && maxError <= this.maxError) return "max";
    // A surface of one channel tells its errors once.
    const own = channels.length > 0 ? channels : [[rms, maxError] as const];
    const all = this.channels.length > 0 && this.channels.every((limit) => together(limit, own) <= limit.most);
    return all ? "channels" : undefined;
  }
}

/** A name that is not wanted or not there, with the reason if it is there. */
function missing(name: string, header: Header): string {
  const there = header.channelNames.includes(name) || header.attributes.some((attribute) => attribute.name === name);
  return name + (there ? ", which is left out: it is not among the attributes asked for" : "");
}

/** The channels that each name stands for; a name that several have stands for each of them. */
function named(target: Target, header: Header): Map<string, number[][]> {
  const wanted = selectedChannels(target, header);
  const groups: [string, number[]][] = header.channelNames.map((name, channel) => [name, [channel]]);
  let first = header.pointChannels;
  for (const { name, components } of header.attributes) {
    if (components > 0) groups.push([name, Array.from({ length: components }, (_, part) => first + part)]);
    first += Math.max(components, 1);
  }
  const found = new Map<string, number[][]>();
  for (const [name, group] of groups) {
    if (group.every((channel) => wanted[channel])) found.set(name, [...(found.get(name) ?? []), group]);
  }
  return found;
}

/** What the error of channels is at most where these are the errors of each; NaN where they are not known. */
function together({ channels, which }: NamedLimit, errors: ChannelErrors): number {
  const found = channels.map((channel) => errors[channel]?.[which] ?? Number.NaN);
  const largest = Math.max(...found);
  if (found.length === 1 || !(largest > 0 && largest < Number.POSITIVE_INFINITY)) return largest;
  let total = 0; // in this order, since servers have to stop at the same layer
  for (const error of found) total += (error / largest) * (error / largest);
  return largest * Math.sqrt(total);
}
