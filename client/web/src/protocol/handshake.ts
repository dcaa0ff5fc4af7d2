/** The client's first message as part of the handshake's address, which saves one round trip; in base64url. */

/** Where it stands in the query of the address. */
export const PARAMETER = "open";

/** The most characters of it. Proxies take addresses of 4 to 8 KiB. */
export const MAX_OPENING = 2048;

/** The query string with this message; undefined if it is too long for an address and must be sent as a message. */
export function toAddress(message: Uint8Array): string | undefined {
  const text = btoa(String.fromCharCode(...message.subarray(0, MAX_OPENING)))
    .replaceAll("+", "-")
    .replaceAll("/", "_")
    .replace(/=+$/, "");
  return message.length <= MAX_OPENING && text.length <= MAX_OPENING ? `${PARAMETER}=${text}` : undefined;
}
