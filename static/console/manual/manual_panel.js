// Moving by hand: a target made with sliders, numbers, named poses and steps of the end effector, shown as a ghost, and sent.

import { config } from "../live/config.js";
import { groupButtons } from "./group_buttons.js";
import { JointRows } from "./joint_rows.js";
import { isAtTarget, groupJoints, tipPositionText, jogArguments, initialTarget, aimText } from "./targets.js";
import { t } from "../../site/sentences.js";

export class ManualPanel {
  #store;
  #commands;
  #aim;
  #names = ""; // names of the joints for which fields exist
  #groups = [];
  #group = 0;
  #target = null; // [D] where the robot would be sent
  #pose = ""; // named pose that equals the target, until the target is changed
  #edited = false; // while false, the target follows the robot
  #held = new Set(); // grippers that are part of the target; the others stay as their own buttons have set them
  #sent = null; // identifies the last press of Send while the target is where the robot was sent
  #clipped = ""; // how the last edit was limited, in words
  #rows;
  #steps = Promise.resolve(); // steps of the end effector, one after the other
  #poses = document.getElementById("pose");
  #speed = document.getElementById("speed");

  constructor(store, commands, aim) {
    this.#store = store;
    this.#commands = commands;
    this.#aim = aim;
    this.#rows = new JointRows((index, value, said) => this.#typed(index, value, said));
    document.getElementById("panel-manual").addEventListener("click", (event) => this.#clicked(event));
    document.getElementById("jog-settings").addEventListener("submit", (event) => event.preventDefault());
    this.#poses.addEventListener("change", () => this.#toPose());
    this.#speed.addEventListener("change", () => this.#look());
    commands.provide("move", () => this.#move());
    store.on("snapshot", (snapshot) => this.#follow(snapshot));
    store.on("joints", () => this.#fromRobot());
    store.on("second", () => this.#look()); // the distance shrinks while the robot moves
    document.addEventListener("eva:panel", () => this.#look());
    this.how("joints");
  }

  /** Show the controls for moving by "joints" or by steps of the "hand". */
  how(name) {
    for (const button of document.querySelectorAll("[data-how]")) button.setAttribute("aria-pressed", String(button.dataset.how === name));
    for (const panel of document.querySelectorAll("[data-how-panel]")) panel.hidden = panel.dataset.howPanel !== name;
  }

  #clicked(event) {
    const { how, group, jog: step, target } = event.target.closest("button")?.dataset ?? {};
    if (how) this.how(how);
    else if (group) this.#choose(Number(group));
    else if (step) this.#jog(step[0], step[1] === "+" ? 1 : -1, "turn" in event.target.closest("button").dataset);
    else if (target === "robot") this.reset();
    else if (target === "next" || target === "previous") this.#rows.focus(target === "next" ? 1 : -1);
  }

  #move() {
    this.#sent = {};
    const speed = Number(this.#speed.value);
    return this.#pose ? { pose: this.#pose, speed } : { joints: this.#moved, speed };
  }

  /** The target, with null for each gripper that stays as it is: the station knows better where that is. */
  get #moved() {
    return this.#target.map((value, index) => (this.#grippers.includes(index) && !this.#held.has(index) ? null : value));
  }

  /** Put the target where the robot is and let it follow the robot. */
  reset(said = t("page.manual.at_robot", "The target is where the robot is.")) {
    this.#edited = false;
    this.#sent = null;
    this.#held.clear();
    this.#pose = this.#clipped = "";
    this.#poses.selectedIndex = 0;
    this.#aim.clear();
    this.#fromRobot();
    this.#say(said);
  }

  #follow({ facts, state_is: is, mode, run }) {
    if (facts?.joint_names && facts.joint_names.join() !== this.#names) this.#build(facts);
    const elsewhere = is.preparing || is.latched || (run?.number && mode !== "manual");
    if (elsewhere && this.#edited) this.reset(); // a target meant for an earlier situation must not be sent by accident
    const send = document.querySelector('[data-command="move"]');
    send.dataset.blocked = this.#edited ? "" : t("page.manual.no_target", "the target is where the robot is: move a slider, take a step, or choose a pose");
  }

  #build(facts) {
    this.#names = facts.joint_names.join();
    this.#groups = groupJoints({ units: config.units, ...facts });
    this.#target = null;
    this.#edited = false;
    const poses = (facts.poses ?? []).map((name) => new Option(name));
    const none = new Option(poses.length ? t("page.manual.pose", "pose") : t("page.manual.no_pose", "no pose"), "");
    none.disabled = true;
    this.#poses.replaceChildren(none, ...poses);
    this.#poses.disabled = !poses.length;
    this.#poses.selectedIndex = 0;
    this.#choose(0);
    this.#fromRobot();
    this.#say(t("page.manual.at_robot", "The target is where the robot is."));
  }

  #choose(group) {
    this.#group = group;
    const buttons = groupButtons(this.#groups, group);
    document.getElementById("groups").replaceChildren(...buttons);
    document.querySelector(".target-head").toggleAttribute("data-many", buttons.length > 2);
    this.#rows.build(this.#groups[group].joints);
    const hand = this.#arm !== undefined;
    document.querySelector('[data-target="no-hand"]').hidden = hand;
    for (const button of document.querySelectorAll("[data-jog]")) button.setAttribute("aria-disabled", String(!hand));
    this.#show();
    if (this.#edited) this.#look();
    else part("at").textContent = "";
  }

  get #arm() {
    const { name } = this.#groups[this.#group];
    return this.#store.snapshot.facts.arms.find((arm) => arm === name);
  }

  #fromRobot() {
    const { joints } = this.#store;
    if (!joints || !this.#groups.length || joints.measured.length !== this.#dim) return;
    this.#rows.now(joints.measured);
    const now = initialTarget(joints);
    if (!this.#edited) this.#target = now;
    else for (const index of this.#grippers) if (!this.#held.has(index)) this.#target[index] = now[index];
    this.#show();
  }

  get #dim() {
    return this.#store.snapshot.facts.joint_names.length;
  }

  get #grippers() {
    return this.#store.snapshot.facts.gripper_dims;
  }

  #show() {
    if (this.#target) this.#rows.show(this.#target);
  }

  #typed(index, value, said) {
    if (!this.#target) return;
    this.#target[index] = value;
    if (this.#grippers.includes(index)) this.#held.add(index);
    this.#changed();
    this.#clipped = said;
    this.#look();
  }

  #changed(pose = "") {
    this.#edited = true;
    this.#sent = null;
    this.#clipped = "";
    this.#pose = pose;
    if (!pose) this.#poses.selectedIndex = 0;
    this.#follow(this.#store.snapshot);
    this.#commands.gate();
  }

  /** Ask the station about the target and show the answer, if this panel is shown. */
  #look() {
    if (!this.#edited) return;
    if (document.getElementById("panel-manual").hidden) this.#aim.clear();
    else {
      const sent = this.#sent;
      this.#aim.follow({ joints: this.#target }, (answer) => this.#heard(answer, sent));
    }
  }

  /**
   * Show an answer. `sent` is the press of Send before this request; an answer requested before the press does not prove
   * arrival.
   */
  #heard(answer, sent = null) {
    if (sent && sent === this.#sent && answer.ok && isAtTarget(answer)) {
      this.reset(t("page.manual.arrived", "The robot has arrived."));
      return;
    }
    const { text, weight } = aimText(answer, Number(this.#speed.value));
    this.#say(`${text} ${this.#clipped}`.trim(), this.#clipped ? "warn" : weight);
    part("at").textContent = tipPositionText(answer.poses, this.#store.snapshot.facts.arms.indexOf(this.#arm));
  }

  async #toPose() {
    const pose = this.#poses.value;
    const answer = await this.#aim.ask({ pose });
    if (answer.ok) {
      this.#held = new Set(this.#grippers);
      this.#take(answer.joints, pose);
    }
    this.#heard(answer);
  }

  #jog(axis, sign, turned) {
    const settings = document.getElementById("jog-settings").elements;
    const [mm, degrees] = [Number(settings.mm.value), Number(settings.degrees.value)];
    if (this.#arm === undefined || !this.#target) return;
    const step = jogArguments({ arm: this.#arm, frame: settings.frame.value, axis, sign, turned, mm, degrees });
    this.#steps = this.#steps.then(() => this.#stepped(step));
  }

  /** Take a step; if it cannot be reached, target and ghost stay where they were. */
  async #stepped(step) {
    const answer = await this.#aim.ask({ joints: this.#target, jog: step });
    const reached = answer.ok && answer.reached !== false;
    if (reached) this.#take(answer.joints);
    this.#heard(answer);
    if (!reached && this.#edited) await this.#aim.ask({ joints: this.#target });
    else if (!reached) this.#aim.clear();
  }

  #take(joints, pose = "") {
    this.#target = [...joints];
    this.#changed(pose);
    this.#show();
  }

  #say(text, weight = "") {
    const line = part("said");
    line.textContent = text;
    line.dataset.weight = weight;
  }
}

function part(name) {
  return document.querySelector(`[data-target="${name}"]`);
}
