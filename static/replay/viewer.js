// The viewer script of meshcat, nearly a megabyte: loaded once, when something is first drawn in 3D.

import { t } from "../site/sentences.js";

let coming = null;

/** Resolve when the script has been loaded; reject if it cannot be loaded. */
export function viewer(address) {
  coming ??= new Promise((resolve, reject) => {
    const script = Object.assign(document.createElement("script"), { src: address });
    script.addEventListener("load", resolve);
    script.addEventListener("error", () => reject(new Error(t("page.replay.no_viewer", "the viewer script did not load"))));
    document.head.append(script);
  });
  return coming;
}
