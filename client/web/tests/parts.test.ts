import { expect, it } from "vitest";
import { RemoteError } from "../src/errors";
import { PART, type Part, PartRanges, type PartReader } from "../src/transfer/parts";
import type { RangeRequest } from "../src/transfer/range-download";
import { AskedParts } from "../src/view/asked-parts";
import type { FromSource } from "../src/view/source-messages";

const DATA = Uint8Array.from({ length: 5 * PART + 77 }, (_, k) => (k * 7919) >> 5);

interface Asked {
  readonly offset: number;
  readonly length: number;
  give(part?: Partial<Part>): void;
  refuse(error: Error): void;
}

/** Somebody who gives parts when told to. */
function giver(): { read: PartReader; asked: Asked[] } {
  const asked: Asked[] = [];
  const read: PartReader = (offset, length) =>
    new Promise((resolve, reject) => {
      const data = DATA.slice(offset, offset + length);
      asked.push({
        offset,
        length,
        give: (part = {}) => resolve({ data, size: DATA.length, tag: "one", ...part }),
        refuse: reject,
      });
    });
  return { read, asked };
}

function request(offset: number, length: number): RangeRequest {
  return { offset, length, end: offset + length } as RangeRequest;
}

const patience = () => 30;

it("a range comes in parts, of which no more than two are asked for at once", async () => {
  const { read, asked } = giver();
  const source = new PartRanges(read);
  const answering = source.ask(request(5, 3 * PART), patience, new AbortController().signal);
  asked[0]!.give();
  const answer = await answering;
  expect(answer.status).toBe(206);
  expect(answer.headers.get("Content-Range")).toBe(`bytes 5-${3 * PART + 4}/${DATA.length}`);
  expect(answer.headers.get("etag")).toBe('"one"');
  expect(asked.length).toBe(1);
  const all = new Uint8Array(3 * PART);
  for (let part = 0; part < 3; part++) {
    const data = await answer.read();
    all.set(data!, part * PART);
    // The next one is on its way while this one is used, and none after it.
    expect(asked.length).toBe(Math.min(part + 2, 3));
    asked[part + 1]?.give();
  }
  expect(await answer.read()).toBeUndefined();
  expect(all).toEqual(DATA.slice(5, 5 + 3 * PART));
  expect(asked.every(({ length }) => length <= PART)).toBe(true);
});

it("a range ends where the container does, and begins nowhere beyond it", async () => {
  const { read, asked } = giver();
  const source = new PartRanges(read);
  const answering = source.ask(request(DATA.length - 10, 500), patience, new AbortController().signal);
  asked[0]!.give();
  const answer = await answering;
  expect(answer.headers.get("content-range")).toBe(`bytes ${DATA.length - 10}-${DATA.length - 1}/${DATA.length}`);
  expect(await answer.read()).toEqual(DATA.slice(-10));
  expect(await answer.read()).toBeUndefined();
  const beyond = source.ask(request(DATA.length, 5), patience, new AbortController().signal);
  asked[1]!.give();
  expect((await beyond).status).toBe(416);
});

it("nothing more is asked for once a range is left", async () => {
  const { read, asked } = giver();
  const left = new AbortController();
  const answering = new PartRanges(read).ask(request(0, 4 * PART), patience, left.signal);
  asked[0]!.give();
  const answer = await answering;
  await answer.read();
  left.abort();
  asked[1]!.give();
  expect(await answer.read()).toBeUndefined();
  expect(asked.length).toBe(2);
});

it("a part that is refused breaks the range, and one that has nothing ends it", async () => {
  const { read, asked } = giver();
  const source = new PartRanges(read);
  const first = source.ask(request(0, 4 * PART), patience, new AbortController().signal);
  asked[0]!.refuse(new RemoteError("other-container", "it has changed"));
  await expect(first).rejects.toMatchObject({ code: "other-container" });
  const second = source.ask(request(0, 4 * PART), patience, new AbortController().signal);
  asked[1]!.give();
  const answer = await second;
  await answer.read();
  asked[2]!.give({ data: new Uint8Array() });
  expect(await answer.read()).toEqual(new Uint8Array());
  expect(await answer.read()).toBeUndefined();
  expect(asked.length).toBe(3);
});

it("what a worker asks its page for is answered by number, and never with more than was asked for", async () => {
  const posted: Extract<FromSource, { kind: "read" }>[] = [];
  const parts = new AskedParts((message) => posted.push(message as Extract<FromSource, { kind: "read" }>));
  const [one, two, three, four] = [parts.read(0, 4), parts.read(4, 4), parts.read(6, 4), parts.read(0, 1)];
  expect(posted.map(({ offset, length }) => [offset, length])).toEqual([
    [0, 4],
    [4, 4],
    [6, 4],
    [0, 1],
  ]);
  const part = (data: number[]): Part => ({ data: Uint8Array.from(data), size: 8, tag: "x" });
  parts.take({ kind: "part", id: posted[1]!.id, part: part([5, 6, 7, 8]) });
  parts.take({ kind: "part", id: posted[0]!.id, part: part([1, 2, 3, 4]) });
  parts.take({ kind: "part", id: posted[0]!.id, part: part([9, 9, 9, 9]) });
  parts.take({ kind: "part", id: posted[2]!.id, part: part([7, 8, 9]) });
  parts.take({ kind: "no part", id: posted[3]!.id, detail: "it has changed", code: "other-container" });
  expect([...(await one).data]).toEqual([1, 2, 3, 4]);
  expect([...(await two).data]).toEqual([5, 6, 7, 8]);
  await expect(three).rejects.toThrow("expected at most 2 bytes of the container, got 3");
  await expect(four).rejects.toMatchObject({ code: "other-container", message: "it has changed" });
});
