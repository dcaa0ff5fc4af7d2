/** The third step of the lifting as the format sees it (docs/format.md, section 4, "Fitted steps"). */
import type { AxisStep } from "../grid/axis";
import type { Grid, Layout } from "../grid/layout";

/** A coefficient has at most so many magnitude bits. */
export const COEFFICIENT_BITS = 28;
/** Beside axis 0 and axis 1 of the patches: the axis of the interfaces. */
export const INTERFACES = 2;
/** Nodes that an axis needs for an (a, b) of its own. */
const FIT_NODES = 24;
const AXES = 3;

/** Factors of the third step. */
export type Predictor = readonly [a: number, b: number];

const FOUR_POINT: Predictor = [16, 0];

/** A step with an (a, b) of its own: from level + 1 to `level`, along axis 0 or 1 of patches, or of interfaces (2). */
export interface FittedStep {
  readonly level: number;
  readonly axis: number;
}

function isFitted(step: AxisStep): boolean {
  return step.midpoints > 0 && step.run >= FIT_NODES;
}

/** Every step with an (a, b) of its own, in the order of the header. */
export function fittedSteps(layout: Layout): FittedStep[] {
  const found: FittedStep[] = [];
  for (let level = 0; level < layout.levels; level++) {
    const fitted = [false, false, false];
    layout.grids.forEach((grid, number) => {
      layout.steps(number, level + 1).forEach((step, axis) => {
        if (isFitted(step)) fitted[grid.interface ? INTERFACES : axis] = true;
      });
    });
    fitted.forEach((is, axis) => {
      if (is) found.push({ level, axis });
    });
  }
  return found;
}

/** The (a, b) of one channel: int8, (level, axis, 2); (0, 0) where none was fitted. */
export class Predictors {
  readonly values: Int8Array;

  constructor(levels: number) {
    this.values = new Int8Array(levels * AXES * 2);
  }

  /** Note the (a, b) of a fitted step. */
  set(step: FittedStep, a: number, b: number): void {
    const place = (step.level * AXES + step.axis) * 2;
    this.values[place] = a;
    this.values[place + 1] = b;
  }

  /** The (a, b) of a grid's step along an axis from `level` to the level below. */
  of(grid: Grid, step: AxisStep, level: number, axis: number): Predictor {
    if (!isFitted(step)) return FOUR_POINT;
    const place = ((level - 1) * AXES + (grid.interface ? INTERFACES : axis)) * 2;
    return [this.values[place]!, this.values[place + 1]!];
  }
}
