// The strategy's parameters: what they are called, what they cost, what differs from what is in force.

/** In the order they are shown. `none` says what an empty field means; without it a number is needed. */
export const PARAMETERS = {
  execution_horizon: { label: "Horizon", unit: "steps", whole: true, min: 1, none: "whole chunk", title: "Rows of each chunk that may be executed, counted from its observation" },
  inference_rate: { label: "Ask at", unit: "Hz", min: 0.1, none: "back to back", title: "Requests to the policy per second" },
  k_max: { label: "k max", unit: "steps", whole: true, min: 0, none: "no bound", title: "Most rows dropped as stale; beyond it the chunk is shifted and recorded as mistimed" },
  blend_window: { label: "Blend over", unit: "steps", whole: true, min: 1, none: "all", empty: "all", title: "Steps over which a new chunk is blended in" },
  blend_shape: { label: "Blend shape", choices: ["linear", "cosine", "exponential"], title: "How the old plan's weight falls over the window" },
  ensemble_m: { label: "Ensemble m", min: 0, title: "Decay of the weights exp(-m rank), rank 0 the oldest chunk" },
  ensemble_horizon: { label: "Ensemble of", unit: "chunks", whole: true, min: 1, title: "Most chunks that make one step; the newest are kept" },
  delay_quantile: { label: "Delay quantile", min: 0.01, max: 1, title: "Quantile of recent delays that is predicted for the next answer" },
};

/** What a field shows for a value in force. */
export function text(name, value) {
  const { empty = null } = PARAMETERS[name];
  return value === empty || value === null || value === undefined ? "" : String(value);
}

/** What a field's text stands for: {value}, or {error} in a sentence. */
export function read(name, typed) {
  const { label, choices, none, empty = null, whole, min, max } = PARAMETERS[name];
  const given = typed.trim();
  if (choices) return choices.includes(given) ? { value: given } : { error: `${label}: one of ${choices.join(", ")}` };
  if (given === "") return none ? { value: empty } : { error: `${label}: a number is needed` };
  const value = Number(given);
  const fits = Number.isFinite(value) && (!whole || Number.isInteger(value)) && value >= min && value <= (max ?? Infinity);
  if (fits) return { value };
  const upper = max === undefined ? "" : ` to ${max}`;
  return { error: `${label}: ${whole ? "a whole number" : "a number"} from ${min}${upper}${none ? `, or empty for ${none}` : ""}; given ${given}` };
}

/** What of the `fields` {name: text} differs from the section `inForce`: {changes, error}. `uses` are the kind's own. */
export function changes(kind, fields, inForce, uses) {
  const found = kind === inForce.kind ? {} : { kind };
  for (const name of uses) {
    const { value, error } = read(name, fields[name] ?? "");
    if (error) return { changes: {}, error };
    if (value !== (inForce[name] ?? null)) found[name] = value;
  }
  return { changes: found, error: "" };
}

/** What a change of mind of the policy costs with these parameters, in a sentence. */
export function cost(kind, parameters, rate) {
  const time = (steps) => `${steps} steps = ${((1000 * steps) / rate).toFixed(0)} ms`;
  if (kind === "sync") return "The robot stands while the policy is asked.";
  if (kind === "ensemble") return `Up to ${parameters.ensemble_horizon} chunks are averaged: the robot follows a change of mind late, and never at once.`;
  if (kind === "naive") return "No blending: the robot follows at once, with a jump at each seam that safety limits.";
  const window = parameters.blend_window;
  if (window === "all") return "Blended over the whole overlap: a change of mind is followed only when the old plan has run out.";
  if (window === 1) return "A window of 1 replaces the old plan at once.";
  return `After a chunk has arrived its weight grows over ${time(window)}: so much later is a change of mind followed in full.`;
}
