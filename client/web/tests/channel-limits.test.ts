/** Streams that stop by errors of channels, over a server that knows them, and over one that does not. */
import { describe, expect, it } from "vitest";
import { readIndex } from "../src/container";
import { plan } from "../src/planning/planner";
import { makeTarget, type TargetOptions } from "../src/planning/target";
import { parse } from "../src/protocol/wire";
import { Download } from "../src/transfer/download";
import { ReceiverState } from "../src/transfer/receiver-state";
import { decoderFor } from "./decoders";
import { run } from "./python";
import { Sender } from "./sender";

const SAMPLES = run("tests.web.samples")
  .trim()
  .split("\n")
  .map((line) => JSON.parse(line) as { name: string; container: string });
const CONTAINERS = SAMPLES.map(({ container }) => new Uint8Array(Buffer.from(container, "base64")));
const INDICES = await Promise.all(
  CONTAINERS.map((data) => readIndex(async (offset, length) => data.subarray(offset, offset + length), data.length)),
);

describe.each([true, false])("over a server that knows errors of channels: %s", (knows) => {
  it.each(["quality", "level"] as const)("stops at the first state that meets all, in %s order", (order) => {
    for (const [number, index] of INDICES.entries()) {
      const data = CONTAINERS[number]!;
      const { marks } = plan(index, makeTarget({ order }));
      const some = marks[Math.max(marks.length - 3, 0)]!;
      const errors = some.channels.length > 0 ? some.channels : [[some.rms, some.maxError] as const];
      const names = index.header.channelNames;
      const untilRms = Object.fromEntries(names.map((name, channel) => [name, errors[channel]![0]]));
      const target = makeTarget({ order, untilRms, untilMax: { [names[0]!]: errors[0]![1] } });
      const expected = plan(index, target);

      const server = new Sender(index, data);
      server.knowsChannels = knows;
      const client = new Download(new ReceiverState(target, decoderFor(target)), { window: 3000 });
      const views: number[] = [];
      let stops = 0;
      for (let message: Uint8Array | undefined; ; ) {
        for (const said of client.dataToSend()) {
          if (parse(said).type === "stop") stops += 1;
          server.receive(said);
        }
        message = server.next();
        if (message === undefined) break;
        views.push(...client.receive(message).map((view) => view.bytes));
      }
      expect(client.reception.ended).toBe(expected.ended);
      // A level without a coefficient is there with the header already.
      expect(views.slice(-expected.marks.length)).toEqual(expected.marks.map((mark) => mark.bytes));
      expect(stops).toBe(knows || expected.ended === "complete" ? 0 : 1);
    }
  });
});

describe("errors of channels", () => {
  it.each<[TargetOptions, RegExp]>([
    [{ untilRms: { a: "0.1%" } }, /expected an error of a in its own unit/],
    [{ untilRms: { a: 1 }, untilMax: 2 }, /either an error of the whole surface or errors of channels/],
    [{ untilRms: { a: 1 }, level: 2 }, /either a level or other limits/],
    [{ untilMax: { a: -1 } }, /an error of 0 or more/],
    [{ attributes: ["a", "b", "a"] }, /expected each attribute once, got "a" twice/],
    [
      {
        untilMax: { a: 1 },
        region: [
          [0, 1],
          [0, 1],
        ],
      },
      /either errors of channels or a region/,
    ],
  ])("are refused where they make no sense: %j", (options, expected) => {
    expect(() => makeTarget(options)).toThrow(expected);
  });

  it("may be those of a channel that is called value", () => {
    expect(makeTarget({ untilRms: { value: 1, relative: 2 } }).channels).toEqual([
      ["relative", "rms", 2],
      ["value", "rms", 1],
    ]);
    expect(makeTarget({ untilRms: { value: 1, relative: true } }).untilRms).toEqual({ value: 1, relative: true });
  });

  it("are refused with the names that there are", () => {
    const index = INDICES[0]!;
    const names = index.header.channelNames;
    expect(() => plan(index, makeTarget({ untilRms: { nothing: 1 } }))).toThrow(`one of ${names[0]}`);
  });
});
