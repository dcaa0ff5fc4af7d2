/** The examples in README.md run. */
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { afterAll, beforeAll, expect, it } from "vitest";
import WebSocket from "ws";
import * as api from "../src";
import { type ConnectOptions, connect, type SocketClass, type TargetOptions } from "../src";
import { ROOT } from "./golden";
import { type Served, serve } from "./servers";

const PAGE = readFileSync(join(ROOT, "client/web/README.md"), "utf8");
const SECTION = PAGE.split("## Receiving a surface")[1]!.split("\n## ")[0]!;
const EXAMPLES = [...SECTION.matchAll(/```js\n(.*?)```/gs)].map((found) => found[1]!);

let served: Served;
beforeAll(async () => {
  served = await serve();
});
afterAll(() => served?.stop());

it.each(EXAMPLES)("%s", async (example) => {
  const drawn: unknown[] = [];
  const note = (...given: unknown[]): void => void drawn.push(given);
  const here = (url: string, target: TargetOptions, options: ConnectOptions) =>
    connect(url.includes("maps.example.org") ? served.surface : url, target, {
      ...options,
      WebSocket: WebSocket as unknown as SocketClass,
    });
  const body = example.replace(/^import .*\n/, "");
  const run = new Function("connect", "url", "draw", "show", "curve", `return (async () => {${body}})()`);
  await run(here, served.surface, note, note, note);
  expect(drawn.length).toBeGreaterThan(3);
});

it("has all options, and all that a stream can do", () => {
  for (const name of ["focus", "aim", "throttle", "prices", "kept", "close", "stop"])
    expect(PAGE).toContain(`\`${name}(`);
  const source = readFileSync(join(ROOT, "client/web/src/connect.ts"), "utf8");
  const plain = readFileSync(join(ROOT, "client/web/src/transfer/options.ts"), "utf8").split(
    "interface StreamOptions",
  )[0]!;
  const own = source.split("interface ConnectOptions")[1]!.split("\n}\n")[0]!;
  const shared = plain.split("interface PlainStreamOptions")[1]!.split("\n}\n")[0]!;
  const names = [...`${own}${shared}`.matchAll(/readonly (\w+)\?/g)].map((found) => found[1]!);
  expect(names.length).toBeGreaterThan(15);
  const rare = ["container", "size", "pauses"];
  for (const name of names) if (!rare.includes(name)) expect(PAGE, name).toMatch(new RegExp(`\`${name}[\`(]`));
});

it("names only what the package exports", () => {
  const imported = [...PAGE.matchAll(/import \{ (.*?) \} from "lodestream"/g)].flatMap((found) =>
    found[1]!.split(", "),
  );
  const called = ["coordinatesOf", "placementOf", "readIndex", "serveDecoder", "Stream"];
  const errors = [...PAGE.matchAll(/`([A-Z]\w*Error)`/g)].map((found) => found[1]!);
  expect(errors.length).toBeGreaterThan(4);
  for (const name of called) expect(PAGE).toContain(`\`${name}`);
  for (const name of [...imported, ...called, ...errors]) expect(api, name).toHaveProperty(name);
});
