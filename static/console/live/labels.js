// Words for what the station reports. The states, their meanings (`state_is`) and the commands allowed in them are defined by
// the runtime.

import { t } from "../../site/sentences.js";

const ADVICE = {
  away: {
    title: t("page.words.away", "No complete picture of the robot"),
    advice: t("page.words.away_advice", "Start the execution node; check the cameras that are grey."),
    buttons: [],
  },
  held: {
    title: t("page.words.held", "The robot holds"),
    advice: t("page.words.held_advice", "Look at the bench first."),
    buttons: ["resume", "stop"],
  },
  latched: {
    title: t("page.words.latched", "E-stop is latched"),
    advice: t("page.words.latched_advice", "After the release, set up again."),
    buttons: ["release"],
  },
};

/** Return what a state asks of the person at the bench, or undefined if the station can be left alone. */
export function advice({ connected, held, latched }) {
  return latched ? ADVICE.latched : held ? ADVICE.held : connected === false ? ADVICE.away : undefined;
}

/** Why the server closes a page's socket: close code -> {word, reason}. */
export const CLOSE_REASONS = {
  4401: { word: t("page.words.logged_out", "logged out"), reason: t("page.words.logged_out_why", "You are logged out: reload this page and log in again.") },
  4404: { word: t("page.words.no_station", "no such station"), reason: t("page.words.no_station_why", "This station is not in the lab any more: go back to the list of stations.") },
};

export const COMMAND_LABELS = {
  setup: t("page.words.setup", "Set up"),
  run: t("page.words.run", "Run"),
  stop: t("page.words.stop", "Stop"),
  halt: t("page.words.halt", "Pause"),
  resume: t("page.words.resume", "Resume"),
  home: t("page.words.home", "Home"),
  release: t("page.words.release", "Release"),
  record_start: t("page.words.record_start", "Start recording"),
  record_stop: t("page.words.record_stop", "End recording"),
  estop: t("page.words.estop", "E-stop"),
  tune: t("page.words.tune", "Apply"),
  step: t("page.words.step", "Next chunk"),
  commit: t("page.words.commit", "Commit"),
  cancel: t("page.words.cancel", "Cancel"),
  move: t("page.words.move", "Send"),
  gripper: t("page.words.gripper", "Gripper"),
  approach: t("page.words.approach", "Approach"),
  arm: t("page.words.arm", "Arm"),
  disarm: t("page.words.disarm", "Disarm"),
  label: t("page.words.label", "Result"),
  discard: t("page.words.discard", "Discard"),
  lease_claim: t("page.words.lease_claim", "Station taken"),
  lease_give_up: t("page.words.lease_give_up", "Station given up"),
};

export function stateLabel(state) {
  return state.replaceAll("_", " ");
}

export function commandLabel(kind) {
  return COMMAND_LABELS[kind] ?? stateLabel(kind);
}

export function formatDuration(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

export function formatAge(seconds) {
  if (!Number.isFinite(seconds)) return t("page.words.never", "never seen");
  if (seconds < 1) return `${Math.round(seconds * 1000)} ms`;
  return seconds < 100 ? `${seconds.toFixed(1)} s` : `${Math.round(seconds / 60)} min`;
}

/** Format a figure with its unit; a value that is not finite becomes a dash. */
export function formatFigure(value, digits, unit) {
  return Number.isFinite(value) ? `${value.toFixed(digits)} ${unit}` : `– ${unit}`;
}
