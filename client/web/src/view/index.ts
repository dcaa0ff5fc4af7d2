/** The custom element `<lodestream-view>`. Importing this module defines it. */

import { LodeSource } from "./lode-source";
import { LodestreamView } from "./lodestream-view";

LodestreamView.sources.push((src, { token }) => {
  const url = URL.canParse(src, document.baseURI) ? new URL(src, document.baseURI) : null;
  return url?.protocol === "http:" || url?.protocol === "https:" ? new LodeSource(url.href, token) : null;
});
if (customElements.get("lodestream-view") === undefined) customElements.define("lodestream-view", LodestreamView);

export type { Part, PartReader } from "../transfer/parts";
export type { Appearance } from "./appearance";
export { fieldName, fieldsOf } from "./look";
export type { Moment, NodeValues, Progress, Region, Source, SourceEvents, SurfaceInfo, Target } from "./source";
export { LodeSource, LodestreamView };
