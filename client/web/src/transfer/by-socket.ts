/** Receiving over a WebSocket: the loop around a `Download` that moves bytes. */

import { RemoteError, SilenceError } from "../errors";
import { toAddress } from "../protocol/handshake";
import type { Region, Target, ViewInfo } from "../types";
import { streamUrl } from "./addresses";
import { Download, type DownloadOptions } from "./download";
import type { Journey } from "./journey";
import type { Place } from "./locating";
import { fromCode } from "./problems";
import { isClosing, Socket, type SocketClass } from "./socket";
import { seconds } from "./waiting";

/** One connection at a time. */
export class SocketTransport<View extends ViewInfo> {
  private download: Download<View> | undefined;
  private socket: Socket | undefined;
  private finding: AbortController | undefined;

  constructor(
    private readonly journey: Journey<View>,
    private readonly place: Place,
    private readonly options: DownloadOptions,
    private readonly make: SocketClass | undefined,
  ) {}

  /**
   * Receive until the stream ends.
   *
   * @throws LodestreamError if the connection breaks before, or the other side does not follow the protocol.
   */
  async travel(): Promise<void> {
    const { journey, options } = this;
    const { reception, turns } = journey;
    const download = new Download(reception, options);
    // A token has no place in an address.
    const opening = options.token === undefined ? toAddress(download.opening) : undefined;
    this.finding = new AbortController();
    const url = await this.place.find(() => journey.patience(), this.finding.signal);
    const began = seconds();
    const socket = await Socket.open(streamUrl(url, opening), journey.patience(), this.make);
    this.socket = socket;
    journey.met();
    if (opening !== undefined) download.opened(began);
    this.download = download;
    if (journey.stopped) download.stop();
    else if (journey.turns !== turns) download.turn(true);
    while (reception.ended === undefined) {
      const left = this.tick(download);
      const patience = journey.patience();
      const asked = seconds();
      const heard = await socket.hear(Math.min(patience, left ?? patience));
      if (heard === undefined) {
        // Interrupted, or the time of the target is over.
        if (seconds() - asked < journey.patience() - 0.005) continue;
        throw new SilenceError(
          `expected more of the stream, but ${url} has sent nothing for ${journey.patience()} seconds`,
        );
      }
      if (isClosing(heard)) return lost(download, heard.code, heard.reason);
      const waited = seconds() - asked;
      await journey.pace(heard.length);
      journey.take(() => download.receive(heard, seconds(), waited));
      this.flush();
      await journey.room();
    }
    // Whoever receives has everything: that the other side has closed, a round trip later, would tell nothing.
    socket.close();
  }

  /** Set the time, and send what there is to send; returns the seconds left of the target's. */
  private tick(download: Download<View>): number | undefined {
    const left = download.tick(seconds());
    this.flush();
    return left;
  }

  /** Ask the server to stop. */
  stop(): void {
    this.download?.stop();
    this.flush();
    this.interrupt();
  }

  /** Change the region that comes first, if there is a connection to do so; false: there is none. */
  focus(region: Region | undefined): boolean {
    if (!this.download?.open) return false;
    this.download.focus(region);
    this.flush();
    return true;
  }

  /** Change what is received, if there is a connection to do so; false: there is none. */
  retarget(target: Target): boolean {
    if (!this.download?.open) return false;
    this.download.retarget(target);
    this.flush();
    return true;
  }

  /** Let whatever is waited for be looked at again. */
  interrupt(): void {
    this.finding?.abort();
    this.socket?.interrupt();
  }

  /** Close whatever is open. */
  hangUp(): void {
    this.socket?.close();
    this.socket = this.download = undefined;
  }

  private flush(): void {
    for (const message of this.download?.dataToSend() ?? []) this.socket?.send(message);
  }
}

function lost(download: Download<ViewInfo>, code: number | undefined, reason: string): void {
  try {
    download.connectionLost(code, reason);
  } catch (error) {
    throw error instanceof RemoteError ? fromCode(error.code, error.message) : error;
  }
}
