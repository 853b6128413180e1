// A decoder in a Worker: the Worker's side. Loaded as a module, it serves the page that made it.

import { serve } from "./worker-protocol.js";

serve(/** @type {import("./worker-protocol.js").Port} */ (/** @type {unknown} */ (globalThis)));
