// Keys on a station's page: those of every page, and no control keeps the focus where it would take Space or a letter. The keys
// that stop are in estop.js.

import { keyboard as everywhere } from "../../site/keys.js";

export { label, namesOf } from "../../site/keys.js";

const CLICKED = 'button, summary, a[href], select, input[type="checkbox"], input[type="radio"]';

/** Blur controls after a click; a list that is operated by keys keeps the focus until Enter. */
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

/** Listen for keys; `refused` as in keys.js of static/site. */
export function keyboard(refused) {
  released();
  everywhere(refused);
}
