import { describe, expect, it } from "vitest";
import type { Moment, Progress } from "../../src/view/source";
import { detailText, type FocusState, statusText } from "../../src/view/status";

const moment = (number: number, rms: number): Moment => ({
  number,
  layer: number,
  region: null,
  level: number,
  bytes: 100 * (number + 1),
  seconds: number,
  rms,
  max: 4 * rms,
  attributes: [],
  complete: rms === 0,
});
const MOMENTS = [moment(0, 4), moment(1, 1), moment(2, 0)];

function state(progress: Progress["state"], given: Partial<FocusState> = {}): FocusState {
  return {
    info: null,
    moments: MOMENTS,
    drawn: MOMENTS.at(-1)!,
    drawnLevel: 2,
    following: true,
    awaited: false,
    progress: { state: progress, bytes: 300, planned: 300, rate: 0, detail: "" },
    looksDone: false,
    silent: 0,
    ...given,
  };
}

describe("the status", () => {
  it("says that the surface is exact only where the picture is", () => {
    expect(statusText(state("complete"))).toBe("Complete: exact");
    expect(statusText(state("complete", { drawn: MOMENTS[1]! }))).toBe("Received: drawing");
    expect(statusText(state("complete", { drawn: null }))).toBe("Received: drawing");
    expect(statusText(state("complete", { drawn: MOMENTS[0]!, following: false }))).toBe("Earlier moment");
  });

  it("claims nothing of a moment that is not drawn yet", () => {
    const early = { drawn: MOMENTS.at(-1)!, following: false, awaited: true };
    expect(statusText(state("complete", early))).toBe("Drawing the moment chosen");
    expect(statusText(state("receiving", early))).toBe("Drawing the moment chosen");
    expect(statusText(state("failed", early))).toBe("Failed");
  });

  it("says so also of an end that is not all of it", () => {
    const moments = MOMENTS.slice(0, 2);
    const [early, late] = [
      { moments, drawn: moments[0]! },
      { moments, drawn: moments[1]! },
    ];
    expect(statusText(state("target", late))).toBe("Target met");
    expect(statusText(state("target", early))).toBe("Received: drawing");
    expect(statusText(state("stopped", { ...late, looksDone: true }))).toBe(
      "The picture looks done (estimate): 300 B of 300 B",
    );
    expect(statusText(state("stopped", { ...early, looksDone: true }))).toBe("Received: drawing");
    expect(statusText(state("receiving", early))).toBe("Receiving");
    expect(statusText(state("receiving", { ...early, silent: 4 }))).toBe("Waiting: no data for 4 s");
  });

  it("tells a failure whatever has come", () => {
    expect(statusText(state("failed", { drawn: MOMENTS[0]! }))).toBe("Failed");
    const progress: Progress = { state: "failed", bytes: 5, planned: 300, rate: 0, detail: "The host is gone" };
    expect(detailText({ ...state("failed"), progress })).toBe("5 B of 300 B. The host is gone");
  });
});
