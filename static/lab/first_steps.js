// First steps: typed values are kept as drafts, and the cameras' pictures are live.

import { drafts } from "../site/drafts.js";

const EVERY_MS = 1000;

/** Load a picture again and again, one request at a time; if it does not load, its alternative text is shown. */
function live(image) {
  const address = image.src;
  const next = () => setTimeout(() => (document.hidden ? next() : (image.src = `${address}?${Date.now()}`)), EVERY_MS);
  image.addEventListener("load", next);
  image.addEventListener("error", next);
  if (image.complete) next();
}

drafts();
document.querySelectorAll("[data-live-picture]").forEach(live);
// What was submitted is either saved or shown in the next page, so the browser's draft is no longer needed.
document.addEventListener("submit", ({ target }) => target.dispatchEvent(new Event("eva:saved", { bubbles: true })));
