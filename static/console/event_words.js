// Events in words: the runtime's kinds and sentences as a person reads them, and how much they weigh.

const BAD = new Set(["estopped", "family_died", "policy_failed", "policy_lost", "recording_failed", "source_failed", "displaced"]);
const WARN = new Set(["refused", "word_refused", "refusals", "starved", "starvation", "limited", "far_start", "chunk_dropped", "ik_unreached", "not_journalled", "unmeasured"]);
const NAMES = { estopped: "e-stop", family_died: "process ended", ik_unreached: "out of reach", truth: "bench says", limited: "safety", limited_sum: "safety" };
const HOLDER = /\bweb:([^\s:]+):([A-Za-z0-9_-]{1,4})[A-Za-z0-9_-]*/g; // a page of a person

/** The kind in words. */
export function kindWords(kind) {
  return NAMES[kind] ?? kind.replaceAll("_", " ");
}

/** The sentence, with arrows as arrows and people by their names. */
export function sentence({ kind, text }) {
  if (kind === "setup" && text === "idle") return "the set-up is over";
  const said = kind === "state" ? text.replace(/^\w+ -> \w+/, (change) => change.replaceAll("_", " ")) : text;
  return said.replaceAll(" -> ", " → ").replace(HOLDER, "$1 (page $2)");
}

/** "bad" for what endangers robot or record, "warn" for what a person should have seen, else "". */
export function weight({ kind, text, data = {} }) {
  if (BAD.has(kind) || (kind === "state" && data.state === "faulted")) return "bad";
  if (WARN.has(kind) || kind.startsWith("source_")) return "warn";
  if (kind === "state") return ["holding", "disconnected"].includes(data.state) ? "warn" : "";
  return kind === "command" && /: (refused|failed)\b/.test(text) ? "warn" : "";
}
