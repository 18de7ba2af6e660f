// Events in words: texts for the runtime's kinds and sentences, and their severity.

import { sentence as translated, t } from "../../site/sentences.js";
import { commandLabel, stateLabel } from "./labels.js";

const BAD = new Set(["estopped", "family_died", "policy_failed", "policy_lost", "recording_failed", "source_failed", "video_lost", "displaced", "moved_away", "implausible", "corrected", "too_far", "node_silent", "leader_lost"]);
const WARN = new Set(["camera_absent", "camera_ended", "camera_is_a_video", "camera_lost", "commands_unheard", "refused", "word_refused", "tune_refused", "lock_refused", "refusals", "starved", "starvation", "limited", "near", "far_start", "pictures_stopped", "recording_late", "chunk_dropped", "ik_unreached", "poses_refused", "joints_missing", "not_journalled", "unmeasured", "zero_joints", "unreadable", "rtc_warning", "late_ticks", "scheduling", "episode_short"]);
// Kinds that report the end of a trouble.
const GOOD = new Set(["camera_back", "commands_heard", "joints_back", "pictures_back", "policy_back", "recording_goes_on", "recovered", "punctual", "released"]);
const NAMES = {
  camera_absent: t("page.events.camera_absent", "camera absent"),
  camera_back: t("page.events.camera_back", "camera is back"),
  camera_ended: t("page.events.camera_ended", "video is over"),
  camera_is_a_video: t("page.events.camera_is_a_video", "video as camera"),
  camera_lost: t("page.events.camera_lost", "camera lost"),
  commands_heard: t("page.events.commands_heard", "commands heard"),
  commands_unheard: t("page.events.commands_unheard", "not heard"),
  chunk_dropped: t("page.events.chunk_dropped", "chunk not used"),
  collect_armed: t("page.events.collect_armed", "armed"),
  collect_disarmed: t("page.events.collect_disarmed", "disarmed"),
  corrected: t("page.events.corrected", "last check"),
  displaced: t("page.events.displaced", "arm was moved"),
  episode_closed: t("page.events.episode_closed", "recording ended"),
  episode_opened: t("page.events.episode_opened", "recording"),
  episode_short: t("page.events.episode_short", "too short"),
  estopped: t("page.events.estopped", "e-stop"),
  family_died: t("page.events.family_died", "process ended"),
  far_start: t("page.events.far_start", "far from robot"),
  implausible: t("page.events.implausible", "encoders"),
  ik_unreached: t("page.events.ik_unreached", "out of reach"),
  poses_refused: t("page.events.poses_refused", "poses refused"),
  joints_back: t("page.events.joints_back", "joints again"),
  joints_missing: t("page.events.joints_missing", "joints missing"),
  leader_lost: t("page.events.leader_lost", "leader lost"),
  late_ticks: t("page.events.late_ticks", "control late"),
  limited: t("page.events.limited", "safety"),
  limited_sum: t("page.events.limited", "safety"),
  lock_refused: t("page.events.lock_refused", "lock refused"),
  locked: t("page.events.locked", "gripper lock"),
  motion_done: t("page.events.motion_done", "motion"),
  moved_away: t("page.events.displaced", "arm was moved"),
  near: t("page.events.near", "too near"),
  node_silent: t("page.events.node_silent", "node silent"),
  near_sum: t("page.events.near", "too near"),
  not_journalled: t("page.events.not_journalled", "not in journal"),
  pictures_back: t("page.events.pictures_back", "pictures again"),
  pictures_stopped: t("page.events.pictures_stopped", "no pictures"),
  policy_back: t("page.events.policy_back", "policy is back"),
  policy_failed: t("page.events.policy_failed", "policy failed"),
  policy_lost: t("page.events.policy_lost", "policy lost"),
  punctual: t("page.events.punctual", "control on time"),
  recording_failed: t("page.events.recording_failed", "recording failed"),
  recording_goes_on: t("page.events.recording_goes_on", "recorder is back"),
  recording_late: t("page.events.recording_late", "recorder is late"),
  recovered: t("page.events.recovered", "actions again"),
  refusals: t("page.events.refusals", "actions refused"),
  refused: t("page.events.refused", "action refused"),
  released: t("page.events.released", "e-stop released"),
  rtc_warning: "RTC",
  scheduling: t("page.events.scheduling", "real time"),
  setup: t("page.events.setup", "set-up"),
  source_failed: t("page.events.source_failed", "robot link"),
  starvation: t("page.events.starved", "out of actions"),
  starved: t("page.events.starved", "out of actions"),
  too_far: t("page.events.too_far", "too far"),
  truth: t("page.events.truth", "bench says"),
  tune_refused: t("page.events.tune_refused", "strategy refused"),
  tuned: t("page.events.tuned", "strategy in force"),
  tuned_to: t("page.events.tuned_to", "strategy asked"),
  unmeasured: t("page.events.unmeasured", "joints not seen"),
  unreadable: t("page.events.unreadable", "not understood"),
  video_lost: t("page.events.video_lost", "video lost"),
  word_refused: t("page.events.word_refused", "robot refused"),
  zero_joints: t("page.events.zero_joints", "joints at 0"),
  command: t("page.events.command", "command"),
  drives: t("page.events.drives", "drives"),
  labelled: t("page.events.labelled", "labelled"),
  preflight: t("page.events.preflight", "preflight"),
  state: t("page.events.state", "state"),
};
const UUID = /\b([0-9a-f]{8})-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}\b/g; // the first eight digits are enough to read
const HOLDER = /\bweb:([^\s:]+):([A-Za-z0-9_-]{1,4})[A-Za-z0-9_-]*/g; // a page of a user

/** Kinds whose sentences begin with a word of the runtime, with the function that replaces it by the page's word. */
const PLAIN = {
  state: (said) => said.replace(/^\w+ -> \w+/, stateLabel),
  command: (said) => said.replace(/^\w+(?= by )/, commandLabel),
  source: (said) => said.replace(/^source: /, ""),
  truth: (said) => said.replace(/^the simulated bench says: /, ""),
  episode_opened: (said) => said.replace(/^recording /, "begun: "),
};

/** Return the name of an event's kind. */
export function kindLabel(kind) {
  return NAMES[kind] ?? (kind.startsWith("source_") ? NAMES.source_failed : stateLabel(kind));
}

/** Return an event's sentence, with arrows as symbols, holders by their names, and commands as their buttons name them. */
export function eventText(event) {
  const { kind, text } = event;
  const said = translated(event);
  if (kind === "setup" && text === "idle") return t("page.events.set_up_over", "the set-up is over");
  const english = PLAIN[kind] ?? (kind.startsWith("source_") ? PLAIN.source : (given) => given);
  return (said === text ? english(said) : said).replaceAll(" -> ", " → ").replace(HOLDER, t("page.events.page_of", "$1 (page $2)")).replace(UUID, "$1");
}

/**
 * Return "bad" if an event endangers robot or record, "warn" if a person should notice it, "good" if it ends a trouble, else
 * "".
 */
export function severity({ kind, text, data = {} }) {
  if (BAD.has(kind) || (kind === "state" && data.state_is?.latched)) return "bad";
  if (WARN.has(kind) || kind.startsWith("source_")) return "warn";
  if (kind === "drives") return data.enabled === false || data.faults?.length ? "bad" : "good";
  if (GOOD.has(kind)) return "good";
  if (kind === "state") return data.state_is?.held || data.state_is?.connected === false ? "warn" : "";
  return kind === "command" && /: (refused|failed)\b/.test(text) ? "warn" : "";
}
