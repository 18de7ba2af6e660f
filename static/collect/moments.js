// What the buttons of the Collect page mean at each moment, and why not; nothing here touches the page.

/** What the big button does now: {kind, text}. Wherever the robot moves it stops; only at rest does it start. */
export function big({ state_is: is } = {}) {
  if (is?.preparing) return { kind: "stop", text: "Cancel the set-up" };
  if (is?.run_open) return { kind: "stop", text: "Stop and save" };
  return { kind: "run", text: "Start" };
}

/** Why no episode can start, "" where the station alone decides. */
export function whyNotStart(snapshot, session) {
  const { collect } = snapshot ?? {};
  if (!collect) return "this station collects nothing";
  if (!session) return "open or resume a session first";
  if (!collect.set_up) return "set up first";
  return collect.armed ? "" : "arm first";
}

/** The episode that a label or a discarding is about: the open one, else the newest that was seen. */
export function subject(collect, seen) {
  return collect?.episode ?? seen ?? collect?.last?.uuid ?? "";
}

/** Why nothing can be said of an episode now, "" where it can. */
export function whyNotLabel({ state_is: is, collect } = {}, episode) {
  if (collect?.episode && is?.run_open) return "stop and save first";
  if (!episode) return "no episode yet";
  return discarded(collect, episode) ? "the episode is discarded" : "";
}

/** Why nothing can be discarded now, "" where it can. */
export function whyNotDiscard({ collect } = {}, episode) {
  if (!episode) return "no episode yet";
  return discarded(collect, episode) ? "the episode is discarded already" : "";
}

/** What goes with a discarding: the open episode is not named, for it ends by that; every other one is. */
export function discarding(collect, episode) {
  return collect?.episode === episode ? {} : { episode };
}

function discarded(collect, episode) {
  return collect?.last?.uuid === episode && collect.last.discarded;
}

/** What is known of who leads, in words; weight "bad" where an episode cannot be led. */
export function leaderWords(collect) {
  const { leader, source, mode } = collect ?? {};
  if (!leader) return { text: "", weight: "" };
  const rate = leader.rate ? `, ${leader.rate.toFixed(0)} Hz` : "";
  const how = source === "node" ? "the robot's own leader" : `leader over ${leader.kind}${mode === "relative" ? ", relative" : ""}`;
  if (leader.state === "alive") return { text: `${how}${rate}`, weight: "good" };
  if (leader.state === "unknown") return { text: how, weight: "" };
  const age = Number.isFinite(leader.age_s) ? ` for ${leader.age_s.toFixed(1)} s` : "";
  return leader.state === "absent" ? { text: collect.set_up ? `${how}: not heard yet` : how, weight: collect.set_up ? "bad" : "" } : { text: `${how}: silent${age}`, weight: "bad" };
}

/** The arm in words: that the next episode may begin, or why it may not. */
export function armWords({ state_is: is, collect } = {}) {
  if (!collect) return "";
  if (collect.episode && is?.going) return "recording";
  return collect.armed ? "armed: Start begins an episode" : collect.why_not || "not armed";
}

/** The step to do now. */
export function step(snapshot, opened) {
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
