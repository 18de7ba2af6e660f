// The stages of the set-up while it runs, and which one failed.

import { formatDuration, stateLabel } from "../live/labels.js";
import { t } from "../../site/sentences.js";

const MARKS = { done: "✓", active: "▸", waiting: "·", failed: "✕", skipped: "–" };

/** Return whether the stages are to be shown: during the set-up, and after a failure until the next attempt. */
export function isUnfinished({ state_is: is, stages = [] }) {
  return is.preparing || (is.idle && stages.some((stage) => stage.state === "failed"));
}

/** Return the duration of a stage in words, or "" if it has not begun or was skipped. */
export function stageDuration({ state, seconds }) {
  if (!Number.isFinite(seconds) || state === "waiting" || state === "skipped") return "";
  return seconds < 60 ? `${seconds.toFixed(1)} s` : formatDuration(seconds);
}

/** Keep lists with data-stages, and the buttons of the set-up, up to date. */
export function setupStages(store) {
  const draw = () => {
    const { snapshot } = store;
    if (!snapshot) return;
    const stages = isUnfinished(snapshot) ? (snapshot.stages ?? []) : [];
    for (const list of document.querySelectorAll("[data-stages]")) {
      list.hidden = !stages.length;
      fill(list, stages);
      const line = list.parentElement.querySelector('[data-show="stage"]'); // the line below says the same during the set-up
      line.toggleAttribute("data-said", Boolean(stages.length) && snapshot.state_is.preparing);
    }
    const failed = stages.some((stage) => stage.state === "failed");
    for (const name of document.querySelectorAll("[data-set-up-name]")) name.textContent = failed ? t("page.setup.retry", "Retry") : t("page.setup.set_up", "Set up");
    for (const button of document.querySelectorAll("[data-hidden-while]")) button.hidden = snapshot.state_is[button.dataset.hiddenWhile];
  };
  store.on("snapshot", draw);
  document.body.addEventListener("htmx:afterSettle", draw);
}

function fill(list, stages) {
  while (list.children.length > stages.length) list.lastElementChild.remove();
  while (list.children.length < stages.length) list.append(row());
  stages.forEach((stage, index) => {
    const item = list.children[index];
    item.dataset.state = stage.state;
    const texts = [MARKS[stage.state] ?? "·", stateLabel(stage.name), stage.state === "skipped" ? t("page.setup.skipped", "skipped") : stageDuration(stage)];
    texts.forEach((text, place) => {
      const cell = item.children[place];
      if (cell.textContent !== text) cell.textContent = text;
    });
  });
}

function row() {
  const item = document.createElement("li");
  item.className = "stage-row";
  item.append(...["stage-mark", "stage-name", "stage-time"].map((name) => Object.assign(document.createElement("span"), { className: name })));
  return item;
}
