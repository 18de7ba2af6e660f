// Puts the controls of the Debug page together.

import { Aim } from "./aim.js";
import { config } from "../live/config.js";
import { ManualPanel } from "./manual_panel.js";
import { ModePanel } from "../debug/mode_panel.js";
import { panels } from "../debug/panels.js";
import { robotPanel } from "../debug/robot_panel.js";
import { groupJoints } from "./targets.js";
import { TuningPanel } from "../debug/tuning_panel.js";

export function byHand(store, socket, commands) {
  const aim = new Aim((message) => socket.send(message));
  store.on("aimed", (answer) => aim.answered(answer));
  const shown = panels(document.getElementById("hand"));
  new ModePanel(store, commands, (mode) => shown.open(mode === "manual" ? "manual" : "policy"));
  new TuningPanel(store, commands);
  new ManualPanel(store, commands, aim);
  robotPanel(store, commands, aboutGripper);
  commands.provide("setup", bench);
  document.getElementById("hand").addEventListener("keydown", ({ key, target }) => {
    if (key === "Enter" && target.matches("input")) target.blur(); // applies what was typed, and frees the keys again
  });
}

/** Return the gripper joint of a group, with its unit and range; undefined if there is none. */
function aboutGripper(facts = {}, group) {
  const own = groupJoints({ units: config.units, ...facts }).find(({ name }) => name === group);
  return own?.joints.find(({ gripper }) => gripper);
}

/** Return how a simulated bench is to be laid out at set-up; {} leaves it as it is. */
function bench() {
  const seed = document.getElementById("seed");
  return seed && seed.value !== "" ? { bench: { seed: seed.valueAsNumber } } : {};
}
