// Grippers with their state, and what the drives say of themselves.

import { digitsOf, withUnit } from "../curves/units.js";

const KEYS = [
  { open: ",", close: ".", lock: "-" },
  { open: "shift+o", close: "shift+c", lock: "shift+l" },
];

/** Where a gripper is, in words; `about` has its unit and its range. */
export function gripperWords({ locked, at }, about = {}) {
  const place = Number.isFinite(at) ? `at ${withUnit(at.toFixed(digitsOf(about)), about.unit)}` : "";
  return locked ? `locked ${place}`.trim() : place || "not known";
}

/** What the drives say: {text, weight}. */
export function driveWords(drives) {
  if (!drives || drives.enabled === undefined) return { text: "This robot does not report them.", weight: "" };
  if (drives.faults?.length) return { text: `Fault: ${drives.faults.join(", ")}`, weight: "bad" };
  return drives.enabled ? { text: "enabled, no fault", weight: "good" } : { text: "disabled: the robot does not follow", weight: "warn" };
}

/** Keeps the panel true; `about(facts, name)` is what is known of the gripper of the group `name`. */
export function robotPanel(store, commands, about) {
  const list = document.getElementById("grippers");
  const rows = new Map();
  store.on("snapshot", ({ grippers = {}, drives, facts }) => {
    const names = Object.keys(grippers);
    if (names.join() !== [...rows.keys()].join()) build(list, rows, names, commands);
    for (const [name, row] of rows) draw(row, grippers[name], about(facts, name));
    drawDrives(driveWords(drives));
  });
}

function build(list, rows, names, commands) {
  rows.clear();
  const template = document.getElementById("gripper-row").content;
  names.forEach((name, index) => {
    const row = template.cloneNode(true).firstElementChild;
    row.querySelector(".gripper-name").textContent = name.replaceAll("_", " ");
    for (const button of row.querySelectorAll("button")) named(button, name, KEYS[index]);
    rows.set(name, row);
  });
  if (names.length) list.replaceChildren(...rows.values());
  else list.firstElementChild.textContent = "This robot has no gripper that opens and closes.";
  commands.gate();
}

function named(button, arm, keys) {
  const { grip } = button.dataset;
  button.dataset.args = JSON.stringify({ arm, action: grip });
  if (!keys) return;
  button.dataset.key = keys[grip];
  button.dataset.keyText = `Gripper ${arm}: ${grip === "lock" ? "lock or unlock" : grip}`;
  const cap = document.createElement("kbd");
  cap.textContent = keys[grip].replace(/^shift\+(.)$/, (_, key) => `⇧${key.toUpperCase()}`);
  button.append(" ", cap);
}

function draw(row, gripper, about) {
  const state = row.querySelector(".gripper-state");
  const said = gripperWords(gripper, about);
  if (state.textContent !== said) state.textContent = said;
  state.dataset.locked = String(Boolean(gripper.locked));
  const lock = row.querySelector('[data-grip="lock"]');
  const action = gripper.locked ? "unlock" : "lock";
  const args = JSON.parse(lock.dataset.args);
  if (args.action === action) return;
  lock.dataset.args = JSON.stringify({ ...args, action });
  lock.firstChild.textContent = gripper.locked ? "Unlock" : "Lock";
}

function drawDrives({ text, weight }) {
  const [said, warning] = ["said", "warn"].map((name) => document.querySelector(`[data-drives="${name}"]`));
  said.textContent = text;
  said.className = `small ${weight}`;
  const bad = weight === "bad" || weight === "warn";
  warning.hidden = !bad;
  warning.className = `small note note-${weight}`;
  warning.textContent = bad ? `Drives: ${text}` : "";
}
