// The list of stations: how each stands, asked every few seconds.

import { get, RequestFailed } from "../site/api.js";
import { quietFragments } from "../site/fragments.js";
import { badge } from "./live/badge.js";

const EVERY_MS = 4000;

async function ask(element) {
  const name = element.dataset.live;
  const reason = document.querySelector(`[data-live-reason="${CSS.escape(name)}"]`);
  try {
    const { snapshot, gone } = await get(`/api/v1/stations/${encodeURIComponent(name)}`);
    show(element, snapshot?.state_is);
    reason.textContent = snapshot ? snapshot.reason : gone;
  } catch (error) {
    if (!(error instanceof RequestFailed)) throw error;
    show(element, undefined);
    reason.textContent = error.message;
  }
}

function show(element, session) {
  element.toggleAttribute("data-stale", !session);
  badge(element, session);
  element.textContent = session ? session.label : "not running";
}

function askAll() {
  if (document.hidden) return;
  for (const element of document.querySelectorAll("[data-live]")) ask(element);
}

quietFragments();
document.body.addEventListener("htmx:afterSettle", askAll);
setInterval(askAll, EVERY_MS);
askAll();
