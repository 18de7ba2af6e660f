// Why a command cannot be given now, in a sentence. The station itself decides whether it can: snapshot.allowed.

import { STOPPING } from "./stops.js";
import { commandLabel } from "../live/labels.js";
import { t } from "../../site/sentences.js";

const MODES = { step: t("page.reasons.mode_step", "step or preview"), commit: t("page.reasons.mode_commit", "preview"), cancel: t("page.reasons.mode_cancel", "step, preview or manual"), move: t("page.reasons.mode_move", "manual") };

/**
 * Return why this page cannot give `kind` now, or "" if it can. A stop does not need a current snapshot, only the lease that
 * the page last had.
 */
export function pageProblem(kind, { fresh, role, lease, snapshot }) {
  if (!fresh) return STOPPING.includes(kind) && lease === "mine" ? "" : t("page.reasons.unknown", "the state of the station is not known at the moment");
  if (role === "viewer") return t("page.reasons.viewer", "a viewer watches; an administrator can make you an operator");
  if (lease === "free") return t("page.reasons.free", "take the station first");
  if (lease === "elsewhere") return t("page.reasons.elsewhere", "another page of yours commands the station; take it here first");
  // A program that drives cannot be asked for the station: its runs may be stopped by any operator.
  if (STOPPING.includes(kind) && lease === "other" && snapshot.lease?.holder.startsWith("robot:")) return commandProblem(kind, snapshot);
  if (lease !== "mine") return t("page.reasons.other", "someone else commands the station; ask for it");
  return commandProblem(kind, snapshot);
}

/**
 * Return "" if the station allows `kind`, its own sentence if only a guard forbids it at the moment, else a sentence about the
 * state.
 */
export function commandProblem(kind, { allowed, guarded = {}, state_is: is }) {
  if (allowed.includes(kind)) return "";
  if (guarded[kind]) return guarded[kind];
  if (MODES[kind]) return is.held ? t("page.reasons.holds", "the robot holds: resume or stop first") : t("page.reasons.mode", "run in the mode {mode} first", { mode: MODES[kind] });
  const possible = allowed.filter((one) => one !== "estop").map(commandLabel).join(t("page.common.comma", ", ")) || t("page.reasons.nothing", "nothing");
  return t("page.reasons.not_while", "not while {state}; possible now: {possible}", { state: is.label, possible });
}

/** Return why no preflight of a checkpoint can be requested now, or "" if one can. A preflight does not need the lease. */
export function preflightProblem({ fresh, role, snapshot }, checkpoint) {
  if (role === "viewer") return t("page.reasons.viewer", "a viewer watches; an administrator can make you an operator");
  if (!checkpoint) return t("page.reasons.choose", "choose a checkpoint: Set up asks the deployed one");
  if (!fresh) return ""; // without a running station the worker carries out the preflight
  return snapshot?.state_is.at_work ? t("page.reasons.at_work", "not while {state}: the policy is at work", { state: snapshot.state_is.label }) : "";
}
