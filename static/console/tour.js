// A line of hints for users who have a simulated station for the first time: what to press next, until the hints are hidden.

import { currentStep } from "./trial/steps.js";
import { t } from "../site/sentences.js";

const KEY = "eva-tour"; // key in this browser; "off" once the hints were hidden
const HINTS = {
  free: t("page.tour.free", "Take the station: you command, all others watch."),
  choose: t("page.tour.choose", "Choose a position, then press Set up."),
  setup: t("page.tour.setup", "The policy answers a first time; then press Run."),
  run: t("page.tour.run", "Press Run: the policy moves the arms."),
  running: t("page.tour.running", "Press Stop once the block is on the plate."),
  next: t("page.tour.next", "Press Next trial: the plan hands it out and sets it up."),
  score: t("page.tour.score", "Tick what was reached, then press Save score."),
  judge: t("page.tour.judge", "Say whether it was a success, then press Save score."),
};

function hint(store) {
  if (store.lease === "free") return HINTS.free;
  if (store.lease !== "mine") return "";
  const steps = document.getElementById("steps");
  const step = currentStep(steps.dataset, store.snapshot);
  if (step === "choose" && steps.querySelector("[data-next]")) return HINTS.next;
  if (step === "score" && !steps.querySelector("[data-step=score] input[type=checkbox]")) return HINTS.judge;
  return HINTS[store.snapshot?.state_is?.run_open ? "running" : step] ?? "";
}

/** Show the hints if the page has a place for them. */
export function tour(store) {
  const line = document.getElementById("tour");
  if (!line || localStorage.getItem(KEY) === "off") return;
  const words = line.querySelector("[data-tour]");
  const show = () => {
    const text = hint(store);
    if (words.textContent !== text) words.textContent = text;
    line.hidden = !text;
  };
  line.querySelector("button").addEventListener("click", () => {
    localStorage.setItem(KEY, "off");
    line.remove();
  });
  store.on(["snapshot", "second"], () => line.isConnected && show());
}
