/** Servers of WebSockets that restart, fall silent, or do not follow the protocol. */
import { createServer, type Server } from "node:http";
import type { AddressInfo } from "node:net";
import { encode } from "@msgpack/msgpack";
import { afterEach, describe, expect, it } from "vitest";
import WebSocket, { WebSocketServer } from "ws";
import { readIndex } from "../src/container";
import type { View } from "../src/decoding/view";
import {
  type LodestreamError,
  RemoteError,
  RemoteProtocolError,
  SilenceError,
  TruncatedStreamError,
} from "../src/errors";
import { makeTarget } from "../src/planning/target";
import { SUBPROTOCOL } from "../src/protocol/messages";
import { serialize } from "../src/protocol/wire";
import type { StreamOptions, StreamState } from "../src/transfer/options";
import type { SocketClass } from "../src/transfer/socket";
import { Stream } from "../src/transfer/stream";
import { decoderFor } from "./decoders";
import { containerOf, NAMES } from "./golden";
import { Sender } from "./sender";

const LARGEST = NAMES.map(containerOf).reduce((one, other) => (one.length > other.length ? one : other));
const INDEX = await readIndex(async (offset, length) => LARGEST.subarray(offset, offset + length), LARGEST.length);

/** What a server does at a connection: it is given what is honest, and the number of the connection. */
type Script = (socket: WebSocket, sender: Sender, connection: number, pump: () => void) => void;

const servers: Server[] = [];
afterEach(async () => {
  for (const server of servers.splice(0)) {
    server.closeAllConnections();
    await new Promise((resolve) => server.close(resolve));
  }
});

/** A server that is honest but for what its script does. */
async function scripted(script: Script, protocol: string | false = SUBPROTOCOL): Promise<string> {
  const server = createServer((_, answer) => answer.writeHead(426).end());
  const sockets = new WebSocketServer({ server, handleProtocols: () => protocol });
  let connections = 0;
  sockets.on("connection", (socket, request) => {
    socket.on("error", () => undefined);
    const sender = new Sender(INDEX, LARGEST);
    const pump = (): void => {
      for (let message = sender.next(); message !== undefined; message = sender.next()) socket.send(message);
      if (sender.connection.state === "closed") socket.close(1000);
    };
    const receive = (message: Uint8Array): void => {
      sender.receive(message);
      pump();
    };
    script(socket, sender, connections++, pump);
    const opening = /open=([\w-]+)/.exec(request.url ?? "")?.[1];
    if (opening !== undefined) receive(new Uint8Array(Buffer.from(opening, "base64url")));
    socket.on("message", (data) => receive(new Uint8Array(data as Buffer)));
  });
  servers.push(server);
  await new Promise<void>((resolve) => server.listen(0, "127.0.0.1", resolve));
  return `http://127.0.0.1:${(server.address() as AddressInfo).port}/v1/surfaces/0`;
}

function streamOf(url: string, options: StreamOptions = {}): Stream<View> {
  const target = makeTarget();
  return new Stream(url, target, decoderFor(target), {
    ...{ WebSocket: WebSocket as unknown as SocketClass, transport: "ws", window: 600 },
    ...{ pauses: { first: 0.002, longest: 0.05 }, closeTimeout: 0.3, deadline: 0.4, silence: 600 },
    ...options,
  });
}

async function all(stream: Stream<View>): Promise<View[]> {
  const views: View[] = [];
  for await (const view of stream) views.push(view);
  return views;
}

/** What a script does by itself. */
interface Hand {
  send(message: Uint8Array | string): void;
  close(code: number, reason: string): void;
  terminate(): void;
}

/** Do something else in place of the server's message of this number. */
function instead(number: number, act: (socket: Hand) => void, connections = Number.POSITIVE_INFINITY): Script {
  return (socket, _, connection) => {
    if (connection >= connections) return;
    const send = socket.send.bind(socket);
    let count = 0;
    socket.send = ((message: Uint8Array) => {
      if (count++ < number) send(message);
      else if (count === number + 1) {
        socket.send = (() => undefined) as never;
        const close = (code: number, reason: string): void => socket.close(code, reason);
        act({ send, close, terminate: () => socket.terminate() });
      }
    }) as never;
  };
}

