/** The custom element `<lodestream-view>`. Importing this module defines it. */

import { LodestreamView } from "./lodestream-view";

if (customElements.get("lodestream-view") === undefined) customElements.define("lodestream-view", LodestreamView);

export type { Moment, Progress, Source, SourceEvents, SurfaceInfo, Target } from "./source";
export { LodestreamView };
