// The viewer script of meshcat, nearly a megabyte: fetched when something is to be drawn in 3D, once.

import { t } from "../site/sentences.js";

let coming = null;

/** Resolves when it is there; rejects where it cannot be had. */
export function viewer(address) {
  coming ??= new Promise((resolve, reject) => {
    const script = Object.assign(document.createElement("script"), { src: address });
    script.addEventListener("load", resolve);
    script.addEventListener("error", () => reject(new Error(t("page.replay.no_viewer", "the viewer script did not load"))));
    document.head.append(script);
  });
  return coming;
}
