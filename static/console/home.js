// The home page: each station's state and the picture of its first camera, requested every few seconds.

import { get, RequestFailed } from "../site/api.js";
import { quietFragments } from "../site/fragments.js";
import { localized, t } from "../site/sentences.js";
import { badge } from "./live/badge.js";

const EVERY_MS = 4000;
const STILL_MS = 8000;

async function ask(element) {
  const name = element.dataset.live;
  const reason = document.querySelector(`[data-live-reason="${CSS.escape(name)}"]`);
  try {
    const { snapshot: said, gone } = await get(`/api/v1/stations/${encodeURIComponent(name)}`);
    const snapshot = localized(said);
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
  element.textContent = session ? session.label : t("page.home.not_running", "not running");
}

/** Replace a picture by the newest one once that is loaded; hide it if there is none. */
async function look(shown) {
  const fresh = shown.cloneNode();
  fresh.src = `${shown.dataset.still}?at=${Date.now()}`;
  try {
    await fresh.decode();
    fresh.hidden = false;
    shown.replaceWith(fresh);
  } catch (error) {
    if (error.name !== "EncodingError") throw error; // a browser's error for an answer that is not a picture
    shown.hidden = true;
  }
}

function lookAll() {
  if (document.hidden) return;
  for (const element of document.querySelectorAll("[data-still]")) look(element);
}

function askAll() {
  if (document.hidden) return;
  for (const element of document.querySelectorAll("[data-live]")) ask(element);
}

quietFragments();
document.body.addEventListener("htmx:afterSettle", ({ target }) => {
  if (!target.querySelector("[data-live]")) return;
  askAll();
  lookAll();
});
document.addEventListener("eva:language", askAll);
setInterval(askAll, EVERY_MS);
setInterval(lookAll, STILL_MS);
askAll();
lookAll();
