// Which of the numbered steps is the one to do now; its button alone is the primary one.

import { collectStep } from "../../collect/actions.js";

/** The step that `panel` (data of the fragment) and the live state ask for. */
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

/** Show it: the steps before it are done, those after it wait. */
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
