// What the buttons of the Collect page do at each moment, and why they are disabled; nothing here touches the page.

import { t } from "../site/sentences.js";

export const ARM_FIRST = t("page.collect.arm_first", "arm first");

/** Return what the primary button does now: {kind, text}. While the robot moves it stops; it starts only at rest. */
export function primaryAction({ state_is: is } = {}) {
  if (is?.preparing) return { kind: "stop", text: t("page.collect.cancel_set_up", "Cancel the set-up") };
  if (is?.run_open) return { kind: "stop", text: t("page.collect.stop_and_save", "Stop and save") };
  return { kind: "run", text: t("page.collect.start", "Start") };
}

/** Return why no episode can start, or "" if the station alone decides. */
export function startProblem(snapshot, session) {
  const { collect } = snapshot ?? {};
  if (!collect) return t("page.collect.collects_nothing", "this station collects nothing");
  if (!session) return t("page.collect.open_first", "open or resume a session first");
  if (!collect.set_up) return t("page.collect.set_up_first", "set up first");
  return collect.armed ? "" : ARM_FIRST;
}

/** Return the episode that a label or Discard refers to: the open one, else the last one seen. */
export function labelTarget(collect, seen) {
  return collect?.episode ?? seen ?? collect?.last?.uuid ?? "";
}

/** Return why no label can be given to the episode now, or "" if one can. */
export function labelProblem({ state_is: is, collect } = {}, episode) {
  if (collect?.episode && is?.run_open) return t("page.collect.stop_first", "stop and save first");
  if (!episode) return t("page.collect.no_episode", "no episode yet");
  return discarded(collect, episode) ? t("page.collect.is_discarded", "the episode is discarded") : "";
}

/** Return why the episode cannot be discarded now, or "" if it can. */
export function discardProblem({ collect } = {}, episode) {
  if (!episode) return t("page.collect.no_episode", "no episode yet");
  return discarded(collect, episode) ? t("page.collect.is_discarded_already", "the episode is discarded already") : "";
}

/** Return the arguments of Discard: an open episode is not named, because discarding ends it; any other is. */
export function discardArguments(collect, episode) {
  return collect?.episode === episode ? {} : { episode };
}

function discarded(collect, episode) {
  return collect?.last?.uuid === episode && collect.last.discarded;
}

/** Describe the leader in words: {text, weight}; the weight is "bad" if no episode can be led. */
export function leaderText(collect) {
  const { leader, source, mode } = collect ?? {};
  if (!leader) return { text: "", weight: "" };
  const over = { kind: leader.kind };
  const how = source === "node" ? t("page.collect.own_leader", "the robot's own leader") : mode === "relative" ? t("page.collect.leader_relative", "leader over {kind}, relative", over) : t("page.collect.leader", "leader over {kind}", over);
  if (leader.state === "alive") return { text: leader.rate ? t("page.collect.leader_rate", "{how}, {rate} Hz", { how, rate: leader.rate.toFixed(0) }) : how, weight: "good" };
  if (leader.state === "unknown") return { text: how, weight: "" };
  const silent = Number.isFinite(leader.age_s) ? t("page.collect.leader_silent_for", "{how}: silent for {seconds} s", { how, seconds: leader.age_s.toFixed(1) }) : t("page.collect.leader_silent", "{how}: silent", { how });
  return leader.state === "absent" ? { text: collect.set_up ? t("page.collect.leader_unheard", "{how}: not heard yet", { how }) : how, weight: collect.set_up ? "bad" : "" } : { text: silent, weight: "bad" };
}

/** Say in words whether the next episode may begin, or why not. */
export function armText({ state_is: is, collect } = {}) {
  if (!collect) return "";
  if (collect.episode && is?.going) return t("page.collect.recording", "recording");
  return collect.armed ? t("page.collect.armed_start", "armed: Start begins an episode") : collect.why_not || t("page.collect.not_armed", "not armed");
}

/** Return the step to do now; `opened` is truthy if a session is open. */
export function collectStep(snapshot, opened) {
  const { state_is: is, collect } = snapshot ?? {};
  if (!opened) return "session";
  if (is?.run_open) return "record";
  if (!is?.ready || !collect?.set_up) return "setup";
  const { last } = collect;
  return last && !last.result && !last.discarded ? "result" : "record";
}

/**
 * Confirmation of an action that cannot be undone: the first press asks, and the question stands until the same button or
 * anything else is pressed.
 */
export class Twice {
  #what = "";
  #about = "";
  #forgotten;

  /** `forgotten(what)` is called for a question that was dropped without an answer. */
  constructor(forgotten) {
    this.#forgotten = forgotten;
  }

  /** Set what questions are about from now on; a question about anything else is dropped. */
  about(subject) {
    if (subject !== this.#about) this.clear();
    this.#about = subject;
  }

  /** Return whether the question for `what` is open. */
  asks(what) {
    return what !== "" && this.#what === what;
  }

  /** Take in a press for `what`; return true if it confirms the open question. */
  press(what) {
    const again = this.asks(what);
    this.#what = again ? "" : what;
    return again;
  }

  /** Drop the open question. */
  clear() {
    const what = this.#what;
    this.#what = "";
    if (what) this.#forgotten(what);
  }
}
