import { expect, it } from "vitest";
import { Answers } from "../../src/view/answers";
import type { MomentGrids, NodeValues } from "../../src/view/source";
import type { FromSource } from "../../src/view/source-messages";

const VALUES: NodeValues = { block: 0, row: 1, column: 2, point: [], attributes: [], rms: 0, max: 0, within: null };

it("answers come in the order of their questions, and one that fails keeps no other back", async () => {
  let resolve!: (grids: MomentGrids) => void;
  const slow = new Promise<MomentGrids>((resolved) => {
    resolve = resolved;
  });
  const begun: string[] = [];
  const receiver = {
    grids: (moment: number | null) => {
      begun.push(`grids ${moment}`);
      return moment === 0 ? slow : Promise.reject(new Error("damaged"));
    },
    valuesAt: async () => {
      begun.push("values");
      return VALUES;
    },
  };
  const sent: FromSource[] = [];
  const transferred: Transferable[][] = [];
  const answers = new Answers(receiver, (answer, transfer) => {
    sent.push(answer);
    transferred.push(transfer);
  });
  answers.take(1, { kind: "grids", moment: 0, level: 3, window: null });
  answers.take(2, { kind: "grids", moment: null, level: 3, window: null });
  answers.take(3, { kind: "values", moment: 0, block: 0, row: 1, column: 2 });
  await new Promise((done) => setTimeout(done, 20));
  // What is the latest is known only when it comes to computing it.
  expect(begun).toEqual(["grids 0"]);
  expect(sent).toEqual([]);
  const points = new Float64Array(3);
  const lines = new Float64Array(1);
  const grid = { rowsAt: lines, columnsAt: lines, full: [1, 1], closed: [false, false], points, mask: null } as const;
  resolve({ moment: 0, grids: [{ ...grid, attributes: [] }] });
  await expect.poll(() => sent.length).toBe(3);
  expect(begun).toEqual(["grids 0", "grids null", "values"]);
  expect(sent.map(({ kind }) => kind)).toEqual(["grids", "refused", "values"]);
  expect(sent.map((answer) => "id" in answer && answer.id)).toEqual([1, 2, 3]);
  expect(transferred[0]).toEqual([points.buffer, lines.buffer]);
});
