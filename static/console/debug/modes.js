// The modes of a run in words: what each does, what can be pressed next in it, and what the run is doing.

import { stateLabel } from "../live/labels.js";
import { t } from "../../site/sentences.js";

/** In the order of the keys that choose them. */
export const MODES = {
  sim: t("page.modes.sim", "Drives a simulated robot, in 3D only."),
  step: t("page.modes.step", "Each press moves the robot by one chunk."),
  preview: t("page.modes.preview", "Each press shows a chunk; Commit moves."),
  continuous: t("page.modes.continuous", "The policy drives the robot until Stop or the run's end."),
  manual: t("page.modes.manual", "You move the robot; no policy is asked."),
  collect: t("page.modes.collect", "A person leads the robot; each run is an episode."),
};

/** What the policy sees in the mode sim, shown while it runs. */
export const SIM_INPUTS = {
  simulated: t("page.modes.seen_simulated", "The policy sees the simulated robot's joints and the live cameras."),
  live: t("page.modes.seen_live", "The policy sees the real robot's joints, which do not follow it, and the live cameras."),
};

/** Return the command of the primary button at this moment. */
export function primaryCommand({ state_is: is, mode, proposal }) {
  if (is?.held) return "resume";
  if (!is?.going) return "run";
  if (mode === "step") return "step";
  if (mode === "preview") return proposal?.chunk ? "commit" : "step";
  return mode === "manual" ? "move" : "run";
}

/** Return the names of the buttons whose meaning depends on the mode. */
export function buttonLabels(mode) {
  return {
    step: mode === "preview" ? t("page.modes.show_next", "Show next") : t("page.modes.next_chunk", "Next chunk"),
    cancel: mode === "manual" ? t("page.modes.hold_here", "Hold here") : t("page.modes.cancel", "Cancel"),
  };
}

const PHASES = {
  asking: t("page.modes.asking", "asking the policy"),
  waiting: t("page.modes.waiting", "waiting for you"),
  proposed: t("page.modes.proposed", "a chunk is shown"),
  moving: t("page.modes.moving", "moving"),
  approaching: t("page.modes.approaching", "going to the policy's first action"),
  starved: t("page.modes.starved", "nothing planned: slowing down"),
};

/** Return what the run is doing, in words; "" if no run is open. */
export function phaseText({ state_is: is, phase: now, control, rate }) {
  if (!now || !is.at_work) return "";
  if (now !== "executing") return PHASES[now] ?? stateLabel(now);
  const left = control?.remaining ?? 0;
  return left > 0 && rate ? t("page.modes.ahead", "executing, {seconds} s ahead", { seconds: (left / rate).toFixed(1) }) : t("page.modes.executing", "executing");
}

/** Return in words how far a chunk's first row, or the policy's first action, is from the commanded position. */
export function distanceText({ distance: far, joint }) {
  if (!Number.isFinite(far)) return "";
  const at = { distance: far.toFixed(2), joint };
  return joint ? t("page.modes.joint_away", "{distance} rad away ({joint})", at) : t("page.modes.away", "{distance} rad away", at);
}

/** Describe the proposed chunk in a sentence. */
export function proposed(proposal) {
  if (!proposal?.chunk) return "";
  const from = distanceText(proposal);
  const begins = from && t("page.modes.begins", ", begins {from}", { from });
  const age = Number.isFinite(proposal.age_s) ? t("page.modes.shown_for", ", shown for {seconds} s", { seconds: proposal.age_s.toFixed(0) }) : "";
  return t("page.modes.chunk", "Chunk {chunk}: {rows} steps{begins}{age}.", { chunk: proposal.chunk, rows: proposal.rows, begins, age });
}

/**
 * Return the mode to show: that of the open run, else the chosen one, the station's last one or "continuous", the first of them
 * that is offered.
 */
export function shown({ open, mode, offered }, chosen) {
  if (open && mode) return mode;
  const wanted = [chosen, mode, "continuous"].find((one) => one && (!offered?.length || offered.includes(one)));
  return wanted ?? offered[0];
}
