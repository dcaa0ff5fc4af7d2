/** Names: `PAGE#NAME` leads to a container, `HOST/v1/names/NAME` to a surface, once for a stream. */
import { createServer, type Server } from "node:http";
import type { AddressInfo } from "node:net";
import { afterAll, beforeAll, beforeEach, describe, expect, it } from "vitest";
import WebSocket from "ws";
import { connect } from "../src/connect";
import { NotFoundError, RemoteProtocolError } from "../src/errors";
import { sourceUrl } from "../src/transfer/addresses";
import { isNamed, locate, publishedName } from "../src/transfer/locating";
import type { SocketClass } from "../src/transfer/socket";
import { containerOf } from "./golden";

const PLAIN = containerOf("attributes");
const OTHER = containerOf("attributes-wide");
const ONE = "/maps/v1/surfaces/0a/container";

let server: Server;
let url: string;
let list: unknown;
let surface: unknown;
let asked: string[];
let authorized: (string | undefined)[];

beforeAll(async () => {
  server = createServer((request, response) => {
    asked.push(request.url!);
    authorized.push(request.headers.authorization);
    if (request.url === "/maps/view.json") {
      response.end(typeof list === "string" ? list : JSON.stringify(list));
      return;
    }
    if (request.url === "/maps/v1/names/dem") {
      response.end(typeof surface === "string" ? surface : JSON.stringify(surface));
      return;
    }
    const data = { "/maps/containers/one.lode": PLAIN, "/maps/containers/two.lode": OTHER, [ONE]: PLAIN }[request.url!];
    const range = /bytes=(\d+)-(\d+)/.exec(request.headers.range ?? "");
    if (data === undefined || range === null) {
      response.writeHead(404).end();
      return;
    }
    const [start, end] = [Number(range[1]), Math.min(Number(range[2]) + 1, data.length)];
    response.writeHead(206, { "content-range": `bytes ${start}-${end - 1}/${data.length}` });
    response.end(data.subarray(start, end));
  });
  await new Promise<void>((resolve) => server.listen(0, "127.0.0.1", resolve));
  url = `http://127.0.0.1:${(server.address() as AddressInfo).port}`;
});

afterAll(() => new Promise((resolve) => server.close(resolve)));

beforeEach(() => {
  asked = [];
  authorized = [];
  list = { surfaces: [{ name: "hills & dales", src: "containers/one.lode" }] };
  surface = { id: "0a", url: "/maps/v1/surfaces/0a", state: "ready" };
});

const find = (place: string): Promise<string> => locate(place, {}, fetch, new AbortController().signal);

describe("the name of an address", () => {
  it.each([
    ["http://host/#hills", { list: "http://host/view.json", name: "hills" }],
    [
      "http://host/a/index.html?b#hills%20%26%20dales&v=1,2",
      { list: "http://host/a/view.json", name: "hills & dales" },
    ],
    ["http://host/a/#100%", { list: "http://host/a/view.json", name: "100%" }],
    ["http://host/a.lode", undefined],
    ["http://server/#s=0123456789abcdef0123&v=1,2", undefined],
    ["http://host/#a%3Db", { list: "http://host/view.json", name: "a=b" }],
    ["http://host/v1/surfaces/ab#hills", undefined],
    ["http://host/v1/names/dem#hills", undefined],
  ])("%s", (address, expected) => expect(publishedName(address)).toEqual(expected));

  it("is kept by connect, and none of a surface's", () => {
    expect(sourceUrl("http://host/#hills")).toBe("http://host/#hills");
    expect(sourceUrl("http://host/v1/surfaces/ab/#hills")).toBe("http://host/v1/surfaces/ab");
    expect(sourceUrl("http://host/v1/names/dem/?a#hills")).toBe("http://host/v1/names/dem");
    expect(() => sourceUrl("http://host/v1/names/")).toThrow("#NAME");
    expect(() => sourceUrl("http://host/#")).toThrow("#NAME");
    expect(sourceUrl("http://host/a.lode?sig=1#v=3")).toBe("http://host/a.lode?sig=1");
  });
});

