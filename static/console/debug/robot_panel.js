// Grippers with their state, and what the drives report.

import { digitsOf, withUnit } from "../curves/units.js";
import { t } from "../../site/sentences.js";

const KEYS = [
  { open: ",", close: ".", lock: "-" },
  { open: "shift+o", close: "shift+c", lock: "shift+l" },
];

/** Return where a gripper is, in words; `about` has its unit and range. */
export function gripperWords({ locked, at }, about = {}) {
  const place = Number.isFinite(at) ? t("page.robot.at", "at {where}", { where: withUnit(at.toFixed(digitsOf(about)), about.unit) }) : "";
  if (!locked) return place || t("page.robot.unknown", "not known");
  return place ? t("page.robot.locked_at", "locked {place}", { place }) : t("page.robot.locked", "locked");
}

/** Return what the drives report: {text, weight}. */
export function driveWords(drives) {
  if (!drives || drives.enabled === undefined) return { text: t("page.robot.no_report", "This robot does not report them."), weight: "" };
  if (drives.faults?.length) return { text: t("page.robot.fault", "Fault: {faults}", { faults: drives.faults.join(", ") }), weight: "bad" };
  return drives.enabled ? { text: t("page.robot.enabled", "enabled, no fault"), weight: "good" } : { text: t("page.robot.disabled", "disabled: the robot does not follow"), weight: "warn" };
}

/** Keep the panel up to date; `about(facts, name)` returns unit and range of the gripper of the group `name`. */
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
  else list.firstElementChild.textContent = t("page.robot.no_gripper", "This robot has no gripper that opens and closes.");
  commands.gate();
}

function named(button, arm, keys) {
  const { grip } = button.dataset;
  button.dataset.args = JSON.stringify({ arm, action: grip });
  if (!keys) return;
  button.dataset.key = keys[grip];
  button.dataset.keyText = {
    open: t("page.robot.open_key", "Gripper {arm}: open", { arm }),
    close: t("page.robot.close_key", "Gripper {arm}: close", { arm }),
    lock: t("page.robot.lock_key", "Gripper {arm}: lock or unlock", { arm }),
  }[grip];
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
  lock.firstChild.textContent = gripper.locked ? t("page.robot.unlock", "Unlock") : t("page.robot.lock", "Lock");
}

function drawDrives({ text, weight }) {
  const [said, warning] = ["said", "warn"].map((name) => document.querySelector(`[data-drives="${name}"]`));
  said.textContent = text;
  said.className = `small ${weight}`;
  const bad = weight === "bad" || weight === "warn";
  warning.hidden = !bad;
  warning.className = `small note note-${weight}`;
  warning.textContent = bad ? t("page.robot.drives", "Drives: {text}", { text }) : "";
}
