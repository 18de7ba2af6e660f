// Words for what the station says; the states, what they mean (`state_is`) and what is allowed in them are the runtime's.

const ADVICE = {
  away: {
    title: "No complete picture of the robot",
    advice: "Start the execution node; check the cameras that are grey.",
    buttons: [],
  },
  held: {
    title: "The robot holds",
    advice: "Look at the bench first.",
    buttons: ["resume", "stop"],
  },
  latched: {
    title: "E-stop is latched",
    advice: "After the release, set up again.",
    buttons: ["release"],
  },
};

/** What a state asks of the person at the bench; undefined where the station can be left alone. */
export function advice({ connected, held, latched }) {
  return latched ? ADVICE.latched : held ? ADVICE.held : connected === false ? ADVICE.away : undefined;
}

/** Why the server closes the socket of a page, by its code. */
export const CLOSED = {
  4401: { word: "logged out", reason: "You are logged out: reload this page and log in again." },
  4404: { word: "no such station", reason: "This station is not in the lab any more: go back to the list of stations." },
};

export const VERBS = {
  setup: "Set up",
  run: "Run",
  stop: "Stop",
  halt: "Pause",
  resume: "Resume",
  home: "Home",
  release: "Release",
  record_start: "Start recording",
  record_stop: "End recording",
  estop: "E-stop",
  tune: "Apply",
  step: "Next chunk",
  commit: "Commit",
  cancel: "Cancel",
  move: "Send",
  gripper: "Gripper",
  approach: "Approach",
  arm: "Arm",
  disarm: "Disarm",
  label: "Result",
  discard: "Discard",
  lease_claim: "Station taken",
  lease_give_up: "Station given up",
};

export function words(state) {
  return state.replaceAll("_", " ");
}

export function verb(kind) {
  return VERBS[kind] ?? words(kind);
}

export function duration(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

export function age(seconds) {
  if (!Number.isFinite(seconds)) return "never seen";
  if (seconds < 1) return `${Math.round(seconds * 1000)} ms`;
  return seconds < 100 ? `${seconds.toFixed(1)} s` : `${Math.round(seconds / 60)} min`;
}

/** A figure with its unit, or a dash where there is none. */
export function figure(value, digits, unit) {
  return Number.isFinite(value) ? `${value.toFixed(digits)} ${unit}` : `– ${unit}`;
}
