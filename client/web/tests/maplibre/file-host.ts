/** A web server that knows Range, in this process: files by name, and what was asked of them. */

/** Answers like a host of files. */
export class FileHost {
  /** Ranges that were asked for, as [first byte, past the last]. */
  readonly asked: (readonly [first: number, past: number])[] = [];
  /** What the headers said of who asks. */
  readonly tokens = new Set<string | null>();
  /** Called before each answer; what it throws, `fetch` throws. */
  before: (url: string, signal: AbortSignal | undefined) => Promise<void> = async () => {};
  private readonly files = new Map<string, { readonly data: Uint8Array<ArrayBuffer>; readonly tag: string }>();
  private versions = 0;

  /** The address of a file. */
  url(name: string): string {
    return `https://files.example/${encodeURIComponent(name)}`;
  }

  put(name: string, data: Uint8Array): void {
    this.versions += 1;
    this.files.set(this.url(name), { data: data.slice(), tag: `"version ${this.versions}"` });
  }

  /** Have a file at another address too. */
  alias(url: string, name: string): void {
    this.files.set(url, this.files.get(this.url(name))!);
  }

  readonly fetch: typeof globalThis.fetch = async (input, init) => {
    const url = String(input);
    const headers = new Headers(init?.headers);
    this.tokens.add(headers.get("authorization"));
    await this.before(url, init?.signal ?? undefined);
    const file = this.files.get(url);
    if (file === undefined) return new Response("there is no such file", { status: 404 });
    const { data, tag } = file;
    const range = /^bytes=(\d+)-(\d+)$/.exec(headers.get("range") ?? "");
    if (range === null || (headers.get("if-range") ?? tag) !== tag) {
      return new Response(data, { status: 200, headers: { ETag: tag } });
    }
    const [first, past] = [Number(range[1]), Math.min(Number(range[2]) + 1, data.length)];
    this.asked.push([first, past]);
    const told = { "Content-Range": `bytes ${first}-${past - 1}/${data.length}`, ETag: tag };
    return new Response(data.slice(first, past), { status: 206, headers: told });
  };
}
