/**
 * The errors of Lodestream. There is one class for each way in which a caller may want to react; names are those of the
 * Python library. Each message says what was expected, what was found, and where.
 */

/** Base class of all errors of Lodestream. */
export class LodestreamError extends Error {
  constructor(message: string) {
    super(message);
    this.name = new.target.name;
  }
}

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