describe("a name", () => {
  it("leads to its container", async () => {
    expect(await find(`${url}/maps/#hills%20%26%20dales`)).toBe(`${url}/maps/containers/one.lode`);
    expect(await find(`${url}/a.lode`)).toBe(`${url}/a.lode`);
  });

  it("that is not there is told", async () => {
    await expect(find(`${url}/maps/#dales`)).rejects.toThrow(NotFoundError);
    await expect(find(`${url}/#dales`)).rejects.toThrow(NotFoundError);
  });

  it.each([
    "no list",
    "null",
    { surfaces: 3 },
    { surfaces: [{ name: "hills & dales" }] },
    { surfaces: [{ name: "hills & dales", src: "http://127.0.0.1:1/one.lode" }] },
    { surfaces: [{ name: "hills & dales", src: "http://:x" }] },
    { surfaces: [{ name: "hills & dales", src: "#hills%20%26%20dales" }] },
  ])("is not followed from a list like %j", async (given) => {
    list = given;
    await expect(find(`${url}/maps/#hills%20%26%20dales`)).rejects.toThrow(RemoteProtocolError);
  });

  it("is not looked for in a list that is too long", async () => {
    list = `{"surfaces": [${" ".repeat(17 * 1024 * 1024)}]}`;
    await expect(find(`${url}/maps/#hills`)).rejects.toThrow(RemoteProtocolError);
  });

  it("is asked for again if the head of the answer broke off", async () => {
    let broken = 2;
    const cut: typeof fetch = async (input, init) => {
      const isName = String(input).endsWith("/names/dem");
      return isName && broken-- > 0 ? new Response(null, { headers: { date: "Sun" } }) : fetch(input, init);
    };
    const pauses = { first: 0.002, longest: 0.05 };
    const options = { worker: false, transport: "http", fetch: cut, pauses } as const;
    const stream = connect(`${url}/maps/v1/names/dem`, {}, options);
    let complete = false;
    for await (const view of stream) complete = view.complete;
    expect(complete).toBe(true);
    expect(broken).toBe(-1);
  });

  it("is asked for once, and the stream ends on what it began", async () => {
    const stream = connect(`${url}/maps/#hills%20%26%20dales`, {}, { worker: false, token: "secret" });
    let complete = false;
    for await (const view of stream) {
      list = { surfaces: [{ name: "hills & dales", src: "containers/two.lode" }] };
      complete = view.complete;
    }
    expect(complete).toBe(true);
    expect(asked.filter((path) => path === "/maps/view.json")).toHaveLength(1);
    expect(asked).not.toContain("/maps/containers/two.lode");
    expect(new Set(authorized)).toEqual(new Set(["Bearer secret"]));
  });
});

describe("a name on a server", () => {
  it("is what leads somewhere", () => {
    expect(isNamed("http://host/v1/names/dem")).toBe(true);
    expect(isNamed("http://host/#dem")).toBe(true);
    expect(isNamed("http://host/v1/surfaces/dem")).toBe(false);
    expect(isNamed("http://host/dem.lode")).toBe(false);
  });

  it("leads to its surface", async () => {
    expect(await find(`${url}/maps/v1/names/dem`)).toBe(`${url}/maps/v1/surfaces/0a`);
    await expect(find(`${url}/maps/v1/names/other`)).rejects.toThrow(NotFoundError);
  });

  it.each([
    "no JSON",
    "null",
    {},
    { url: 3 },
    { url: "http://127.0.0.1:1/v1/surfaces/0a" },
    { url: "/maps/v1/names/dem" },
    { url: "/maps/containers/one.lode" },
    { url: "http://:x" },
  ])("is not followed where it leads to %j", async (given) => {
    surface = given;
    await expect(find(`${url}/maps/v1/names/dem`)).rejects.toThrow(RemoteProtocolError);
  });

  it("is asked for once, and the stream ends on what it began", async () => {
    const options = { worker: false, token: "secret", transport: "http" } as const;
    const stream = connect(`${url}/maps/v1/names/dem`, {}, options);
    let complete = false;
    for await (const view of stream) {
      surface = { url: "/maps/v1/surfaces/0b" };
      complete = view.complete;
    }
    expect(complete).toBe(true);
    expect(asked[0]).toBe("/maps/v1/names/dem");
    expect(new Set(asked.slice(1))).toEqual(new Set([ONE]));
    expect(new Set(authorized)).toEqual(new Set(["Bearer secret"]));
  });

  it("is asked for before a WebSocket is opened", async () => {
    const opened: string[] = [];
    server.once("upgrade", (request, socket) => {
      opened.push(request.url!);
      socket.destroy();
    });
    const stream = connect(
      `${url}/maps/v1/names/dem`,
      {},
      { worker: false, WebSocket: WebSocket as unknown as SocketClass },
    );
    let complete = false;
    for await (const view of stream) complete = view.complete;
    expect(complete, "over HTTP then").toBe(true);
    expect(opened[0]).toMatch(/^\/maps\/v1\/surfaces\/0a\/stream/);
    expect(asked.filter((path) => path === "/maps/v1/names/dem")).toHaveLength(1);
  });

  it("that is stopped while it is asked for ends at once", async () => {
    const fetch = (_: unknown, options?: RequestInit): Promise<Response> =>
      new Promise((_resolve, reject) => {
        options?.signal?.addEventListener("abort", () => reject(new Error("aborted")));
        setTimeout(() => void stream.stop());
      });
    const options = { worker: false, WebSocket: WebSocket as unknown as SocketClass, fetch };
    const stream = connect(`${url}/maps/v1/names/dem`, {}, options);
    expect((await stream.next()).done).toBe(true);
  });
});
