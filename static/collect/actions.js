// What the buttons of the Collect page mean at each moment, and why not; nothing here touches the page.

import { t } from "../site/sentences.js";

export const ARM_FIRST = t("page.collect.arm_first", "arm first");

/** What the big button does now: {kind, text}. Wherever the robot moves it stops; only at rest does it start. */
export function primaryAction({ state_is: is } = {}) {
  if (is?.preparing) return { kind: "stop", text: t("page.collect.cancel_set_up", "Cancel the set-up") };
  if (is?.run_open) return { kind: "stop", text: t("page.collect.stop_and_save", "Stop and save") };
  return { kind: "run", text: t("page.collect.start", "Start") };
}

/** Why no episode can start, "" where the station alone decides. */
export function startProblem(snapshot, session) {
  const { collect } = snapshot ?? {};
  if (!collect) return t("page.collect.collects_nothing", "this station collects nothing");
  if (!session) return t("page.collect.open_first", "open or resume a session first");
  if (!collect.set_up) return t("page.collect.set_up_first", "set up first");
  return collect.armed ? "" : ARM_FIRST;
}

/** The episode that a label or a discarding is about: the open one, else the newest that was seen. */
export function labelTarget(collect, seen) {
  return collect?.episode ?? seen ?? collect?.last?.uuid ?? "";
}

/** Why nothing can be said of an episode now, "" where it can. */
export function labelProblem({ state_is: is, collect } = {}, episode) {
  if (collect?.episode && is?.run_open) return t("page.collect.stop_first", "stop and save first");
  if (!episode) return t("page.collect.no_episode", "no episode yet");
  return discarded(collect, episode) ? t("page.collect.is_discarded", "the episode is discarded") : "";
}

/** Why nothing can be discarded now, "" where it can. */
export function discardProblem({ collect } = {}, episode) {
  if (!episode) return t("page.collect.no_episode", "no episode yet");
  return discarded(collect, episode) ? t("page.collect.is_discarded_already", "the episode is discarded already") : "";
}

/** What goes with a discarding: the open episode is not named, for it ends by that; every other one is. */
export function discardArguments(collect, episode) {
  return collect?.episode === episode ? {} : { episode };
}

function discarded(collect, episode) {
  return collect?.last?.uuid === episode && collect.last.discarded;
}

/** What is known of who leads, in words; weight "bad" where an episode cannot be led. */
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

/** The arm in words: that the next episode may begin, or why it may not. */
export function armText({ state_is: is, collect } = {}) {
  if (!collect) return "";
  if (collect.episode && is?.going) return t("page.collect.recording", "recording");
  return collect.armed ? t("page.collect.armed_start", "armed: Start begins an episode") : collect.why_not || t("page.collect.not_armed", "not armed");
}

/** The step to do now. */
export function collectStep(snapshot, opened) {
  const { state_is: is, collect } = snapshot ?? {};
  if (!opened) return "session";
  if (is?.run_open) return "record";
  if (!is?.ready || !collect?.set_up) return "setup";
  const { last } = collect;
  return last && !last.result && !last.discarded ? "result" : "record";
}

/** Something that cannot be taken back is asked about once: that stands until it is pressed again, or anything else is. */
export class Twice {
  #what = "";
  #about = "";
  #forgotten;

  /** `forgotten(what)` hears of a question that was not answered. */
  constructor(forgotten) {
    this.#forgotten = forgotten;
  }

  /** What is asked about from now on: a question about anything else is forgotten. */
  about(subject) {
    if (subject !== this.#about) this.clear();
    this.#about = subject;
  }

  /** Whether `what` is being asked about at the moment. */
  asks(what) {
    return what !== "" && this.#what === what;
  }

  /** Press for `what`; true where that was the second time. */
  press(what) {
    const again = this.asks(what);
    this.#what = again ? "" : what;
    return again;
  }

  /** Forget what was asked. */
  clear() {
    const what = this.#what;
    this.#what = "";
    if (what) this.#forgotten(what);
  }
}