describe("a server", () => {
  it("that is honest is understood", async () => {
    const stream = streamOf(await scripted(() => undefined));
    await all(stream);
    expect(stream.ended).toBe("complete");
    expect(stream.reception.dataBytes).toBe(stream.reception.cached.total);
  });

  it.each([
    ["restarts", 1012, "restarting"],
    ["is busy", 4503, "busy: later"],
    ["counts too much", 4429, "too-many"],
    ["closes without a reason", 1001, ""],
  ])("that %s is come back to, and nothing comes twice", async (_, code, reason) => {
    const states: StreamState[] = [];
    const script = instead(4, (socket) => socket.close(code, reason), 3);
    const stream = streamOf(await scripted(script), { onState: (state) => void states.push(state), deadline: 600 });
    await all(stream);
    expect(stream.ended).toBe("complete");
    expect(stream.progress.connections).toBe(4);
    expect(stream.reception.dataBytes).toBe(stream.reception.cached.total);
    expect(states.filter((state) => state.phase === "reconnecting").length).toBe(3);
  });

  it.each<[string, (socket: Hand) => void, new (...given: never[]) => LodestreamError, RegExp]>([
    ["sends text", (socket) => socket.send("{}"), RemoteProtocolError, /expected binary messages, got text/],
    ["sends no message", (socket) => socket.send(encode([1])), RemoteProtocolError, /expected a MessagePack map/],
    [
      "sends more than was granted",
      (socket) => socket.send(serialize({ type: "segments", offset: 300, data: new Uint8Array(601) })),
      RemoteProtocolError,
      /expected at most \d+ bytes/,
    ],
    [
      "floods",
      (socket) => {
        for (let count = 0; count < 40; count++)
          socket.send(encode({ type: "segments", data: new Uint8Array(65_000) }));
      },
      RemoteProtocolError,
      /at once|expected segments.offset/,
    ],
    ["answers as another one", (socket) => socket.send(serialize({ type: "bye" })), RemoteProtocolError, /got bye/],
    ["is busy", (socket) => socket.close(4503, "busy: later"), RemoteError, /^later$/],
    [
      "refuses",
      (socket) => socket.send(serialize({ type: "error", code: "damaged", title: "Damaged", detail: "at byte 7" })),
      RemoteError,
      /^at byte 7$/,
    ],
    [
      "ends before the end, again and again",
      (socket) => socket.send(serialize({ type: "end", why: "complete" })),
      TruncatedStreamError,
      /bytes of the surface/,
    ],
    ["falls silent, again and again", () => undefined, SilenceError, /has sent nothing for 0.8 seconds/],
  ])("that %s is left with an error", async (name, act, kind, text) => {
    const silence = name.startsWith("falls") ? 0.8 : 600;
    // The first connection brings something; those after it do the same and bring nothing.
    const script: Script = (socket, sender, connection, pump) =>
      instead(connection === 0 ? 2 : 1, act)(socket, sender, connection, pump);
    const stream = streamOf(await scripted(script), { silence });
    const error = await all(stream).catch((each: unknown) => each);
    expect(error).toBeInstanceOf(kind);
    expect((error as Error).message).toMatch(text);
    expect(stream.ended).toBe("truncated");
  });

  it("that has another container when it is come back to is left", async () => {
    const other = containerOf("two-points");
    const index = await readIndex(async (offset, length) => other.subarray(offset, offset + length), other.length);
    const script: Script = (socket, sender, connection) => {
      if (connection === 0) instead(4, (each) => each.terminate())(socket, sender, 0, () => undefined);
      else Object.assign(sender, new Sender(index, other));
    };
    await expect(all(streamOf(await scripted(script)))).rejects.toMatchObject({ code: "other-container" });
  });

  it("that speaks another protocol is not one, and HTTP Range may be", async () => {
    const url = await scripted(() => undefined, false);
    await expect(all(streamOf(url))).rejects.toThrow(/no subprotocol|no WebSocket/);
    const error = await all(streamOf(url, { transport: "auto" })).catch((each: unknown) => each);
    expect((error as Error).message).toMatch(/\(and by WebSocket: /);
  });

  it("that does not close after the end is not waited for, and has been told bye", async () => {
    const heard: Uint8Array[] = [];
    const sockets: { terminate(): void }[] = [];
    const url = await scripted((socket) => {
      // Only its closing is left out.
      socket.close = () => undefined;
      socket.on("message", (data) => heard.push(new Uint8Array(data as Buffer)));
      sockets.push(socket);
    });
    const stream = streamOf(url, { closeTimeout: 1e6, window: 1e6 });
    const views = await all(stream);
    expect(views.at(-1)!.complete).toBe(true);
    await expect.poll(() => heard.at(-1)).toEqual(serialize({ type: "bye" }));
    for (const socket of sockets) socket.terminate();
  });

  it("that does not answer a stop is left after closeTimeout", async () => {
    const stream = streamOf(await scripted(instead(6, () => undefined)), { silence: 1e6 });
    for await (const _ of stream) if (stream.reception.dataBytes > 300) break;
    expect(stream.ended).toBe("stopped");
  });
});
