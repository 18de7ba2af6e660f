// The status bar and the box that says what a person has to do: state by place, not by pop-up.

import { badge } from "./badge.js";
import { advice, age, duration, figure, words } from "./words.js";

const TITLES = { mine: "This page commands", elsewhere: "You command on another page", free: "The station is free" };
const shown = (name) => document.querySelectorAll(`[data-show="${name}"]`);

function write(name, text) {
  for (const element of shown(name)) if (element.textContent !== text) element.textContent = text;
}

/** Keeps the bar true: as news come, and each second for what grows old without news. */
export function statusBar(store) {
  const draw = () => {
    document.body.toggleAttribute("data-stale", !store.fresh && store.snapshot !== null);
    drawState(store);
    drawSituation(store);
    if (store.snapshot) drawFigures(store, store.snapshot);
  };
  store.on(["snapshot", "link", "open", "second"], draw);
  draw();
}

function drawState(store) {
  const snapshot = store.snapshot;
  for (const element of shown("state")) {
    element.toggleAttribute("data-stale", !store.fresh);
    badge(element, store.fresh ? snapshot.state_is : null);
    const text = store.fresh ? snapshot.state_is.label : trouble(store).word;
    if (element.textContent !== text) element.textContent = text;
    element.title = store.fresh ? snapshot.reason : trouble(store).reason;
  }
  const running = store.fresh && snapshot.run.number > 0;
  write("clock", running ? duration(snapshot.run.elapsed) : "");
}

/** Why nothing is known, in a word and in a sentence. */
function trouble(store) {
  if (store.closed) return store.closed;
  if (!store.open) return { word: "no connection", reason: "The web server does not answer; this page tries again by itself." };
  if (!store.link.ok) return { word: "no station", reason: store.link.reason || "The station's runtime does not answer." };
  if (!store.snapshot) return { word: "waiting", reason: "No state has come yet." };
  return { word: `silent ${age(store.age)}`, reason: "The station has said nothing for a while; what is shown is old." };
}

function drawSituation(store) {
  const box = document.getElementById("situation");
  const asked = store.fresh ? advice(store.snapshot.state_is) : null;
  const lost = !store.fresh && store.snapshotAt !== -Infinity;
  const dead = !store.fresh && store.open && !store.link.ok && store.link.told;
  box.hidden = !(asked || lost || dead);
  if (box.hidden) return;
  const { word, reason } = store.fresh ? { word: "", reason: store.snapshot.reason } : trouble(store);
  box.dataset.tone = store.fresh ? store.snapshot.state_is.tone : "neutral";
  part(box, "title").textContent = asked ? asked.title : `Nothing is known: ${word}`;
  part(box, "reason").textContent = reason;
  part(box, "advice").textContent = asked ? asked.advice : "The robot goes on as its runtime decides; the hardware stop is yours.";
  const busy = document.querySelectorAll("#steps [data-command]:not([hidden])");
  const elsewhere = new Set([...busy].map((button) => button.dataset.command));
  for (const button of part(box, "buttons").children) {
    const kind = button.dataset.command;
    button.hidden = !asked?.buttons.includes(kind) || elsewhere.has(kind);
  }
}

function part(box, name) {
  return box.querySelector(`[data-situation="${name}"]`);
}

function drawFigures(store, snapshot) {
  const joints = snapshot.link.ages.joints;
  if (!store.fresh) {
    write("transport", `last news ${age(store.age)} ago`);
    return;
  }
  write("transport", `${snapshot.transport} ${joints !== null && joints < 1 ? "ok" : `silent ${age(joints ?? Infinity)}`}`);
  drawPolicy(snapshot.policy);
  const held = { mine: "you", elsewhere: "other page", free: "free", other: store.commander }[store.lease];
  write("lease", `lease: ${held}`);
  for (const element of shown("lease")) {
    element.dataset.lease = store.lease;
    element.title = TITLES[store.lease] ?? `${held} commands this station`;
  }
  drawStage(snapshot);
  const { uuid, rows, repeated, unclosed } = snapshot.recording;
  const waiting = Object.values(unclosed ?? {});
  const waits = waiting.length ? `; ${waiting.length} not closed yet: ${waiting[0]}` : "";
  write("recording", (uuid ? `recording ${rows} rows, ${repeated} with a repeated picture` : "not recording") + waits);
}

/** How far the set-up is, or what an idle station waits for: the reason why a set-up failed among it. */
function drawStage({ state_is: is, stage, reason }) {
  const text = is.preparing ? `${words(stage)} …` : is.idle ? reason : "";
  write("stage", text);
  for (const element of shown("stage")) {
    element.hidden = !text;
    element.toggleAttribute("data-idle", is.idle);
  }
}

/** The latency as a small distribution: a bar to the 90th percentile with a mark at the median. */
function drawPolicy(policy) {
  for (const element of shown("policy")) element.toggleAttribute("data-lost", Boolean(policy.lost));
  if (policy.lost) {
    write("policy", "policy lost, trying again");
    for (const element of shown("policy")) element.title = `The policy's server does not answer; next try in ${figure(policy.retry_in_s, 1, "s")}`;
    return;
  }
  const { latency_p50_ms: p50, latency_p90_ms: p90, answers } = policy;
  if (!answers || p50 === null) {
    write("policy", "policy: no answer yet");
    return;
  }
  const title = `Inference latency of the last ${answers} answers: median ${figure(p50, 0, "ms")}, 90 % within ${figure(p90, 0, "ms")}`;
  for (const element of shown("policy")) {
    if (!element.querySelector(".latency")) element.innerHTML = '<span class="muted">policy</span><span class="latency"><i></i></span><span></span>';
    element.title = title;
    element.style.setProperty("--p50", Math.min(1, p50 / 400));
    element.style.setProperty("--p90", Math.min(1, p90 / 400));
    element.lastElementChild.textContent = `${p50.toFixed(0)}–${p90.toFixed(0)} ms`;
  }
}
