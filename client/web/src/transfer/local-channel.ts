/** A host in the same thread, for programs without workers. */

import { UnavailableError } from "../errors";
import type { Channel } from "./channel";
import { Host } from "./host";
import type { Platform, Questions, Told } from "./questions";
import { answerOf } from "./serve-host";

/** A host in the same thread. */
export class LocalChannel implements Channel {
  private readonly host: Host;
  private over = false;

  constructor(tell: (told: Told) => void, platform: Platform) {
    this.host = new Host((told) => {
      if (!this.over) tell(told);
    }, platform);
  }

  async ask<Name extends keyof Questions>(
    name: Name,
    ...given: Parameters<Questions[Name]>
  ): Promise<Awaited<ReturnType<Questions[Name]>>> {
    if (this.over) throw new UnavailableError("expected a stream that is open, got one that has been closed");
    return answerOf(this.host, name, given) as Promise<Awaited<ReturnType<Questions[Name]>>>;
  }

  end(): void {
    this.over = true;
    void this.host.close().catch(() => undefined);
  }
}
