/**
 * What is said of a transmission and of the picture. Errors stand beside it that are those of the drawn moment, so no
 * sentence claims of the surface what another moment has reached.
 */

import { formatBytes, formatNumber } from "./format";
import type { Moment, Progress, SurfaceInfo } from "./source";

/** All that is told of. */
export interface FocusState {
  readonly info: SurfaceInfo | null;
  readonly moments: readonly Moment[];
  /** The moment that the picture shows; null: none yet. */
  readonly drawn: Moment | null;
  readonly drawnLevel: number;
  /** Whether new moments are drawn as they come. */
  readonly following: boolean;
  /** A moment was chosen that is not drawn yet. */
  readonly awaited: boolean;
  readonly progress: Progress;
  readonly looksDone: boolean;
  /** Seconds without a byte, while receiving. */
  readonly silent: number;
}

/** An error with its unit. */
export function errorText(value: number, unit: string): string {
  if (Number.isNaN(value)) return "not yet known";
  return `${formatNumber(value, 3)} ${unit}`.trim();
}

/** Whether nothing is missing: also when the last bytes came after the transmission was stopped. */
export function isWhole({ progress, moments }: FocusState): boolean {
  return progress.state === "complete" || moments.at(-1)?.complete === true;
}

/** One or a few words. */
export function statusText(state: FocusState): string {
  const { progress, looksDone, silent, info, moments, drawn, following } = state;
  const last = moments.at(-1);
  if (state.awaited && progress.state !== "failed") return "Drawing the moment chosen";
  const whole = isWhole(state) && progress.state !== "failed";
  if (last !== undefined && drawn?.number !== last.number && (whole || looksDone || progress.state === "target"))
    return following ? "Received: drawing" : "Earlier moment";
  if (whole) return info?.exact === false || last?.rms !== 0 ? "Complete" : "Complete: exact";
  if (looksDone && progress.state !== "failed") {
    const total = progress.planned || info?.size || 0;
    return `The picture looks done (estimate): ${formatBytes(progress.bytes)} of ${formatBytes(total)}`;
  }
  switch (progress.state) {
    case "connecting":
      return "Connecting";
    case "receiving":
      return silent >= 3 ? `Waiting: no data for ${silent} s` : "Receiving";
    case "waiting":
      return "Waiting";
    case "resuming":
      return "Link lost: resuming";
    case "stopped":
      return "Stopped";
    case "target":
      return "Target met";
    case "complete":
      return "Complete";
    case "failed":
      return "Failed";
  }
}

/** Bytes, rate and level, and why something is as it is. */
export function detailText({ progress, info, drawn, drawnLevel }: FocusState): string {
  const total = progress.planned || info?.size || 0;
  const parts = [total > 0 ? `${formatBytes(progress.bytes)} of ${formatBytes(total)}` : formatBytes(progress.bytes)];
  if (progress.state === "receiving" && progress.rate > 0) parts.push(`${formatBytes(progress.rate)}/s`);
  if (drawn !== null && info !== null) {
    const level = `level ${drawn.level} of ${info.levels}`;
    parts.push(drawnLevel < drawn.level ? `${level} (drawn ${drawnLevel})` : level);
  }
  return [parts.join(" · "), progress.detail].filter((text) => text !== "").join(". ");
}
