/** Decoders for tests of streams. */
import { Decoder } from "../src/decoding/decoder";
import type { View } from "../src/decoding/view";
import { loadKernels } from "../src/kernels/instance";
import type { StreamDecoder } from "../src/transfer/decoding";
import type { Target } from "../src/types";

const MODULE = await loadKernels();

/** A decoder for what a target asks for. */
export function decoderFor(target: Target): StreamDecoder<View> & Decoder {
  const { region, attributes, level } = target;
  return new Decoder(MODULE, { region, attributes, ...(level === undefined ? {} : { level }) });
}
