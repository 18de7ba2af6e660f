// Why a command cannot be given now, in a sentence. Whether it can is the station's own word: snapshot.allowed.

import { STOPPING } from "./stops.js";
import { verb, words } from "./words.js";

const MODES = { step: ["step", "preview"], commit: ["preview"], cancel: ["step", "preview", "manual"], move: ["manual"] };
const BUSY = {
  asking: "the policy is being asked",
  executing: "the last chunk is still being executed",
  proposed: "a chunk is shown: commit or cancel it first",
};

/** Why this page cannot give `kind` now, "" where it can. To stop it needs no news, only the lease it last had. */
export function refusal(kind, { fresh, role, lease, snapshot }) {
  if (!fresh) return STOPPING.includes(kind) && lease === "mine" ? "" : "nothing is known of the station at the moment";
  if (role === "viewer") return "a viewer watches; an administrator can make you an operator";
  if (lease === "free") return "take the station first";
  if (lease === "elsewhere") return "another page of yours commands the station; take it here first";
  if (lease !== "mine") return "somebody else commands the station; ask for it";
  return whyNot(kind, snapshot);
}

/** "" where the station allows `kind`. */
export function whyNot(kind, snapshot) {
  const { allowed, state, phase = "" } = snapshot;
  if (allowed.includes(kind)) return "";
  return ofMode(kind, snapshot) || ofKind(kind, { state, phase, mode: snapshot.mode }) || generic(allowed, state);
}

function ofMode(kind, { state, mode }) {
  const modes = MODES[kind];
  if (!modes) return "";
  if (state === "holding") return "the robot holds: resume or stop first";
  if (state !== "running") return `run in the mode ${modes.join(" or ")} first`;
  if (modes.includes(mode)) return kind === "commit" ? "no chunk is shown: show one first" : "";
  return `this is for ${modes.join(" and ")}; the run's mode is ${mode}`;
}

function ofKind(kind, { state, phase, mode }) {
  if (kind === "step") return BUSY[phase] ?? "";
  if (kind === "approach") {
    if (state === "ready") return "the policy's first action is not known: set up again";
    return state === "running" && mode === "preview" ? "no chunk is shown: show one first" : "";
  }
  const always = { tune: ["idle", "ready", "running", "holding"], gripper: ["ready", "running", "holding"] }[kind];
  if (always?.includes(state)) return "a trial is being run: what is measured may not be changed";
  return "";
}

function generic(allowed, state) {
  const possible = allowed.filter((one) => one !== "estop").map(verb).join(", ") || "nothing";
  return `not while ${words(state)}; possible now: ${possible}`;
}
