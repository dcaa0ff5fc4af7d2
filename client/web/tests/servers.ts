/** Servers of the Python library on this machine, and links to them that break. */
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { type AddressInfo, connect, createServer, type Server, type Socket } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";
import { start } from "./python";

/** What runs. */
export interface Served {
  /** A surface on a server that wants no token, and the same on one that does. */
  readonly surface: string;
  readonly closed: string;
  readonly token: string;
  /** Its container on a web server that knows Range, and on one that does not. */
  readonly static: string;
  readonly whole: string;
  /** The bytes of the container. */
  readonly data: Uint8Array;
  stop(): Promise<void>;
}

/** Start the servers; their folders are removed at the end. */
export async function serve(): Promise<Served> {
  const folder = mkdtempSync(join(tmpdir(), "lodestream-web-"));
  const process = start("tests.web.servers", folder);
  const ended = new Promise<void>((resolve) => process.on("exit", () => resolve()));
  const lines = createInterface({ input: process.stdout! });
  const first = await Promise.race([
    new Promise<string>((resolve) => lines.once("line", resolve)),
    ended.then(() => Promise.reject(new Error("the servers did not start"))),
  ]);
  const said = JSON.parse(first) as Record<"surface" | "closed" | "token" | "static" | "whole" | "container", string>;
  const stop = async () => {
    process.stdin!.end();
    await ended;
    rmSync(folder, { recursive: true, force: true });
  };
  return { ...said, data: new Uint8Array(readFileSync(said.container)), stop };
}

/** What is wrong with one connection. */
export interface Fault {
  /** It breaks after so many bytes from the server. */
  readonly cutDown?: number;
  /** It does not break: nothing more comes, and nobody is told. */
  readonly vanish?: boolean;
  /** What answers more than so many messages, each sent after the answer to the one before, does not come. */
  readonly roundTrips?: number;
}

/** A proxy in front of one server, with a fault for each connection in turn. */
export class Faulty {
  /** How many connections there were, and bytes that went to clients. */
  connections = 0;
  down = 0;
  private readonly open = new Set<Socket>();

  private constructor(
    private readonly server: Server,
    private readonly given: URL,
  ) {}

  static async to(url: string, fault: (connection: number) => Fault): Promise<Faulty> {
    const given = new URL(url);
    const server = createServer();
    const made = new Faulty(server, given);
    server.on("connection", (near) => made.carry(near, fault(made.connections++)));
    await new Promise<void>((resolve) => server.listen(0, "127.0.0.1", resolve));
    return made;
  }

  /** The address given, by way of this proxy. */
  get url(): string {
    const url = new URL(this.given);
    url.port = String((this.server.address() as AddressInfo).port);
    return url.href;
  }

  async close(): Promise<void> {
    for (const socket of this.open) socket.destroy();
    await new Promise((resolve) => this.server.close(resolve));
  }

  private carry(near: Socket, fault: Fault): void {
    if (fault.cutDown === 0 && !fault.vanish) {
      near.destroy();
      return;
    }
    const far = connect(Number(this.given.port), this.given.hostname);
    let left = fault.cutDown ?? Number.POSITIVE_INFINITY;
    for (const socket of [near, far]) {
      this.open.add(socket);
      socket.on("error", () => undefined);
      socket.on("close", () => {
        this.open.delete(socket);
        if (!(fault.vanish && left <= 0)) for (const each of [near, far]) each.destroy();
      });
    }
    let trips = 0;
    let answered = true;
    near.on("data", (data) => {
      trips += Number(answered);
      answered = false;
      if (trips <= (fault.roundTrips ?? Number.POSITIVE_INFINITY)) far.write(data);
    });
    far.on("data", (data) => {
      answered = true;
      if (left <= 0) return;
      const slice = data.subarray(0, left);
      left -= slice.length;
      this.down += slice.length;
      near.write(slice, () => {
        if (left <= 0 && !fault.vanish) near.destroy();
      });
      if (left <= 0) far.destroy();
    });
  }
}
