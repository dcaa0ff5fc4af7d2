/**
 * The errors of Lodestream. There is one class for each way in which a caller may want to react; names are those of the
 * Python library. Each message says what was expected, what was found, and where.
 */

/** Base class of all errors of Lodestream. */
export class LodestreamError extends Error {}

/** The caller's input cannot be used. */
export class InputError extends LodestreamError {}

/** More bytes or vertices than allowed. */
export class TooLargeError extends InputError {}

/** An option, level or region that does not exist, or a value that it does not take. */
export class OptionError extends InputError {}

/** Something that is needed is missing, whatever the input. */
export class UnavailableError extends LodestreamError {}

/** There is no such surface. */
export class NotFoundError extends LodestreamError {}

/** The bytes of a container cannot be used. */
export class StreamError extends LodestreamError {}

/** The bytes of a container are damaged. */
export class CorruptStreamError extends StreamError {
  /** Offset in the container, in bytes, of the part that failed its check. */
  readonly offset: number;

  constructor(message: string, offset: number) {
    super(`${message} (at byte ${offset})`);
    this.offset = offset;
  }
}

/** A container ends too early. */
export class TruncatedStreamError extends StreamError {}

/** A container or a peer has a version that this program does not support. */
export class UnsupportedVersionError extends StreamError {}

/** A message that the protocol does not allow. */
export class ProtocolError extends LodestreamError {}

/** This side tried to send a message that the protocol does not allow now. */
export class LocalProtocolError extends ProtocolError {}

/** The other side sent a message that the protocol does not allow now. */
export class RemoteProtocolError extends ProtocolError {}

/** The other side refused the request. */
export class RemoteError extends LodestreamError {
  /** Code from the table of error codes in docs/protocol.md. */
  readonly code: string;

  constructor(code: string, message: string) {
    super(message);
    this.code = code;
  }
}

/** There is no connection to the server, or it broke before the end. */
export class UnreachableError extends LodestreamError {}

/** The server sent nothing for longer than allowed. */
export class SilenceError extends LodestreamError {}

/** The classes that are made of a message alone, by their names. */
const PLAIN_CLASSES = {
  LodestreamError,
  InputError,
  TooLargeError,
  OptionError,
  UnavailableError,
  NotFoundError,
  StreamError,
  TruncatedStreamError,
  UnsupportedVersionError,
  ProtocolError,
  LocalProtocolError,
  RemoteProtocolError,
  UnreachableError,
  SilenceError,
};

// A bundler shortens the names of classes, not those of keys.
for (const [name, kind] of Object.entries({ ...PLAIN_CLASSES, CorruptStreamError, RemoteError })) {
  kind.prototype.name = name;
}

/** An error as it goes from one thread to another, where its class would be lost. */
export interface PlainError {
  readonly name: string;
  readonly message: string;
  readonly code?: string;
  readonly offset?: number;
}

/** What is to be told of an error. */
export function plainError(error: unknown): PlainError {
  const { name, message } = error instanceof Error ? error : new Error(String(error));
  if (error instanceof RemoteError) return { name, message, code: error.code };
  if (error instanceof CorruptStreamError) return { name, message, offset: error.offset };
  return { name, message };
}

/** The error that was told. */
export function errorFrom({ name, message, code, offset }: PlainError): Error {
  if (name === "RemoteError") return new RemoteError(code ?? "internal", message);
  if (name === "CorruptStreamError")
    return new CorruptStreamError(message.replace(/ \(at byte \d+\)$/, ""), offset ?? 0);
  const kind = Object.hasOwn(PLAIN_CLASSES, name) ? PLAIN_CLASSES[name as keyof typeof PLAIN_CLASSES] : Error;
  return new kind(message);
}
