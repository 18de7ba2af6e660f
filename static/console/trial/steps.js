// Which of the numbered steps is the present one; only its button is the primary one.

import { collectStep } from "../../collect/actions.js";

/** Return the step that `panel` (data attributes of the fragment) and the live state ask for. */
export function currentStep({ panel, status, setUp }, snapshot) {
  const is = snapshot?.state_is;
  if (panel === "debug") {
    return is?.set_up ? "run" : "setup";
  }
  if (panel === "collect") return collectStep(snapshot, document.querySelector("[data-session-uuid]"));
  if (status === "ended") return "score";
  if (status === "running" || status === "paused") return "run";
  if (status === "prepared") return setUp === "yes" && is?.ready ? "run" : "setup";
  return is?.preparing ? "setup" : "choose";
}

/** Mark the step `now` as the present one: steps before it are done, steps after it are still to come. */
export function showStep(steps, now) {
  let done = true;
  for (const step of steps.querySelectorAll("[data-step]")) {
    const here = step.dataset.step === now;
    if (here) done = false;
    const place = here ? "now" : done ? "done" : "later";
    if (step.dataset.place !== place) step.dataset.place = place;
    if (!here) step.removeAttribute("aria-current");
    else if (!step.hasAttribute("aria-current")) {
      step.setAttribute("aria-current", "step");
      if (step.previousElementSibling) step.scrollIntoView({ block: "nearest" });
      else step.closest(".controls-scroll").scrollTop = 0;
    }
  }
}
