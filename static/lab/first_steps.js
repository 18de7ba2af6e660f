// First steps: what was typed is kept, and the pictures of cameras are those of now.

import { drafts } from "../site/drafts.js";

const EVERY_MS = 1000;

/** Ask for a picture again and again, one request at a time; where it does not come, what stood there says so. */
function live(image) {
  const address = image.src;
  const next = () => setTimeout(() => (document.hidden ? next() : (image.src = `${address}?${Date.now()}`)), EVERY_MS);
  image.addEventListener("load", next);
  image.addEventListener("error", next);
  if (image.complete) next();
}

drafts();
document.querySelectorAll("[data-live-picture]").forEach(live);
// What was sent is saved or comes back in the page: the draft of the browser is not needed any more.
document.addEventListener("submit", ({ target }) => target.dispatchEvent(new Event("eva:saved", { bubbles: true })));
