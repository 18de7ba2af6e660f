// Keys at a station: those of every page, and the focus is never left where Space or a letter would be taken. The
// stopping keys are in estop.js.

import { keyboard as everywhere } from "../../site/keys.js";

export { label, namesOf } from "../../site/keys.js";

const CLICKED = 'button, summary, a[href], select, input[type="checkbox"], input[type="radio"]';

/** What was clicked gives the keys back; a list that is gone through by keys keeps them until Enter. */
function released() {
  let byKey = false;
  document.addEventListener("pointerdown", () => (byKey = false), { capture: true });
  document.addEventListener("keydown", ({ key, target }) => {
    byKey = key !== "Enter" || !target.matches?.("select");
    if (key === "Enter" && target.matches?.("select")) target.blur();
  }, { capture: true });
  document.addEventListener("change", ({ target }) => !byKey && target.matches("select") && target.blur());
  document.addEventListener("click", ({ target }) => {
    const clicked = !byKey && target.closest(CLICKED);
    if (clicked && !clicked.matches("select")) clicked.blur();
  }, { capture: true });
}

/** Listen for keys; `refused` as of every page. */
export function keyboard(refused) {
  released();
  everywhere(refused);
}
