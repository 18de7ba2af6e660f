// Why a command cannot be given now, in a sentence. Whether it can is the station's own word: snapshot.allowed.

import { STOPPING } from "./stops.js";
import { verb } from "../live/words.js";

const MODES = { step: "step or preview", commit: "preview", cancel: "step, preview or manual", move: "manual" };

/** Why this page cannot give `kind` now, "" where it can. To stop it needs no news, only the lease it last had. */
export function refusal(kind, { fresh, role, lease, snapshot }) {
  if (!fresh) return STOPPING.includes(kind) && lease === "mine" ? "" : "the state of the station is not known at the moment";
  if (role === "viewer") return "a viewer watches; an administrator can make you an operator";
  if (lease === "free") return "take the station first";
  if (lease === "elsewhere") return "another page of yours commands the station; take it here first";
  if (lease !== "mine") return "someone else commands the station; ask for it";
  return whyNot(kind, snapshot);
}

/** "" where the station allows `kind`; its own sentence where it is only not allowed just now. */
export function whyNot(kind, { allowed, guarded = {}, state_is: is }) {
  if (allowed.includes(kind)) return "";
  if (guarded[kind]) return guarded[kind];
  if (MODES[kind]) return is.held ? "the robot holds: resume or stop first" : `run in the mode ${MODES[kind]} first`;
  const possible = allowed.filter((one) => one !== "estop").map(verb).join(", ") || "nothing";
  return `not while ${is.label}; possible now: ${possible}`;
}

/** Why no preflight of a checkpoint can be asked for now, "" where one can; nobody needs the lease for it. */
export function whyNoPreflight({ fresh, role, snapshot }, checkpoint) {
  if (role === "viewer") return "a viewer watches; an administrator can make you an operator";
  if (!checkpoint) return "choose a checkpoint: Set up asks the deployed one";
  if (!fresh) return ""; // the worker asks where the station does not run
  return snapshot?.state_is.at_work ? `not while ${snapshot.state_is.label}: the policy is at work` : "";
}
