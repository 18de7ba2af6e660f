// The page on which a plan is begun: what was typed survives a reload until the draft is made.

import { drafts } from "../site/drafts.js";

drafts();
document.querySelector("form[data-draft]").addEventListener("submit", ({ target }) => {
  target.dispatchEvent(new Event("eva:saved", { bubbles: true }));
});
