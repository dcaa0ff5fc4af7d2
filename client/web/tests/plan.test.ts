import { describe, expect, it } from "vitest";
import { readIndex } from "../src/container";
import { RangeSet } from "../src/planning/byte-ranges";
import { endOf, type Plan } from "../src/planning/plan";
import { plan } from "../src/planning/planner";
import { makeTarget, type TargetOptions } from "../src/planning/target";
import { readWindowErrors } from "../src/planning/window-errors";
import { run } from "./python";

interface Case {
  target: TargetOptions;
  held: [number, number][];
  /** Whether the container's bounds of windows are used, those of the whole surface only, or none. */
  windows: "own" | "whole" | "none";
  plan?: Plan;
  error?: string;
}

const SEED = Number(process.env.SEED ?? Math.floor(Math.random() * 2 ** 30));
const CONTAINERS = Number(process.env.CONTAINERS ?? 25);

/** What is not a number Python's JSON does not say. */
function told(made: Plan): unknown {
  return JSON.parse(JSON.stringify(made));
}

describe(`plans of random containers, seed ${SEED}`, () => {
  const lines = run("tests.web.plans", SEED, CONTAINERS).trim().split("\n");
  const given = lines.map((line) => JSON.parse(line) as { container: string; cases: Case[] });

  it.each(given)("are those of Python", async ({ container, cases }) => {
    const data = new Uint8Array(Buffer.from(container, "base64"));
    const read = async (offset: number, length: number) => data.subarray(offset, offset + length);
    const index = await readIndex(read, data.length);
    const own = await readWindowErrors(index, read);
    let made = 0;
    for (const { target, held, windows, plan: expected, error } of cases) {
      const said = JSON.stringify({ target, held, windows });
      const options = { windows: windows === "own" ? own : null, bounded: windows !== "none" };
      if (expected === undefined) {
        const make = () => plan(index, makeTarget(target), new RangeSet(held), options);
        expect(make, said).toThrow(error?.replaceAll("'", ""));
        continue;
      }
      const found = plan(index, makeTarget(target), new RangeSet(held), options);
      expect(told(found), said).toEqual(expected);
      expect(endOf(found).bytes, said).toBe(endOf(expected).bytes);
      made += 1;
    }
    expect(made).toBeGreaterThan(cases.length / 4);
  });
});
