// The status bar and the box that says what a person has to do: state is shown in a fixed place, never in a pop-up.

import { badge } from "./badge.js";
import { advice, formatAge, formatDuration, formatFigure, stateLabel } from "./labels.js";
import { t } from "../../site/sentences.js";

const TITLES = { mine: t("page.status.mine", "This page commands"), elsewhere: t("page.status.elsewhere", "You command on another page"), free: t("page.status.free", "The station is free") };
const shown = (name) => document.querySelectorAll(`[data-show="${name}"]`);

function write(name, text) {
  for (const element of shown(name)) if (element.textContent !== text) element.textContent = text;
}

/** Update the bar with every message, and each second for values that age without one. */
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
  write("clock", running ? formatDuration(snapshot.run.elapsed) : "");
}

/** Return {word, reason}: why nothing is known about the station. */
function trouble(store) {
  if (store.closed) return store.closed;
  if (!store.open) return { word: t("page.status.no_connection", "no connection"), reason: t("page.status.no_connection_why", "The web server does not answer; this page tries again by itself.") };
  if (!store.link.ok) return { word: t("page.status.no_station", "no station"), reason: store.link.reason || t("page.status.no_station_why", "The station's runtime does not answer.") };
  if (!store.snapshot) return { word: t("page.status.waiting", "waiting"), reason: t("page.status.waiting_why", "No state has come yet.") };
  return { word: t("page.status.silent", "silent {age}", { age: formatAge(store.age) }), reason: t("page.status.silent_why", "The station has said nothing for a while; what is shown is old.") };
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
  part(box, "title").textContent = asked ? asked.title : t("page.status.nothing_known", "Nothing is known: {word}", { word });
  part(box, "reason").textContent = reason;
  part(box, "advice").textContent = asked ? asked.advice : t("page.status.hardware_stop", "The robot goes on as its runtime decides; the hardware stop is yours.");
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
    write("transport", t("page.status.last_news", "last news {age} ago", { age: formatAge(store.age) }));
    return;
  }
  const { transport } = snapshot;
  write("transport", joints !== null && joints < 1 ? t("page.status.transport_ok", "{transport} ok", { transport }) : t("page.status.transport_silent", "{transport} silent {age}", { transport, age: formatAge(joints ?? Infinity) }));
  drawPolicy(snapshot.policy, snapshot.state);
  const held = { mine: t("page.status.held_you", "you"), elsewhere: t("page.status.held_elsewhere", "other page"), free: t("page.status.held_free", "free"), other: store.commander }[store.lease];
  write("lease", t("page.status.lease", "lease: {held}", { held }));
  for (const element of shown("lease")) {
    element.dataset.lease = store.lease;
    element.title = TITLES[store.lease] ?? t("page.status.commands", "{held} commands this station", { held });
  }
  drawStage(snapshot);
  const { uuid, rows, repeated, unclosed } = snapshot.recording;
  const waiting = Object.values(unclosed ?? {});
  const waits = waiting.length ? t("page.status.unclosed", "; {n} not closed yet: {first}", { n: waiting.length, first: waiting[0] }) : "";
  write("recording", (uuid ? t("page.status.recording", "recording {rows} rows, {repeated} with a repeated picture", { rows, repeated }) : t("page.status.not_recording", "not recording")) + waits);
}

/** Show the stage of the set-up or, for an idle station, what it waits for, such as why a set-up failed. */
function drawStage({ state_is: is, stage, reason }) {
  const text = is.preparing ? t("page.status.stage", "{stage} …", { stage: stateLabel(stage) }) : is.idle ? reason : "";
  write("stage", text);
  for (const element of shown("stage")) {
    element.hidden = !text;
    element.toggleAttribute("data-idle", is.idle);
  }
}

/** Show the latency as a small distribution: a bar up to the 90th percentile with a mark at the median. */
function drawPolicy(policy, state) {
  for (const element of shown("policy")) element.toggleAttribute("data-lost", Boolean(policy.lost));
  if (policy.lost) {
    write("policy", t("page.status.policy_lost", "policy lost, trying again"));
    for (const element of shown("policy")) element.title = t("page.status.policy_retry", "The policy's server does not answer; next try in {time}", { time: formatFigure(policy.retry_in_s, 1, "s") });
    return;
  }
  const { latency_p50_ms: p50, latency_p90_ms: p90, answers } = policy;
  if (!answers || p50 === null) {
    const prepared = ["ready", "running", "holding"].includes(state); // a set-up ends with an answer
    write("policy", prepared ? t("page.status.policy_ready", "policy ready") : t("page.status.policy_silent", "policy: no answer yet"));
    return;
  }
  const title = t("page.status.latency", "Inference latency of the last {n} answers: median {p50}, 90 % within {p90}", { n: answers, p50: formatFigure(p50, 0, "ms"), p90: formatFigure(p90, 0, "ms") });
  for (const element of shown("policy")) {
    if (!element.querySelector(".latency")) element.innerHTML = '<span class="muted"></span><span class="latency"><i></i></span><span></span>';
    element.firstElementChild.textContent = t("page.status.policy", "policy");
    element.title = title;
    element.style.setProperty("--p50", Math.min(1, p50 / 400));
    element.style.setProperty("--p90", Math.min(1, p90 / 400));
    element.lastElementChild.textContent = `${p50.toFixed(0)}–${p90.toFixed(0)} ms`;
  }
}
