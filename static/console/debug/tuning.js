// The strategy's parameters: their names, their cost, and how edits differ from what is in force.

import { t } from "../../site/sentences.js";

const STEPS = t("page.tuning.steps", "steps");

/** In the order they are shown. `none` says what an empty field means; without it a number is required. */
export const PARAMETERS = {
  execution_horizon: { label: t("page.tuning.horizon", "Horizon"), unit: STEPS, whole: true, min: 1, none: t("page.tuning.whole_chunk", "whole chunk"), title: t("page.tuning.horizon_title", "Rows of each chunk that may be executed, counted from its observation") },
  inference_rate: { label: t("page.tuning.ask_at", "Ask at"), unit: "Hz", min: 0.1, none: t("page.tuning.back_to_back", "back to back"), title: t("page.tuning.ask_title", "Requests to the policy per second") },
  k_max: { label: t("page.tuning.k_max", "k max"), unit: STEPS, whole: true, min: 0, none: t("page.tuning.no_bound", "no bound"), title: t("page.tuning.k_title", "Most rows dropped as stale; beyond it the chunk is shifted and recorded as mistimed") },
  blend_window: { label: t("page.tuning.blend", "Blend over"), unit: STEPS, whole: true, min: 1, none: t("page.tuning.all", "all"), empty: "all", title: t("page.tuning.blend_title", "Steps over which a new chunk is blended in") },
  blend_shape: { label: t("page.tuning.shape", "Blend shape"), choices: ["linear", "cosine", "exponential"], title: t("page.tuning.shape_title", "How the old plan's weight falls over the window") },
  ensemble_m: { label: t("page.tuning.m", "Ensemble m"), min: 0, title: t("page.tuning.m_title", "Decay of the weights exp(-m rank), rank 0 the oldest chunk") },
  ensemble_horizon: { label: t("page.tuning.ensemble", "Ensemble of"), unit: t("page.tuning.chunks", "chunks"), whole: true, min: 1, title: t("page.tuning.ensemble_title", "Most chunks that make one step; the newest are kept") },
  delay_quantile: { label: t("page.tuning.quantile", "Delay quantile"), min: 0.01, max: 1, title: t("page.tuning.quantile_title", "Quantile of recent delays that is predicted for the next answer") },
};

/** Return the text of a field for a value in force. */
export function text(name, value) {
  const { empty = null } = PARAMETERS[name];
  return value === empty || value === null || value === undefined ? "" : String(value);
}

/** Parse a field's text: {value}, or {error} as a sentence. */
export function read(name, typed) {
  const { label, choices, none, empty = null, whole, min, max } = PARAMETERS[name];
  const given = typed.trim();
  if (choices) return choices.includes(given) ? { value: given } : { error: t("page.tuning.one_of", "{label}: one of {choices}", { label, choices: choices.join(", ") }) };
  if (given === "") return none ? { value: empty } : { error: t("page.tuning.needed", "{label}: a number is needed", { label }) };
  const value = Number(given);
  const fits = Number.isFinite(value) && (!whole || Number.isInteger(value)) && value >= min && value <= (max ?? Infinity);
  if (fits) return { value };
  const number = whole ? t("page.tuning.whole", "a whole number") : t("page.tuning.number", "a number");
  const range = max === undefined ? t("page.tuning.from", "{number} from {min}", { number, min }) : t("page.tuning.from_to", "{number} from {min} to {max}", { number, min, max });
  const open = none ? t("page.tuning.or_empty", ", or empty for {none}", { none }) : "";
  return { error: t("page.tuning.wrong", "{label}: {range}{open}; given {given}", { label, range, open, given }) };
}

/**
 * Return how `fields` {name: text} differ from the strategy `inForce`: {changes, error}. `uses` names the parameters of this
 * kind.
 */
export function changes(kind, fields, inForce, uses) {
  const found = kind === inForce.kind ? {} : { kind };
  for (const name of uses) {
    const { value, error } = read(name, fields[name] ?? "");
    if (error) return { changes: {}, error };
    if (value !== (inForce[name] ?? null)) found[name] = value;
  }
  return { changes: found, error: "" };
}

/** Return a sentence: with these parameters, what it costs when the policy changes its mind. */
export function cost(kind, parameters, rate) {
  if (kind === "sync") return t("page.tuning.cost_sync", "The robot stands while the policy is asked.");
  if (kind === "ensemble") return t("page.tuning.cost_ensemble", "Up to {n} chunks are averaged: the robot follows a change of mind late, and never at once.", { n: parameters.ensemble_horizon });
  if (kind === "naive") return t("page.tuning.cost_naive", "No blending: the robot follows at once, with a jump at each seam that safety limits.");
  const window = parameters.blend_window;
  if (window === "all") return t("page.tuning.cost_all", "Blended over the whole overlap: a change of mind is followed only when the old plan has run out.");
  if (window === 1) return t("page.tuning.cost_one", "A window of 1 replaces the old plan at once.");
  const ms = ((1000 * window) / rate).toFixed(0);
  return t("page.tuning.cost_window", "After a chunk has arrived its weight grows over {steps} steps = {ms} ms: so much later is a change of mind followed in full.", { steps: window, ms });
}
