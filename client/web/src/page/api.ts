/** The server's HTTP interface, as the page needs it. The token is kept here, in memory, and goes into no address. */

/** A surface as the server lists it. */
export interface ListedSurface {
  readonly id: string;
  /** A path on the server. */
  readonly url: string;
  /** Of the surface, or of its first file; null: neither has one. */
  readonly name: string | null;
  readonly state: "queued" | "building" | "ready" | "failed" | "waiting";
  /** 0 to 1. */
  readonly progress: number;
  readonly reason: string | null;
  readonly created: string;
  readonly upload_bytes: number;
  /** Those of its upload. Only where it was asked for by itself. */
  readonly options?: Readonly<Record<string, string>>;
  readonly bytes?: number;
  readonly shape?: readonly [number, number] | null;
  /** Its place in a series: among the steps along a dimension, or the variables, of one file. */
  readonly series?: Place;
  /** A data URL of a picture; null: there is none. Only where it was asked for. */
  readonly thumbnail?: string | null;
  /** What its file has, if it failed because one has to be chosen. Only where it was asked for by itself. */
  readonly choices?: readonly Choice[];
}

/** Options of an upload by which one of the surfaces of a file is built. */
export interface Choice {
  readonly options: Readonly<Record<string, string>>;
  /** Empty where it is not known. */
  readonly shape: readonly number[];
}

/** A place in a series; surfaces with the same name belong together. */
export interface Place {
  readonly name: string;
  /** The dimension, or `variable`. */
  readonly along: string;
  readonly index: number;
  readonly value: number | string;
  readonly unit: string;
}

/** Some of the surfaces, and the address of the next ones. */
interface Page {
  readonly surfaces: readonly ListedSurface[];
  readonly next: string | null;
}

/** What the server answered in place of what was asked for. */
export class ProblemError extends Error {
  /** @param code - A word such as `no-token`; `network` where there was no answer. */
  constructor(
    readonly status: number,
    readonly code: string,
    message: string,
  ) {
    super(message);
  }
}

/** The path of surfaces, relative to the page, so that the server may stand below a path of a proxy. */
const SURFACES = "v1/surfaces";

const THUMBNAILS = "thumbnails=true";

/** Reads a problem document, or makes one from an answer without. */
export function problemOf(status: number, text: string): ProblemError {
  try {
    const { code, title, detail } = JSON.parse(text) as Record<string, unknown>;
    if (typeof title === "string") return new ProblemError(status, String(code ?? ""), String(detail || title));
  } catch {
    // Not JSON: a proxy's own page.
  }
  return new ProblemError(status, `http-${status}`, `The server answered ${status}`);
}

/** Requests to one server. */
export class Server {
  /** The server has refused to write with this token. */
  readsOnly = false;
  private given: string | null = null;

  /** @param base - Address of the page. */
  constructor(private readonly base: string) {}

  /** What is sent with each request; null: nothing. */
  get token(): string | null {
    return this.given;
  }

  set token(value: string | null) {
    this.given = value;
    this.readsOnly = false;
  }

  /** The first page of surfaces with their thumbnails, oldest first, or the one at an address; and that of the next. */
  async page(address: string | null): Promise<Page> {
    return (await this.json("GET", address ?? `${SURFACES}?limit=1000&${THUMBNAILS}`)) as Page;
  }

  /** All surfaces, page after page, without thumbnails. */
  async all(): Promise<ListedSurface[]> {
    const surfaces: ListedSurface[] = [];
    let address: string | null = `${SURFACES}?limit=1000`;
    do {
      const page: Page = await this.page(address);
      surfaces.push(...page.surfaces);
      address = page.next;
    } while (address !== null);
    return surfaces;
  }

  /** One surface, or that to which a name leads. */
  async look(url: string): Promise<ListedSurface> {
    return (await this.json("GET", url)) as ListedSurface;
  }

  /** One surface with its thumbnail, as a page has it; once its build has ended, or after so many seconds. */
  async listed(url: string, seconds = 0): Promise<ListedSurface> {
    return this.look(`${url}?${THUMBNAILS}&wait=${seconds}`);
  }

  /** Where the tiles of a surface, or of what a name leads to, lie: west, south, east, north in degrees; and to which zoom. */
  async tiles(url: string): Promise<{ bounds: [number, number, number, number]; maxzoom: number }> {
    const { bounds, maxzoom } = (await this.json("GET", `${url}/map.json`)) as Awaited<ReturnType<Server["tiles"]>>;
    return { bounds, maxzoom };
  }

  /** Deletes a surface. */
  async delete(url: string): Promise<void> {
    await this.json("DELETE", url);
  }

  /** Builds a surface again. */
  async retry(url: string): Promise<void> {
    await this.json("POST", `${url}/retry`);
  }

  /** The absolute address of a path that the server gave. */
  address(path: string): string {
    const url = new URL(path, this.base);
    if (url.origin !== new URL(this.base).origin)
      throw new ProblemError(0, "origin", `The server named another host: ${url.host}`);
    return url.href;
  }

  /**
   * Uploads a file.
   *
   * @param options - Of its format.
   * @param progress - Called with bytes sent.
   */
  upload(
    file: File,
    options: Readonly<Record<string, string>>,
    progress: (sent: number) => void,
    signal: AbortSignal,
  ): Promise<ListedSurface> {
    // Of fetch and XMLHttpRequest only the latter tells how much has been sent.
    return new Promise((resolve, reject) => {
      const request = new XMLHttpRequest();
      request.open("POST", this.address(`${SURFACES}?${new URLSearchParams({ ...options, filename: file.name })}`));
      request.setRequestHeader("content-type", "application/octet-stream");
      if (this.token !== null) request.setRequestHeader("authorization", `Bearer ${this.token}`);
      request.upload.onprogress = ({ loaded }) => progress(loaded);
      request.onload = () => {
        if (request.status !== 200 && request.status !== 202)
          return reject(problemOf(request.status, request.responseText));
        try {
          resolve(JSON.parse(request.responseText) as ListedSurface);
        } catch {
          reject(problemOf(request.status, ""));
        }
      };
      request.onerror = () => reject(new ProblemError(0, "network", "The server could not be reached"));
      request.onabort = () => reject(new ProblemError(0, "cancelled", "Cancelled"));
      signal.addEventListener("abort", () => request.abort());
      request.send(file);
    });
  }

  private async json(method: string, path: string): Promise<unknown> {
    const headers: Record<string, string> = this.token === null ? {} : { authorization: `Bearer ${this.token}` };
    const address = this.address(path);
    let answer: Response;
    let text: string;
    try {
      answer = await fetch(address, { method, headers, credentials: "omit" });
      text = await answer.text();
    } catch {
      throw new ProblemError(0, "network", "The server could not be reached");
    }
    if (!answer.ok) throw problemOf(answer.status, text);
    if (answer.status === 204) return null;
    try {
      return JSON.parse(text);
    } catch {
      throw new ProblemError(0, "network", "The server's answer broke off");
    }
  }
}
