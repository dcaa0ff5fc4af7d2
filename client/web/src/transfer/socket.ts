/** A WebSocket whose messages are waited for, and whose sender cannot make them pile up. */

import { type LodestreamError, RemoteProtocolError, UnavailableError } from "../errors";
import { MAX_CREDIT, MAX_MESSAGE, SUBPROTOCOL } from "../protocol/messages";
import { NoStreamError } from "./problems";

/** What makes WebSockets: the platform's class, or one like it. */
export type SocketClass = new (url: string, protocols: string[]) => WebSocket;

/** Why a WebSocket was closed; without a close frame the code is undefined. */
export interface Closing {
  readonly code: number | undefined;
  readonly reason: string;
}

/** A message, or why there are no more; undefined: none came in time. */
export type Heard = Uint8Array | Closing | undefined;

// More than the credit, with the framing of the smallest messages, is not what a server sends.
const MOST_WAITING = 4 * (MAX_CREDIT + MAX_MESSAGE);

// What a browser says of a connection that broke without a close frame, or of a close frame without a code.
const NO_CODE = new Set([1005, 1006]);

/** One connection. */
export class Socket {
  private readonly socket: WebSocket;
  private readonly waiting: Uint8Array[] = [];
  private waitingBytes = 0;
  private closing: Closing | undefined;
  private failure: LodestreamError | undefined;
  private wake: (() => void) | undefined;

  private constructor(url: string, make: SocketClass) {
    this.socket = new make(url, [SUBPROTOCOL]);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = (event) => this.take(event.data);
    this.socket.onclose = (event) => {
      this.closing = NO_CODE.has(event.code)
        ? { code: undefined, reason: "" }
        : { code: event.code, reason: event.reason };
      this.wake?.();
    };
    // What went wrong, a page is not told; that it is closed comes next.
    this.socket.onerror = () => this.wake?.();
  }

  /**
   * Open a connection that speaks the stream protocol.
   *
   * @param seconds How long that may take.
   * @throws NoStreamError if that fails; why it does, a page is not told.
   * @throws UnavailableError if there are no WebSockets here.
   */
  static async open(url: string, seconds: number, make: SocketClass | undefined): Promise<Socket> {
    if (make === undefined) throw new UnavailableError("expected WebSockets, got a platform without them: use http");
    let socket: Socket;
    try {
      socket = new Socket(url, make);
    } catch (error) {
      // Such as a policy of the page.
      throw new NoStreamError(`no WebSocket to ${bare(url)}: ${(error as Error).message}`);
    }
    await socket.opened(url, seconds);
    return socket;
  }

  /** Send a message; after the connection has closed, nothing: what the server said before tells more than this. */
  send(message: Uint8Array): void {
    if (this.socket.readyState === OPEN) this.socket.send(message as Uint8Array<ArrayBuffer>);
  }

  /**
   * The next message, or why there are no more; undefined: none came within so many seconds.
   *
   * @throws RemoteProtocolError if the other side sent text, or far more than was granted.
   */
  async hear(seconds: number): Promise<Heard> {
    if (this.waiting.length === 0 && !this.over) await this.woken(seconds);
    if (this.failure !== undefined) throw this.failure;
    const message = this.waiting.shift();
    if (message === undefined) return this.closing;
    this.waitingBytes -= message.length;
    return message;
  }

  /** Let a pending `hear` return before its time. */
  interrupt(): void {
    this.wake?.();
  }

  /** Close without waiting; what was sent is still delivered. */
  close(): void {
    this.socket.onmessage = null;
    this.socket.close();
  }

  private get over(): boolean {
    return this.closing !== undefined || this.failure !== undefined;
  }

  private async opened(url: string, seconds: number): Promise<void> {
    const until = performance.now() + 1000 * seconds;
    let met = false;
    this.socket.onopen = () => {
      met = true;
      this.wake?.();
    };
    while (!met && this.closing === undefined) {
      const rest = (until - performance.now()) / 1000;
      if (rest <= 0) {
        this.close();
        throw new NoStreamError(`no answer from ${bare(url)} in time`);
      }
      await this.woken(rest);
    }
    // One that has been opened and closed again has something to tell.
    if (!met) throw new NoStreamError(`no WebSocket to ${bare(url)}`);
    if (this.socket.protocol !== SUBPROTOCOL) {
      this.close();
      throw new NoStreamError(
        `expected ${bare(url)} to speak ${SUBPROTOCOL}, got ${this.socket.protocol || "no subprotocol"}`,
      );
    }
  }

  private woken(seconds: number): Promise<void> {
    return new Promise((resolve) => {
      const timer = setTimeout(() => this.wake?.(), 1000 * seconds);
      this.wake = () => {
        clearTimeout(timer);
        this.wake = undefined;
        resolve();
      };
    });
  }

  private take(data: unknown): void {
    if (!(data instanceof ArrayBuffer)) this.fail("expected binary messages, got text");
    else {
      this.waiting.push(new Uint8Array(data));
      this.waitingBytes += data.byteLength;
      if (this.waitingBytes > MOST_WAITING) this.fail(`expected at most ${MAX_CREDIT} bytes at once, got more`);
    }
    this.wake?.();
  }

  private fail(message: string): void {
    this.failure ??= new RemoteProtocolError(message);
    this.waiting.length = 0;
    this.close();
  }
}

// `WebSocket.OPEN` is not there where the class is a caller's own.
const OPEN = 1;

/** An address without its query, which is long. */
function bare(url: string): string {
  return url.split("?")[0]!;
}

/** The platform's own class of WebSockets, if it has one. */
export function platformSocket(): SocketClass | undefined {
  return globalThis.WebSocket as SocketClass | undefined;
}

/** Whether what was heard is the end of the connection. */
export function isClosing(heard: Heard): heard is Closing {
  return heard !== undefined && !(heard instanceof Uint8Array);
}
