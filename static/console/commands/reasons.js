// Why a command cannot be given now, in a sentence. Whether it can is the station's own word: snapshot.allowed.

import { STOPPING } from "./stops.js";
import { commandLabel } from "../live/labels.js";
import { t } from "../../site/sentences.js";

const MODES = { step: t("page.reasons.mode_step", "step or preview"), commit: t("page.reasons.mode_commit", "preview"), cancel: t("page.reasons.mode_cancel", "step, preview or manual"), move: t("page.reasons.mode_move", "manual") };

/** Why this page cannot give `kind` now, "" where it can. To stop it needs no news, only the lease it last had. */
export function pageProblem(kind, { fresh, role, lease, snapshot }) {
  if (!fresh) return STOPPING.includes(kind) && lease === "mine" ? "" : t("page.reasons.unknown", "the state of the station is not known at the moment");
  if (role === "viewer") return t("page.reasons.viewer", "a viewer watches; an administrator can make you an operator");
  if (lease === "free") return t("page.reasons.free", "take the station first");
  if (lease === "elsewhere") return t("page.reasons.elsewhere", "another page of yours commands the station; take it here first");
  if (lease !== "mine") return t("page.reasons.other", "someone else commands the station; ask for it");
  return commandProblem(kind, snapshot);
}

/** "" where the station allows `kind`; its own sentence where it is only not allowed just now. */
export function commandProblem(kind, { allowed, guarded = {}, state_is: is }) {
  if (allowed.includes(kind)) return "";
  if (guarded[kind]) return guarded[kind];
  if (MODES[kind]) return is.held ? t("page.reasons.holds", "the robot holds: resume or stop first") : t("page.reasons.mode", "run in the mode {mode} first", { mode: MODES[kind] });
  const possible = allowed.filter((one) => one !== "estop").map(commandLabel).join(t("page.common.comma", ", ")) || t("page.reasons.nothing", "nothing");
  return t("page.reasons.not_while", "not while {state}; possible now: {possible}", { state: is.label, possible });
}

/** Why no preflight of a checkpoint can be asked for now, "" where one can; nobody needs the lease for it. */
export function preflightProblem({ fresh, role, snapshot }, checkpoint) {
  if (role === "viewer") return t("page.reasons.viewer", "a viewer watches; an administrator can make you an operator");
  if (!checkpoint) return t("page.reasons.choose", "choose a checkpoint: Set up asks the deployed one");
  if (!fresh) return ""; // the worker asks where the station does not run
  return snapshot?.state_is.at_work ? t("page.reasons.at_work", "not while {state}: the policy is at work", { state: snapshot.state_is.label }) : "";
}
