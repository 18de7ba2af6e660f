// Preflights: the chosen checkpoint's server is asked without the robot, and the newest result is shown below the button.

import { post } from "../../site/api.js";
import { setReason } from "../commands/commands.js";
import { config } from "../live/config.js";
import { preflightProblem } from "../commands/reasons.js";
import { t } from "../../site/sentences.js";

const TIMEOUT_MS = 15000; // the server first asks the other stations which policy server they use

/** Keep buttons with data-preflight-ask and their results up to date. */
export function preflights(store, commands) {
  const draw = () => {
    for (const button of document.querySelectorAll("[data-preflight-ask]")) {
      const checkpoint = chosen(button);
      setReason(button, preflightProblem(store, checkpoint));
      const result = resultOf(button);
      if (result.dataset.of === checkpoint) continue;
      result.dataset.of = checkpoint;
      if (checkpoint) show(result, `${config.preflights.newest}?checkpoint=${encodeURIComponent(checkpoint)}`);
      else result.replaceChildren();
    }
  };
  document.addEventListener("click", (event) => {
    const button = event.target.closest("[data-preflight-ask]");
    if (button) ask(button, commands);
  });
  document.addEventListener("change", draw);
  document.body.addEventListener("htmx:afterSettle", ({ target }) => {
    draw();
    if (target.dataset?.asked) told(target, commands);
  });
  store.on(["snapshot", "second"], draw);
  draw();
}

async function ask(button, commands) {
  if (button.getAttribute("aria-disabled") === "true") {
    commands.say(t("page.preflight.said", "Preflight: {said}", { said: button.title }), "refused");
    return;
  }
  if ("pressed" in button.dataset) return;
  button.dataset.pressed = "";
  commands.say(t("page.preflight.pressed", "Preflight: pressed …"), "pressed");
  try {
    const asked = await post(config.preflights.ask, { checkpoint: chosen(button), station: config.station }, { timeout: TIMEOUT_MS });
    commands.say(t("page.preflight.under_way", "Preflight: under way"), "accepted");
    const result = resultOf(button);
    result.dataset.asked = asked.id;
    show(result, `${config.preflights.result}${asked.id}/`);
  } catch (error) {
    commands.fail(t("page.preflight.name", "Preflight"), error, t("page.preflight.look", "Look below the button before you repeat it."));
  } finally {
    delete button.dataset.pressed;
  }
}

/** Report the outcome of a preflight that was requested on this page. */
function told(result, commands) {
  const shown = result.querySelector("[data-preflight]");
  if (shown?.dataset.preflight !== result.dataset.asked || shown.dataset.status === "running") return;
  delete result.dataset.asked;
  commands.say(t("page.preflight.said", "Preflight: {said}", { said: shown.querySelector(".state").textContent }), shown.dataset.verdict === "ok" ? "accepted" : "refused");
}

function chosen(button) {
  const { checkpoint, checkpointChoice } = button.dataset;
  return checkpoint ?? document.querySelector(checkpointChoice)?.value ?? "";
}

function resultOf(button) {
  return button.closest(".preflight-here").querySelector("[data-preflight-result]");
}

function show(result, address) {
  window.htmx.ajax("GET", address, { target: result, swap: "innerHTML" });
}
