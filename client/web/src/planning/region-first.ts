/** Reordering a plan: what a region needs comes first, the rest after it. */

import type { Index } from "../container/model";
import type { ByteRange, Region } from "../types";
import { RangeSet } from "./byte-ranges";
import type { Mark, Plan } from "./plan";
import { checkSelection, selectedTiles } from "./selection";

/** A mark, and of the bytes before it in the plan's order those that now come ahead and behind. */
interface Step {
  readonly mark: Mark;
  readonly ahead: number;
  readonly behind: number;
}

/**
 * Move the segments that a region needs to the front of a plan; the slices stay the same.
 *
 * What the first state needs stays in front. Both parts keep the plan's order, so that every segment comes after those
 * that its contexts depend on. The index comes before everything, because only with it can the slices be told apart. A
 * mark then stands where its state is complete in the region, and again where it is complete everywhere; its errors are
 * NaN if more than the state's data have been sent by then.
 *
 * @param chosen A plan for a client that holds nothing.
 * @throws OptionError if the surface has no such region, or several blocks.
 */
export function regionFirst(index: Index, chosen: Plan, region: Region): Plan {
  checkSelection({ region }, index.header);
  const tiles = selectedTiles({ region }, index.header);
  const near = new RangeSet(
    index.segments.filter((segment) => tiles[segment.tile]).map(({ range }) => [range.offset, range.length] as const),
  );
  const head: ByteRange[] = [];
  const first: ByteRange[] = [];
  const rest: ByteRange[] = [];
  const steps: Step[] = [];
  let ahead = 0;
  let behind = 0;
  for (const [mark, places] of between(chosen)) {
    for (const place of places) {
      if (steps.length === 0) {
        head.push(place);
        ahead += place.length;
        continue;
      }
      for (const [offset, length] of near.overlap(place.offset, place.length)) {
        first.push({ offset, length });
        ahead += length;
      }
      for (const [offset, length] of near.missing(place.offset, place.length)) {
        rest.push({ offset, length });
        behind += length;
      }
    }
    steps.push({ mark, ahead, behind });
  }
  return {
    ...chosen,
    before: [index.index, ...chosen.before.filter((place) => place !== index.index)],
    ranges: [...head, ...first, ...rest],
    marks: [...reordered(steps)],
    prefix: false,
  };
}

/** Each mark with the slices between the one before and itself. */
function* between(chosen: Plan): Generator<[Mark, ByteRange[]]> {
  let number = 0;
  let begun = 0; // bytes of the slice in hand that went to earlier marks
  let sent = 0;
  for (const mark of chosen.marks) {
    const places: ByteRange[] = [];
    while (sent < mark.sent) {
      const place = chosen.ranges[number]!;
      const size = Math.min(place.length - begun, mark.sent - sent);
      places.push({ offset: place.offset + begun, length: size });
      sent += size;
      begun += size;
      if (begun === place.length) {
        number += 1;
        begun = 0;
      }
    }
    yield [mark, places];
  }
}

/** The marks, counted in bytes of the surface in their new order. */
function* reordered(steps: readonly Step[]): Generator<Mark> {
  const end = steps[steps.length - 1]!;
  for (const inRegion of [true, false]) {
    let before = 0;
    for (const step of steps) {
      const size = inRegion ? step.ahead : step.behind;
      if (size > before && step !== end) {
        const sent = inRegion ? size : end.ahead + size;
        // Figures are those of a state by itself: all of it, and nothing else, is there.
        const alone = inRegion ? step.behind === 0 : step.ahead === end.ahead;
        const unknown = { bytes: sent, rms: Number.NaN, maxError: Number.NaN, channels: [] };
        yield { ...step.mark, sent, ...(alone ? {} : unknown) };
      }
      before = size;
    }
  }
  yield { ...end.mark, sent: end.ahead + end.behind };
}
